"""Splitting: where several Gaussians could show the tissue better than one, it is split in three. The outer
parts take the rows of Gaussians that hardly show, so that the number of Gaussians and their cost stay.

A split changes the image less than a new Gaussian does, which covers what was there. The middle part stays
where the whole was, under its id, so that nothing jumps for who follows the tissue by ids.
"""

from typing import Any

import numpy as np
from numba import prange

from sags_node.engine.losses.pieces import LEVEL
from sags_node.engine.pinhole import pack, to_camera, to_pixel
from sags_node.geometry import quat_to_matrix
from sags_node.kernels.jit import PIECE, kernel, parallel_kernel
from sags_node.mapping.densify import FRONT_TOLERANCE, HOLES, mean_contribution
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, I64, U8, Bool, Observation, RenderedView

GROWN = 0.8  # of the Gaussians that are allowed: below it, splitting adds Gaussians
SPLIT = 0.005  # of all, per frame: the most that are split where the parts take others' rows
GROWTH = 0.03  # of all, per frame: the most that are split where there is room
HARDLY = 0.15  # of the mean contribution: less hardly shows
ENOUGH = 0.8  # of the mean contribution: only what shows more is split
APART = 1.1  # standard deviations of the whole, from its middle to that of an outer part
PART_SIZE = 0.4  # of the whole, along its longest axis


def split_worst(model: GaussianModel, observation: Observation, view: RenderedView, room: int) -> int:
    """Split what shows most where the image is worst.

    What is hidden, by an instrument or other tissue, or out of view is not given up for it.

    Args:
        model: as it was drawn in `view`, for `observation`.
        room: so many Gaussians may be added; without it the outer parts take rows of what hardly shows.

    Returns:
        How many were split.
    """
    contribution = model.contribution
    mean = mean_contribution(contribution)
    score = np.zeros(model.count, np.float32)
    spare = np.zeros(model.count, np.bool_)
    _look(
        model.means, contribution, pack(view.camera), view.colours.small, view.depth, observation.image,
        observation.tissue, np.float32(HARDLY * mean), np.float32(ENOUGH * mean), score, spare,
    )  # fmt: skip
    spare_rows, wholes = np.flatnonzero(spare), np.flatnonzero(score)
    exchanged = min(int(SPLIT * model.count), len(spare_rows) // 2)
    grown = min(int(GROWTH * model.count), room // 2)
    count = min(max(exchanged, grown), len(wholes))
    if count > 0:
        worst = wholes[np.argpartition(-score[wholes], count - 1)[:count]]
        if grown >= exchanged:
            rows = model.extend(2 * count)
        else:
            rows = spare_rows[np.argpartition(contribution[spare_rows], 2 * count - 1)[: 2 * count]]
        _split(model, worst, rows)
    return count


def split_where_room(model: GaussianModel, observation: Observation, view: RenderedView, limit: int) -> int:
    """`split_worst` of a model that may have `limit` Gaussians; how many were split."""
    if limit - model.count <= HOLES:
        return 0  # what hardly shows is needed to fill holes
    return split_worst(model, observation, view, max(0, round(GROWN * limit) - model.count))


def _split(model: GaussianModel, wholes: I64, spare: I64) -> None:
    """Split the Gaussians in the rows `wholes` [M]; their outer parts go into the rows `spare` [2 M]."""
    count = len(wholes)
    longest = np.argmax(model.scales[wholes], axis=1)
    axes = quat_to_matrix(model.quats[wholes])[np.arange(count), :, longest]
    scale, smoothing = model.scales[wholes, longest], model.smoothing[wholes]
    variance, part = scale**2 + smoothing, (PART_SIZE * scale) ** 2 + smoothing  # as they are drawn
    size = np.sqrt(variance)
    offsets = (np.float32(APART) * size)[:, None] * axes
    # Each part has the colour that the whole had there, and the same change of colour per metre.
    brighter = (np.float32(APART) * model.slopes[wholes, longest] * scale / size)[:, None]
    model.slopes[wholes, longest] *= part / (np.float32(PART_SIZE) * variance)
    model.scales[wholes, longest] *= np.float32(PART_SIZE)
    model.log_scales[wholes, longest] += np.float32(np.log(PART_SIZE))
    model.contribution[wholes] /= 3
    model.adam_m[wholes] = 0
    for rows, side in ((spare[:count], np.float32(-1)), (spare[count:], np.float32(1))):
        model.replace(rows, wholes)
        model.means[rows] += side * offsets
        model.colors[rows] += side * brighter


@parallel_kernel
def _look(
    means: F32, contribution: F32, cam: F32, rgb: U8, drawn: F32, image: U8, tissue: Bool,
    hardly: Any, enough: Any, score: F32, spare: Bool,
) -> None:  # fmt: skip
    for piece in prange(-(-len(means) // PIECE)):
        first = np.int64(piece) * PIECE
        _look_at_rows(
            means, contribution, cam, rgb, drawn, image, tissue, hardly, enough, score, spare,
            first, min(first + PIECE, len(means)),
        )  # fmt: skip


@kernel
def _look_at_rows(
    means: F32, contribution: F32, cam: F32, rgb: U8, drawn: F32, image: U8, tissue: Bool,
    hardly: Any, enough: Any, score: F32, spare: Bool, first: Any, end: Any,
) -> None:  # fmt: skip
    """Of the Gaussians on the visible tissue, mark those that can be spared. For those that may be split,
    write a score: contribution times squared colour residual."""
    height, width = tissue.shape
    across, down = np.float32(rgb.shape[1] / width), np.float32(rgb.shape[0] / height)
    for i in range(first, end):
        much = contribution[i] > enough and contribution[i] < np.float32(np.inf)
        if not (much or contribution[i] < hardly):
            continue
        x, y, z = to_camera(cam, means[i, 0], means[i, 1], means[i, 2])
        if not z > 0:
            continue
        u, v = to_pixel(cam, x, y, z)
        if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        px, py = int(u + 0.5), int(v + 0.5)
        if not (tissue[py, px] and abs(z - drawn[py, px]) < np.float32(FRONT_TOLERANCE) * z):
            continue
        if not much:
            spare[i] = True
            continue
        row, column = int(py * down), int(px * across)
        square = np.float32(0)
        for k in range(3):
            difference = (np.float32(rgb[row, column, k]) - np.float32(image[py, px, k])) * LEVEL
            square += difference * difference
        if square < np.float32(3):  # else one of them is damaged
            score[i] = square * contribution[i]
