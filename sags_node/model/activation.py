"""From the raw rows that are trained to the Gaussians that are drawn, and back."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from sags_node.engine.interface import Gradients
from sags_node.kernels.jit import parallel_kernel, read_only
from sags_node.model import columns
from sags_node.types import F32, I64, Gaussians

LOG_SCALE, QUAT, COLOR = columns.LOG_SCALE.start, columns.QUAT.start, columns.COLOR.start
LOGIT = columns.LOGIT


def activate(rows: F32, ids: I64, smoothing: F32 | None) -> Gaussians:
    """Gaussians [N] of raw rows [N, 14] (`columns`), in fresh arrays."""
    count = len(rows)
    means, scales, colors = (np.empty((count, 3), np.float32) for _ in range(3))
    quats, opacities = np.empty((count, 4), np.float32), np.empty(count, np.float32)
    _activate(read_only(rows), means, scales, quats, colors, opacities)
    return Gaussians(means, quats, scales, opacities, colors, ids, smoothing=smoothing)


def deactivate(gaussians: Gaussians) -> F32:
    """Raw rows [N, 14] of Gaussians: the inverse of `activate`."""
    opacities = np.clip(gaussians.opacities, 1e-6, 1 - 1e-6)
    return np.concatenate(
        [
            gaussians.means,
            np.log(gaussians.scales),
            gaussians.quats,
            gaussians.colors,
            np.log(opacities / (1 - opacities))[:, None],
        ],
        axis=1,
        dtype=np.float32,
    )


def activate_backward(gaussians: Gaussians, gradients: Gradients) -> F32:
    """Gradient [N, 14] by the raw rows, from that by what was drawn of them."""
    v_rows = np.empty((len(gaussians), columns.COUNT), np.float32)
    _activate_backward(
        read_only(gaussians.scales), read_only(gaussians.opacities),
        gradients.means, gradients.scales, gradients.quats, gradients.colors, gradients.opacities, v_rows,
    )  # fmt: skip
    return v_rows


@parallel_kernel
def _activate(rows: F32, means: F32, scales: F32, quats: F32, colors: F32, opacities: F32) -> None:
    for i in prange(len(rows)):
        for k in range(3):
            means[i, k] = rows[i, k]
            scales[i, k] = math.exp(rows[i, LOG_SCALE + k])
            colors[i, k] = rows[i, COLOR + k]
        for k in range(4):
            quats[i, k] = rows[i, QUAT + k]
        opacities[i] = np.float32(1) / (np.float32(1) + math.exp(-rows[i, LOGIT]))


@parallel_kernel
def _activate_backward(
    scales: F32, opacities: F32, v_means: F32, v_scales: F32, v_quats: F32, v_colors: F32, v_opacities: F32,
    v_rows: F32,
) -> None:  # fmt: skip
    for i in prange(len(v_rows)):
        for k in range(3):
            v_rows[i, k] = v_means[i, k]
            v_rows[i, LOG_SCALE + k] = v_scales[i, k] * scales[i, k]
            v_rows[i, COLOR + k] = v_colors[i, k]
        for k in range(4):
            v_rows[i, QUAT + k] = v_quats[i, k]
        v_rows[i, LOGIT] = v_opacities[i] * opacities[i] * (np.float32(1) - opacities[i])
