"""Stereo pairs from video files: one file per eye, or one file that shows both."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import cv2

from sags_node.errors import SagsError, UsageError
from sags_node.sources.layout import Layout
from sags_node.sources.pictures import RawPair, size_text
from sags_node.types import U8, Bool

log = logging.getLogger(__name__)

# FFmpeg and OpenCV would print their own lines about broken files beside our message. FFmpeg's level is read
# when the first video is opened.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_FATAL)


class Video:
    """One video file, decoded forward.

    Raises:
        UsageError: the file is missing or is not a video.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._open()
        self.rate = self._capture.get(cv2.CAP_PROP_FPS) or None
        self.count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        width, height = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
        self.size = int(self._capture.get(width)), int(self._capture.get(height))
        if self.count <= 0:
            raise UsageError(f"video {path} does not say how many frames it holds; remux it (ffmpeg -c copy)")
        if not self._capture.grab():
            raise UsageError(f"video {path} holds no picture that can be decoded")
        self.seek(0)

    def _open(self) -> None:
        if not self.path.is_file():
            raise UsageError(f"video {self.path} does not exist; check the path, or SAGS_DATA if it is used")
        self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise UsageError(f"{self.path} cannot be read as a video; is it complete?")

    def seek(self, index: int) -> None:
        """Make `index` the next frame, by counting where the file cannot seek to it exactly."""
        self._capture.release()
        self._open()
        if index and self._capture.set(cv2.CAP_PROP_POS_FRAMES, index):
            if round(self._capture.get(cv2.CAP_PROP_POS_FRAMES)) == index:
                self._next = index
                return
            self._capture.release()
            self._open()
        self._next = 0
        while self._next < index and self.skip():
            pass

    def skip(self) -> bool:
        """Pass over one frame without converting it; False at the end."""
        found: bool = self._capture.grab()
        self._next += found
        return found

    def read(self) -> U8 | None:
        """The next frame, BGR [H, W, 3], None at the end."""
        picture: U8
        found, picture = self._capture.read()
        if not found:
            if self._next < self.count:
                log.warning("%s ends at frame %d, it announces %d", self.path, self._next, self.count)
            return None
        self._next += 1
        return picture

    def close(self) -> None:
        self._capture.release()


class VideoPairs:
    """Two videos, paired by frame number, or the left one alone, which says how long it is.

    Args:
        layout: what is used of each eye's picture.

    Raises:
        UsageError: a file is missing or not a video, or the two differ in size or rate.
    """

    def __init__(self, left: Path, right: Path | None, layout: Layout) -> None:
        self._left = Video(left)
        self._right = None if right is None else Video(right)
        self._layout = layout
        self.rate, self.count = self._left.rate, self._left.count
        self._next = 0
        if self._right is not None:
            self._check(self._left, self._right)
        try:
            layout.size(*self._left.size, str(left))
        except UsageError:
            self.close()
            raise

    def _check(self, one: Video, other: Video) -> None:
        for what, fits, values in (
            ("px", one.size == other.size, (size_text(*one.size), size_text(*other.size))),
            ("frames/s", _is_same_rate(one.rate, other.rate), (one.rate, other.rate)),
        ):
            if not fits:
                self.close()
                raise UsageError(
                    f"{one.path} has {values[0]} {what} but {other.path} has {values[1]}; they are not one "
                    "stereo pair"
                )

    def seek(self, index: int) -> None:
        for video in self._videos:
            video.seek(index)
        self._next = index

    def skip(self) -> bool:
        found = self._left.skip()
        if found and self._right is not None and not self._right.skip():
            raise self._right_ended(self._right)
        self._next += found
        return found

    def read(self) -> RawPair | None:
        """The next pair, None at the end of the left video.

        Raises:
            SagsError: the right video is shorter than the left one.
        """
        left = self._left.read()
        if left is None:
            return None
        right = None if self._right is None else self._right.read()
        if self._right is not None and right is None:
            raise self._right_ended(self._right)
        self._next += 1
        left = _rgb(self._layout.eye(left, "left"))
        return RawPair(left, None if right is None else _rgb(self._layout.eye(right, "right")), None)

    def close(self) -> None:
        for video in self._videos:
            video.close()

    @property
    def _videos(self) -> list[Video]:
        return [self._left] if self._right is None else [self._left, self._right]

    def _right_ended(self, right: Video) -> SagsError:
        return SagsError(
            f"{right.path} ends at frame {self._next} but {self._left.path} goes on; "
            f"set source.frames to stop there"
        )


class OneVideoPairs:
    """One video of both eyes: in halves or boxes of a picture, in rows, or one after the other.

    Attributes:
        size: width and height of an eye's picture, px.

    Raises:
        UsageError: its pictures cannot be split as asked.
    """

    def __init__(self, video: Video, layout: Layout) -> None:
        self._video = video
        self._layout = layout
        self._pictures = 2 if layout.is_sequential else 1  # that make a pair
        self.rate = None if video.rate is None else video.rate / self._pictures
        self.count = video.count // self._pictures
        try:
            self.size = layout.size(*video.size, str(video.path))
        except UsageError:
            self.close()
            raise

    def seek(self, index: int) -> None:
        self._video.seek(index * self._pictures)

    def skip(self) -> bool:
        return all(self._video.skip() for _ in range(self._pictures))

    def read(self) -> RawPair | None:
        """The next pair, None at the end."""
        pictures = [self._video.read() for _ in range(self._pictures)]
        first, last = pictures[0], pictures[-1]
        if first is None or last is None:
            return None
        if self._layout.is_sequential:
            of = dict(zip(self._layout.order, (first, last), strict=True))
            left, right = self._layout.eye(of["left"], "left"), self._layout.eye(of["right"], "right")
        else:
            left, right = self._layout.eyes(first)
        painted = self._layout.tools(first)
        return RawPair(_rgb(left), _rgb(right), None if painted is None else _unpainted(painted, left))

    def close(self) -> None:
        self._video.close()


def _rgb(bgr: U8) -> U8:
    """A new RGB picture, so that nothing the decoder owns leaves this file."""
    rgb: U8 = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    return rgb


def _unpainted(painted: U8, left: U8) -> Bool:
    from sags_node.sources.painted import unpainted  # a kernel: other videos need no place for one

    return unpainted(painted, left)


def _is_same_rate(one: float | None, other: float | None) -> bool:
    """LearningRates measured from a file's stamps differ a little."""
    return one is None or other is None or abs(one - other) <= 0.01 * one
