"""Where Gaussians are added and which are removed. N stays under its cap."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numba import prange

from sags_node.engine.interface import BEHIND_SURFACE
from sags_node.engine.losses.pieces import LEVEL
from sags_node.engine.rasterizer.views import SOLID
from sags_node.geometry import project
from sags_node.kernels.jit import PIECE, inlined, kernel, parallel_kernel
from sags_node.mapping.initialise import insert
from sags_node.mapping.surface import surface_at
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, I32, U8, Bool, Observation
from sags_node.vision.depth_grid import depth_at, grid_of

HOLE_ALPHA = float(SOLID)  # below this a tissue pixel is a hole; 0.8 would count gaps of small Gaussians
RESIDUAL_NEW_SURFACE = 0.2  # RGB residual, summed: above it a pixel nearer than the model is new surface
RESIDUAL_DETAIL = 0.45  # summed over RGB: with the right depth, detail is missing
GRID = 4  # px between candidates
MAX_INSERTED = 1500  # per frame: a budget, and a brake on runaway insertion
FRONT_TOLERANCE = 0.065  # of the depth: farther in front of the measured surface is free space
FRONT_FRAMES = 3  # frames in a row, since stereo is wrong now and then
MIN_OPACITY = 0.03
CROWDED = 0.9  # share of the cap above which Gaussians that do not show are removed
SHED = 0.03  # share of all Gaussians that is given up per frame while the machine cannot afford them
LITTLE = 0.35  # of the mean contribution: what shows more would leave a hole
HOLES = 200  # Gaussians per frame that are exchanged for new ones when the model is full
ADDED = 500  # Gaussians per frame that may be added even when there are as many as the machine affords
IDLE = 0.1  # px of coverage: less does not show
LARGEST = 1e6  # metres, colours, quaternions: no honest value comes near


def candidates(planes: F32, observation: Observation, phase: int) -> tuple[I32, F32, F32]:
    """Return pixels [M, 2] (x, y) that need a Gaussian, with depths and their errors [M] m: holes first, then
    new surfaces, then missing detail.

    A hole beside an instrument or in the strip that one eye does not see has no depth of its own; it borrows
    that from around. Missing detail without measured depth takes the model's, with a borrowed error.

    Args:
        planes: [5, H, W] of the rasteriser: sums of w*rgb, w*z, w.
        phase: shifts the candidate grid, so that every pixel has its turn over the frames.
    """
    pixels = np.empty((MAX_INSERTED, 2), np.int32)
    depths, errors = np.empty((2, MAX_INSERTED), np.float32)
    depth, grid = observation.depth, grid_of(observation)
    count = _candidates(
        planes, observation.image, observation.tissue, depth, grid.inverse, grid.error, np.float32(grid.side),
        phase % GRID, pixels, depths, errors,
    )  # fmt: skip
    return pixels[:count], depths[:count], errors[:count]


def prune(model: GaussianModel, surface: F32, observation: Observation, limit: int) -> int:
    """Remove what `prune_mask` selects, then what `prune_to_budget` does; returns how many."""
    remove = prune_mask(model, surface, observation.depth_is_new, limit)
    removed = model.remove(remove)
    if model.count > limit:
        removed += prune_to_budget(model, shown(model, surface[~remove], observation), limit)
    return removed


def prune_mask(model: GaussianModel, surface: F32, depth_is_new: bool, limit: int) -> Bool:
    """Return [N] which to remove: those in free space for several frames in a row, transparent or not finite;
    when N nears its `limit` also those out of view, and those on the visible surface that do not show. What
    an instrument or other tissue hides is kept. Counts the frames in free space (`in_front`), once for each
    measured depth.

    Args:
        surface: [N, 3] of `surface_at`.
        depth_is_new: this measured depth was not counted yet.
    """
    remove = np.zeros(model.count, np.bool_)
    _inspect(
        model.means, model.quats, model.scales, model.smoothing, model.node_weight,
        model.opacities, model.colors, model.slopes, model.contribution,
        surface, depth_is_new, model.count > CROWDED * limit, model.in_front, remove,
    )  # fmt: skip
    return remove


def shown(model: GaussianModel, surface: F32, observation: Observation) -> F32:
    """Return how much each Gaussian shows, [N] px; infinite: not known yet.

    A Gaussian that an instrument or other tissue hides, or that an instrument begins to hide, counts at least
    as the mean of all: it would be missed when it comes into view again.

    Args:
        surface: [N, 3] of `surface_at`.
        observation: the frame of `surface`.
    """
    z, measured = surface[:, 0], surface[:, 1]
    behind = z > (1 + FRONT_TOLERANCE) * measured  # also where nothing is measured
    hidden = (z > 0) & behind & (model.contribution < IDLE)
    mean = np.float32(mean_contribution(model.contribution[~hidden]))
    counted = np.where(hidden, mean, model.contribution)
    little = np.flatnonzero(counted < mean)
    height, width = observation.tissue.shape
    apart = np.sqrt(width * height / max(model.count, 1))  # px from one Gaussian to the next
    counted[little[_beside_instrument(model.means[little], observation, round(apart))]] = mean
    return counted


def _beside_instrument(means: F32, observation: Observation, reach: int) -> Bool:
    """[N] which of the Gaussians at `means` [N, 3] lie behind an instrument, or at most `reach` px beside
    it."""
    height, width = observation.tissue.shape
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    clear = cv2.erode(observation.tissue.view(np.uint8), around, borderType=cv2.BORDER_REPLICATE)
    pixels, _ = project(observation.camera, means)
    inside = np.all((pixels > -0.5) & (pixels < (width - 0.5, height - 0.5)), axis=1)
    columns, rows = np.rint(np.where(inside[:, None], pixels, 0)).astype(np.intp).T
    return np.asarray(inside & (clear[rows, columns] == 0))


def prune_to_budget(model: GaussianModel, contribution: F32, limit: int) -> int:
    """While there are more than `limit`, give up some of those that show least; returns how many.

    The others grow by the area that is given up, so that the tissue stays covered.

    Args:
        contribution: [N] of `shown`.
    """
    excess = min(model.count - limit, int(SHED * model.count))
    if excess <= 0:
        return 0
    least = np.argpartition(contribution, excess)[:excess]
    known = contribution[contribution < np.inf].sum()
    given_up = contribution[least]
    share = float(given_up[given_up < np.inf].sum() / known) if known > 0 else 0.0
    remove = np.zeros(model.count, np.bool_)
    remove[least] = True
    removed = model.remove(remove)
    if share < 1:
        model.grow(1 / np.sqrt(1 - share))
    return removed


def fill(
    model: GaussianModel, nodes: NodeDeformation, planes: F32, observation: Observation, phase: int,
    limit: int, smoothing: bool, give_up: Callable[[int], int],
) -> tuple[I32, int, int]:  # fmt: skip
    """Insert Gaussians at the pixels of `candidates`. A full model first gives up some that show least.

    Args:
        planes: [5, H, W] of the model, drawn for the frame.
        give_up: removes up to so many that show least; returns how many.

    Returns:
        The pixels [M, 2] of the new Gaussians, how many there are, and how many were given up.
    """
    room, given_up = max(ADDED, limit - model.count), 0
    pixels, depths, errors = candidates(planes, observation, phase)
    pixels, depths, errors = pixels[:room], depths[:room], errors[:room]
    lacking = min(len(pixels), HOLES) - max(0, limit - model.count)
    if 0 < lacking < model.count:
        given_up = give_up(lacking)
    rows = insert(model, observation, pixels, depths, errors, GRID, smoothing)
    nodes.attach(model, rows)
    return pixels, rows.stop - rows.start, given_up


def give_up(model: GaussianModel, observation: Observation, count: int) -> int:
    """Remove `least_shown`; returns how many."""
    surface = surface_at(model.means, observation)
    return model.remove(least_shown(shown(model, surface, observation), count))


def least_shown(contribution: F32, count: int) -> Bool:
    """Return [N] which up to `count` Gaussians show least, and little, by the `contribution` of `shown`."""
    remove = np.zeros(len(contribution), np.bool_)
    little = LITTLE * mean_contribution(contribution)
    least = np.argpartition(contribution, count)[:count]
    remove[least] = contribution[least] < little
    return remove


def mean_contribution(contribution: F32) -> float:
    """The mean, px, of those contributions [N] that are known; 0: none is."""
    known = contribution[contribution < np.inf]
    return float(known.mean()) if len(known) else 0.0


@kernel
def _candidates(
    planes: F32, image: U8, tissue: Bool, depth: F32, inverse: F32, grid_error: F32, side: Any,
    phase: int, pixels: I32, depths: F32, errors: F32,
) -> int:  # fmt: skip
    height, width = tissue.shape
    n = 0
    for rank in range(3):
        for y in range(phase, height, GRID):
            for x in range(phase, width, GRID):
                if not tissue[y, x]:
                    continue
                z = depth[y, x]
                alpha = planes[4, y, x]
                if alpha < HOLE_ALPHA:
                    if rank == 0:
                        z, _ = depth_at(depth, inverse, grid_error, side, x, y)
                    wanted = rank == 0 and z > 0
                elif rank == 0 or (rank == 1 and z <= 0):
                    wanted = False
                else:
                    residual = np.float32(0)
                    for c in range(3):
                        residual += abs(planes[c, y, x] / alpha - np.float32(image[y, x, c]) * LEVEL)
                    drawn_z = planes[3, y, x] / alpha
                    if z <= 0:
                        z = drawn_z
                    behind = drawn_z - z
                    if rank == 1:
                        wanted = residual > RESIDUAL_NEW_SURFACE and behind > 2 * BEHIND_SURFACE * z
                    else:
                        wanted = residual > RESIDUAL_DETAIL and abs(behind) < BEHIND_SURFACE * z
                if wanted:
                    if n == len(pixels):
                        return n
                    pixels[n, 0] = x
                    pixels[n, 1] = y
                    depths[n] = z
                    errors[n] = depth_at(depth, inverse, grid_error, side, x, y)[1]
                    n += 1
    return n


@parallel_kernel
def _inspect(
    means: F32, quats: F32, scales: F32, smoothing: F32, node_weight: F32,
    opacities: F32, colors: F32, slopes: F32, contribution: F32,
    surface: F32, is_new: bool, crowded: bool, in_front: I32, remove: Bool,
) -> None:  # fmt: skip
    for piece in prange(-(-len(means) // PIECE)):
        first = np.int64(piece) * PIECE
        _inspect_rows(
            means, quats, scales, smoothing, node_weight, opacities, colors, slopes, contribution,
            surface, is_new, crowded, in_front, remove, first, min(first + PIECE, len(means)),
        )  # fmt: skip


@kernel
def _inspect_rows(
    means: F32, quats: F32, scales: F32, smoothing: F32, node_weight: F32,
    opacities: F32, colors: F32, slopes: F32, contribution: F32,
    surface: F32, is_new: bool, crowded: bool, in_front: I32, remove: Bool,
    first: Any, end: Any,
) -> None:  # fmt: skip
    for i in range(first, end):
        if not _is_sound(means, quats, scales, smoothing, node_weight, opacities, colors, slopes, i):
            remove[i] = True
            continue
        z, measured = surface[i, 0], surface[i, 1]
        if z == 0:  # out of view
            remove[i] = crowded
            continue
        on_surface = False
        if measured > 0:
            on_surface = abs(measured - z) < FRONT_TOLERANCE * measured
            if is_new:
                in_front[i] = in_front[i] + 1 if measured - z > FRONT_TOLERANCE * measured else 0
        idle = contribution[i] < IDLE
        remove[i] = in_front[i] >= FRONT_FRAMES or (crowded and idle and on_surface)


@inlined
def _is_sound(
    means: F32,
    quats: F32,
    scales: F32,
    smoothing: F32,
    node_weight: F32,
    opacities: F32,
    colors: F32,
    slopes: F32,
    i: int,
) -> bool:
    """Tell whether a Gaussian is finite and opaque enough to be drawn."""
    held = abs(node_weight[i, 0]) + abs(node_weight[i, 1]) + abs(node_weight[i, 2]) + abs(node_weight[i, 3])
    size = abs(smoothing[i]) + abs(quats[i, 0]) + abs(quats[i, 1]) + abs(quats[i, 2]) + abs(quats[i, 3])
    for k in range(3):
        size += abs(means[i, k]) + abs(colors[i, k]) + abs(slopes[i, k]) + abs(scales[i, k])
    least = min(scales[i, 0], scales[i, 1], scales[i, 2])
    return bool(size < LARGEST and held < 2 and least > 0 and MIN_OPACITY <= opacities[i] <= 1)
