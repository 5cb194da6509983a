"""What picture files say of themselves before they are decoded: their size, and whether their end is there.

Decoders take the memory that a header asks for, and fill what is missing of a cut-off picture with grey and
say nothing.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import closing
from io import BytesIO

from PIL import (
    BmpImagePlugin,
    JpegImagePlugin,
    PngImagePlugin,
    PpmImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)
from PIL.ImageFile import ImageFile
from PIL.TiffImagePlugin import (
    IMAGELENGTH,
    IMAGEWIDTH,
    STRIPBYTECOUNTS,
    STRIPOFFSETS,
    TILEBYTECOUNTS,
    TILEOFFSETS,
)

KINDS = "JPEG, PNG, TIFF, BMP, WebP or binary PGM/PPM"
SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".pnm"))
_READERS: dict[bytes, Callable[[BytesIO], ImageFile]] = {  # by how a file begins
    b"\xff\xd8": JpegImagePlugin.JpegImageFile,
    b"\x89PNG\r\n\x1a\n": PngImagePlugin.PngImageFile,
    b"BM": BmpImagePlugin.BmpImageFile,
    b"P5": PpmImagePlugin.PpmImageFile,
    b"P6": PpmImagePlugin.PpmImageFile,
    b"RIFF": WebPImagePlugin.WebPImageFile,
}
_TIFF_STRIPS, _TIFF_TILES = (STRIPOFFSETS, STRIPBYTECOUNTS), (TILEOFFSETS, TILEBYTECOUNTS)
_ENDS = {b"\xff\xd8": b"\xff\xd9", b"\x89PNG\r\n\x1a\n": b"IEND\xaeB`\x82"}  # marks of a picture's end
warnings.filterwarnings("ignore", module=r"PIL\.TiffImagePlugin")  # of damaged files; they are refused
_LONGEST_PADDING = 512  # bytes some cameras write after the end of a picture


def claimed_size(data: memoryview) -> tuple[int, int] | None:
    """Width and height that a file claims; None where it is of no kind that is read, or claims nothing."""
    try:
        if _is_tiff(data):
            tags = _tiff_tags(data)
            return tags[IMAGEWIDTH], tags[IMAGELENGTH]
        with closing(_opened(data)) as picture:
            return picture.size
    except Exception:  # Pillow raises a dozen kinds on damaged headers
        return None


def is_whole(data: memoryview) -> bool:
    """Whether the end of a picture is there: its mark, or, where a kind has none, all of its pixels."""
    end = next((end for begin, end in _ENDS.items() if bytes(data[: len(begin)]) == begin), None)
    if end is not None:
        return end in bytes(data[-_LONGEST_PADDING:])
    try:
        if _is_tiff(data):
            tags = _tiff_tags(data)
            begins, lengths = (
                (STRIPOFFSETS, STRIPBYTECOUNTS) if STRIPOFFSETS in tags else (TILEOFFSETS, TILEBYTECOUNTS)
            )
            return max(map(sum, zip(tags[begins], tags[lengths], strict=True))) <= len(data)
        with closing(_opened(data)) as picture:
            picture.load()
    except Exception:  # as above
        return False
    return True


def _is_tiff(data: memoryview) -> bool:
    return bytes(data[:4]) in (b"II*\0", b"MM\0*")


def _tiff_tags(data: memoryview) -> TiffImagePlugin.ImageFileDirectory_v2:
    """Of the first picture. Pillow has no mode for some that OpenCV reads, such as three floats a pixel."""
    tags = TiffImagePlugin.ImageFileDirectory_v2(bytes(data[:8]))
    file = BytesIO(data)
    file.seek(tags.next)
    tags.load(file)
    return tags


def _opened(data: memoryview) -> ImageFile:
    """With its header read. Not by `Image.open`, which looks for other kinds and warns of large pictures."""
    start = bytes(data[:8])
    return next(reader for begin, reader in _READERS.items() if start.startswith(begin))(BytesIO(data))
