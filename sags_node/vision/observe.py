"""Images and depth -> what the mapper may know of one frame."""

from dataclasses import replace

import cv2
import numpy as np

from sags_node.geometry import scale_intrinsics
from sags_node.types import F32, Bool, Camera, Observation, RectifiedPair
from sags_node.vision.depth import Measured
from sags_node.vision.depth_grid import depth_grid
from sags_node.vision.pyramid import pyramids


def observe(pair: RectifiedPair, tissue: Bool, measured: Measured) -> Observation:
    """Gather one frame's observation.

    Args:
        measured: depth and confidence; specks are taken out of both.
    """
    pyramid, _ = pyramids(pair)
    depth, confidence = measured.depth, measured.confidence
    grid = depth_grid(depth, confidence, tissue, float(pair.camera.K[0, 0]), pair.baseline)
    return Observation(
        frame_id=pair.frame_id,
        t_capture_ns=pair.t_capture_ns,
        camera=pair.camera,
        image=pair.left,
        gray=pyramid.full,
        tissue=tissue,
        depth=depth,
        depth_confidence=confidence,
        depth_is_new=measured.is_new,
        baseline=pair.baseline,
        pyramid=pyramid,
        grid=grid,
    )


def resized(observation: Observation, scale: float) -> Observation:
    """Return the observation with images of `scale` times the size. Masks and depths are not interpolated:
    a mean across an edge is a surface that does not exist."""
    if scale == 1:
        return observation
    camera = observation.camera
    full = camera.width, camera.height
    size = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))

    def nearest(array: F32) -> F32:
        return np.asarray(cv2.resize(array, size, interpolation=cv2.INTER_NEAREST_EXACT))

    grid = observation.grid
    return replace(
        observation,
        camera=Camera(*size, scale_intrinsics(camera.K, full, size), camera.T_world_cam),
        image=cv2.resize(observation.image, size),
        gray=cv2.resize(observation.gray, size),
        tissue=nearest(observation.tissue.view(np.uint8)).view(np.bool_),
        depth=nearest(observation.depth),
        depth_confidence=nearest(observation.depth_confidence),
        grid=None if grid is None else replace(grid, side=grid.side * size[0] / full[0]),
    )
