"""One optimiser step on the Gaussians of a model on the device: a closed-form colour step, Adam on the rest.

The step of `mapping.optimiser`, whose constants come as `Constants`. A program takes `BLOCK` Gaussians; each
of their parameters is a tile [BLOCK, 4] of which 1, 3 or 4 columns are used: loads of neighbouring rows join.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import triton
import triton.language as tl

from sags_node.engine import interface
from sags_node.engine.cuda.signatures import Compiled

if TYPE_CHECKING:
    from torch import Tensor

BLOCK = 128  # Gaussians of a program
PARAMETERS = 11  # columns of Adam's moments
MEAN, QUAT, SCALE, LOGIT = (tl.constexpr(first) for first in (0, 3, 7, 10))  # where each parameter's begin
STATE = tl.constexpr(PARAMETERS)
INFINITY = tl.constexpr(float("inf"))
MAX_OPACITY = tl.constexpr(interface.MAX_OPACITY)


@dataclass(frozen=True, slots=True)
class Model:
    """What a step changes, of N Gaussians: float32, contiguous, on one device."""

    means: Tensor  # [N, 3] m, world
    quats: Tensor  # [N, 4] wxyz
    log_scales: Tensor  # [N, 3]
    opacity_logits: Tensor  # [N]
    scales: Tensor  # [N, 3] m, kept in step with `log_scales`
    opacities: Tensor  # [N] likewise
    colors: Tensor  # [N, 3]
    adam_m: Tensor  # [N, 11] of mean, quat, log scale, logit
    adam_v: Tensor  # [N, 11]


@dataclass(frozen=True, slots=True)
class Slopes:
    """Derivatives of the loss by what is drawn, of the same Gaussians; see `engine.interface.Gradients`."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3]
    contribution: Tensor  # [N] px


@dataclass(frozen=True, slots=True)
class Constants:
    """How a step is made; the values are the mapper's."""

    relaxation: float  # of the colour step
    damping: float  # px of coverage
    beta1: float
    beta2: float
    least_contribution: float  # px: rows that were seen less are not touched
    eps: float  # of Adam
    color_range: tuple[float, float]
    log_scale_range: tuple[float, float]
    logit_range: tuple[float, float]
    largest: float  # sum of a sound row's gradients, momenta and variances
    largest_raw: float  # sum of a sound row's log scales and logit


@triton.jit
def _load(
    table: tl.tensor,
    row: tl.tensor,
    ok: tl.tensor,
    STRIDE: tl.constexpr,
    FIRST: tl.constexpr,
    COUNT: tl.constexpr,
) -> tl.tensor:
    """Columns FIRST.. of rows, as a tile [BLOCK, 4]; 0 where there is none."""
    column = tl.arange(0, 4)[None, :]
    return tl.load(table + row[:, None] * STRIDE + FIRST + column, ok[:, None] & (column < COUNT), other=0.0)


@triton.jit
def _store(
    table: tl.tensor,
    values: tl.tensor,
    row: tl.tensor,
    ok: tl.tensor,
    STRIDE: tl.constexpr,
    FIRST: tl.constexpr,
    COUNT: tl.constexpr,
) -> None:
    column = tl.arange(0, 4)[None, :]
    at = table + row[:, None] * STRIDE + FIRST + column
    tl.store(at, values, ok[:, None] & (column < COUNT))


@triton.jit
def _size(
    g: tl.tensor,
    m: tl.tensor,
    v: tl.tensor,
    row: tl.tensor,
    ok: tl.tensor,
    FIRST: tl.constexpr,
    COUNT: tl.constexpr,
) -> tl.tensor:
    """[BLOCK] how large a parameter's gradient and state are together."""
    state_m = _load(m, row, ok, STATE, FIRST, COUNT)
    state_v = _load(v, row, ok, STATE, FIRST, COUNT)
    return tl.sum(tl.abs(g) + tl.abs(state_m) + tl.abs(state_v), axis=1)


