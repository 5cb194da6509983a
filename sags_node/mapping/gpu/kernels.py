"""What the mapper does around the rasteriser: loss, worst tiles, the nodes' descent and the optimiser's step.

Formulas: `engine.losses.tissue`, `mapping.focus`, `model.deformation` and `mapping.optimiser`.
"""

from __future__ import annotations

import warp as wp

from sags_node.engine.interface import MAX_OPACITY
from sags_node.engine.losses import tissue
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.mapping.focus import EVERY
from sags_node.mapping.optimiser import (
    BETA1,
    BETA2,
    COLOUR_DAMPING,
    COLOUR_RELAXATION,
    EPS,
    LARGEST,
    LARGEST_RAW,
    MIN_CONTRIBUTION,
    SLOPE_DECAY,
    STEEPEST,
)
from sags_node.model import deformation
from sags_node.model.columns import COLOR_RANGE, LOG_SCALE_RANGE, LOGIT_RANGE
from sags_node.model.gaussians import ADAM_PARAMETERS

wp.set_module_options({"enable_backward": False})

PIXELS = 256  # of a block, whose losses are summed before they are added to the total
LEVEL = 1.0 / 255.0
INFINITE = 3.0e38  # beyond is no finite float32
COVERED, DEPTH_COVERED, FULL = float(tissue.COVERED), float(tissue.DEPTH_COVERED), float(tissue.FULL)
MAX_RESIDUAL, COVERAGE_WEIGHT = float(tissue.MAX_RESIDUAL), tissue.COVERAGE_WEIGHT
INERTIA, CALM, NODE_EPS = deformation.INERTIA, deformation.CALM, deformation.NODE_EPS
LEAST_SEEN, NODE_STEEPEST = deformation.LEAST_SEEN, deformation.STEEPEST
NODE_CONTRIBUTION = deformation.MIN_CONTRIBUTION
COLOR_LOW, COLOR_HIGH = COLOR_RANGE
LOG_SCALE_LOW, LOG_SCALE_HIGH = LOG_SCALE_RANGE
LOGIT_LOW, LOGIT_HIGH = LOGIT_RANGE
parameters = wp.types.vector(ADAM_PARAMETERS, wp.float32)


@wp.kernel(grid_stride=False)
def tissue_loss(
    planes: wp.array3d(dtype=float), image: wp.array3d(dtype=wp.uint8), is_tissue: wp.array2d(dtype=wp.bool),
    depth: wp.array2d(dtype=float), depth_weight: float, depth_scale: float,
    v_planes: wp.array3d(dtype=float), weight: wp.array2d(dtype=float), sums: wp.array(dtype=wp.vec2),
):  # fmt: skip
    """Launched for whole blocks: `sums` gets the absolute colour residuals and the number of their pixels."""
    p = wp.tid()
    width, height = weight.shape[1], weight.shape[0]
    y, x = p // width, p % width
    used, measured = bool(False), bool(False)
    c, r = wp.vec3(), wp.vec3()
    inverse, d, off, residual = float(0.0), float(0.0), float(0.0), float(0.0)
    counts = bool(False)
    coverage = float(0.0)
    if y < height:
        coverage = planes[4, y, x]
        counts = is_tissue[y, x]
    if counts and coverage > COVERED and coverage < INFINITE:
        inverse = 1.0 / coverage
        c = inverse * wp.vec3(planes[0, y, x], planes[1, y, x], planes[2, y, x])
        r = c - LEVEL * wp.vec3(float(image[y, x, 0]), float(image[y, x, 1]), float(image[y, x, 2]))
        residual = wp.abs(r[0]) + wp.abs(r[1]) + wp.abs(r[2])
        used = residual < MAX_RESIDUAL
        d = planes[3, y, x] * inverse
        off = (d - depth[y, x]) / depth_scale
        measured = used and coverage > DEPTH_COVERED and depth[y, x] > 0.0 and wp.abs(off) < INFINITE
    v_color, v_depth, v_coverage, counted = wp.vec3(), float(0.0), float(0.0), wp.vec2()
    if used:
        v_color = inverse * r
        v_coverage -= wp.dot(v_color, c)
        counted = wp.vec2(residual, 1.0)
    if measured:
        v_depth = inverse * depth_weight / depth_scale * wp.clamp(off, -1.0, 1.0)
        v_coverage -= v_depth * d
    if counts and wp.abs(coverage) < FULL:
        v_coverage -= COVERAGE_WEIGHT
    if y < height:
        for k in range(3):
            v_planes[k, y, x] = v_color[k]
        v_planes[3, y, x] = v_depth
        v_planes[4, y, x] = v_coverage
        weight[y, x] = wp.where(used, inverse, 0.0)
    wp.tile_atomic_add(sums, wp.tile_sum(wp.tile(counted, preserve_type=True)), offset=(0,))


