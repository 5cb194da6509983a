"""The confidence of a drawn depth, from the predicted errors of what was drawn.

The errors are averaged on a coarse grid, weighted by what each Gaussian covers of the surface that is drawn.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numba import prange

from sags_node.confidence import HALVING, LEAST
from sags_node.engine.pinhole import pack, to_camera, to_pixel
from sags_node.kernels.jit import kernel, parallel_kernel, read_only
from sags_node.types import F32, Gaussians, RenderedView

CELLS = 80  # across the picture
BEHIND = 0.035  # of the depth: what is so far behind the drawn surface is hidden by it
SHARES = 4  # of the Gaussians, each added up by itself
ENOUGH = 3  # Gaussians in a cell, on the average: of more not all are looked at


def with_confidence(view: RenderedView, gaussians: Gaussians) -> RenderedView:
    """The view of these Gaussians with its confidence; a depth below `LEAST` is taken out, in place."""
    if gaussians.depth_errors is None:
        return view
    height, width = view.depth.shape
    side = max(1, round(width / CELLS))
    rows, columns = -(-height // side), -(-width // side)
    sums = np.zeros((SHARES, 2, rows, columns), np.float32)
    every = max(1, len(gaussians) // (ENOUGH * rows * columns))
    _add_up(
        read_only(gaussians.means), read_only(gaussians.scales), read_only(gaussians.opacities),
        read_only(gaussians.depth_errors), tuple(pack(view.camera)), view.depth, side, every, sums,
    )  # fmt: skip
    coarse = np.empty((rows, columns), np.float32)
    _average(sums, np.float32(HALVING), coarse)
    confidence = cv2.resize(coarse, (columns * side, rows * side), interpolation=cv2.INTER_LINEAR)
    confidence = np.ascontiguousarray(confidence[:height, :width])
    _leave_out(np.float32(LEAST), view.depth, confidence)
    return replace(view, confidence=confidence)


def doubted(view: RenderedView, error: float) -> RenderedView:
    """The view when its depth may be wrong by so much more, m; what falls below `LEAST` is taken out."""
    if view.confidence is None:
        return view
    confidence = view.confidence * np.float32(2 ** (-error / HALVING))
    _leave_out(np.float32(LEAST), depth := view.depth.copy(), confidence)
    return replace(view, depth=depth, confidence=confidence)


@parallel_kernel
def _add_up(
    means: F32, scales: F32, opacities: F32, errors: F32, cam: Any, depth: F32, side: int, every: int,
    sums: F32,
) -> None:  # fmt: skip
    for share in prange(SHARES):
        number = np.int64(share)
        first, end = len(means) * number // SHARES, len(means) * (number + 1) // SHARES
        _add_up_rows(means, scales, opacities, errors, cam, depth, side, every, sums[number], first, end)


@kernel
def _add_up_rows(
    means: F32, scales: F32, opacities: F32, errors: F32, cam: Any, depth: F32, side: int, every: int,
    sums: F32, first: Any, end: Any,
) -> None:  # fmt: skip
    """Of each cell, what the Gaussians in it cover of the drawn surface, and that times the squared error."""
    height, width = depth.shape
    for i in range(first, end, every):
        x, y, z = to_camera(cam, means[i, 0], means[i, 1], means[i, 2])
        if not z > 0:
            continue
        u, v = to_pixel(cam, x, y, z)
        if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        column, row = int(u + 0.5), int(v + 0.5)
        if depth[row, column] * np.float32(1 + BEHIND) < z:
            continue
        covered = opacities[i] * scales[i, 0] * scales[i, 1] / (z * z)
        row //= side
        column //= side
        sums[0, row, column] += covered
        sums[1, row, column] += covered * errors[i] * errors[i]


@kernel
def _average(sums: F32, halving: Any, confidence: F32) -> None:
    """Over each cell and, by half, its neighbours."""
    shares, _, rows, columns = sums.shape
    one, half = np.float32(1), np.float32(0.5)
    for share in range(1, shares):
        for row in range(rows):
            for column in range(columns):
                sums[0, 0, row, column] += sums[share, 0, row, column]
                sums[0, 1, row, column] += sums[share, 1, row, column]
    for row in range(rows):
        for column in range(columns):
            covered, squares = np.float32(0), np.float32(0)
            for y in range(max(row - 1, 0), min(row + 2, rows)):
                by_row = one if y == row else half
                for x in range(max(column - 1, 0), min(column + 2, columns)):
                    weight = by_row if x == column else by_row * half
                    covered += weight * sums[0, 0, y, x]
                    squares += weight * sums[0, 1, y, x]
            confidence[row, column] = np.float32(0)
            if covered > 0:
                confidence[row, column] = np.float32(2) ** (-np.sqrt(squares / covered) / halving)


@parallel_kernel
def _leave_out(least: Any, depth: F32, confidence: F32) -> None:
    for row in prange(depth.shape[0]):
        _leave_out_row(least, depth[np.int64(row)], confidence[np.int64(row)])


@kernel
def _leave_out_row(least: Any, depth: F32, confidence: F32) -> None:
    zero = np.float32(0)
    for i in range(depth.size):
        x = np.uint64(i)
        stated = (confidence[x] >= least) & (depth[x] > zero)
        depth[x] = depth[x] if stated else zero
        confidence[x] = confidence[x] if stated else zero
