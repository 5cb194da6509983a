"""What picture files say of themselves before they are decoded: their size, and whether their end is there.

Decoders take the memory that a header asks for, and fill what is missing of a cut-off picture with grey and
say nothing.
"""

from __future__ import annotations

import re
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
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_READERS: dict[bytes, Callable[[BytesIO], ImageFile]] = {  # by how a file begins
    _JPEG: JpegImagePlugin.JpegImageFile,
    _PNG: PngImagePlugin.PngImageFile,
    b"BM": BmpImagePlugin.BmpImageFile,
    b"P5": PpmImagePlugin.PpmImageFile,
    b"P6": PpmImagePlugin.PpmImageFile,
    b"RIFF": WebPImagePlugin.WebPImageFile,
}
_TIFF_STRIPS, _TIFF_TILES = (STRIPOFFSETS, STRIPBYTECOUNTS), (TILEOFFSETS, TILEBYTECOUNTS)
_ENDS = {_JPEG: b"\xff\xd9", _PNG: b"IEND\xaeB`\x82"}  # marks of a picture's end
_JPEG_MARK = re.compile(rb"\xff+([^\0\xff\xd0-\xd7])")  # but for those that stand within pixels
warnings.filterwarnings("ignore", module=r"PIL\.TiffImagePlugin")  # of damaged files; they are refused
_LONGEST_PADDING = 512  # bytes after the end of a picture, within which its mark is looked for first


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
    begin = next((begin for begin in _ENDS if bytes(data[: len(begin)]) == begin), None)
    if begin is not None:
        near = _ENDS[begin] in bytes(data[-_LONGEST_PADDING:])
        return near or (_jpeg_ends(data) if begin == _JPEG else _ENDS[begin] in bytes(data))
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


def _jpeg_ends(data: memoryview) -> bool:
    """Whether its segments and scans lead to an end; drivers hand over buffers that are longer."""
    at = 2
    while (found := _JPEG_MARK.search(data, at)) is not None and found[1] != b"\xd9":
        length = int.from_bytes(data[found.end() : found.end() + 2], "big")
        at = found.end() + max(2, length)
    return found is not None


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
