"""Live stereo from GStreamer: runs the user's launch string in a process of its own.

A pipeline has one clock and one base time for all its images. The source stamps each image on that clock.
The stamp, converted to the wall clock, is the capture time. Live pipelines drop late images at each step;
files are played at their own rate, to their end.
"""

import logging
import mmap
import os
import time
from collections import deque
from typing import Any

import numpy as np

from sags_node.config.schema import GstSource
from sags_node.errors import SagsError
from sags_node.sources.gst_process import GstProcess
from sags_node.sources.layout import Layout
from sags_node.sources.live import EndedError, Input, LiveStereo
from sags_node.sources.pairing import Shot
from sags_node.types import Samples, Side

log = logging.getLogger(__name__)

DEFAULT_RATE = 30.0  # Hz, of pipelines that do not tell theirs
OLD_NS = 1_000_000_000  # ns: consumers refuse older images, so they are worth a warning
POLL_S = 0.1
# `queue` gives each eye a thread of its own. `videoconvert` converts from all formats and colour spaces, and
# does nothing if the launch string ends in this format already.
TAIL = (
    "queue name={name} max-size-buffers=3 max-size-bytes=0 max-size-time=0 ! "
    "videoconvert n-threads=1 dither=none ! video/x-raw,format={format} ! "
    "appsink name={name}_sink max-buffers=1"
)
RGB, DEEP = "RGB", "ARGB64_LE"
SIDES: dict[str, Side | None] = {"left": "left", "right": "right", "both": None}


def open_pipeline(config: GstSource, size: tuple[int, int] | None = None) -> LiveStereo:
    """Start the pipeline of a launch file.

    Args:
        size: width and height that an eye's images must have, px.

    Raises:
        UsageError: its images do not fit the geometry or `size`.
        SagsError: GStreamer is not installed, the pipeline is wrong, or no image comes in time.
    """
    only = Input("GStreamer", None, lambda: Pipeline(config), config.deadline)
    return LiveStereo([only], config, size)


def whole_launch(config: GstSource) -> tuple[str, list[str]]:
    """Return the launch string with sinks appended, and their names: left and right, or both."""
    # More than 8 bits help only where `levels` selects a range of them.
    wanted = RGB if config.geometry.levels == (0.0, 1.0) else DEEP
    left, right, both = (TAIL.format(name=name, format=wanted) for name in SIDES)
    if config.launch is None:
        return f"{config.left} ! {left}  {config.right} ! {right}", ["left", "right"]
    if config.geometry.layout == "separate":
        return f"{config.launch}  {left}  {right}", ["left", "right"]
    return f"{config.launch} ! {both}", ["both"]


