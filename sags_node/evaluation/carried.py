"""A picture of a moment between two others: the mean of both, each carried along the model's motion.

Gaussians cannot say all of a picture's detail, but they know where everything went. Where nothing moves this
is the mean of both pictures, whose noise is less than that of either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sags_node.engine.rasterizer.rasterize import Rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.geometry import project
from sags_node.types import F32, Bool, Camera, Gaussians

INSIDE = 0.99  # of a carried mask: below, the place is at the edge of an instrument
COVERED = 0.01  # of a pixel; below, the model does not say where it went


@dataclass(frozen=True, slots=True)
class Seen:
    """A moment with its picture."""

    gaussians: Gaussians
    camera: Camera
    picture: F32  # [H, W, 3] RGB 0..1
    tissue: Bool  # [H, W]
    weight: float  # of the picture in the mean, more than 0


def carried(rasterizer: Rasterizer, middle: Gaussians, camera: Camera, around: Sequence[Seen]) -> F32:
    """The mean of some pictures, carried to where the tissue is at another moment.

    Args:
        rasterizer: for pictures of the camera's size.
        middle: the Gaussians at that moment.
        camera: that sees it.
        around: the moments with pictures.

    Returns:
        [H, W, 3] RGB 0..1; where no picture shows tissue, what the Gaussians show.
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
    """Where each pixel's tissue is in a picture, [H, W, 2] px: the mean over the Gaussians that show there of
    how far each is from there. One that was not known there stays where it is."""
    pixels, _ = project(camera, middle.means)
    displacement = np.zeros_like(middle.colors)
    order = np.argsort(seen.gaussians.ids)
    rows = order[np.minimum(np.searchsorted(seen.gaussians.ids[order], middle.ids), len(order) - 1)]
    there, _ = project(seen.camera, seen.gaussians.means[rows])
    known = (seen.gaussians.ids[rows] == middle.ids)[:, None] & np.isfinite(there) & np.isfinite(pixels)
    displacement[:, :2] = np.where(known, there - pixels, 0)
    planes = rasterizer.forward(replace(middle, colors=displacement, sh_rest=None, slopes=None), camera)
    covered = planes[4] > COVERED
    moved = np.where(covered, planes[:2] / np.where(covered, planes[4], np.float32(1)), np.float32(0))
    places: F32 = np.moveaxis(np.indices(covered.shape, np.float32)[::-1] + moved, 0, -1)
    return np.ascontiguousarray(places)
