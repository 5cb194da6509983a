"""Images as small files: a receiver of ROS 2 with default settings loses larger ones.

Colour becomes JPEG; masks, confidence and overlays PNG. Depth becomes a PNG as ROS' `compressedDepth` makes
it: steps of equal disparity, as stereo measures. All are made coarser until they are small enough.
"""

import struct
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.bags.pictures import encode_file
from sags_node.media.picture_file import PNG
from sags_node.messaging import cdr, topics
from sags_node.messaging.received import Received, ReceivedImage
from sags_node.types import F32, U8

LARGEST = 160_000  # bytes; stock receivers have 212,992, of which the kernel takes some for each packet
SMALL = LARGEST // 2  # bytes; below it the next file is finer: no step below makes a file twice as large
QUALITIES = (90, 80, 65, 50, 35, 20)  # of JPEG
STEPS = (0.02e-3, 0.04e-3, 0.08e-3, 0.16e-3, 0.32e-3)  # m at `USUAL` that one count of a depth PNG stands for
USUAL = 0.1  # m, of tissue
FARTHEST = 10.0  # m; what is farther is unknown
LEVELS = (256, 64, 16, 8)  # of confidence
_INVERSE_DEPTH = 0  # the form of a depth PNG, the only one that ROS has

Pack = Callable[[NDArray[Any]], tuple[bytes, str]]  # the file, and ROS' name of its format


def suffix(topic: topics.Topic) -> str:
    """Return the suffix that ROS' image_transport gives to the topic of an image's file."""
    return "/compressedDepth" if _is_depth(topic.name) else "/compressed"


class Compressor:
    """The compressor of one image topic."""

    def __init__(self, topic: topics.Topic) -> None:
        self._ways = _ways(topic)  # the finest first
        self._chosen = 0

    def __call__(self, received: Received) -> bytes:
        """Return the `sensor_msgs/CompressedImage` of an image; too large only where none is coarser."""
        assert isinstance(received, ReceivedImage)
        file, form = self._ways[self._chosen](received.array)
        while len(file) > LARGEST and self._chosen < len(self._ways) - 1:
            self._chosen += 1
            file, form = self._ways[self._chosen](received.array)
        if len(file) < SMALL and self._chosen > 0:
            self._chosen -= 1
        return cdr.compressed_image(file, form, cdr.decode(received.cdr(), topics.IMAGE).header)


def over_black(rgba: U8) -> U8:
    """An image [H, W, 4] over black, [H, W, 3]."""
    shown: U8 = cv2.cvtColor(cv2.cvtColor(rgba, cv2.COLOR_RGBA2mRGBA), cv2.COLOR_RGBA2RGB)
    return shown


def _ways(topic: topics.Topic) -> Sequence[Pack]:
    if _is_depth(topic.name):
        return [partial(_depth, step=step) for step in STEPS]
    if topic.name.endswith("confidence"):
        return [partial(_confidence, levels=levels) for levels in LEVELS]
    if topic.content.startswith("mono8") or topic.name.endswith("overlay/image"):
        return [_exact]
    return [partial(_jpeg, quality=quality) for quality in QUALITIES]


def _is_depth(name: str) -> bool:
    return name.endswith("depth")


def _jpeg(picture: U8, quality: int) -> tuple[bytes, str]:
    """JPEG knows no alpha: what the model does not show becomes black."""
    rgb = over_black(picture) if picture.shape[2] == 4 else picture
    options = (cv2.IMWRITE_JPEG_QUALITY, quality)
    return encode_file(rgb, "rgb8", "jpeg", options), cdr.file_form("rgb8", "jpeg")


def _exact(picture: U8) -> tuple[bytes, str]:
    encoding = "mono8" if picture.ndim == 2 else "rgba8"
    return encode_file(picture, encoding, "png", PNG), cdr.file_form(encoding, "png")


def _confidence(sure: F32, levels: int) -> tuple[bytes, str]:
    """A PNG of confidence in `levels` steps; 255 stands for 1.0."""
    steps = cv2.convertScaleAbs(sure, alpha=levels - 1)  # scales, rounds and saturates in one pass
    return _exact(cv2.convertScaleAbs(steps, alpha=255 / (levels - 1)))


def _depth(z: F32, step: float) -> tuple[bytes, str]:
    """A PNG of `a / z + b` as 16 bit (0: unknown), after the numbers `a` and `b`.

    Source: ROS' image_transport_plugins, compressed_depth_image_transport/src/codec.cpp.
    """
    a = USUAL**2 / step
    b = 1 - a / FARTHEST
    with np.errstate(divide="ignore", invalid="ignore"):
        counts = a / z + b
    known = (z > 0) & (counts >= 1) & (counts < 65535.5)  # no comparison with NaN holds
    file = encode_file(np.where(known, counts + 0.5, 0).astype(np.uint16), "mono16", "png", PNG)
    return struct.pack("<iff", _INVERSE_DEPTH, a, b) + file, "32FC1; compressedDepth png"
