"""`losses.compare` and its gradient in two passes over the image, where torch takes about a hundred."""

from typing import Any

import numpy as np
from numba import prange

from sags_node.kernels.jit import inlined, kernel, parallel_kernel, read_only, square_root, stack_floats
from sags_node.types import F32, F64, U8, Bool

u8, f4 = np.uint64, np.float32
ZERO, ONE, INFINITY, BYTE = f4(0), f4(1), f4(np.inf), f4(1 / 255)
DEPTH, COVERAGE = u8(3), u8(4)  # the planes after the colours
TERMS = ("color", "inverse_depth", "smoothness", "depth_smoothness", "coverage")
USED, MEASURED, EXPLAINED = 5, 6, 7  # pixels, counted after the sums of the terms

COVERED = 0.05  # below this coverage the normalised colour means nothing
DEPTH_COVERED = 0.3  # the same for depth
FULL = 0.9  # coverage that tissue should reach
NEAREST = 1e-3  # m: a nearer depth means nothing


def compare_by_kernels(
    planes: F32, image: U8, tissue: Bool, depth: F32, unseen: Bool, weights: F64, softness: float
) -> tuple[F64, F32, F32]:
    """The terms of a loss, and its gradient. They do not depend on the number of threads.

    Args:
        planes, image, tissue, depth, unseen, softness: as in `losses.compare`.
        weights: [5] of TERMS.

    Returns:
        [5] TERMS, not weighted; [5, H, W] the gradient of the loss; [H, W] 1 / coverage where a colour
        counts, else 0.
    """
    height, width = tissue.shape
    planes, depth = read_only(planes), read_only(depth)
    image, tissue, unseen = read_only(image), read_only(tissue), read_only(unseen)
    drawn, v_planes, weight = np.empty_like(planes), np.empty_like(planes), np.empty_like(depth)
    sums = np.zeros((height, 8))
    _normalise(planes, tissue, depth, drawn, weight, sums)
    used, measured, explained = np.maximum(sums[:, USED:].sum(axis=0), 1)
    counts = np.array([3 * used, measured, 3 * height * width, height * width, explained])
    slopes = (weights / counts).astype(np.float32)
    _differentiate(drawn, image, tissue, depth, unseen, weight, slopes, f4(softness), v_planes, sums)
    return sums[:, :USED].sum(axis=0) / counts, v_planes, weight


@kernel
def _normalise_row(y: Any, planes: F32, tissue: Bool, depth: F32, drawn: F32, weight: F32, sums: F64) -> None:
    """Divide colours and depth of a row's pixels by the coverage; it becomes -1 if a plane is not finite."""
    used = measured = explained = 0
    for k in range(planes.shape[2]):
        x = u8(k)
        coverage = planes[COVERAGE, y, x]
        total = coverage
        for plane in range(4):
            total += planes[u8(plane), y, x]
        sound = abs(total) < INFINITY
        covered = sound and coverage > COVERED
        inverse = ONE / coverage if covered else ZERO
        for plane in range(4):
            drawn[u8(plane), y, x] = planes[u8(plane), y, x] * inverse if covered else ZERO
        drawn[COVERAGE, y, x] = coverage if sound else -ONE
        weight[y, x] = inverse if tissue[y, x] else ZERO
        explained += tissue[y, x]
        used += tissue[y, x] and covered
        measured += tissue[y, x] and _has_depth(drawn, depth, y, x)
    sums[y, USED], sums[y, MEASURED], sums[y, EXPLAINED] = used, measured, explained


@inlined
def _has_depth(drawn: F32, depth: F32, y: Any, x: Any) -> Any:
    """Whether a pixel's depth was measured, and drawn."""
    given = depth[y, x]
    return (
        drawn[COVERAGE, y, x] > DEPTH_COVERED and given > ZERO and given < INFINITY
        and drawn[DEPTH, y, x] > NEAREST
    )  # fmt: skip


