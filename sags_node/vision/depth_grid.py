"""What is known of the depth around each place: how good a measurement is, and what stands in for one.

The grid is coarse, and in inverse depth, in which stereo errs alike near and far. A measurement is as good as
it agrees with those around it. Where matches are good, neighbouring cells lie on a smooth surface; where they
are not, as in fog, on a wet spot or at a fold, neighbours differ, and on recordings with true depth the
errors are in proportion to that. Few matches in a place where the tissue around has none are worth little,
whatever their own windows look like.

What was not measured is borrowed from measured cells around it, more from better and nearer ones, by
push-pull through a pyramid (Gortler et al., The Lumigraph, 1996). So a stray match counts only as little as
it is trusted.
"""

from typing import Any

import cv2
import numpy as np

from sags_node.confidence import HALVING
from sags_node.kernels.jit import kernel
from sags_node.kernels.vectors import (
    LANES,
    load_anywhere,
    select,
    smaller,
    spread,
    square_roots,
    store_anywhere,
)
from sags_node.types import F32, Bool, DepthGrid, Observation

CELLS = 80  # across the image
AROUND = 4  # cells to each side of one that are looked at
EVERY = 2  # px between the pixels that are read; depth is matched no finer
WIDTH = 640  # px: the errors below are those of an image so wide
FLOOR = 0.25  # px of disparity: calibration error (principal points, rows, lenses), which no match shows
UNSUPPORTED = 1.0  # px: error of a match with which no neighbour agrees
ROUGHNESS = 3.5  # times how far cells lie from the mean of their neighbours: nine of ten errors are smaller
AGREEING = 1.0  # px, plus what a slope explains: two cells that differ by less are of one surface
STEEPEST = 1.0  # m deeper per m aside, 45 degrees: more is another surface
SLOPE = 0.5  # m deeper per m aside: tissue mostly lies flatter
LEAST_SUPPORT = 0.1  # of the tissue around, measured to be the same surface: less is a speck
NOMINAL_BASELINE = 4e-3  # m: of depth that no pair of eyes measured; endoscopes have about that
UNSURE = 1.1 * HALVING  # m, least error of borrowed depth: it decides nothing, however near it is
JUMP = 0.06  # of the depth: further error of borrowed depth, which often lies behind an edge or an instrument


