"""First stage of the CPU backend, from Gaussians to splats, and its derivative: the 3D filter, the colour for
the camera's place, the projection. Its memory grows with the Gaussians and is never given back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sags_node.engine.interface import DILATION_VARIANCE, MIP_VARIANCE, Pinhole
from sags_node.engine.rasterizer import projection, projection_backward, smoothing, spherical_harmonics
from sags_node.kernels.jit import aligned, read_only
from sags_node.kernels.threads import thread_count
from sags_node.types import F32, Gaussians

SPARE = 1.25  # what is asked for beyond the need when memory grows

Row = tuple[np.float32, ...]
Records = NDArray[Any]  # of a structured type of `layout`


class Projector:
    """`project` once per drawing; then `backward`, once."""

    def __init__(self, antialias: bool) -> None:
        variance = MIP_VARIANCE if antialias else DILATION_VARIANCE
        self._screen_filter = np.float32(variance), np.float32(antialias)
        self._scratch = aligned((0, projection_backward.SCRATCH))
        self._next_block = aligned((1,), np.int64)
        self._terms = 0
        self._allocate(1024)

    def _allocate(self, room: int) -> None:
        self._room = room
        self._scales, self._colors, self._slopes, self._no_slopes = (aligned((room, 3)) for _ in range(4))
        self._no_slopes[:] = 0
        self._v_means, self._v_scales, self._v_slopes = (aligned((room, 3)) for _ in range(3))
        self._opacities, self._v_opacities = aligned((room,)), aligned((room,))
        self._v_quats = aligned((room, 4))
        self._v_sh_rest = aligned((room, self._terms, 3))

    def project(self, gaussians: Gaussians, pinhole: Pinhole, splats: Records, depths: F32) -> None:
        """Writes `splats` [N] SPLAT and `depths` [N] m (0 where not drawn). Keeps the Gaussians, checked and
        contiguous, until the next call."""
        n = self._count = len(gaussians)
        terms = 0 if gaussians.sh_rest is None else gaussians.sh_rest.shape[1]
        if n > self._room or terms != self._terms:
            self._terms = terms
            self._allocate(max(self._room, int(n * SPARE)))
        if len(self._scratch) != thread_count():
            self._scratch = aligned((thread_count(), projection_backward.SCRATCH))
        self._view, self._centre = _view_of(pinhole), centre_of(pinhole)
        self._given = self._smoothed = gaussians
        given_slopes = read_only(self._no_slopes[:n]) if gaussians.slopes is None else gaussians.slopes
        self._given_slopes = self._smoothed_slopes = given_slopes
        if gaussians.smoothing is not None:
            scales, opacities, slopes = self._scales[:n], self._opacities[:n], self._slopes[:n]
            smoothing.smooth(
                gaussians.scales, gaussians.opacities, gaussians.smoothing, given_slopes,
                scales, opacities, slopes,
            )  # fmt: skip
            self._smoothed = replace(gaussians, scales=read_only(scales), opacities=read_only(opacities))
            self._smoothed_slopes = read_only(slopes)
        gaussians, colors = self._smoothed, self._smoothed.colors
        if gaussians.sh_rest is not None:
            seen = self._colors[:n]
            spherical_harmonics.color(gaussians.means, colors, gaussians.sh_rest, self._centre, seen)
            colors = read_only(seen)
        projection.project(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            colors,
            self._smoothed_slopes,
            self._view,
            self._screen_filter,
            self._scratch,
            self._next_block,
            splats.view(np.float32),
            depths,
        )

    def backward(
        self, slots: Records, v_pairs: F32, v_colors: F32, contribution: F32, spread: F32
    ) -> tuple[F32, F32, F32, F32, F32, F32]:
        """Gradients of means, quats, scales, opacities, sh_rest and slopes.

        Args:
            slots: [N] SLOTS.
            v_pairs: [16 slots] a SPLAT_GRADIENT per slot.
            v_colors: [N, 3] written: 0 where not drawn.
            contribution, spread: [N] written.
        """
        n, gaussians, given = self._count, self._smoothed, self._given
        v_scales, v_opacities, v_slopes = self._v_scales[:n], self._v_opacities[:n], self._v_slopes[:n]
        projection_backward.project_backward(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            self._smoothed_slopes,
            self._view,
            self._screen_filter,
            self._scratch,
            self._next_block,
            slots,
            v_pairs,
            v_colors,
            contribution,
            spread,
            self._v_means[:n],
            self._v_quats[:n],
            v_scales,
            v_opacities,
            v_slopes,
        )
        if gaussians.sh_rest is not None:
            spherical_harmonics.color_backward(
                gaussians.means,
                gaussians.sh_rest,
                self._centre,
                v_colors,
                self._v_sh_rest[:n],
                self._v_means[:n],
            )
        if given.smoothing is not None:
            smoothing.smooth_backward(
                given.scales,
                given.opacities,
                given.smoothing,
                self._given_slopes,
                v_scales,
                v_opacities,
                v_slopes,
            )
        return self._v_means[:n], self._v_quats[:n], v_scales, v_opacities, self._v_sh_rest[:n], v_slopes


def centre_of(pinhole: Pinhole) -> Row:
    """The camera's place in the world."""
    return tuple(np.float32(v) for v in -pinhole.R.T @ pinhole.t)


def _view_of(pinhole: Pinhole) -> F32:
    """[VIEW]: a camera as kernels take it."""
    fx, fy, cx, cy = pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy
    pose = [*pinhole.R.ravel().tolist(), *pinhole.t.tolist()]
    return np.array([*pose, fx, fy, cx, cy, *pinhole.limits], np.float32)
