"""Checks and decodes the images in ROS messages, raw and compressed; encodes compressed ones."""

import re
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.errors import SagsError
from sags_node.media.picture_file import decode
from sags_node.messaging import cdr
from sags_node.messaging.topics import IMAGE
from sags_node.types import U8

IMAGE_TYPES = (IMAGE, cdr.COMPRESSED)
LARGEST_SIDE = 16384  # px
_STREAM = re.compile("h.?26[45]|hevc|avc|av1|vp[89]|theora|mpeg", re.IGNORECASE)
_BAYER = re.compile("bayer_(rggb|bggr|gbrg|grbg)")
_STAMP = struct.Struct("<iI")
_BIG_STAMP = struct.Struct(">iI")

_OF_CHANNELS = {3: "rgb8", 4: "rgba8"}
_FROM_FILE = {"rgb8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_BGRA2RGBA}  # OpenCV reads and writes BGR
_TO_FILE = {"rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGRA}


class Encoding(NamedTuple):
    """The conversion of one of ROS's image encodings to RGB."""

    bytes_per_pixel: int
    to_rgb: int | None  # OpenCV's code of the conversion; None: it is RGB


ENCODINGS = {
    "rgb8": Encoding(3, None),
    "bgr8": Encoding(3, cv2.COLOR_BGR2RGB),
    "8UC3": Encoding(3, cv2.COLOR_BGR2RGB),
    "rgba8": Encoding(4, cv2.COLOR_RGBA2RGB),
    "bgra8": Encoding(4, cv2.COLOR_BGRA2RGB),
    "8UC4": Encoding(4, cv2.COLOR_BGRA2RGB),
    "mono8": Encoding(1, cv2.COLOR_GRAY2RGB),
    "8UC1": Encoding(1, cv2.COLOR_GRAY2RGB),
    "uyvy": Encoding(2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422": Encoding(2, cv2.COLOR_YUV2RGB_UYVY),  # the old name
    "yuyv": Encoding(2, cv2.COLOR_YUV2RGB_YUYV),
    "yuv422_yuy2": Encoding(2, cv2.COLOR_YUV2RGB_YUYV),
    "bayer_rggb8": Encoding(1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": Encoding(1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": Encoding(1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": Encoding(1, cv2.COLOR_BayerGRBG2RGB),
}


def header_stamp(data: bytes | memoryview) -> int:
    """Read the stamp (ns) of a CDR message that begins with a `std_msgs/Header`.

    Raises:
        SagsError: it is too short for a header.
    """
    if len(data) < 12:
        raise SagsError(f"a message of {len(data)} bytes has no header")
    seconds, nanoseconds = (_STAMP if data[1] & 1 else _BIG_STAMP).unpack_from(data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def decode_picture(data: bytes | memoryview, kind: str, where: str) -> U8:
    """Decode the RGB image [H, W, 3] in an `Image` or `CompressedImage`; a new array.

    Args:
        kind: ROS type of the message.
        where: name of the image in error messages.

    Raises:
        SagsError: the message is damaged, or its encoding is not supported.
    """
    message = decode_message(data, kind, where)
    if kind != cdr.COMPRESSED:
        return _raw_to_rgb(message, where)
    picture, encoding = decompressed(message, where)
    to_rgb = ENCODINGS[encoding].to_rgb
    of_file: U8 = picture if to_rgb is None else cv2.cvtColor(picture, to_rgb)
    return of_file


def decompressed(message: Any, where: str) -> tuple[U8, str]:
    """Decode a `CompressedImage`, and return its encoding, too: mono8 [H, W], rgb8 or rgba8 [H, W, C].

    The file decides. `format` only tells the Bayer pattern of a grey file: recorders fill it differently.

    Raises:
        SagsError: as `decode_picture`.
    """
    try:
        decoded = decode_file(np.asarray(message.data, np.uint8), where)
    except SagsError:
        if (stream := _STREAM.search(message.format)) is None:
            raise
        raise SagsError(
            f"{where}: {stream[0]!r} is a stream of images, and single ones are read (JPEG, PNG); make "
            "a video of each eye's messages, or record single images"
        ) from None
    if decoded.ndim == 3:
        encoding = _OF_CHANNELS[decoded.shape[2]]
        return np.asarray(cv2.cvtColor(decoded, _FROM_FILE[encoding])), encoding
    mosaic = _mosaic(message.format)
    return (decoded, "mono8") if mosaic is None else (np.asarray(cv2.cvtColor(decoded, mosaic)), "rgb8")


def _mosaic(said: str) -> int | None:
    """OpenCV's code to demosaic a grey file, by the `format` of its message; None: it is no mosaic. If it was
    demosaiced before, the new encoding comes last, as in `bayer_rggb8; jpeg compressed mono8`."""
    before, _, made = said.lower().partition(";")
    pattern = _BAYER.match(before.strip())
    target = made.split()[-1:]
    if pattern is None or target in (["mono8"], ["bgr8"], ["rgb8"]):
        return None
    return ENCODINGS[f"{pattern[0]}8"].to_rgb


def _raw_to_rgb(message: Any, where: str) -> U8:
    encoding = ENCODINGS.get(message.encoding)
    if encoding is None:
        known = ", ".join(ENCODINGS)
        raise SagsError(f"{where}: an image encoded as {message.encoding!r} is not read; known: {known}")
    height, width, step = message.height, message.width, message.step
    used = width * encoding.bytes_per_pixel
    sizes = 0 < height <= LARGEST_SIDE and 0 < width <= LARGEST_SIDE
    if not sizes or step < used or message.data.size < height * step:
        raise SagsError(
            f"{where}: {width}x{height} px of {message.encoding} in rows of {step} bytes do not fit "
            f"{message.data.size} bytes"
        )
    rows = message.data[: height * step].reshape(height, step)[:, :used]
    pixels = rows if encoding.bytes_per_pixel == 1 else rows.reshape(height, width, -1)
    try:
        rgb: U8 = pixels.copy() if encoding.to_rgb is None else cv2.cvtColor(pixels, encoding.to_rgb)
    except cv2.error:
        raise SagsError(f"{where}: {width}x{height} px cannot be {message.encoding}") from None
    return rgb


def decode_file(file: U8, where: str) -> U8:
    """Decode the image file in a message with OpenCV: [H, W] or BGR(A) [H, W, C].

    Raises:
        SagsError: it is no image file, damaged, too large, or not 8 bit.
    """
    decoded = decode(file, cv2.IMREAD_UNCHANGED, f"{where}: a compressed image", "record it again")
    if decoded.dtype != np.uint8:
        raise SagsError(f"{where}: a compressed image is {decoded.dtype}; what is read is 8 bit")
    return decoded


def encode_file(picture: NDArray[Any], encoding: str, form: str, options: Sequence[int]) -> bytes:
    """Encode an image [H, W] or [H, W, C], in one of ROS's encodings, as a JPEG or PNG file (`form`).

    Args:
        options: of `cv2.imencode`.

    Raises:
        SagsError: it cannot be encoded, e.g. because it has no pixels.
    """
    code = _TO_FILE.get(encoding)
    try:
        stored = picture if code is None else cv2.cvtColor(picture, code)
        done, file = cv2.imencode(f".{form}", stored, options)
    except cv2.error:
        done = False
    if not done:
        raise SagsError(f"an image of {picture.shape} cannot be compressed as {form}")
    return bytes(file.data)


def decode_message(data: bytes | memoryview, kind: str, where: str) -> Any:
    """Decode a message of ROS type `kind`.

    Raises:
        SagsError: it is damaged; the error begins with `where`.
    """
    try:
        return cdr.decode(data, kind)
    except SagsError as error:
        raise SagsError(f"{where}: {error}") from None
