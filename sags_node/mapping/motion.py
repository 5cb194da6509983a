"""Scene flow: where each seen Gaussian went, from optical flow and the new depth."""

from __future__ import annotations

import cv2
import numpy as np
from numba import prange

from sags_node.engine.jit import kernel, parallel_kernel
from sags_node.types import F32, U8, Bool, Camera, Observation, RenderedView

DEPTH_GATE = 0.13  # of the depth: a larger innovation is another surface, not this one
BEHIND_TOLERANCE = 0.035  # of the depth: a Gaussian this far behind the drawn surface is hidden by it
SEEN_ALPHA = 0.3
DEPTH_PULL = 0.4  # share of the depth innovation taken per frame; measured best 0.3-0.5


class OpticalFlow:
    """Dense inverse search flow (Kroeger et al., ECCV 2016) between consecutive left pictures."""

    def __init__(self) -> None:
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def __call__(self, before: U8, after: U8) -> F32:
        """Flow [H, W, 2] in px from `before` to `after`, both gray [H, W]."""
        flow: F32 = self._dis.calc(before, after, None)
        return flow


def scene_flow(
    means: F32, before: RenderedView, tissue_before: Bool, flow: F32, after: Observation
) -> tuple[F32, F32]:
    """Displacement of each Gaussian from one frame to the next.

    Args:
        means: [N, 3] m, world, at the earlier frame.
        before: the model drawn at the earlier frame, to know what was hidden.
        tissue_before: [H, W].
        flow: [H, W, 2] px from the earlier to the later picture.
        after: the later frame; its depth pulls the Gaussian along the ray.

    Returns:
        displacements [N, 3] m, world, and seen [N]: 1 where the displacement was observed, else 0.
    """
    displacements = np.zeros_like(means)
    seen = np.zeros(len(means), np.float32)
    _advect(
        means, _pack(before.camera), before.depth, before.alpha, tissue_before, flow,
        _pack(after.camera), after.tissue, after.depth, displacements, seen,
    )  # fmt: skip
    return displacements, seen


def _pack(camera: Camera) -> F32:
    """viewmat rows (12), fx, fy, cx, cy: what a kernel needs of a camera."""
    K = camera.K
    return np.concatenate([camera.viewmat[:3].ravel(), [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]]).astype(
        np.float32
    )


@parallel_kernel
def _advect(
    means: F32, cam0: F32, drawn_depth: F32, alpha: F32, tissue0: Bool, flow: F32,
    cam1: F32, tissue1: Bool, depth1: F32, displacements: F32, seen: F32,
) -> None:  # fmt: skip
    height, width = alpha.shape
    for i in prange(len(means)):
        x, y, z = _to_camera(cam0, means[i, 0], means[i, 1], means[i, 2])
        if not z > 1e-3:
            continue
        u = cam0[12] * x / z + cam0[14]
        v = cam0[13] * y / z + cam0[15]
        if not (u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1):
            continue
        px, py = int(u + 0.5), int(v + 0.5)
        if not tissue0[py, px] or alpha[py, px] < SEEN_ALPHA:
            continue
        if drawn_depth[py, px] > 0 and z - drawn_depth[py, px] > BEHIND_TOLERANCE * z:
            continue
        u0, v0 = min(int(u), width - 2), min(int(v), height - 2)
        a, b = np.float32(u - u0), np.float32(v - v0)
        one = np.float32(1)
        du = ((one - a) * flow[v0, u0, 0] + a * flow[v0, u0 + 1, 0]) * (one - b) + (
            (one - a) * flow[v0 + 1, u0, 0] + a * flow[v0 + 1, u0 + 1, 0]
        ) * b
        dv = ((one - a) * flow[v0, u0, 1] + a * flow[v0, u0 + 1, 1]) * (one - b) + (
            (one - a) * flow[v0 + 1, u0, 1] + a * flow[v0 + 1, u0 + 1, 1]
        ) * b
        u += du
        v += dv
        _, _, z1 = _to_camera(cam1, means[i, 0], means[i, 1], means[i, 2])
        if u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1:
            px, py = int(u + 0.5), int(v + 0.5)
            if not tissue1[py, px]:
                continue  # flow into an instrument is the instrument's motion
            measured = depth1[py, px]
            if measured > 0 and abs(measured - z1) < DEPTH_GATE * z1:
                z1 += np.float32(DEPTH_PULL) * (measured - z1)
        x1 = (u - cam1[14]) * z1 / cam1[12] - cam1[3]
        y1 = (v - cam1[15]) * z1 / cam1[13] - cam1[7]
        z1 -= cam1[11]
        for k in range(3):  # camera to world: the transposed rotation
            displacements[i, k] = cam1[k] * x1 + cam1[4 + k] * y1 + cam1[8 + k] * z1 - means[i, k]
        seen[i] = 1.0


@kernel
def _to_camera(cam: F32, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        cam[0] * x + cam[1] * y + cam[2] * z + cam[3],
        cam[4] * x + cam[5] * y + cam[6] * z + cam[7],
        cam[8] * x + cam[9] * y + cam[10] * z + cam[11],
    )
