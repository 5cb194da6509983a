"""Thin images: smaller forms of what a node draws and measures, for links that are too slow for the whole.

Colour becomes JPEG, blended over black where it has an alpha, which has a topic of its own. Depth becomes
16-bit PNG. Depths are never averaged: at half size every second one is sent unchanged.
"""

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.errors import SagsError
from sags_node.media.picture_file import PNG
from sags_node.media.picture_file import decode as decode_file
from sags_node.messaging import cdr, published
from sags_node.messaging.cdr import Content
from sags_node.messaging.content import tells_of
from sags_node.messaging.topics import ThinPicture
from sags_node.messaging.wire import Buffer, WireError
from sags_node.types import U8, FrameResult, Side

DEPTH_STEP = 5e-5  # m; errs by 25 um at most, far below the error of any depth here; reaches 3.2 m
CONFIDENCE_STEP = 1 / 255
QUALITY = 80  # of JPEG; the default of ROS's image transport
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, QUALITY)

log = logging.getLogger(__name__)


def thin_pictures(
    result: FrameResult, asked: Mapping[str, ThinPicture], logged: set[str] | None = None
) -> dict[str, Content]:
    """Return the thin images of a frame, by topic; a text instead of one that cannot be made.

    Args:
        logged: topics whose failure was logged; those that fail now are added.
    """
    width, height = published.size_of(result.pair)
    logged = set() if logged is None else logged
    made: dict[str, Content] = {}
    for name, thin in asked.items():
        x, y, wide, high = thin.region or (0, 0, width, height)
        if x + wide > width or y + high > height:
            made[name] = cdr.string(f"'{name}': the region leaves the image, which has {width}x{height} px")
        elif tells_of(result, thin.topic):
            part = np.s_[y : y + high - high % thin.every, x : x + wide - wide % thin.every]
            try:
                made[name] = _thin(result, thin, part, (x, y, thin.every))
            except Exception as error:  # only this topic fails
                if name not in logged:
                    logged.add(name)
                    log.exception("'%s' cannot be made", name)
                made[name] = cdr.string(f"'{name}' cannot be made: {str(error) or type(error).__name__}")
    return made


def _thin(
    result: FrameResult, thin: ThinPicture, part: tuple[slice, slice], window: tuple[int, int, int]
) -> Content:
    scale, encoding = 0.0, "mono8"
    picture: NDArray[Any]
    if thin.form == "jpeg":
        encoding, picture = "rgb8", _averaged(_colour(result, thin.topic, part), thin.every)
    elif thin.form == "alpha":
        picture = _averaged(_alpha(result, thin.topic, part), thin.every)
    else:
        scale, encoding, picture = _numbers(result, thin.topic, part, np.s_[:: thin.every, :: thin.every])
    is_jpeg = thin.form == "jpeg"
    if is_jpeg:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    _, file = cv2.imencode(".jpg" if is_jpeg else ".png", picture, _JPEG if is_jpeg else PNG)
    frame = cdr.FRAMES[_side(thin.topic)]
    kind = "jpeg" if is_jpeg else "png"
    drawn = result.views[_side(thin.topic)] if thin.topic.endswith("render/image") else None
    body = cdr.thin_picture(file, kind, encoding, result.pair.t_capture_ns, frame, scale, window)
    return body if drawn is None else replace(body, detail_age_ns=published.detail_age_ns(drawn))


def _colour(result: FrameResult, topic: str, part: tuple[slice, slice]) -> U8:
    """The colours [H, W, 3]; drawn views are blended over black."""
    side, pair = _side(topic), result.pair
    if topic.endswith("image_rect_color"):
        return published.picture(pair, side)[part]
    colours = published.colours(result.views[side], published.size_of(pair))[part]
    coverage = _alpha(result, topic, part)
    over_black: U8 = cv2.multiply(colours, cv2.merge([coverage] * 3), scale=1 / 255)
    return over_black


def _side(topic: str) -> Side:
    return "left" if topic.startswith("left/") else "right"


def _alpha(result: FrameResult, topic: str, part: tuple[slice, slice]) -> U8:
    whole = published.alpha(result.views[_side(topic)], published.size_of(result.pair))
    alpha: U8 = cv2.convertScaleAbs(whole[part], alpha=255.0)
    return alpha


def _numbers(
    result: FrameResult, topic: str, part: tuple[slice, slice], few: tuple[slice, slice]
) -> tuple[float, str, NDArray[Any]]:
    """Return the scale (0: none), encoding and pixels of what must not be averaged."""
    if topic == "left/tissue_mask":
        tissue = published.nearest(result.pair, result.observation.tissue)
        return 0.0, "mono8", tissue[part][few].view(np.uint8) * np.uint8(255)
    view = result.views["left"]
    if topic == "left/render/depth_confidence":
        assert view.confidence is not None  # else it is not published
        confidence = published.nearest(result.pair, view.confidence)
        steps = cv2.convertScaleAbs(confidence[part][few], alpha=1 / CONFIDENCE_STEP)
        return CONFIDENCE_STEP, "mono8", steps
    depth = view.depth if topic == "left/render/depth" else result.observation.depth
    steps = published.nearest(result.pair, depth)[part][few] * np.float32(1 / DEPTH_STEP) + np.float32(0.5)
    told = np.where(steps < 65536, steps, 0)  # 0: unknown, or too far for 16 bits
    return DEPTH_STEP, "16UC1", told.astype(np.uint16)


def _averaged(picture: U8, every: int) -> U8:
    """The image with each pixel the mean of `every` x `every` pixels."""
    height, width = picture.shape[:2]
    if every == 1:
        return picture
    smaller: U8 = cv2.resize(picture, (width // every, height // every), interpolation=cv2.INTER_AREA)
    return smaller


def decode(topic: str, scale: float, file: Buffer) -> NDArray[Any]:
    """The image in a thin message, see `received.ReceivedCompressed.array`; `scale` 0: its header has none.

    Raises:
        WireError: the file is damaged.
    """
    try:
        stored = decode_file(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED, topic, "it was left out")
    except SagsError as error:
        raise WireError(str(error)) from None
    picture: NDArray[Any]
    if scale:
        picture = stored * np.float32(scale)
        if stored.dtype == np.uint16:
            picture[stored == 0] = np.nan
    else:
        picture = stored if stored.ndim == 2 else cv2.cvtColor(stored, cv2.COLOR_BGR2RGB)
    picture.flags.writeable = False
    return picture
