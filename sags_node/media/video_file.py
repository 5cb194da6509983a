"""Writes a video image by image: H.264 in MP4, which every browser plays."""

import errno
import logging
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import Colorspace

from sags_node.types import U8

log = logging.getLogger(__name__)

TICKS = 90_000  # per second: the period of usual rates is a whole number of ticks
LONGEST_STEP = 60 * TICKS  # between two images; a longer pause is left out
RATES = (1.0, 240.0)  # Hz: the range that players can play


class VideoFile:
    """A video file being written. Use it within `files.whole`: the file is complete only after `finish`.

    Args:
        rate: Hz, for images without a stamp.
        size: width and height of the images, px; odd ones lose a column or row.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(self, path: Path, rate: float, size: tuple[int, int]) -> None:
        self._name = path.name
        rate = min(max(rate, RATES[0]), RATES[1])
        self._file = av.open(f"file:{path}", "w", format="mp4", options={"movflags": "faststart"})
        self._stream = self._file.add_stream("libx264", Fraction(rate).limit_denominator(1000))
        self._stream.width, self._stream.height = (side - side % 2 for side in size)
        self._stream.pix_fmt = "yuv420p"
        codec = self._stream.codec_context
        codec.time_base, codec.thread_count = Fraction(1, TICKS), 1
        codec.colorspace = Colorspace.ITU601  # tagged, as players take untagged HD for BT.709
        self._stream.options = {"preset": "ultrafast", "crf": "22"}  # beside a node that needs the cores
        self._shape = size[::-1]
        self._period = TICKS / rate
        self._first_ns: int | None = None
        self._shift = 0.0  # ticks that are added to stamps, as they began anew or a pause was left out
        self._at = -self._period  # ticks, of the newest image

    def add(self, picture: U8, stamp_ns: int | None = None) -> None:
        """Add an image, RGB [H, W, 3]; one of another size is scaled.

        Args:
            stamp_ns: capture time: sets the interval to the image before. If stamps begin anew, the image
                follows at the rate; so it does after a minute's pause, which is logged. None: at the rate.

        Raises:
            OSError: it cannot be written.
        """
        after = self._at + self._period
        if stamp_ns is not None:
            if self._first_ns is None:
                self._first_ns = stamp_ns
            at = (stamp_ns - self._first_ns) * 1e-9 * TICKS + self._shift
            if at >= self._at + LONGEST_STEP:
                log.warning(
                    "%s: a pause of %.0f s is left out at %.1f s",
                    self._name,
                    (at - self._at) / TICKS,
                    self._at / TICKS,
                )
            if not self._at < at < self._at + LONGEST_STEP:
                self._shift += after - at
                at = after
            after = at
        self._at = max(after, self._at + 1)
        width, height = self._stream.width, self._stream.height
        if picture.shape[:2] == self._shape:
            picture = picture[:height, :width]
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), "rgb24")
        frame = frame.reformat(width, height, "yuv420p", threads=1)
        frame.pts, frame.time_base = round(self._at), Fraction(1, TICKS)
        self._write(frame)

    def finish(self) -> None:
        """Encode the last images and close the file.

        Raises:
            OSError: it cannot be written.
        """
        self._write(None)
        self._file.close()

    def _write(self, frame: av.VideoFrame | None) -> None:
        try:
            self._file.mux(self._stream.encode(frame))
        except av.FFmpegError as error:
            if isinstance(error, OSError):
                raise
            size = f"{self._stream.width}x{self._stream.height} px"
            raise OSError(errno.EINVAL, f"{size} cannot be encoded as a video") from None
