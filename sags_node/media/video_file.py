"""A video that is written picture by picture."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import cv2

from sags_node.media.native_output import native_output
from sags_node.types import U8

RATES = (1.0, 240.0)  # Hz that MPEG-4 and players can do

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_FATAL)  # it would say a line for each lost picture


class VideoFile:
    """An MP4 file. Write it where `files.whole` says: only after `finish` all of it is there.

    Args:
        rate: pictures per second.
        size: width and height of the pictures, px.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(self, path: Path, rate: float, size: tuple[int, int]) -> None:
        self._path = path
        self._count = 0
        code = cv2.VideoWriter.fourcc(*"mp4v")
        rate = round(min(max(rate, RATES[0]), RATES[1]), 2)  # MPEG-4 knows no finer fractions
        with native_output():
            self._writer = cv2.VideoWriter(str(path), code, rate, size)
        if not self._writer.isOpened():
            if shutil.disk_usage(path.parent).free == 0:
                raise _no_space()
            raise OSError(errno.EINVAL, f"{size[0]}x{size[1]} px cannot be encoded as a video")

    def add(self, picture: U8) -> None:
        """One more picture, RGB [H, W, 3]."""
        self._writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        self._count += 1

    def finish(self) -> None:
        """Write the rest.

        Raises:
            OSError: not all of it is there.
        """
        self._writer.release()
        # OpenCV says nothing of a full disk. The index comes last: a file that was cut off has none.
        with native_output():
            written = cv2.VideoCapture(str(self._path)).get(cv2.CAP_PROP_FRAME_COUNT)
        if written != self._count:
            raise _no_space()


def _no_space() -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
