"""A video that every browser plays, by PyAV, which is an extra: `pip install 'sags-node[report]'`."""

from __future__ import annotations

from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from sags_node.errors import UsageError
from sags_node.types import U8


def check_h264() -> None:
    """To be asked before long work whose result is a video.

    Raises:
        UsageError: PyAV is not installed.
    """
    if find_spec("av") is None:
        raise UsageError(
            "the report's video needs PyAV, which is not installed: pip install 'sags-node[report]'"
        )


class H264File:
    """H.264 in MP4. Write it where `files.whole` says: only after `finish` all of it is there.

    Args:
        rate: pictures per second.
        size: width and height of the pictures, px; odd ones lose a column or row.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(self, path: Path, rate: float, size: tuple[int, int]) -> None:
        import av

        self._file = av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
        self._stream = self._file.add_stream("libx264", Fraction(rate).limit_denominator(1000))
        self._stream.width, self._stream.height = (side - side % 2 for side in size)
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"preset": "veryfast", "crf": "22"}

    def add(self, picture: U8) -> None:
        """One more picture, RGB [H, W, 3]."""
        import av

        even = np.ascontiguousarray(picture[: self._stream.height, : self._stream.width])
        self._file.mux(self._stream.encode(av.VideoFrame.from_ndarray(even, "rgb24")))

    def finish(self) -> None:
        """Write the rest."""
        self._file.mux(self._stream.encode())
        self._file.close()