@triton.jit
def _move(
    g: tl.tensor,
    m: tl.tensor,
    v: tl.tensor,
    row: tl.tensor,
    moves: tl.tensor,
    broken: tl.tensor,
    length: tl.tensor,
    move_m: tl.tensor,
    move_v: tl.tensor,
    correction_m: tl.tensor,
    correction_v: tl.tensor,
    eps: tl.tensor,
    FIRST: tl.constexpr,
    COUNT: tl.constexpr,
) -> tl.tensor:
    """Adam's step [BLOCK, 4] of a parameter, to be subtracted; a broken row's state is made anew."""
    state_m = _load(m, row, moves, STATE, FIRST, COUNT)
    state_v = _load(v, row, moves, STATE, FIRST, COUNT)
    state_m += move_m * (g - state_m)
    state_v += move_v * (g * g - state_v)
    anew = tl.where(tl.abs(g) < INFINITY, g * g, 0.0)
    written = moves | broken
    _store(m, tl.where(broken[:, None], 0.0, state_m), row, written, STATE, FIRST, COUNT)
    _store(v, tl.where(broken[:, None], anew, state_v), row, written, STATE, FIRST, COUNT)
    return length * state_m * correction_m / (tl.sqrt_rn(state_v * correction_v) + eps)


@triton.jit(do_not_specialize=("count",))
def _step(
    means: tl.tensor,
    quats: tl.tensor,
    log_scales: tl.tensor,
    opacity_logits: tl.tensor,
    scales: tl.tensor,
    opacities: tl.tensor,
    colors: tl.tensor,
    adam_m: tl.tensor,
    adam_v: tl.tensor,
    v_means: tl.tensor,
    v_quats: tl.tensor,
    v_scales: tl.tensor,
    v_opacities: tl.tensor,
    v_colors: tl.tensor,
    contribution: tl.tensor,
    count: tl.tensor,
    mean_px: tl.tensor,
    quat_length: tl.tensor,
    log_scale_length: tl.tensor,
    logit_length: tl.tensor,
    view_x: tl.tensor,  # the row of the view matrix that gives z
    view_y: tl.tensor,
    view_z: tl.tensor,
    view_shift: tl.tensor,
    focal: tl.tensor,
    move_m: tl.tensor,
    move_v: tl.tensor,
    correction_m: tl.tensor,
    correction_v: tl.tensor,
    relaxation: tl.tensor,
    damping: tl.tensor,
    least_contribution: tl.tensor,
    eps: tl.tensor,
    color_low: tl.tensor,
    color_high: tl.tensor,
    log_scale_low: tl.tensor,
    log_scale_high: tl.tensor,
    logit_low: tl.tensor,
    logit_high: tl.tensor,
    largest: tl.tensor,
    largest_raw: tl.tensor,
    BLOCK: tl.constexpr,
) -> None:
    row = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    seen = tl.load(contribution + row, row < count, other=0.0)
    taken = seen > least_contribution
    scale, opacity = _load(scales, row, taken, 3, 0, 3), _load(opacities, row, taken, 1, 0, 1)
    log_scale, logit = _load(log_scales, row, taken, 3, 0, 3), _load(opacity_logits, row, taken, 1, 0, 1)
    g_mean, g_quat = _load(v_means, row, taken, 3, 0, 3), _load(v_quats, row, taken, 4, 0, 4)
    g_scale = _load(v_scales, row, taken, 3, 0, 3) * scale  # by log scale
    g_logit = _load(v_opacities, row, taken, 1, 0, 1) * opacity * (1.0 - opacity)
    g_color = _load(v_colors, row, taken, 3, 0, 3)
    size = seen + tl.sum(tl.abs(g_color), axis=1)
    size += _size(g_mean, adam_m, adam_v, row, taken, MEAN, 3)
    size += _size(g_quat, adam_m, adam_v, row, taken, QUAT, 4)
    size += _size(g_scale, adam_m, adam_v, row, taken, SCALE, 3)
    size += _size(g_logit, adam_m, adam_v, row, taken, LOGIT, 1)
    raw = tl.sum(tl.abs(log_scale) + tl.abs(logit), axis=1)
    moves = taken & (size < largest) & (raw < largest_raw)
    broken = taken & ~moves

    gain = (relaxation / (seen + damping))[:, None]
    color = _load(colors, row, moves, 3, 0, 3) - gain * g_color
    _store(colors, tl.minimum(tl.maximum(color, color_low), color_high), row, moves, 3, 0, 3)

    mean = _load(means, row, moves, 3, 0, 3)
    axis = tl.arange(0, 4)[None, :]
    view = tl.where(axis == 0, view_x, tl.where(axis == 1, view_y, tl.where(axis == 2, view_z, 0.0)))
    z = tl.sum(view * mean, axis=1) + view_shift
    pixel = (tl.abs(z) / focal)[:, None]  # metres that a pixel spans at the Gaussian's depth
    step = _move(g_mean, adam_m, adam_v, row, moves, broken, mean_px,
                 move_m, move_v, correction_m, correction_v, eps, MEAN, 3)  # fmt: skip
    _store(means, mean - pixel * step, row, moves, 3, 0, 3)
    step = _move(g_quat, adam_m, adam_v, row, moves, broken, quat_length,
                 move_m, move_v, correction_m, correction_v, eps, QUAT, 4)  # fmt: skip
    _store(quats, _load(quats, row, moves, 4, 0, 4) - step, row, moves, 4, 0, 4)

    # what is drawn of a broken row is known to be sound: its raw values are made anew from that
    written = moves | broken
    step = _move(g_scale, adam_m, adam_v, row, moves, broken, log_scale_length,
                 move_m, move_v, correction_m, correction_v, eps, SCALE, 3)  # fmt: skip
    log_scale = tl.minimum(tl.maximum(log_scale - step, log_scale_low), log_scale_high)
    _store(scales, tl.exp(log_scale), row, moves, 3, 0, 3)
    _store(log_scales, tl.where(broken[:, None], tl.log(scale), log_scale), row, written, 3, 0, 3)
    step = _move(g_logit, adam_m, adam_v, row, moves, broken, logit_length,
                 move_m, move_v, correction_m, correction_v, eps, LOGIT, 1)  # fmt: skip
    logit = tl.minimum(tl.maximum(logit - step, logit_low), logit_high)
    _store(opacities, 1.0 / (1.0 + tl.exp(-logit)), row, moves, 1, 0, 1)
    opacity = tl.minimum(opacity, MAX_OPACITY)
    logit = tl.where(broken[:, None], tl.log(opacity / (1.0 - opacity)), logit)
    _store(opacity_logits, logit, row, written, 1, 0, 1)