class Pipeline:
    """A running pipeline as a capture device: delivers single images of either eye, or of both in one.

    Raises:
        SagsError: GStreamer is not installed, the pipeline is wrong, or no image comes in time.
    """

    def __init__(self, config: GstSource) -> None:
        launch, names = whole_launch(config)
        self._deadline = config.deadline
        self._sinks = [Sink(name) for name in names]
        self._arrived: deque[Shot] = deque()
        self._plays = False
        self._process = GstProcess({"launch": launch, "sinks": names})
        try:
            self._wait_for_pictures(config.start)
            self._check(config)
        except BaseException:
            self.close()
            raise
        self.size = self._sinks[0].size
        self.rate = self._sinks[0].rate or DEFAULT_RATE

    def _wait_for_pictures(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while missing := [sink.name for sink in self._sinks if not sink.has_begun]:
            self._take_in(POLL_S)
            if time.monotonic() > until:
                raise SagsError(
                    f"GStreamer: no image of {' and '.join(missing)} within {seconds:g} s; is the camera "
                    "on? A source that takes longer needs a longer source.start"
                )

    def _check(self, config: GstSource) -> None:
        one, other = self._sinks[0], self._sinks[-1]
        if one.size != other.size:
            raise SagsError(
                f"GStreamer: the left eye's images are {one.size[0]}x{one.size[1]} px but the right eye's "
                f"{other.size[0]}x{other.size[1]}; both eyes need one size"
            )
        if one.interlaced and not Layout(config.geometry).takes_fields:
            log.warning(
                "GStreamer: the images are interlaced, so what moves is torn; add ! deinterlace fields=top "
                "to the launch string, or set source.geometry.deinterlace"
            )

    def read(self, timeout: float) -> Shot | None:
        """Return the next image; None when none comes within `timeout` seconds.

        Raises:
            SagsError: the pipeline failed, or one eye's images have ceased.
            EndedError: a file was played to its end.
        """
        if not self._plays:
            self._process.start()
            self._plays = True
            for sink in self._sinks:
                sink.seen = time.monotonic()
        if not self._arrived:
            self._take_in(timeout)
        silent = min(self._sinks, key=lambda sink: sink.seen)
        if time.monotonic() - silent.seen > self._deadline:
            raise SagsError(f"GStreamer: no new image of {silent.name} for {self._deadline:g} s")
        return self._arrived.popleft() if self._arrived else None

    def _take_in(self, timeout: float) -> None:
        """Handle one message of the process, if one comes in time."""
        heard = self._process.hear(timeout)
        if heard is None:
            return
        said, descriptors = heard
        if "ended" in said:
            if self._sinks[0].live:
                raise SagsError("GStreamer: the stream has ended")
            raise EndedError
        sink = self._sinks[said["sink"]]
        if descriptors:
            sink.begin(said, descriptors[0])
            return
        picture = sink.take(said)
        self._process.release(said["sink"], said["slot"])
        if picture is not None:
            self._arrived.append(picture)

    def close(self) -> None:
        self._process.close()


class Sink:
    """The images of one sink, in memory shared with the process."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.seen = time.monotonic()  # when the last image came
        self.running_ns = -1  # its stamp on the pipeline's clock
        self.has_begun = False
        self._warned_old = self._warned_still = False

    def begin(self, said: dict[str, Any], descriptor: int) -> None:
        """Take in the format of the images, and map their shared memory."""
        self.has_begun = True
        self.size = said["width"], said["height"]
        self.rate, self.interlaced, self.live = said["rate"], said["interlaced"], said["live"]
        self._dtype = np.dtype("<u2") if said["format"] == DEEP else np.dtype(np.uint8)
        self._channels = 4 if said["format"] == DEEP else 3
        self._row = said["row"]  # bytes
        self._memory = mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ)
        os.close(descriptor)

    def take(self, said: dict[str, Any]) -> Shot | None:
        """Copy an image out of its slot, which is written again; None if its stamp is not newer."""
        if said["running_ns"] <= self.running_ns:
            if not self._warned_still:
                log.warning(
                    "GStreamer: the stamps of %s do not rise (%.3f s after %.3f s); such images are left "
                    "out; does the source stamp them (do-timestamp=true)?",
                    *(self.name, said["running_ns"] * 1e-9, self.running_ns * 1e-9),
                )
            self._warned_still = True
            return None
        self.running_ns = said["running_ns"]
        self.seen = time.monotonic()
        if said["age_ns"] > OLD_NS and not self._warned_old:
            log.warning(
                "GStreamer: the images of %s are %.1f s old when they come; make the launch string hold "
                "fewer back (queue leaky=downstream max-size-buffers=1, rtspsrc latency=0)",
                *(self.name, said["age_ns"] * 1e-9),
            )
            self._warned_old = True
        (width, height), bytes_each = self.size, self._dtype.itemsize
        whole: Samples = np.ndarray(
            (height, width, self._channels),
            self._dtype,
            self._memory,
            offset=said["slot"] * height * self._row,
            strides=(self._row, self._channels * bytes_each, bytes_each),
        )
        rgb = whole[..., self._channels - 3 :].copy()
        return Shot(said["t_ns"], rgb, SIDES[self.name], said["running_ns"], said["t_ns"] + said["age_ns"])
