"""Live stereo from V4L2: two cameras paired by their stamps, or one that delivers both eyes side by side.

Cameras come and go: a device that fails or falls silent is closed and opened again, until `stop`.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from types import TracebackType
from typing import Protocol, Self

from sags_node.config import V4l2Source
from sags_node.errors import SagsError, UsageError
from sags_node.sources.device import Device, Picture
from sags_node.sources.live_pairs import LivePairs
from sags_node.sources.videos import side_by_side_boxes
from sags_node.types import StereoFrame

log = logging.getLogger(__name__)

POLL_S = 0.1  # how soon a reading thread notices `stop`
CLOSE_S = 5.0  # a driver may take to give a reading thread back
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 5.0  # between attempts to open a device again


class CaptureDevice(Protocol):
    """What `device.Device` offers."""

    rate: float

    def read(self, timeout: float) -> Picture | None: ...

    def close(self) -> None: ...


class StereoCameras:
    """A `Source` of live stereo frames.

    `frame_id` counts the left eye's pictures, so a left picture that found no partner leaves a gap. `epoch`
    grows when the wall clock is set back.

    Args:
        config: devices, size, rate, and how far apart the stamps of a pair may be.
        open_device: opens one camera.

    Raises:
        UsageError: the devices named cannot make a stereo pair.
        SagsError: a device is missing, cannot be opened, or gives another size.
    """

    frame_count: int | None = None

    def __init__(
        self, config: V4l2Source, open_device: Callable[[str, V4l2Source], CaptureDevice] = Device
    ) -> None:
        self._pairs = LivePairs(config.pair_tolerance_ms, config.latency_ms)
        self._readers: list[DeviceReader] = []
        if config.side_by_side is not None:
            self._halves = side_by_side_boxes(config.width, config.height, config.side_by_side, config.left)
            eyes = [(config.left, self._put_halves)]
        else:
            eyes = [
                (config.left, partial(self._pairs.put, "left")),
                (_right_path(config), partial(self._pairs.put, "right")),
            ]
        try:
            for path, put in eyes:
                device = open_device(path, config)
                self._readers.append(
                    DeviceReader(path, config, open_device, device, put, self._pairs.stopped)
                )
        except SagsError:
            self._close()
            raise
        self.rate = self._readers[0].rate

    @property
    def dropped(self) -> int:
        """Pictures of either eye that found no partner."""
        return self._pairs.unpaired

    def __enter__(self) -> Self:
        for reader in self._readers:
            reader.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        self._close()

    def _close(self) -> None:
        for reader in self._readers:
            reader.close()

    def stop(self) -> None:
        """End the iteration; any thread may call this."""
        self._pairs.stop()

    def __iter__(self) -> Iterator[StereoFrame]:
        """Pairs as they arrive, until `stop`; silent while a camera is away."""
        return iter(self._pairs)

    def _put_halves(self, picture: Picture) -> None:
        left, right = (picture.image[y : y + h, x : x + w].copy() for x, y, w, h in self._halves)
        self._pairs.put_both(picture._replace(image=left), picture._replace(image=right))


class DeviceReader:
    """Keeps one device read in a thread of its own, and opens it again whenever it is lost."""

    def __init__(
        self,
        path: str,
        config: V4l2Source,
        open_device: Callable[[str, V4l2Source], CaptureDevice],
        device: CaptureDevice,
        put: Callable[[Picture], None],
        stopped: threading.Event,
    ) -> None:
        self._path = path
        self._config = config
        self._open_device = open_device
        self._device: CaptureDevice | None = device
        self._put = put
        self._stopped = stopped
        self._thread = threading.Thread(target=self._run, name=f"read {path}", daemon=True)
        self.rate = device.rate

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Wait for the thread, which `stopped` ends, and close the device."""
        if self._thread.ident is not None:
            self._thread.join(CLOSE_S)
        if self._thread.is_alive():  # to close a device under its reader would crash
            log.warning("%s: its driver does not answer; it is left open until this process ends", self._path)
            return
        self._close_device()

    def _close_device(self) -> None:
        if self._device is not None:
            self._device.close()
            self._device = None

    def _run(self) -> None:
        pause = FIRST_PAUSE_S
        while not self._stopped.is_set():
            if self._device is not None:
                if self._read_until_lost(self._device) > 0:
                    pause = FIRST_PAUSE_S
                self._close_device()
            if self._stopped.wait(pause):
                return
            pause = min(2 * pause, LONGEST_PAUSE_S)
            try:
                self._device = self._open_device(self._path, self._config)
                log.warning("%s is open again", self._path)
            except SagsError as error:
                log.warning("%s; next attempt in %.1f s", error, pause)

    def _read_until_lost(self, device: CaptureDevice) -> int:
        """Hand on pictures until the device fails or falls silent, or `stopped`; how many there were."""
        count = 0
        last = time.monotonic()
        while not self._stopped.is_set():
            try:
                picture = device.read(min(POLL_S, self._config.deadline))
            except SagsError as error:
                log.warning("%s; it will be opened again", error)
                break
            if picture is not None:
                self._put(picture)
                count += 1
                last = time.monotonic()
            elif time.monotonic() - last > self._config.deadline:
                log.warning(
                    "%s: no new picture for %g s; it will be opened again", self._path, self._config.deadline
                )
                break
        return count


def _right_path(config: V4l2Source) -> str:
    if config.right is None:
        raise UsageError("source.right names no camera; name one, or set source.side_by_side")
    if os.path.realpath(config.left) == os.path.realpath(config.right):
        raise UsageError(f"source.left and source.right are the same camera, {config.right}")
    return config.right