@wp.kernel(grid_stride=False)
def sum_residuals(
    planes: wp.array3d(dtype=float), image: wp.array3d(dtype=wp.uint8), is_tissue: wp.array2d(dtype=wp.bool),
    sums: wp.array2d(dtype=float),
):  # fmt: skip
    """Squared colour residuals [rows, columns] of the CPU engine's tiles."""
    row, column = wp.tid()
    height, width = is_tissue.shape[0], is_tissue.shape[1]
    total = float(0.0)
    for y in range(row * TILE_HEIGHT, wp.min((row + 1) * TILE_HEIGHT, height), EVERY):
        for x in range(column * TILE_WIDTH, wp.min((column + 1) * TILE_WIDTH, width), EVERY):
            coverage = planes[4, y, x]
            if is_tissue[y, x] and coverage > COVERED:
                for k in range(3):
                    residual = planes[k, y, x] / coverage - float(image[y, x, k]) * LEVEL
                    if wp.abs(residual) < 1.0:
                        total += residual * residual
    sums[row, column] = total


@wp.kernel(grid_stride=False)
def gather_nodes(
    v_means: wp.array(dtype=wp.vec3), contribution: wp.array(dtype=float),
    node_index: wp.array(dtype=wp.vec4i), node_weight: wp.array(dtype=wp.vec4),
    total: wp.array(dtype=wp.vec3), mass: wp.array(dtype=float),
):  # fmt: skip
    """Sum the gradients of what follows each node. On a GPU a sum's order changes from run to run."""
    i = wp.tid()
    if contribution[i] > NODE_CONTRIBUTION:
        for k in range(4):
            share = node_weight[i][k]
            if share >= 0.0 and share <= 1.0:
                wp.atomic_add(total, node_index[i][k], share * v_means[i])
                wp.atomic_add(mass, node_index[i][k], share)


@wp.kernel(grid_stride=False)
def move_nodes(
    total: wp.array(dtype=wp.vec3), mass: wp.array(dtype=float), step: float, nodes: wp.array(dtype=wp.vec3),
    momentum: wp.array(dtype=wp.vec3), variance: wp.array(dtype=wp.vec3), motion: wp.array(dtype=wp.vec3),
):  # fmt: skip
    m = wp.tid()
    gradient = wp.vec3()
    if mass[m] > LEAST_SEEN:
        gradient = total[m] / mass[m]
    p, v, moved = momentum[m], variance[m], wp.vec3()
    for k in range(3):
        p[k] = p[k] + INERTIA * (gradient[k] - p[k])
        v[k] = v[k] + CALM * (gradient[k] * gradient[k] - v[k])
        size = wp.sqrt(v[k])
        if not (wp.abs(p[k]) <= NODE_STEEPEST * size and wp.isfinite(size)):
            p[k] = 0.0
            v[k] = 0.0
            size = 0.0
        moved[k] = -step * p[k] / (size + NODE_EPS)
    momentum[m] = p
    variance[m] = v
    motion[m] = moved
    nodes[m] = nodes[m] + moved


