"""One optimiser step: a closed-form colour step and Adam on the geometry."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numba import prange

from sags_node.engine.interface import MAX_OPACITY, Gradients
from sags_node.kernels.jit import PIECE, kernel, parallel_kernel
from sags_node.model.columns import COLOR_RANGE, LOG_SCALE_RANGE, LOGIT_RANGE
from sags_node.model.gaussians import ADAM_PARAMETERS, GaussianModel
from sags_node.types import F32, Camera


@dataclass(frozen=True, slots=True)
class LearningRates:
    """Lengths of one optimiser step. Positions are in px at the Gaussian's depth, so they are scale-free."""

    mean_px: float = 0.08
    quat: float = 0.0025
    log_scale: float = 0.005
    opacity_logit: float = 0.0075

    def scaled(self, factor: float) -> LearningRates:
        return LearningRates(*(factor * length for length in astuple(self)))

    @property
    def of_columns(self) -> list[float]:
        """The lengths for the columns of a row that Adam steps on."""
        return [self.mean_px] * 3 + [self.quat] * 4 + [self.log_scale] * 3 + [self.opacity_logit]


COLOUR_RELAXATION = 0.9  # of the SIRT step on colours and slopes
SLOPE_DECAY = 0.99  # per step: what the image does not ask for fades
STEEPEST = 0.25  # largest slope: change of a colour 0..1 for each standard deviation
COLOUR_DAMPING = 0.3  # px of coverage: a barely seen Gaussian changes its colour slowly
BETA1, BETA2 = 0.5, 0.99  # low momentum: a few steps per frame must not coast
MIN_CONTRIBUTION = 1e-3  # px: rows that were not seen are not touched
EPS = 1e-8  # of Adam
LARGEST = 1e20  # sum of a row's gradients, momenta and variances
LARGEST_RAW = 100.0  # sum of a row's log scales and logit: no honest value comes near


class Optimiser:
    """Adam (Kingma & Ba, 2015) on geometry and a SIRT step on colours and slopes.

    The colour step is one step of the simultaneous iterative reconstruction technique, in closed form: each
    colour moves by the mean residual of the pixels it covers, weighted by its share in them, and each slope
    by the mean of residual times place. It replaces many gradient steps.

    Let w be a Gaussian's share in a pixel's colour, sum w = 1, e the pixel's place in its standard
    deviations, c and a changes of colours and slopes, and m the mean of |e|^2 under w (`spread` over
    `contribution`). By Cauchy and Schwarz, summed over pixels and channels,

        sum (sum w (c + a . e))^2  <=  sum over Gaussians of (sum w) (|c|^2 + 3 |a|^2)

    where all are seen whole, which makes m = 2. Where others hide their middle, their pixels lie in a ring or
    on one side; the bound is then (sum w) (2 |c|^2 + 6 m |a|^2). So with the relaxation r the step is
    r / (sum w) for colours and r / (3 max(1, m - 1) sum w) for slopes. The first bound asks for r < 2, the
    second one for r < 1 - 1 / m; between the two, tests show that no step makes the image worse.
    """

    def __init__(self) -> None:
        self._steps = 0

    def step(self, model: GaussianModel, gradients: Gradients, camera: Camera, rates: LearningRates) -> None:
        """Update every row of the model that contributed to the image. A row whose gradient or optimiser
        state is not finite sits the step out, with its state made anew."""
        self._steps += 1
        corrections = 1.0 / (1.0 - np.array([BETA1, BETA2]) ** self._steps)
        _step(
            model.means, model.quats, model.log_scales, model.opacity_logits,
            model.scales, model.opacities, model.colors, model.slopes, model.adam_m, model.adam_v,
            gradients.means, gradients.quats, gradients.scales, gradients.opacities,
            gradients.colors, gradients.slopes, gradients.contribution, gradients.spread,
            np.array(rates.of_columns, np.float32), camera.viewmat[2].astype(np.float32),
            float(camera.K[0, 0]), corrections.astype(np.float32),
        )  # fmt: skip


