"""What a run says of a moment that the mapper never saw: later than its frames, or between two of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sags_node.engine.rasterizer.rasterize import Rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.geometry import project
from sags_node.model.forecast import gaussians_ahead, reached
from sags_node.types import F32, I64, Bool, Camera, Gaussians, Snapshot

VELOCITY_SHARE = 0.8  # tissue slows down: less than the last velocity predicts best (0.3 to 0.7 dB over none)
ROUNDING = 1e-3  # s, of stamps
INSIDE = 0.99  # least value of a carried mask: below, the place is at the edge of an instrument
COVERED = 0.01  # least coverage of a pixel: below, the model does not say where it went


def extrapolated(snapshot: Snapshot, seconds: float) -> Gaussians:
    """The Gaussians `seconds` after the snapshot: by the motion field where motion is periodic and the field
    has skill so far ahead, else by 0.8 times their last observed velocity."""
    comes_again = snapshot.forecast is not None and snapshot.forecast.state.period is not None
    if comes_again and 0 < seconds <= reached(snapshot, seconds) + ROUNDING:
        return gaussians_ahead(snapshot, seconds)
    means = snapshot.gaussians.means + snapshot.velocities * np.float32(VELOCITY_SHARE * seconds)
    return replace(snapshot.gaussians, means=means)


def between(before: Gaussians, after: Gaussians, share: float) -> Gaussians:
    """The Gaussians of a moment between two mapped frames: means and colours are interpolated linearly,
    `share` (0..1) of the way from the earlier to the later. Gaussians that the earlier one lacks are as in
    the later one."""
    places, shared = _found(before, after)
    left = np.where(shared, np.float32(1 - share), np.float32(0))[:, None]
    return replace(
        after,
        means=after.means + left * (before.means[places] - after.means),
        colors=after.colors + left * (before.colors[places] - after.colors),
    )


@dataclass(frozen=True, slots=True)
class Seen:
    """A moment with its image."""

    gaussians: Gaussians
    camera: Camera
    picture: F32  # [H, W, 3] RGB 0..1
    tissue: Bool  # [H, W]
    weight: float  # of the image in the mean, more than 0


def carried(rasterizer: Rasterizer, middle: Gaussians, camera: Camera, around: Sequence[Seen]) -> F32:
    """The mean of some images, carried along the model's motion to where the tissue is at another moment.

    Gaussians cannot say all of an image's detail, but they know where everything went. Where nothing moves
    this is the mean of the images, whose noise is less than that of each.

    Args:
        rasterizer: for images of the camera's size.
        middle: the Gaussians at that moment.
        camera: that sees it.
        around: the moments with images.

    Returns:
        [H, W, 3] RGB 0..1; where no image shows tissue, what the Gaussians show.
    """
    total = np.zeros((camera.height, camera.width, 3), np.float32)
    weights = np.zeros((camera.height, camera.width, 1), np.float32)
    for seen in around:
        places = _displaced(rasterizer, middle, camera, seen)
        tissue = cv2.remap(
            seen.tissue.astype(np.float32), places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )
        weight = np.where(tissue > INSIDE, np.float32(seen.weight), np.float32(0))[..., None]
        total += weight * cv2.remap(
            seen.picture, places, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
        weights += weight
    drawn = colours_of(rasterizer.forward(middle, camera))
    found: F32 = np.where(weights > 0, total / np.maximum(weights, np.float32(1e-6)), drawn)
    return np.clip(found, 0, 1)


def _displaced(rasterizer: Rasterizer, middle: Gaussians, camera: Camera, seen: Seen) -> F32:
    """Where each pixel's tissue is in the image of `seen`, [H, W, 2] px: displaced by the mean displacement
    of the Gaussians drawn at the pixel. A Gaussian that is unknown in `seen` counts as not displaced."""
    pixels, _ = project(camera, middle.means)
    displacement = np.zeros_like(middle.colors)
    rows, shared = _found(seen.gaussians, middle)
    there, _ = project(seen.camera, seen.gaussians.means[rows])
    known = shared[:, None] & np.isfinite(there) & np.isfinite(pixels)
    displacement[:, :2] = np.where(known, there - pixels, 0)
    planes = rasterizer.forward(replace(middle, colors=displacement, sh_rest=None, slopes=None), camera)
    covered = planes[4] > COVERED
    moved = np.where(covered, planes[:2] / np.where(covered, planes[4], np.float32(1)), np.float32(0))
    places: F32 = np.moveaxis(np.indices(covered.shape, np.float32)[::-1] + moved, 0, -1)
    return np.ascontiguousarray(places)


def _found(others: Gaussians, gaussians: Gaussians) -> tuple[I64, Bool]:
    """The row [N] of each Gaussian among others, and whether it is there [N]."""
    order = np.argsort(others.ids)
    rows = order[np.minimum(np.searchsorted(others.ids[order], gaussians.ids), len(order) - 1)]
    return rows, others.ids[rows] == gaussians.ids
