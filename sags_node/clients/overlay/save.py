"""Keeps what `sags overlay` shows, for looking at it later."""

import logging
import struct
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, NamedTuple

import cv2
import numpy as np

from sags_node.errors import UsageError
from sags_node.files import check_file, whole, writing
from sags_node.media.video_file import VideoFile
from sags_node.types import U8

RATE = 30.0  # Hz that the video's header begins with; its images have their own stamps

log = logging.getLogger(__name__)

_LAYER = struct.Struct("<5i")  # frame, first row and column, height and width of what follows: RGBA


class Layers:
    """Stores what was drawn over each frame, and nothing else. A video can be made of it when the node
    has ended.

    Args:
        force: replace a file that exists.

    Raises:
        UsageError: the file exists.
        SagsError: it cannot be written.
    """

    def __init__(self, file: Path, force: bool = False) -> None:
        check_file(file, force)
        self._path = file
        self._failed: OSError | None = None
        with writing(file):
            self._file: BinaryIO = file.open("wb")

    def add(self, frame_id: int, rgba: U8 | None) -> None:
        """Add one frame [H, W, 4]; None: it was blank. If it cannot be written, `close` raises that."""
        if self._failed is not None:
            return
        top = left = height = width = 0
        if rgba is not None and rgba[..., 3].any():
            left, top, width, height = cv2.boundingRect(rgba[..., 3])
        try:
            self._file.write(_LAYER.pack(frame_id, top, left, height, width))
            if rgba is not None:
                self._file.write(np.ascontiguousarray(rgba[top : top + height, left : left + width]).data)
        except OSError as error:
            self._failed = error  # the overlay itself goes on

    def close(self) -> None:
        """Close the file. Raises: SagsError: not all of it was written."""
        with writing(self._path):
            self._file.close()
            if self._failed is not None:
                raise self._failed


class Layer(NamedTuple):
    """Where something was drawn over a frame."""

    top: int
    left: int
    rgba: U8  # [h, w, 4]


def read_layers(file: Path) -> dict[int, Layer]:
    """Read the layers by frame number. If the overlay was killed, those that were written whole before."""
    data, at, found = file.read_bytes(), 0, {}
    while at + _LAYER.size <= len(data):
        frame_id, top, left, height, width = _LAYER.unpack_from(data, at)
        at += _LAYER.size
        if at + 4 * height * width > len(data):
            break
        part = np.frombuffer(data, np.uint8, 4 * height * width, at).reshape(height, width, 4)
        at += part.size
        found[frame_id] = Layer(top, left, part)
    return found


class Output:
    """Every image as .mp4, or the last one with the overlay as .png; None: nothing is kept.

    Args:
        force: replace a file that exists.

    Raises:
        UsageError: another kind of file, its folder does not exist, or the file does.
        SagsError: it cannot be written.
    """

    def __init__(self, file: Path | None, force: bool = False) -> None:
        if file is not None and file.suffix not in (".mp4", ".png"):
            raise UsageError(f"cannot save {file}: the name must end in .mp4 or .png")
        if file is not None and not file.parent.is_dir():
            raise UsageError(f"cannot save {file}: there is no folder {file.parent}")
        if file is not None:
            check_file(file, force)
        self._file = file
        self._still: U8 | None = None
        self._video: VideoFile | None = None
        self._whole = ExitStack()  # of the video
        self._failed: OSError | None = None
        self.saved: str | None = None  # what has been written

    def add(self, picture: U8, with_overlay: bool, stamp_ns: int) -> None:
        """Add an image [H, W, 3] RGB with its capture time. If a video can get no more, that is logged once.

        Raises:
            SagsError: the video cannot be begun.
        """
        if self._file is None:
            return
        if self._file.suffix == ".png":
            if with_overlay or self._still is None:
                self._still = picture
            return
        if self._video is None:
            size = picture.shape[1], picture.shape[0]
            with writing(self._file):
                self._video = VideoFile(self._whole.enter_context(whole(self._file)), RATE, size)
        if self._failed is None:
            try:
                self._video.add(picture, stamp_ns)
            except OSError as error:
                self._failed = error
                log.warning("%s gets no more images: %s; the overlay goes on", self._file, error.strerror)

    def close(self) -> None:
        """Finish the file. If no image came there is none, which is logged.

        Raises:
            SagsError: it cannot be written.
        """
        if self._video is not None:
            with self._whole:
                if self._failed is not None:
                    raise self._failed
                self._video.finish()
            self.saved = str(self._file)
        if self._still is not None and self._file is not None:
            with whole(self._file) as partial:
                partial.write_bytes(cv2.imencode(".png", self._still[..., ::-1])[1].tobytes())
            self.saved = str(self._file)
        if self._file is not None and self.saved is None:
            log.warning("%s is not written: no image came while the overlay ran", self._file)
