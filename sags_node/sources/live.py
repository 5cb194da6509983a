"""Live stereo: keeps capture devices open, splits their images into eyes, and pairs these by stamps.

A device that fails or falls silent is closed and opened again, until `stop`.
"""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from sags_node.config.schema import GstSource, V4l2Source
from sags_node.errors import SagsError, UsageError
from sags_node.sources.layout import Layout
from sags_node.sources.pairing import Alternation, LivePairs, Picture, Shot
from sags_node.sources.pictures import judge_pixels
from sags_node.types import U8, Side
from sags_node.workers import go_on

log = logging.getLogger(__name__)

POLL_S = 0.1  # s until a reading thread notices `stop`
CLOSE_S = 5.0  # s that a driver may block a reading thread
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 5.0  # s between attempts to open a device again


class EndedError(Exception):
    """A file was played to its end: no more images will come."""


class CaptureDevice(Protocol):
    """A device that delivers images.

    Attributes:
        rate: Hz.
        size: of an image, width and height, px.
    """

    rate: float
    size: tuple[int, int]

    def read(self, timeout: float) -> Shot | None:
        """Return the next image; None when none comes within `timeout` seconds.

        Raises:
            SagsError: the device is lost, and should be opened again.
            EndedError: it was a file, and has ended.
        """

    def close(self) -> None: ...


class Input(NamedTuple):
    """One device of a live source."""

    name: str
    side: Side | None  # the eye whose images it delivers; None: both
    open: Callable[[], CaptureDevice]
    deadline: float  # s without an image before it is opened again


class LiveStereo(LivePairs):
    """A `Source` of live stereo frames from devices.

    Attributes:
        pixel_aspect: width of a pixel over its height.

    Args:
        inputs: one device for both eyes, or one for each.
        config: geometry of the images, and tolerance of pairs.
        size: width and height that an eye's images must have, px; None: any.

    Raises:
        UsageError: the images do not fit the geometry or `size`.
        SagsError: a device is missing or cannot be opened.
    """

    def __init__(
        self, inputs: Sequence[Input], config: V4l2Source | GstSource, size: tuple[int, int] | None = None
    ) -> None:
        super().__init__(config.pair_tolerance_ms, config.latency_ms)
        self._layout = Layout(config.geometry)
        self._size = size
        self.pixel_aspect = 1.0
        self._alternation: Alternation | None = None
        self._readers: list[DeviceReader] = []
        try:
            for one in inputs:
                self._readers.append(DeviceReader(one, self._checked, self._put, self.stopped))
        except SagsError:
            self.close()
            raise
        for finding in judge_pixels(self.pixel_aspect):
            log.warning("%s; %s", finding.what, finding.fix)
        self.rate = self._readers[0].rate
        if self._layout.is_sequential:
            self._alternation = Alternation(1e9 / self.rate)
            self.rate /= 2
            log.warning(
                "source.geometry.layout frame_sequential: nothing tells which eye the first image shows; "
                "look at them with sags calib live, and exchange them with source.geometry.first"
            )

    @property
    def dropped(self) -> int:
        """The number of images without a partner, and of pairs that are no newer than the one before."""
        return super().dropped + (self._alternation.alone if self._alternation else 0)

    def start(self) -> None:
        for reader in self._readers:
            reader.start()

    def close(self) -> None:
        for reader in self._readers:
            reader.close()

    def _checked(self, one: Input) -> CaptureDevice:
        """Open a device, and check that its images have the size of the rig or of the first images."""
        device = one.open()
        try:
            size = self._layout.size(*device.size, one.name)
            self.pixel_aspect = self._layout.pixel_aspect(*device.size, 1.0)
            if self._size is not None and self._size != size:
                raise UsageError(
                    f"{one.name}: the images of an eye are {size[0]}x{size[1]} px but should be "
                    f"{self._size[0]}x{self._size[1]}, as the calibration and the other eye are; set the "
                    "size at the source, or source.geometry.crop"
                )
        except SagsError:
            device.close()
            raise
        self._size = size
        return device

    def _put(self, picture: Shot | None, side: Side | None) -> None:
        """Take an image in; None: there are no more."""
        if picture is None:
            self.end()
            return
        side = picture.side or side
        if side is not None:
            self.add(side, _of(picture, self._layout.eye(picture.image, side)))
        elif self._alternation is None:
            left, right = self._layout.eyes(picture.image)
            self.add_both(_of(picture, left), _of(picture, right))
        elif (joined := self._alternation.add(picture)) is not None:
            left, right = self._layout.in_turn(joined[0].image, joined[1].image)
            shots = joined if self._layout.order[0] == "left" else joined[::-1]
            self.add_both(_of(shots[0], left), _of(shots[1], right))


def _of(shot: Shot, image: U8) -> Picture:
    """One eye's image, with the stamps of the delivered one."""
    return Picture(shot.t_ns, image, shot.device_ns or 0, shot.arrival_ns)


class DeviceReader:
    """Reads one device in a thread of its own, and opens it again whenever it is lost."""

    def __init__(
        self,
        one: Input,
        open_device: Callable[[Input], CaptureDevice],
        put: Callable[[Shot | None, Side | None], None],
        stopped: threading.Event,
    ) -> None:
        self._input = one
        self._open_device = open_device
        device = open_device(one)
        self._device: CaptureDevice | None = device
        self._put = put
        self._stopped = stopped
        self._pause = FIRST_PAUSE_S  # s before the next attempt to open it
        turn = self._read, stopped, one.name
        self._thread = threading.Thread(target=go_on, args=turn, name=f"read {one.name}", daemon=True)
        self.rate = device.rate

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Wait until the thread has noticed `stopped`, and close the device."""
        if self._thread.ident is not None:
            self._thread.join(CLOSE_S)
        if self._thread.is_alive():  # closing a device while it is read would crash
            log.warning(
                "%s: its driver does not answer; it is left open until this process ends", self._input.name
            )
            return
        self._close_device()

    def _close_device(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _read(self) -> bool:
        """Open the device if needed, and read it until it is lost; False: no more images will come."""
        try:
            if self._device is None:
                self._device = self._open_device(self._input)
                log.warning("%s is open again", self._input.name)
            if self._read_until_lost(self._device) > 0:
                self._pause = FIRST_PAUSE_S
        except EndedError:
            self._put(None, None)
            return False
        except SagsError as error:
            if not self._stopped.is_set():
                log.warning("%s; next attempt in %.1f s", error, self._pause)
        finally:
            self._close_device()
        self._stopped.wait(self._pause)
        self._pause = min(2 * self._pause, LONGEST_PAUSE_S)
        return True

    def _read_until_lost(self, device: CaptureDevice) -> int:
        """Pass images on until the device fails, falls silent, or `stopped` is set; return their number."""
        count, name, deadline = 0, self._input.name, self._input.deadline
        last = time.monotonic()
        while not self._stopped.is_set():
            try:
                picture = device.read(min(POLL_S, deadline))
            except SagsError as error:
                log.warning("%s; it will be opened again", error)
                break
            if picture is not None:
                self._put(picture, self._input.side)
                count += 1
                last = time.monotonic()
            elif time.monotonic() - last > deadline:
                log.warning("%s: no new image for %g s; it will be opened again", name, deadline)
                break
        return count