class Optimiser:
    """Adam (Kingma & Ba, 2015) on geometry and a SIRT step on colours, as `mapping.optimiser.Optimiser`."""

    def __init__(self, constants: Constants) -> None:
        self._constants = constants
        self._steps = 0

    def step(
        self,
        model: Model,
        slopes: Slopes,
        lengths: tuple[float, float, float, float],
        view_z: tuple[float, float, float, float],
        focal_px: float,
    ) -> None:
        """Update every row of the model that contributed to the picture. A row whose gradient or optimiser
        state is not finite sits the step out, with its state made anew.

        Args:
            lengths: of one step of means (px at the Gaussian's depth), quats, log scales and logits.
            view_z: the row of the camera's `viewmat` that gives z.
            focal_px: of the camera.
        """
        self._steps += 1
        constants, count = self._constants, len(model.means)
        beta1, beta2 = constants.beta1, constants.beta2
        if count == 0:
            return
        _step[(triton.cdiv(count, BLOCK),)](
            model.means, model.quats, model.log_scales, model.opacity_logits, model.scales, model.opacities,
            model.colors, model.adam_m, model.adam_v,
            slopes.means, slopes.quats, slopes.scales, slopes.opacities, slopes.colors, slopes.contribution,
            count, *lengths, *view_z, focal_px,
            1.0 - beta1, 1.0 - beta2, 1.0 / (1.0 - beta1**self._steps), 1.0 / (1.0 - beta2**self._steps),
            constants.relaxation, constants.damping, constants.least_contribution, constants.eps,
            *constants.color_range, *constants.log_scale_range, *constants.logit_range,
            constants.largest, constants.largest_raw,
            BLOCK=BLOCK,
        )  # fmt: skip


_TABLES = (
    "means", "quats", "log_scales", "opacity_logits", "scales", "opacities", "colors", "adam_m", "adam_v",
    "v_means", "v_quats", "v_scales", "v_opacities", "v_colors", "contribution",
)  # fmt: skip
_NUMBERS = (
    "mean_px", "quat_length", "log_scale_length", "logit_length",
    "view_x", "view_y", "view_z", "view_shift", "focal", "move_m", "move_v", "correction_m", "correction_v",
    "relaxation", "damping", "least_contribution", "eps", "color_low", "color_high",
    "log_scale_low", "log_scale_high", "logit_low", "logit_high", "largest", "largest_raw",
)  # fmt: skip
SIGNATURES = (
    Compiled(
        _step,
        {**dict.fromkeys(_TABLES, "*fp32"), "count": "i32", **dict.fromkeys(_NUMBERS, "fp32")},
        {"BLOCK": BLOCK},
    ),
)
