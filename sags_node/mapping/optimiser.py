"""One optimiser step: a closed-form colour step and Adam on the geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import prange

from sags_node.engine.jit import parallel_kernel
from sags_node.engine.rasterize import Gradients
from sags_node.model.gaussians import ADAM_PARAMETERS, GaussianModel
from sags_node.types import F32, F64, Camera


@dataclass(frozen=True, slots=True)
class Rates:
    """Lengths of one optimiser step. Positions are in px at the Gaussian's depth, so they are scale-free."""

    mean_px: float = 0.08
    quat: float = 0.0025
    log_scale: float = 0.005
    opacity_logit: float = 0.0075

    def scaled(self, factor: float) -> Rates:
        return Rates(
            factor * self.mean_px, factor * self.quat, factor * self.log_scale, factor * self.opacity_logit
        )


COLOUR_RELAXATION = 1.6  # SIRT over-relaxation; 0 < value < 2 converges
COLOUR_DAMPING = 0.3  # px of coverage: a barely seen Gaussian changes its colour slowly
BETA1, BETA2 = 0.5, 0.99  # low momentum: a few steps per frame must not coast
MIN_CONTRIBUTION = 1e-3  # px: rows that were not seen are not touched
LOG_SCALE_RANGE = (math.log(1e-6), math.log(5e-3))  # m
LOGIT_RANGE = (-6.0, 6.0)


class Optimiser:
    """Adam (Kingma & Ba, 2015) on geometry and a SIRT step on colours.

    The colour step solves for the colours in closed form as far as one simultaneous iterative
    reconstruction step goes: each colour moves by the mean residual of the pixels it covers, weighted by
    its share in them. It replaces many gradient steps.
    """

    def __init__(self) -> None:
        self._steps = 0

    def step(self, model: GaussianModel, gradients: Gradients, camera: Camera, rates: Rates) -> None:
        """Update every row of the model that contributed to the picture. Rows with a gradient that is not
        finite are left as they are."""
        self._steps += 1
        corrections = 1.0 / (1.0 - np.array([BETA1, BETA2]) ** self._steps)
        lengths = np.array(
            [rates.mean_px] * 3 + [rates.quat] * 4 + [rates.log_scale] * 3 + [rates.opacity_logit], np.float32
        )
        viewmat = camera.viewmat[2]
        _step(
            model.means, model.quats, model.log_scales, model.opacity_logits,
            model.scales, model.opacities, model.colors, model.adam_m, model.adam_v,
            gradients.means, gradients.quats, gradients.scales, gradients.opacities,
            gradients.colors, gradients.contribution,
            lengths, viewmat.astype(np.float32), float(camera.K[0, 0]), corrections.astype(np.float32),
        )  # fmt: skip


@parallel_kernel
def _step(
    means: F32, quats: F32, log_scales: F32, opacity_logits: F32, scales: F32, opacities: F32, colors: F32,
    adam_m: F32, adam_v: F32,
    v_means: F32, v_quats: F32, v_scales: F32, v_opacities: F32, v_colors: F32, contribution: F32,
    lengths: F32, view_z: F64, focal: float, corrections: F32,
) -> None:  # fmt: skip
    one = np.float32(1)
    for i in prange(len(means)):
        w = contribution[i]
        if not w > MIN_CONTRIBUTION:
            continue
        g = np.empty(ADAM_PARAMETERS, np.float32)
        for k in range(3):
            g[k] = v_means[i, k]
            g[7 + k] = v_scales[i, k] * scales[i, k]  # by log scale
        for k in range(4):
            g[3 + k] = v_quats[i, k]
        g[10] = v_opacities[i] * opacities[i] * (one - opacities[i])  # by logit
        finite = w < np.inf
        for k in range(ADAM_PARAMETERS):
            finite = finite and abs(g[k]) < np.inf
        for k in range(3):
            finite = finite and abs(v_colors[i, k]) < np.inf
        if not finite:
            continue
        gain = np.float32(COLOUR_RELAXATION) / (w + np.float32(COLOUR_DAMPING))
        for k in range(3):
            colors[i, k] = min(max(colors[i, k] - gain * v_colors[i, k], np.float32(-0.5)), np.float32(1.5))
        z = view_z[0] * means[i, 0] + view_z[1] * means[i, 1] + view_z[2] * means[i, 2] + view_z[3]
        pixel = np.float32(abs(z) / focal)  # metres that one pixel spans at this depth
        for k in range(ADAM_PARAMETERS):
            adam_m[i, k] += np.float32(1 - BETA1) * (g[k] - adam_m[i, k])
            adam_v[i, k] += np.float32(1 - BETA2) * (g[k] * g[k] - adam_v[i, k])
            g[k] = lengths[k] * adam_m[i, k] * corrections[0]
            g[k] /= np.sqrt(adam_v[i, k] * corrections[1]) + np.float32(1e-8)
        for k in range(3):
            means[i, k] -= pixel * g[k]
            value = log_scales[i, k] - g[7 + k]
            log_scales[i, k] = min(max(value, np.float32(LOG_SCALE_RANGE[0])), np.float32(LOG_SCALE_RANGE[1]))
            scales[i, k] = math.exp(log_scales[i, k])
        for k in range(4):
            quats[i, k] -= g[3 + k]
        value = opacity_logits[i] - g[10]
        opacity_logits[i] = min(max(value, np.float32(LOGIT_RANGE[0])), np.float32(LOGIT_RANGE[1]))
        opacities[i] = one / (one + math.exp(-opacity_logits[i]))
