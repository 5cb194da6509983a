"""The CPU backend: project, sort, bin, composite, and the same backwards, over memory it keeps."""

from __future__ import annotations

import numpy as np

from sags_node.engine import binning, compositing, layout, projection
from sags_node.engine.compositing import TILE_HEIGHT, TILE_HEIGHT_BITS, TILE_WIDTH, TILE_WIDTH_BITS
from sags_node.engine.interface import Gradients, Pinhole
from sags_node.engine.jit import aligned
from sags_node.engine.threads import thread_count
from sags_node.errors import SagsError
from sags_node.types import F32, Gaussians

MAX_PAIRS = 1 << 25  # 2 GiB of gradients
SPARE = 1.25  # what is asked for beyond the need when a buffer grows

Row = tuple[np.float32, ...]


class NumbaRasterizer:
    """Buffers grow with the number of Gaussians and pairs and are never given back."""

    def __init__(self, width: int, height: int) -> None:
        self._width, self._height = width, height
        self._tiles = -(-width // TILE_WIDTH) * -(-height // TILE_HEIGHT)
        self._planes = aligned((5, height, width))
        self._tile_starts = aligned((self._tiles + 1,), np.int32)
        self._tile_ends = aligned((self._tiles,), np.int32)
        self._count = 0
        self._allocate_workers(thread_count())
        self._allocate_gaussians(1024)
        self._emitted = aligned((4096,), layout.EMITTED)
        self._pairs = aligned((4096,), layout.PAIR)
        self._v_pairs = aligned((0,), layout.SPLAT_GRADIENT)

    def _allocate_workers(self, workers: int) -> None:
        self._workers = workers
        self._tile_scratch = aligned((workers, compositing.SCRATCH))
        self._block_scratch = aligned((workers, projection.SCRATCH))
        self._histogram = aligned((workers, self._tiles), np.int32)
        self._emitted_counts = aligned((workers,), np.int64)

    def _allocate_gaussians(self, room: int) -> None:
        self._splats = aligned((room,), layout.SPLAT)
        self._v_splats = aligned((room,), layout.SPLAT_GRADIENT)
        self._depths = aligned((room,))
        self._order, self._spare_order, self._keys, self._spare_keys, self._first_slots, self._slot_counts = (
            aligned((room,), np.int32) for _ in range(6)
        )
        self._v_means, self._v_scales, self._v_colors = (aligned((room, 3)) for _ in range(3))
        self._v_quats = aligned((room, 4))
        self._v_opacities, self._contribution = aligned((room,)), aligned((room,))

    def forward(self, gaussians: Gaussians, pinhole: Pinhole) -> F32:
        n = self._count = len(gaussians)
        if n > len(self._splats):
            self._allocate_gaussians(int(n * SPARE))
        if self._workers != thread_count():
            self._allocate_workers(thread_count())
        self._gaussians = gaussians
        self._camera = _as_tuples(pinhole)
        projection.project(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            gaussians.colors,
            *self._camera,
            self._block_scratch,
            self._splats[:n],
            self._depths[:n],
        )
        binning.sort_by_depth(
            self._depths[:n], self._order[:n], self._spare_order[:n], self._keys[:n], self._spare_keys[:n]
        )
        self._bin()
        compositing.composite(
            self._splats[:n],
            self._pairs,
            self._tile_starts,
            self._tile_scratch,
            self._planes,
            self._tile_ends,
        )
        return self._planes

    def _bin(self) -> None:
        n = self._count
        while True:
            binning.emit_pairs(
                self._splats[:n],
                self._order[:n],
                self._width,
                self._height,
                TILE_WIDTH_BITS,
                TILE_HEIGHT_BITS,
                self._emitted,
                self._histogram,
                self._emitted_counts,
                self._first_slots[:n],
                self._slot_counts[:n],
            )
            needed = int(self._emitted_counts.sum())
            if needed > MAX_PAIRS:
                raise SagsError(
                    f"drawing {n} Gaussians takes {needed} Gaussian-tile pairs, the limit is {MAX_PAIRS}: "
                    "the Gaussians are too large for the picture; draw fewer or smaller ones"
                )
            busiest = int(self._emitted_counts.max())
            if busiest <= len(self._emitted) // self._workers:
                break
            self._emitted = aligned((int(busiest * SPARE) * self._workers,), layout.EMITTED)
        if needed > len(self._pairs):
            self._pairs = aligned((int(needed * SPARE),), layout.PAIR)
        binning.sort_into_tiles(
            self._emitted,
            self._histogram,
            self._emitted_counts,
            self._order[:n],
            self._first_slots[:n],
            self._pairs,
            self._tile_starts,
        )

    def backward(self, v_planes: F32, weight: F32, geometry: bool) -> Gradients:
        n, gaussians = self._count, self._gaussians
        if len(self._v_pairs) < len(self._pairs):
            self._v_pairs = aligned((len(self._pairs),), layout.SPLAT_GRADIENT)
        compositing.composite_backward(
            self._splats[:n],
            self._pairs,
            self._tile_starts,
            self._tile_ends,
            self._tile_scratch,
            self._planes,
            v_planes,
            weight,
            self._v_pairs,
        )
        compositing.sum_pairs(
            self._first_slots[:n],
            self._slot_counts[:n],
            self._v_pairs,
            self._v_splats[:n],
            self._v_colors[:n],
            self._contribution[:n],
        )
        if geometry:
            projection.project_backward(
                gaussians.means,
                gaussians.quats,
                gaussians.scales,
                gaussians.opacities,
                *self._camera,
                self._block_scratch,
                self._splats[:n],
                self._v_splats[:n],
                self._v_means[:n],
                self._v_quats[:n],
                self._v_scales[:n],
                self._v_opacities[:n],
            )
        drawn = n if geometry else 0
        return Gradients(
            self._v_means[:drawn],
            self._v_quats[:drawn],
            self._v_scales[:drawn],
            self._v_opacities[:drawn],
            self._v_colors[:n],
            self._contribution[:n],
        )


def _as_tuples(pinhole: Pinhole) -> tuple[Row, Row, Row, Row]:
    """Rotation, translation, intrinsics and limits as kernels take them: tuples travel in registers."""
    f4 = np.float32
    return (
        tuple(f4(v) for v in pinhole.R.ravel()),
        tuple(f4(v) for v in pinhole.t),
        (f4(pinhole.fx), f4(pinhole.fy), f4(pinhole.cx), f4(pinhole.cy)),
        tuple(f4(v) for v in pinhole.limits),
    )
