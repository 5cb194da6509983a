"""The image for the right eye of a stereo display: the model, in the colours that this eye sees.

Tissue does not look the same to both eyes: what shines lies elsewhere, and the cameras differ in colour and
vignette. So each Gaussian remembers how much brighter than its colour the right eye saw it, from the
right images of frames before. The detail of the left image is added as to any view (`sags_node.detail`).

The right image of a frame is never used to draw that frame. Instruments come neither from the left image
nor from the right one.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numba import prange

from sags_node.engine.pinhole import pack, to_camera, to_pixel
from sags_node.engine.rasterizer.views import to_view
from sags_node.kernels.jit import PIECE, kernel, parallel_kernel
from sags_node.mapping.mapped import Mapped
from sags_node.mapping.right_eye import COARSE, coarse_right_eye_mask
from sags_node.model.gaussians import GaussianModel, for_right_eye
from sags_node.types import F32, U8, Bool, Camera, Colours, Gaussians, RenderedView

LEARN_EVERY = 2  # frames
LEARNING = 0.5  # share of what a Gaussian lacks in the right eye, learnt from such a frame
FADING = 0.94  # factor between such frames on what was not seen again: highlights move within a second
SAME = 0.03  # of the depth: two depths that differ by less are of one surface
f4 = np.float32
u8 = np.uint64


class RightView:
    """Draws the right eye, and learns from what it really saw."""

    def __init__(self) -> None:
        self._missed = 0  # frames in which nobody looked

    def miss(self) -> None:
        """Note that nobody looks at this frame."""
        self._missed += 1

    def wake(self, model: GaussianModel) -> None:
        """Note that somebody looks at this frame: what was learnt fades by the frames that were missed."""
        if self._missed:
            model.right_colors[:] *= f4(FADING ** (self._missed / LEARN_EVERY))
            self._missed = 0

    def draw(self, mapped: Mapped, baseline: float, show: Callable[[Gaussians, Camera], F32]) -> RenderedView:
        """The right eye's view of a frame.

        Args:
            baseline: m.
            show: draws Gaussians for a camera, [5, H, W].
        """
        snapshot, left = mapped.snapshot, mapped.view
        camera = snapshot.camera.moved_right(baseline)
        planes = show(for_right_eye(snapshot.gaussians, snapshot), camera)
        view = to_view(planes, camera, left.frame_id, left.t_capture_ns)
        return replace(view, colours=Colours(view.rgb))  # the planes are drawn over with the next frame

    def learn(
        self, view: RenderedView, shown: U8, mapped: Mapped, model: GaussianModel, picture: U8, tissue: Bool,
        baseline: float,
    ) -> None:  # fmt: skip
        """Learn what the right eye saw of a frame, for later frames; for every `LEARN_EVERY`-th frame.

        Args:
            view: as it was drawn for that frame.
            shown: [H, W, 3] RGB, what was shown of it.
            model: which may have changed since.
            picture: [H, W, 3] RGB of the right eye.
            tissue: [H, W] of the left image, without what the right eye does not see.
            baseline: m.
        """
        snapshot = mapped.snapshot
        sure = coarse_right_eye_mask(tissue, mapped.view.depth, float(view.camera.K[0, 0]), baseline)
        rows = min(len(snapshot.gaussians), model.count)
        same = model.ids[:rows] == snapshot.gaussians.ids[:rows]
        _learn(
            snapshot.gaussians.means[:rows], same, pack(view.camera), picture, shown, view.depth, sure,
            model.right_colors[:rows],
        )  # fmt: skip


@parallel_kernel
def _learn(
    means: F32, same: Bool, cam: F32, picture: U8, right: U8, right_depth: F32, sure: Bool, colors: F32
) -> None:
    for piece in prange(-(-len(means) // PIECE)):
        first = np.int64(piece) * PIECE
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
            seen = sure[py // u8(COARSE), px // u8(COARSE)]
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
