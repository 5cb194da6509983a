"""What is published of a frame has the same size on every machine, whatever the working size.

Only this module converts from the working to the published size. Depths, confidences and masks are those of
the nearest working pixel: a mean across an edge would be a surface that does not exist.
"""

from dataclasses import replace
from typing import TypeVar

import cv2
import numpy as np

from sags_node.geometry import scale_pixels
from sags_node.types import F32, U8, AnchorStates, Bool, Camera, Colours, RectifiedPair, RenderedView, Side

Plane = TypeVar("Plane", F32, Bool)


def size_of(pair: RectifiedPair) -> tuple[int, int]:
    """Width and height of all that is published of a frame, px."""
    camera = camera_of(pair)
    return camera.width, camera.height


def camera_of(pair: RectifiedPair) -> Camera:
    """The left camera at the published size."""
    if pair.published is None:
        return pair.camera
    return replace(pair.published.camera, T_world_cam=pair.camera.T_world_cam)


def picture(pair: RectifiedPair, side: Side) -> U8:
    """The rectified image [H, W, 3] of an eye that exists, made from the raw one instead of enlarged."""
    if pair.published is not None:
        return pair.published.picture(side)
    shown = pair.left if side == "left" else pair.right
    assert shown is not None
    return shown


def nearest(pair: RectifiedPair, plane: Plane) -> Plane:
    """Resize a depth, confidence or mask [h, w] of the working size to the published one [H, W]."""
    if pair.published is None:
        return plane
    values = plane.view(np.uint8) if plane.dtype == np.bool_ else plane
    enlarged = cv2.resize(values, size_of(pair), interpolation=cv2.INTER_NEAREST_EXACT)
    return np.asarray(enlarged).view(plane.dtype)


def colours(view: RenderedView, size: tuple[int, int]) -> U8:
    """Return the colours [H, W, 3] RGB of a view at `size` (width, height; px), with the detail of images
    if it was made at that size."""
    if view.shown is not None and view.shown.rgb.shape[1::-1] == size:
        return view.shown.rgb
    return view.colours.at(*size)


def alpha(view: RenderedView, size: tuple[int, int]) -> F32:
    """The coverage [H, W] 0..1 of a view at `size` (width, height; px), by the model or an image."""
    drawn = view.alpha
    if drawn.shape[::-1] != size:
        drawn = np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_LINEAR))
    if view.shown is None or view.shown.taken.shape[::-1] != size:
        return drawn
    return np.asarray(np.maximum(drawn, view.shown.taken * np.float32(1 / 255)))


def detail_age_ns(view: RenderedView) -> int | None:
    """How long before the view's frame the oldest image in it was captured; None: the model alone."""
    return None if view.shown is None else max(0, view.t_capture_ns - view.shown.oldest_ns)


def view(pair: RectifiedPair, drawn: RenderedView) -> RenderedView:
    """The view of a frame at the published size. Its depth is a copy, which may be written."""
    size, sure, camera = size_of(pair), drawn.confidence, camera_of(pair)
    return replace(
        drawn,
        camera=replace(camera, T_world_cam=drawn.camera.T_world_cam),
        colours=Colours(drawn.colours.small, *size),
        depth=nearest(pair, drawn.depth).copy(),
        alpha=alpha(drawn, size),
        confidence=None if sure is None else nearest(pair, sure),
    )


def anchors(pair: RectifiedPair, states: AnchorStates) -> AnchorStates:
    """The anchors with their pixels at the published size."""
    if pair.published is None:
        return states
    ahead = states.ahead
    if ahead is not None:
        ahead = replace(ahead, pixels=pixels(pair, ahead.pixels))
    return replace(states, pixels=pixels(pair, states.pixels), ahead=ahead)


def pixels(pair: RectifiedPair, places: F32) -> F32:
    """Convert pixels [N, 2] of the working size to the published one."""
    if pair.published is None:
        return places
    return scale_pixels(places, (pair.camera.width, pair.camera.height), size_of(pair)).astype(np.float32)
