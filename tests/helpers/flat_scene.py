"""A flat piece of tissue seen straight on: one frame of it, with a model whose Gaussians lie on it."""

from dataclasses import replace

import numpy as np
from engine_scenes import round_gaussians

from sags_node.types import Camera, Colours, Observation, RenderedView, Snapshot

Scene = tuple[Observation, Snapshot, RenderedView]


def camera_in_front(width: int, height: int, focal: float) -> Camera:
    """A camera without a pose that looks along z, its middle in the middle of the image."""
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera(width, height, K, np.eye(4))


def flat_means(camera: Camera, depth: float, every: float) -> np.ndarray:
    """Places [N, 3] m on the plane z = depth, one for each `every` px."""
    u, v = np.meshgrid(np.arange(0, camera.width, every), np.arange(0, camera.height, every))
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1) @ np.linalg.inv(camera.K).T
    return (depth * rays).astype(np.float32)


def flat_scene(
    camera: Camera,
    means: np.ndarray,
    gray: np.ndarray,
    drawn: float,
    frame: int = 0,
    stamp_ns: int = 0,
    first_id: int = 0,
) -> Scene:
    """What was seen, the model and what it shows: all of it tissue, at the depth `drawn` (m)."""
    shape = camera.height, camera.width
    gaussians = round_gaussians(means, 1e-3, 1.0, 1.0)
    gaussians = replace(gaussians, ids=gaussians.ids + first_id)
    depth = np.full(shape, drawn, np.float32)
    tissue = np.ones(shape, bool)
    dark = Colours(np.zeros((*shape, 3), np.uint8))
    observation = Observation(frame, stamp_ns, camera, dark.small, gray, tissue, depth, depth)
    snapshot = Snapshot(frame, stamp_ns, 0, gaussians, np.zeros_like(means), camera, 0.0)
    return observation, snapshot, RenderedView(frame, stamp_ns, camera, dark, depth, np.ones_like(depth))
