"""The confidence of a drawn depth, from the predicted errors of what was drawn.

The errors are averaged on a coarse grid, weighted by what each Gaussian covers of the surface that is drawn.
Where a frame measures another depth than is drawn, the error is at least the difference: outdated surfaces
can be drawn together with new ones.
"""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numba import prange

from sags_node.confidence import HALVING, LEAST
from sags_node.engine.interface import BEHIND_SURFACE
from sags_node.engine.pinhole import pack, to_camera, to_pixel
from sags_node.kernels.jit import kernel, parallel_kernel, read_only
from sags_node.types import F32, DepthGrid, Gaussians, RenderedView

CELLS = 80  # across the image
SHARES = 4  # parts of the Gaussians that are summed in parallel
ENOUGH = 3  # Gaussians per cell on average; with more, only every n-th is used


def with_confidence(
    view: RenderedView, gaussians: Gaussians, measured: DepthGrid | None = None
) -> RenderedView:
    """Return the view of these Gaussians with its confidence. Depths below `LEAST` are set to 0, in place.

    Args:
        measured: the depth that was measured in the same frame, in cells of the same size.
    """
    if gaussians.depth_errors is None:
        return view
    height, width = view.depth.shape
    side = max(1, round(width / CELLS))
    rows, columns = -(-height // side), -(-width // side)
    sums = np.zeros((SHARES, 2, rows, columns), np.float32)
    every = max(1, len(gaussians) // (ENOUGH * rows * columns))
    _add_up(
        read_only(gaussians.means), read_only(gaussians.scales), read_only(gaussians.opacities),
        read_only(gaussians.depth_errors), tuple(pack(view.camera)), view.depth, np.float32(1 / side), every,
        sums,
    )  # fmt: skip
    coarse = np.empty((rows, columns), np.float32)
    nothing = np.zeros((0, 0), np.float32)
    inverse, error = (nothing, nothing) if measured is None else (measured.inverse, measured.error)
    if inverse.shape != coarse.shape:
        inverse = error = nothing
    _average(sums, np.float32(HALVING), view.depth, side, inverse, error, coarse)
    wide = cv2.resize(coarse, (columns * side, rows), interpolation=cv2.INTER_LINEAR)
    confidence = np.empty((height, width), np.float32)
    _state(wide, np.float32(1 / side), np.float32(LEAST), view.depth, confidence)
    return replace(view, confidence=confidence)


def doubted(view: RenderedView, error: float) -> RenderedView:
    """Lower the confidence as for a depth error `error` m larger; below `LEAST`, it and depth become 0."""
    if view.confidence is None:
        return view
    confidence = view.confidence * np.float32(2 ** (-error / HALVING))
    nothing = np.float32(0)
    stated = confidence >= np.float32(LEAST)
    return replace(
        view,
        depth=np.where(stated, view.depth, nothing),
        confidence=np.where(stated, confidence, nothing),
    )


@parallel_kernel
def _add_up(
    means: F32, scales: F32, opacities: F32, errors: F32, cam: Any, depth: F32, per_px: Any, every: int,
    sums: F32,
) -> None:  # fmt: skip
    for share in prange(SHARES):
        number = np.int64(share)
        first, end = len(means) * number // SHARES, len(means) * (number + 1) // SHARES
        _add_up_rows(means, scales, opacities, errors, cam, depth, per_px, every, sums[number], first, end)


@kernel
def _add_up_rows(
    means: F32, scales: F32, opacities: F32, errors: F32, cam: Any, depth: F32, per_px: Any, every: int,
    sums: F32, first: Any, end: Any,
) -> None:  # fmt: skip
    """Add up, for each cell, the area of the drawn surface that its Gaussians cover, and that area times the
    squared error."""
    height, width = depth.shape
    half = np.float32(0.5)
    for i in range(first, end, every):
        x, y, z = to_camera(cam, means[i, 0], means[i, 1], means[i, 2])
        if not z > 0:
            continue
        u, v = to_pixel(cam, x, y, z)
        if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        column, row = int(u + half), int(v + half)
        if depth[row, column] * np.float32(1 + BEHIND_SURFACE) < z:
            continue
        covered = opacities[i] * scales[i, 0] * scales[i, 1] / (z * z)
        row, column = int((row + half) * per_px), int((column + half) * per_px)
        sums[0, row, column] += covered
        sums[1, row, column] += covered * errors[i] * errors[i]


@kernel
def _average(
    sums: F32, halving: Any, depth: F32, side: int, inverse: F32, error: F32, confidence: F32
) -> None:
    """Average the error over each cell and its neighbours (1 2 1 along rows and columns). It is at least the
    difference from the depth measured there (`inverse` and `error` of a `DepthGrid`, or empty)."""
    shares, _, rows, columns = sums.shape
    height, width = depth.shape[0] - 1, depth.shape[1] - 1
    half = np.float32(0.5)
    total = np.zeros((2, rows + 2, columns + 2), np.float32)  # none beyond the edges
    for k in range(2):
        for share in range(shares):
            for row in range(rows):
                _add(sums[share, k, row], total[k, row + 1, 1:])
    line = np.empty((2, columns + 2), np.float32)
    for row in range(rows):
        for k in range(2):
            for i in range(columns + 2):
                x = np.uint64(i)
                line[k, x] = half * (total[k, row, x] + total[k, row + 2, x]) + total[k, row + 1, x]
        for column in range(columns):
            covered = half * (line[0, column] + line[0, column + 2]) + line[0, column + 1]
            squares = half * (line[1, column] + line[1, column + 2]) + line[1, column + 1]
            confidence[row, column] = np.float32(0)
            if covered > 0:
                wrong = np.sqrt(squares / covered)
                if inverse.size:
                    drawn = depth[min(row * side + side // 2, height), min(column * side + side // 2, width)]
                    wrong = max(wrong, _difference(drawn, inverse[row, column], error[row, column]))
                confidence[row, column] = np.exp2(-wrong / halving)


@kernel
def _difference(drawn: Any, inverse: Any, error: Any) -> Any:
    """The difference between a drawn and a measured depth, less the measured one's error, m."""
    if not (drawn > 0 and inverse > 0):
        return np.float32(0)
    measured = np.float32(1) / inverse
    return abs(drawn - measured) - error * measured * measured


@kernel
def _add(values: F32, to: F32) -> None:
    for i in range(values.size):
        x = np.uint64(i)
        to[x] += values[x]


@parallel_kernel
def _state(wide: F32, per_px: Any, least: Any, depth: F32, confidence: F32) -> None:
    for row in prange(depth.shape[0]):
        _state_row(wide, per_px, least, np.int64(row), depth, confidence)


@kernel
def _state_row(wide: F32, per_px: Any, least: Any, row: Any, depth: F32, confidence: F32) -> None:
    """Interpolate the confidence of a row of pixels. Below `least`, or without a depth, both become 0."""
    zero, half = np.float32(0), np.float32(0.5)
    v = min(max((np.float32(row) + half) * per_px - half, zero), np.float32(len(wide) - 1))
    before = int(v)
    after, share = min(before + 1, len(wide) - 1), v - np.float32(before)
    _state_between(wide[before], wide[after], share, least, depth[row], confidence[row])


@kernel
def _state_between(upper: F32, lower: F32, share: Any, least: Any, depth: F32, confidence: F32) -> None:
    zero = np.float32(0)
    for i in range(depth.size):
        x = np.uint64(i)
        between = upper[x] + share * (lower[x] - upper[x])
        stated = (between >= least) & (depth[x] > zero)
        depth[x] = depth[x] if stated else zero
        confidence[x] = between if stated else zero