def depth_grid(depth: F32, confidence: F32, tissue: Bool, focal: float, baseline: float) -> DepthGrid:
    """Make the grid of a measured depth [H, W] (m, 0 unknown). Specks are set to 0 in place, in the depth and
    the confidence.

    Args:
        confidence: [H, W] 0..1, how far each depth is trusted by itself.
        focal: px.
        baseline: m between the eyes; 0: there was only one.
    """
    height, width = depth.shape
    side = max(1, round(width / CELLS))
    rows, columns = -(-height // side), -(-width // side)
    if not depth.any():
        return DepthGrid(
            float(side), np.zeros((rows, columns), np.float32), np.full((rows, columns), np.inf, np.float32)
        )
    px = np.float32(width / WIDTH / (focal * (baseline or NOMINAL_BASELINE)))  # 1/m of one px of disparity
    line = -(-columns // LANES) * LANES + 2 * AROUND
    sums = np.zeros((3, rows + 2 * AROUND, line), np.float32)  # nothing beyond the image's edges
    _gather(depth, confidence, tissue, side, columns, sums)
    around = np.zeros((4, *sums.shape[1:]), np.float32)
    aside = side / focal  # width of a cell at a distance of 1
    _compare(sums, np.float32(AGREEING) * px, np.float32(STEEPEST * aside), around)
    _judge(sums, px, around)
    inverse, error = around[2:, AROUND:-AROUND, AROUND : AROUND + columns]
    _drop_specks(error, side, depth, confidence)
    known = error > 0
    weight = np.where(known, np.square(np.float32(2 * FLOOR) * px / np.where(known, error, 1)), np.float32(0))
    lent, square = _borrowed(np.stack([weight, weight * inverse, weight * error * error]))
    away = cv2.distanceTransform((~known).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
    square += np.square((np.float32(SLOPE * aside) * away + np.float32(JUMP)) * lent)
    unsure = np.maximum(np.sqrt(square), np.float32(UNSURE) * lent * lent)
    lent_error = np.where(lent > 0, unsure, np.float32(np.inf))
    return DepthGrid(float(side), np.where(known, inverse, lent), np.where(known, error, lent_error))


@kernel
def depth_at(depth: F32, inverse: F32, error: F32, side: Any, x: int, y: int) -> Any:
    """Return depth and its error (m) at a pixel of `depth` [H, W]: measured or borrowed; (0, inf): unknown.

    Args:
        inverse, error, side: of the `DepthGrid`.
    """
    half = np.float32(0.5)
    rows, columns = inverse.shape
    v = min(max((np.float32(y) + half) / side - half, np.float32(0)), np.float32(rows - 1))
    u = min(max((np.float32(x) + half) / side - half, np.float32(0)), np.float32(columns - 1))
    z = depth[y, x]
    if not z > 0:
        j, i = int(v), int(u)
        b, a = v - np.float32(j), u - np.float32(i)
        below, right = min(j + 1, rows - 1), min(i + 1, columns - 1)
        upper = (1 - a) * inverse[j, i] + a * inverse[j, right]
        lower = (1 - a) * inverse[below, i] + a * inverse[below, right]
        between = (1 - b) * upper + b * lower
        if not between > 0:
            return np.float32(0), np.float32(np.inf)
        z = np.float32(1) / np.float32(between)
    return z, error[int(v + half), int(u + half)] * z * z


def grid_of(observation: Observation) -> DepthGrid:
    """Return the grid of a frame; if it brings none, it is made now, and no specks are dropped."""
    if observation.grid is not None:
        return observation.grid
    depth, confidence = observation.depth.copy(), observation.depth_confidence.copy()
    focal = float(observation.camera.K[0, 0])
    return depth_grid(depth, confidence, observation.tissue, focal, observation.baseline)


def _borrowed(sums: F32) -> F32:
    """Push-pull: inverse depth and its squared error, [2, h, w], everywhere, from the weights of known cells
    and the weights times either, [3, h, w]. A weight of 1 suffices. 0: nothing is known at all."""
    _, rows, columns = sums.shape
    filled = np.empty((2, rows, columns), np.float32)
    if rows == columns == 1:
        _mix(sums, np.zeros((2, 1, 1), np.float32), filled)
        return filled
    half = np.zeros((3, (rows + 1) // 2, (columns + 1) // 2), np.float32)
    _halve(sums, half)
    _mix(sums, _borrowed(half), filled)
    return filled


@kernel
def _halve(sums: F32, half: F32) -> None:
    for k in range(3):
        for y in range(sums.shape[1]):
            for x in range(sums.shape[2]):
                half[k, y // 2, x // 2] += sums[k, y, x]


@kernel
def _mix(sums: F32, coarse: F32, filled: F32) -> None:
    """Fill each cell with its own mean, and for what its weight lacks to 1 with the value interpolated from
    the grid of half the size."""
    _, height, width = filled.shape
    _, rows, columns = coarse.shape
    one, near, far = np.float32(1), np.float32(0.75), np.float32(0.25)
    for y in range(height):
        j = y // 2
        other_j = min(max(j + (1 if y % 2 else -1), 0), rows - 1)
        for x in range(width):
            i = x // 2
            other_i = min(max(i + (1 if x % 2 else -1), 0), columns - 1)
            weight = sums[0, y, x]
            missing = max(one - weight, np.float32(0)) if height * width > 1 else np.float32(0)
            scale = (one - missing) / weight if weight > 0 else np.float32(0)
            for k in range(2):
                value = scale * sums[k + 1, y, x]
                if missing > 0:
                    nearer = near * coarse[k, j, i] + far * coarse[k, j, other_i]
                    farther = near * coarse[k, other_j, i] + far * coarse[k, other_j, other_i]
                    value += missing * (near * nearer + far * farther)
                filled[k, y, x] = value


@kernel
def _gather(depth: F32, confidence: F32, tissue: Bool, side: int, columns: int, sums: F32) -> None:
    """Gather for each cell the share of pixels that show tissue, the mean trust, and the mean inverse depth,
    weighted by trust."""
    height, width = depth.shape
    line = np.empty((3, width), np.float32)  # sums over the pixels below each other in one row of cells
    for row in range(sums.shape[1] - 2 * AROUND):
        line[:] = np.float32(0)
        top, bottom = row * side, min((row + 1) * side, height)
        for y in range(top, bottom, EVERY):
            _add_shown(tissue[y], line[0])
            _add_depth(depth[y], confidence[y], line[1], line[2])
        _add_cells(line, -((top - bottom) // EVERY), side, columns, row + AROUND, sums)


@kernel
def _add_cells(line: F32, deep: int, side: int, columns: int, row: int, sums: F32) -> None:
    zero = np.float32(0)
    for column in range(columns):
        first, end = column * side, min((column + 1) * side, line.shape[1])
        shown, trust, inverse = zero, zero, zero
        for x in range(first, end, EVERY):
            shown, trust, inverse = shown + line[0, x], trust + line[1, x], inverse + line[2, x]
        count = np.float32(-((first - end) // EVERY) * deep)
        sums[0, row, AROUND + column] = shown / count
        sums[1, row, AROUND + column] = trust / count
        sums[2, row, AROUND + column] = inverse / trust if trust > zero else zero


@kernel
def _add_shown(tissue: Bool, shown: F32) -> None:
    for i in range(shown.size):
        x = np.uint64(i)
        shown[x] += np.float32(tissue[x])


@kernel
def _add_depth(depth: F32, confidence: F32, trust: F32, inverse: F32) -> None:
    zero, one = np.float32(0), np.float32(1)
    for i in range(trust.size):
        x = np.uint64(i)
        known = depth[x] > zero
        share, distance = confidence[x] if known else zero, depth[x] if known else one
        trust[x] += share
        inverse[x] += share / distance


@kernel
def _compare(sums: F32, tolerance: Any, slope: Any, around: F32) -> None:
    """Compare the measured cells: the squared distance from the mean of their neighbours, and the share of
    the tissue up to four cells around that was measured to be the same surface."""
    _, high, line = sums.shape
    trusts, inverses = high * line, 2 * high * line
    zero, none = spread(np.float32(0)), np.float32(0)
    for y in range(AROUND, high - AROUND):
        for x in range(AROUND, line - AROUND, LANES):
            at = y * line + x
            own = load_anywhere(sums, inverses + at)
            weight, mean, shown, agreeing = zero, zero, zero, zero
            for j in range(-1, 2):
                for i in range(-1, 2):
                    near = at + j * line + i
                    if near != at:
                        trust = load_anywhere(sums, trusts + near)
                        weight, mean = weight + trust, mean + trust * load_anywhere(sums, inverses + near)
            for j in range(-AROUND, AROUND + 1, 2):
                for i in range(-AROUND, AROUND + 1, 2):
                    near = at + j * line + i
                    most = own * (slope * np.float32(max(abs(j), abs(i)))) + tolerance
                    apart = load_anywhere(sums, inverses + near) - own
                    same = (apart < most) & (-apart < most)
                    shown = shown + load_anywhere(sums, near)
                    agreeing = agreeing + select(same, load_anywhere(sums, trusts + near), zero)
            is_measured = load_anywhere(sums, trusts + at) > none
            off = mean / weight - own
            store_anywhere(around, at, select(is_measured & (weight > none), off * off, zero))
            support = smaller(agreeing / shown, np.float32(1))
            store_anywhere(around, trusts + at, select(is_measured & (shown > none), support, zero))


@kernel
def _judge(sums: F32, px: Any, around: F32) -> None:
    """Inverse depth and error of the cells that are believed. For the others both are 0, but the error is -1
    where something was measured."""
    _, high, line = sums.shape
    plane = high * line
    zero, one, none = spread(np.float32(0)), spread(np.float32(1)), np.float32(0)
    floor, unsupported = np.float32(FLOOR) * px, np.float32(UNSUPPORTED) * px
    for y in range(AROUND, high - AROUND):
        for x in range(AROUND, line - AROUND, LANES):
            at = y * line + x
            weight, squares = zero, zero
            for j in range(-2, 3):
                for i in range(-2, 3):
                    near = at + j * line + i
                    trust = load_anywhere(sums, plane + near)
                    weight, squares = weight + trust, squares + trust * load_anywhere(around, near)
            support = load_anywhere(around, plane + at)
            is_measured = load_anywhere(sums, plane + at) > none
            is_believed = is_measured & (support >= np.float32(LEAST_SUPPORT))
            rough = np.float32(ROUGHNESS**2) * squares / weight
            alone = unsupported * (one - support)
            error = square_roots(alone * alone + rough + floor * floor)
            inverse = load_anywhere(sums, 2 * plane + at)
            unbelieved = select(is_measured, -one, zero)
            store_anywhere(around, 2 * plane + at, select(is_believed, inverse, zero))
            store_anywhere(around, 3 * plane + at, select(is_believed, error, unbelieved))


@kernel
def _drop_specks(error: F32, side: int, depth: F32, confidence: F32) -> None:
    """Set depth and confidence to 0 in cells of error -1, and then that error to 0."""
    height, width = depth.shape
    for row in range(error.shape[0]):
        for column in range(error.shape[1]):
            if error[row, column] < 0:
                error[row, column] = 0
                for y in range(row * side, min((row + 1) * side, height)):
                    for x in range(column * side, min((column + 1) * side, width)):
                        depth[y, x] = 0
                        confidence[y, x] = 0
