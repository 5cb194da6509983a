"""A video that is written picture by picture."""

from __future__ import annotations

import re
from pathlib import Path

import cv2

from sags_node.errors import SagsError
from sags_node.native_output import native_output
from sags_node.types import U8

_WHO = re.compile(r"^\[.*?\] *")  # says it; the address of an object
RATES = (1.0, 240.0)  # Hz that MPEG-4 and players can do


class VideoFile:
    """An MP4 file; one that is there is replaced.

    Args:
        rate: pictures per second.
        size: width and height of the pictures, px.

    Raises:
        SagsError: it cannot be written.
    """

    def __init__(self, path: Path, rate: float, size: tuple[int, int]) -> None:
        code = cv2.VideoWriter.fourcc(*"mp4v")
        rate = round(min(max(rate, RATES[0]), RATES[1]), 2)  # MPEG-4 knows no finer fractions
        with native_output() as said:
            self._writer = cv2.VideoWriter(str(path), code, rate, size)
        if not self._writer.isOpened():
            reason = ": " + _WHO.sub("", said[0]) if said else ""
            raise SagsError(f"the video cannot be written{reason}; check the folder's rights and the disk")

    def add(self, picture: U8) -> None:
        """One more picture, RGB [H, W, 3]."""
        self._writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))

    def close(self) -> None:
        """Finish the file."""
        self._writer.release()