@wp.kernel(grid_stride=False)
def skin(
    motion: wp.array(dtype=wp.vec3), node_index: wp.array(dtype=wp.vec4i),
    node_weight: wp.array(dtype=wp.vec4), means: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Move Gaussians by the motion of their nodes."""
    i = wp.tid()
    moved = wp.vec3()
    for k in range(4):
        moved += node_weight[i][k] * motion[node_index[i][k]]
    means[i] = means[i] + moved


@wp.kernel(grid_stride=False)
def carry_moments(
    origin: wp.array(dtype=int), old_m: wp.array(dtype=parameters), old_v: wp.array(dtype=parameters),
    adam_m: wp.array(dtype=parameters), adam_v: wp.array(dtype=parameters),
):  # fmt: skip
    """Let Adam's moments follow their Gaussians to new rows; `origin` as `GaussianModel` has it."""
    i = wp.tid()
    m, v = parameters(), parameters()
    if origin[i] > 0:
        m = old_m[origin[i] - 1]
        v = old_v[origin[i] - 1]
    adam_m[i] = m
    adam_v[i] = v


@wp.kernel(grid_stride=False)
def optimise(
    v_means: wp.array(dtype=wp.vec3), v_quats: wp.array(dtype=wp.vec4), v_scales: wp.array(dtype=wp.vec3),
    v_opacities: wp.array(dtype=float), v_colors: wp.array(dtype=wp.vec3), v_slopes: wp.array(dtype=wp.vec3),
    contribution: wp.array(dtype=float), spread: wp.array(dtype=float),
    lengths: parameters, view_z: wp.vec4, focal: float, correct_m: float, correct_v: float,
    means: wp.array(dtype=wp.vec3), quats: wp.array(dtype=wp.vec4), log_scales: wp.array(dtype=wp.vec3),
    logits: wp.array(dtype=float), scales: wp.array(dtype=wp.vec3), opacities: wp.array(dtype=float),
    colors: wp.array(dtype=wp.vec3), slopes: wp.array(dtype=wp.vec3),
    adam_m: wp.array(dtype=parameters), adam_v: wp.array(dtype=parameters),
):  # fmt: skip
    i = wp.tid()
    seen = contribution[i]
    if not seen > MIN_CONTRIBUTION:
        return
    scale, opacity = scales[i], opacities[i]
    by_mean, by_quat, by_scale = v_means[i], v_quats[i], wp.cw_mul(v_scales[i], scale)
    g = parameters(
        by_mean[0], by_mean[1], by_mean[2], by_quat[0], by_quat[1], by_quat[2], by_quat[3],
        by_scale[0], by_scale[1], by_scale[2], v_opacities[i] * opacity * (1.0 - opacity),
    )  # fmt: skip
    m, v = adam_m[i], adam_v[i]
    size = float(seen)
    for k in range(ADAM_PARAMETERS):
        size += wp.abs(g[k]) + wp.abs(m[k]) + wp.abs(v[k])
    for k in range(3):
        size += wp.abs(v_colors[i][k]) + wp.abs(v_slopes[i][k])
    raw = logits[i]
    rows = log_scales[i]
    hidden = wp.abs(raw) + wp.abs(rows[0]) + wp.abs(rows[1]) + wp.abs(rows[2])
    if not (size < LARGEST and hidden < LARGEST_RAW):
        fresh = parameters()  # raw parameters and Adam's state are rebuilt from the drawn values
        for k in range(ADAM_PARAMETERS):
            if wp.abs(g[k]) < INFINITE:
                fresh[k] = g[k] * g[k]
        adam_m[i] = parameters()
        adam_v[i] = fresh
        log_scales[i] = wp.vec3(wp.log(scale[0]), wp.log(scale[1]), wp.log(scale[2]))
        held = wp.min(opacity, MAX_OPACITY)
        logits[i] = wp.log(held / (1.0 - held))
        return
    gain = COLOUR_RELAXATION / (seen + COLOUR_DAMPING)
    slope_gain = gain / (3.0 * wp.max(spread[i] / seen - 1.0, 1.0))
    c, s = colors[i] - gain * v_colors[i], SLOPE_DECAY * slopes[i] - slope_gain * v_slopes[i]
    for k in range(3):
        c[k] = wp.clamp(c[k], COLOR_LOW, COLOR_HIGH)
        s[k] = wp.clamp(s[k], -STEEPEST, STEEPEST)
    colors[i] = c
    slopes[i] = s
    step = parameters()
    for k in range(ADAM_PARAMETERS):
        m[k] = m[k] + (1.0 - BETA1) * (g[k] - m[k])
        v[k] = v[k] + (1.0 - BETA2) * (g[k] * g[k] - v[k])
        step[k] = lengths[k] * m[k] * correct_m / (wp.sqrt(v[k] * correct_v) + EPS)
    adam_m[i] = m
    adam_v[i] = v
    mean = means[i]
    z = view_z[0] * mean[0] + view_z[1] * mean[1] + view_z[2] * mean[2] + view_z[3]
    pixel = wp.abs(z) / focal  # metres that a pixel spans at the Gaussian's depth
    means[i] = mean - pixel * wp.vec3(step[0], step[1], step[2])
    quats[i] = quats[i] - wp.vec4(step[3], step[4], step[5], step[6])
    for k in range(3):
        rows[k] = wp.clamp(rows[k] - step[7 + k], LOG_SCALE_LOW, LOG_SCALE_HIGH)
        scale[k] = wp.exp(rows[k])
    log_scales[i] = rows
    scales[i] = scale
    logit = wp.clamp(raw - step[10], LOGIT_LOW, LOGIT_HIGH)
    logits[i] = logit
    opacities[i] = 1.0 / (1.0 + wp.exp(-logit))
