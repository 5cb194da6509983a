"""The picture for the right eye of a stereo display: the model, and what the model alone does not say.

Tissue does not look the same to both eyes: what shines lies elsewhere, and the cameras differ in colour and
vignette. So each Gaussian remembers how much brighter than its colour the right eye saw it, from the
right pictures of frames before. And what the left picture shows beyond the drawn left view is carried over
by the drawn depth, where both eyes see the same tissue.

The right picture of a frame is never used to draw that frame. Instruments come neither from the left picture
nor from the right one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import prange

from sags_node.engine.pinhole import pack, to_camera, to_pixel
from sags_node.engine.rasterizer.views import to_view
from sags_node.kernels.jit import PIECE, kernel, parallel_kernel
from sags_node.mapping.mapped import Mapped
from sags_node.mapping.right_eye import right_eye_mask
from sags_node.model.gaussians import GaussianModel, for_right_eye
from sags_node.types import F32, F64, U8, Bool, Camera, Colours, Gaussians, Observation, RenderedView

LEARNING = 0.5  # of what a Gaussian lacks in the right eye, taken in from every other frame
FADING = 0.94  # in two frames, of what was not seen again: a highlight of a second ago lies elsewhere by now
SAME = 0.03  # of the depth: nearer to each other, two depths are of one surface
EVERY = 4  # px: a mask this coarse keeps within the margin that masks have; so many pixels tell the share
REMEMBERED = 0.9  # of the sums that tell how much of the left picture's detail holds for the right eye
NEAREST = 1e-3  # m: no tissue is nearer
f4 = np.float32
u8 = np.uint64


@dataclass(frozen=True, slots=True)
class Drawn:
    """The right view of one frame, with what it takes to learn from the right picture."""

    view: RenderedView
    mapped: Mapped
    share: float  # of `brought` in the view
    brought: F32  # [H / 4, W / 4, 3] what the left picture has beyond the left view, in every fourth pixel


class RightView:
    """Draws the right eye, and learns from what it really saw.

    Attributes:
        share: of the left picture's detail, that is added: as much as fitted best lately.
    """

    def __init__(self) -> None:
        self.share = 1.0
        self._sums: F64 = np.zeros(2)  # of detail times what lacked, and of detail squared
        self._turn = 0  # which half of the Gaussians learns next
        self._missed = 0  # frames in which nobody looked

    def miss(self) -> None:
        """Nobody looks at this frame."""
        self._missed += 1

    def wake(self, model: GaussianModel) -> None:
        """Somebody looks at this frame: what was learnt is older by the frames that were missed."""
        if self._missed:
            model.right_colors[:] *= f4(FADING ** (self._missed / 2))
            self._missed = 0

    def draw(
        self,
        mapped: Mapped,
        observation: Observation,
        picture: U8,
        show: Callable[[Gaussians, Camera], F32],
        learn: bool,
    ) -> Drawn:
        """The right eye's view of a frame.

        Args:
            picture: [H, W, 3] RGB of the left eye.
            show: draws Gaussians for a camera, [5, H, W].
            learn: else the left picture's colours are not the tissue's: nothing of it is carried over.
        """
        snapshot, left = mapped.snapshot, mapped.view
        camera = snapshot.camera.moved_right(observation.baseline)
        planes = show(for_right_eye(snapshot.gaussians, snapshot), camera)
        view = to_view(planes, camera, left.frame_id, left.t_capture_ns)
        view = replace(view, colours=Colours(view.rgb))  # detail is added to it: larger ones are made of that
        height, width = view.depth.shape
        brought = np.zeros((-(-height // EVERY), -(-width // EVERY), 3), f4)
        if learn:
            disparity = f4(camera.K[0, 0] * observation.baseline)  # px m
            _carry(
                picture, left.rgb, left.depth, observation.tissue, disparity, f4(self.share),
                view.rgb, view.depth, brought,
            )  # fmt: skip
        return Drawn(view, mapped, self.share, brought)

    def learn(self, drawn: Drawn, model: GaussianModel, picture: U8, tissue: Bool, baseline: float) -> None:
        """Take in what the right eye saw of a frame, for the frames after it.

        Args:
            drawn: of that frame.
            model: which may have changed since.
            picture: [H, W, 3] RGB of the right eye.
            tissue: [H, W] of the left picture, without what the right eye does not see.
            baseline: m.
        """
        view, snapshot = drawn.view, drawn.mapped.snapshot
        sure = _sure_tissue(tissue, drawn.mapped.view.depth, float(view.camera.K[0, 0]), baseline)
        found = np.zeros(2)
        _compare(picture, view.rgb, drawn.brought, sure, f4(drawn.share), found)
        self._sums = REMEMBERED * self._sums + found
        if self._sums[1] > 0:
            self.share = float(np.clip(self._sums[0] / self._sums[1], 0, 1))
        rows = min(len(snapshot.gaussians), model.count)
        same = model.ids[:rows] == snapshot.gaussians.ids[:rows]
        _learn(
            snapshot.gaussians.means[:rows], same, pack(view.camera), picture, view.rgb, view.depth, sure,
            model.right_colors[:rows], self._turn,
        )  # fmt: skip
        self._turn = 1 - self._turn


def _sure_tissue(tissue: Bool, depth: F32, focal_px: float, baseline: float) -> Bool:
    """`right_eye_mask` of every fourth pixel, [h, w]."""
    tissue = tissue[::EVERY, ::EVERY]
    known = depth[:: 2 * EVERY, :: 2 * EVERY][tissue[::2, ::2]]
    return right_eye_mask(tissue, known[known > 0], focal_px / EVERY, baseline)


@parallel_kernel
def _carry(
    picture: U8, rgb: U8, drawn: F32, tissue: Bool, disparity: Any, share: Any,
    right: U8, right_depth: F32, brought: F32,
) -> None:  # fmt: skip
    """Adds `share` of what the left picture has beyond the left view to the right view; writes all of it to
    `brought`. disparity: px m."""
    for row in prange(len(picture)):
        y = np.int64(row)
        _carry_row(
            picture[y].reshape(-1), rgb[y].reshape(-1), drawn[y], tissue[y], disparity, share,
            right[y].reshape(-1), right_depth[y], brought[y // EVERY], y % EVERY == 0,
        )  # fmt: skip


@kernel
def _carry_row(
    picture: U8, rgb: U8, drawn: F32, tissue: Bool, disparity: Any, share: Any,
    right: U8, right_depth: F32, brought: F32, sampled: Any,
) -> None:  # fmt: skip
    width = len(drawn)
    beyond = np.empty(3 * width, f4)
    for i in range(u8(3 * width)):
        beyond[i] = (f4(picture[i]) - f4(rgb[i])) * f4(1 / 255)
    # What a right pixel shows lies between `columns` and the next one in the left picture.
    columns, fractions, weights = np.empty(width, np.int32), np.empty(width, f4), np.empty(width, f4)
    last = f4(width - 2)
    for x in range(u8(width)):
        z = right_depth[x]
        there = f4(np.int32(x)) + disparity / max(z, f4(NEAREST))
        weights[x] = f4(1) if z > f4(0) and there <= last else f4(0)
        there = min(there, last)
        columns[x] = np.int32(there)
        fractions[x] = there - f4(columns[x])
    for x in range(u8(width)):
        left, z = u8(columns[x]), right_depth[x]
        surface = drawn[left] if fractions[x] < f4(0.5) else drawn[left + u8(1)]
        if not (tissue[left] and tissue[left + u8(1)] and abs(surface - z) < f4(SAME) * z):
            weights[x] = f4(0)
    for x in range(u8(width)):
        left, part, weight = u8(3) * u8(columns[x]), fractions[x], f4(255) * share * weights[x]
        for c in range(u8(3)):
            first, at = beyond[left + c], u8(3) * x + c
            detail = first + part * (beyond[left + u8(3) + c] - first)
            level = min(max(f4(right[at]) + weight * detail, f4(0)), f4(255))
            right[at] = np.uint8(np.int32(level + f4(0.5)))
    if not sampled:
        return
    for j in range(len(brought)):
        x = EVERY * j
        start = 3 * columns[x]
        for k in range(3):
            step = beyond[start + 3 + k] - beyond[start + k]
            brought[j, k] = weights[x] * (beyond[start + k] + fractions[x] * step)


@kernel
def _compare(picture: U8, right: U8, brought: F32, sure: Bool, share: Any, sums: F64) -> None:
    """Adds to `sums`: what the view would lack without detail from the left times that detail, and the
    detail squared."""
    height, width = sure.shape
    for i in range(height):
        for j in range(width):
            if not sure[i, j]:
                continue
            for c in range(3):
                detail = brought[i, j, c]
                lacks = f4(picture[EVERY * i, EVERY * j, c]) - f4(right[EVERY * i, EVERY * j, c])
                sums[0] += (lacks * f4(1 / 255) + share * detail) * detail
                sums[1] += detail * detail


@parallel_kernel
def _learn(
    means: F32, same: Bool, cam: F32, picture: U8, right: U8, right_depth: F32, sure: Bool, colors: F32,
    turn: Any,
) -> None:  # fmt: skip
    for pair in prange(-(-len(means) // (2 * PIECE))):
        first = (2 * np.int64(pair) + turn) * PIECE
        _learn_rows(
            means, same, cam, picture, right, right_depth, sure, colors,
            first, min(first + PIECE, len(means)),
        )  # fmt: skip


@kernel
def _learn_rows(
    means: F32, same: Bool, cam: F32, picture: U8, right: U8, right_depth: F32, sure: Bool, colors: F32,
    first: Any, end: Any,
) -> None:  # fmt: skip
    """Moves the colours [N, 3] of Gaussians that show in the right view by what they lack there, the mean of
    3x3 px; those of all others fade. Rows whose Gaussian is not the `same` any more are left alone."""
    height, width = right_depth.shape
    for i in range(first, end):
        if not same[i]:
            continue
        x, y, z = to_camera(cam, means[i, 0], means[i, 1], means[i, 2])
        shows = z > f4(0)
        if shows:
            u, v = to_pixel(cam, x, y, z)
            shows = u >= f4(1) and v >= f4(1) and u < f4(width - 2) and v < f4(height - 2)
        if shows:
            px, py = u8(np.int32(u + f4(0.5))), u8(np.int32(v + f4(0.5)))
            seen = sure[py // u8(EVERY), px // u8(EVERY)]
            shows = seen and abs(right_depth[py, px] - z) < f4(SAME) * z
        if not shows:
            for c in range(3):
                colors[i, c] *= f4(FADING)
            continue
        for c in range(u8(3)):
            lacks = f4(0)
            for row in range(py - u8(1), py + u8(2)):
                for column in range(px - u8(1), px + u8(2)):
                    lacks += f4(picture[row, column, c]) - f4(right[row, column, c])
            colors[i, c] += f4(LEARNING / (9 * 255)) * lacks
