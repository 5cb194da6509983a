"""Keeps what `sags overlay` shows, for looking at it later."""

from __future__ import annotations

from pathlib import Path

import cv2

from sags_node.errors import SagsError, UsageError
from sags_node.types import U8
from sags_node.video_file import VideoFile

PICTURES_BEFORE_VIDEO = 5  # the frame rate must be known before a video file is opened


class Output:
    """Every picture as .mp4, or the last one with the overlay as .png; None: nothing is kept.

    Raises:
        UsageError: another kind of file, or its folder does not exist.
    """

    def __init__(self, file: Path | None) -> None:
        if file is not None and file.suffix not in (".mp4", ".png"):
            raise UsageError(f"cannot save {file}: the name must end in .mp4 or .png")
        if file is not None and not file.parent.is_dir():
            raise UsageError(f"cannot save {file}: there is no folder {file.parent}")
        self._file = file
        self._still: U8 | None = None
        self._video: VideoFile | None = None
        self._shown = 0
        self.saved: str | None = None  # what has been written

    def add(self, picture: U8, with_overlay: bool, period: float) -> None:
        """One picture [H, W, 3] RGB, `period` s after the one before.

        Raises:
            SagsError: the video cannot be written.
        """
        self._shown += 1
        if self._file is None:
            return
        if self._file.suffix == ".png":
            if with_overlay or self._still is None:
                self._still = picture
            return
        if self._shown < PICTURES_BEFORE_VIDEO:
            return
        if self._video is None:
            try:
                self._video = VideoFile(self._file, 1 / period, (picture.shape[1], picture.shape[0]))
            except SagsError as error:
                raise SagsError(f"{self._file}: {error}") from None
        self._video.add(picture)

    def close(self) -> None:
        """Finish the file.

        Raises:
            SagsError: it cannot be written.
        """
        if self._video is not None:
            self._video.close()
            self.saved = str(self._file)
        if self._still is not None:
            if not cv2.imwrite(str(self._file), cv2.cvtColor(self._still, cv2.COLOR_RGB2BGR)):
                raise SagsError(f"cannot write {self._file}; check the folder's rights and the disk")
            self.saved = str(self._file)