@parallel_kernel
def _step(
    means: F32, quats: F32, log_scales: F32, opacity_logits: F32, scales: F32, opacities: F32, colors: F32,
    slopes: F32, adam_m: F32, adam_v: F32,
    v_means: F32, v_quats: F32, v_scales: F32, v_opacities: F32, v_colors: F32, v_slopes: F32,
    contribution: F32, spread: F32,
    lengths: F32, view_z: F32, focal: float, corrections: F32,
) -> None:  # fmt: skip
    for piece in prange(-(-len(means) // PIECE)):
        first = np.int64(piece) * PIECE
        _step_rows(
            means, quats, log_scales, opacity_logits, scales, opacities, colors, slopes, adam_m, adam_v,
            v_means, v_quats, v_scales, v_opacities, v_colors, v_slopes, contribution, spread,
            lengths, view_z, focal, corrections, first, min(first + PIECE, len(means)),
        )  # fmt: skip


@kernel
def _step_rows(
    means: F32, quats: F32, log_scales: F32, opacity_logits: F32, scales: F32, opacities: F32, colors: F32,
    slopes: F32, adam_m: F32, adam_v: F32,
    v_means: F32, v_quats: F32, v_scales: F32, v_opacities: F32, v_colors: F32, v_slopes: F32,
    contribution: F32, spread: F32,
    lengths: F32, view_z: F32, focal: Any, corrections: F32, first: Any, end: Any,
) -> None:  # fmt: skip
    one = np.float32(1)
    g = np.empty(ADAM_PARAMETERS, np.float32)
    for i in range(first, end):
        if not contribution[i] > MIN_CONTRIBUTION:
            continue
        for k in range(3):
            g[k] = v_means[i, k]
            g[7 + k] = v_scales[i, k] * scales[i, k]  # by log scale
        for k in range(4):
            g[3 + k] = v_quats[i, k]
        g[10] = v_opacities[i] * opacities[i] * (one - opacities[i])  # by logit
        size = contribution[i]
        for k in range(ADAM_PARAMETERS):
            size += abs(g[k]) + abs(adam_m[i, k]) + abs(adam_v[i, k])
        for k in range(3):
            size += abs(v_colors[i, k]) + abs(v_slopes[i, k])
        raw = abs(opacity_logits[i]) + abs(log_scales[i, 0]) + abs(log_scales[i, 1]) + abs(log_scales[i, 2])
        if not (size < np.float32(LARGEST) and raw < np.float32(LARGEST_RAW)):
            _fix(log_scales[i], opacity_logits, scales[i], opacities, adam_m[i], adam_v[i], g, i)
            continue
        gain = np.float32(COLOUR_RELAXATION) / (contribution[i] + np.float32(COLOUR_DAMPING))
        slope_gain = gain / (np.float32(3) * max(spread[i] / contribution[i] - one, one))
        for k in range(3):
            color = colors[i, k] - gain * v_colors[i, k]
            colors[i, k] = min(max(color, np.float32(COLOR_RANGE[0])), np.float32(COLOR_RANGE[1]))
            slope = np.float32(SLOPE_DECAY) * slopes[i, k] - slope_gain * v_slopes[i, k]
            slopes[i, k] = min(max(slope, -np.float32(STEEPEST)), np.float32(STEEPEST))
        for k in range(ADAM_PARAMETERS):
            adam_m[i, k] += np.float32(1 - BETA1) * (g[k] - adam_m[i, k])
            adam_v[i, k] += np.float32(1 - BETA2) * (g[k] * g[k] - adam_v[i, k])
            g[k] = lengths[k] * adam_m[i, k] * corrections[0]
            g[k] /= np.sqrt(adam_v[i, k] * corrections[1]) + np.float32(EPS)
        z = view_z[0] * means[i, 0] + view_z[1] * means[i, 1] + view_z[2] * means[i, 2] + view_z[3]
        pixel = np.float32(abs(z) / focal)  # metres that a pixel spans at the Gaussian's depth
        for k in range(3):
            means[i, k] -= pixel * g[k]
            value = log_scales[i, k] - g[7 + k]
            value = min(max(value, np.float32(LOG_SCALE_RANGE[0])), np.float32(LOG_SCALE_RANGE[1]))
            log_scales[i, k] = value
            scales[i, k] = math.exp(value)
        for k in range(4):
            quats[i, k] -= g[3 + k]
        value = opacity_logits[i] - g[10]
        value = min(max(value, np.float32(LOGIT_RANGE[0])), np.float32(LOGIT_RANGE[1]))
        opacity_logits[i] = value
        opacities[i] = one / (one + math.exp(-value))


@kernel
def _fix(
    log_scale: F32, opacity_logits: F32, scale: F32, opacities: F32, adam_m: F32, adam_v: F32, g: F32, i: int
) -> None:
    """Rebuild a row's raw parameters and Adam's state from its drawn values, which are known to be sound."""
    for k in range(ADAM_PARAMETERS):
        adam_m[k] = 0
        adam_v[k] = g[k] * g[k] if abs(g[k]) < np.inf else np.float32(0)
    for k in range(3):
        log_scale[k] = math.log(scale[k])
    opacity = min(opacities[i], np.float32(MAX_OPACITY))
    opacity_logits[i] = math.log(opacity / (np.float32(1) - opacity))