@parallel_kernel
def _normalise(planes: F32, tissue: Bool, depth: F32, drawn: F32, weight: F32, sums: F64) -> None:
    for row in prange(len(tissue)):
        _normalise_row(np.int64(row), planes, tissue, depth, drawn, weight, sums)


@inlined
def _sign(value: Any) -> Any:
    return ONE if value > ZERO else -ONE if value < ZERO else ZERO


@inlined
def _pull(drawn: F32, y: Any, x: Any, v: Any, u: Any, slopes: F32, by: F32) -> Any:
    """For a pixel and its neighbour (v, u), one of them unseen: add their smoothness to the gradient by the
    pixel's colours and depth, and return what the pair adds to both kinds of smoothness."""
    least = min(drawn[COVERAGE, y, x], drawn[COVERAGE, v, u])
    of_color = of_depth = ZERO
    if least > COVERED:
        for plane in range(3):
            apart = drawn[u8(plane), y, x] - drawn[u8(plane), v, u]
            of_color += abs(apart)
            by[plane] += slopes[2] * _sign(apart)
    if least > DEPTH_COVERED:
        apart = drawn[DEPTH, y, x] - drawn[DEPTH, v, u]
        of_depth = abs(apart)
        by[3] += slopes[3] * _sign(apart)
    return of_color, of_depth


@kernel
def _differentiate_row(
    y: Any, drawn: F32, image: U8, tissue: Bool, depth: F32, unseen: Bool, weight: F32, slopes: F32,
    softness: Any, v_planes: F32, sums: F64,
) -> None:  # fmt: skip
    """Write the gradient of a row's pixels by their planes, and add up its terms. `slopes` [5]: derivative of
    the loss by the sum over pixels of each term."""
    height, width = tissue.shape
    by, found = stack_floats(4), np.zeros(5)
    for x in range(width):
        coverage = drawn[COVERAGE, y, x]
        for plane in range(4):
            by[plane] = ZERO
        if weight[y, x] > ZERO:
            for plane in range(3):
                apart = drawn[plane, y, x] - image[y, x, plane] * BYTE
                length = square_root(apart * apart + softness * softness)
                found[0] += length - softness
                by[plane] = slopes[0] * apart / length if length > ZERO else ZERO
            if _has_depth(drawn, depth, y, x):
                inverse = ONE / drawn[DEPTH, y, x]
                apart = inverse - ONE / depth[y, x]
                found[1] += abs(apart)
                by[3] = -slopes[1] * _sign(apart) * inverse * inverse
        here = unseen[y, x]
        if x > 0 and (here or unseen[y, x - 1]):
            _pull(drawn, y, x, y, x - 1, slopes, by)
        if y > 0 and (here or unseen[y - 1, x]):
            _pull(drawn, y, x, y - 1, x, slopes, by)
        if x + 1 < width and (here or unseen[y, x + 1]):
            of_color, of_depth = _pull(drawn, y, x, y, x + 1, slopes, by)
            found[2] += of_color
            found[3] += of_depth
        if y + 1 < height and (here or unseen[y + 1, x]):
            of_color, of_depth = _pull(drawn, y, x, y + 1, x, slopes, by)
            found[2] += of_color
            found[3] += of_depth
        inverse = ONE / coverage if coverage > COVERED else ZERO
        by_coverage = ZERO
        for plane in range(4):
            v_planes[plane, y, x] = by[plane] * inverse
            by_coverage -= by[plane] * inverse * drawn[plane, y, x]
        if tissue[y, x] and ZERO <= coverage < FULL:
            found[4] += FULL - coverage
            by_coverage -= slopes[4]
        v_planes[COVERAGE, y, x] = by_coverage
    for term in range(5):
        sums[y, term] = found[term]


@parallel_kernel
def _differentiate(
    drawn: F32, image: U8, tissue: Bool, depth: F32, unseen: Bool, weight: F32, slopes: F32, softness: Any,
    v_planes: F32, sums: F64,
) -> None:  # fmt: skip
    for row in prange(len(tissue)):
        _differentiate_row(
            np.int64(row), drawn, image, tissue, depth, unseen, weight, slopes, softness, v_planes, sums
        )
