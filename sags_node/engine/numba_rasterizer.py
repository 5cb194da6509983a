"""The CPU backend: project, bin, composite, and the same backwards, over memory it keeps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sags_node.engine import binning, compositing, layout, median, pair_sums
from sags_node.engine.compositing import TILE_HEIGHT, TILE_HEIGHT_BITS, TILE_WIDTH, TILE_WIDTH_BITS
from sags_node.engine.interface import Gradients, Pinhole
from sags_node.engine.projector import Projector
from sags_node.errors import SagsError
from sags_node.kernels.jit import aligned, read_only
from sags_node.kernels.threads import thread_count
from sags_node.types import F32, I32, Bool, Gaussians

MAX_PAIRS = 1 << 25  # 2 GiB of gradients
SPARE = 1.25  # what is asked for beyond the need when a buffer grows


class NumbaRasterizer:
    """Buffers grow with the numbers of cameras, Gaussians and pairs and are never given back."""

    def __init__(self, width: int, height: int, antialias: bool) -> None:
        self._width, self._height = width, height
        self._shape = width, height, TILE_WIDTH_BITS, TILE_HEIGHT_BITS
        self._tiles = -(-width // TILE_WIDTH) * -(-height // TILE_HEIGHT)
        self._projector = Projector(antialias)
        self._next = aligned((1,), np.int64)  # shared counter of the workers
        self._reserved = aligned((1,), np.int64)
        self._allocate_scratch(thread_count())
        self._allocate_splats(1024)
        self._emitted = aligned((4096,), layout.EMITTED)
        self._pairs = aligned((4096,), layout.PAIR)
        self._v_pairs = aligned((0,), layout.SPLAT_GRADIENT)
        self._planes = aligned((0, 5, height, width))
        self._median_depths = aligned((0, height, width))
        self._median_rows = aligned((0, height, width), np.int32)

    def _allocate_scratch(self, workers: int) -> None:
        self._workers = workers
        self._scratch = aligned((workers, compositing.SCRATCH))

    def _allocate_splats(self, room: int) -> None:
        self._splats = aligned((room,), layout.SPLAT)
        self._v_splats = aligned((room,), layout.SPLAT_GRADIENT)
        self._slots = aligned((room,), layout.SLOTS)
        self._depths = aligned((room,))
        self._order, self._spare_order, self._keys, self._spare_keys = (
            aligned((room,), np.int32) for _ in range(4)
        )
        self._v_view_colors, self._v_colors = aligned((room, 3)), aligned((room, 3))
        self._contribution = aligned((room,))

    def _allocate_pictures(self, cameras: int) -> None:
        """Room for more cameras; the pictures of the others stay."""
        planes, depths, rows = self._planes, self._median_depths, self._median_rows
        self._planes = aligned((cameras, 5, self._height, self._width))
        self._median_depths = aligned((cameras, self._height, self._width))
        self._median_rows = aligned((cameras, self._height, self._width), np.int32)
        self._all_active = read_only(np.ones((cameras, self._tiles), np.bool_))
        self._median_rows[:] = -1
        self._planes[: len(planes)] = planes
        self._median_depths[: len(planes)] = depths
        self._median_rows[: len(planes)] = rows

    def forward(self, gaussians: Gaussians, pinholes: Sequence[Pinhole], tiles: Bool | None) -> F32:
        n, cameras = self._count, self._cameras = len(gaussians), len(pinholes)
        self._pinholes = pinholes
        if n * cameras > len(self._splats):
            self._allocate_splats(int(n * cameras * SPARE))
        if cameras > len(self._planes):
            self._allocate_pictures(cameras)
        if self._workers != thread_count():
            self._allocate_scratch(thread_count())
        self._projector.load(gaussians)
        for camera, pinhole in enumerate(pinholes):
            rows = slice(camera * n, (camera + 1) * n)
            self._projector.project(pinhole, self._splats[rows], self._depths[rows])
        self._bin(tiles)
        compositing.composite(
            self._splats[: n * cameras],
            self._pairs,
            self._tile_starts,
            self._drawn,
            self._next,
            self._scratch,
            self._width,
            self._height,
            self._planes[:cameras].reshape(-1),
            self._tile_ends,
        )
        return self._planes[:cameras]

    def _bin(self, tiles: Bool | None) -> None:
        """Lists of splats, near to far, for the tiles to draw."""
        splats = self._splats[: self._count * self._cameras]
        depths = self._depths[: len(splats)]
        slots = self._slots[: len(splats)]
        slots.view(np.int64)[:] = 0
        if tiles is None:
            active = self._all_active[: self._cameras]
        else:
            active = read_only(tiles.reshape(self._cameras, -1))
            binning.drop_untouched(splats, depths, self._cameras, _integral(tiles).reshape(-1), *self._shape)
        self._drawn = np.flatnonzero(active).astype(np.int32)
        kept = binning.sort_by_depth(depths, self._order, self._spare_order, self._keys, self._spare_keys)
        histogram = aligned((4 * self._workers, active.size), np.int32)
        while True:
            binning.emit_pairs(
                splats,
                self._order[:kept],
                self._cameras,
                active.reshape(-1),
                *self._shape,
                self._workers,
                self._emitted,
                slots,
                self._reserved,
                histogram,
                self._next,
            )
            needed = int(self._reserved[0])
            if needed > MAX_PAIRS:
                raise SagsError(
                    f"drawing {self._count} Gaussians takes about {needed} Gaussian-tile pairs, the limit is "
                    f"{MAX_PAIRS}: the Gaussians are too large for the picture; draw fewer or smaller ones"
                )
            if needed <= len(self._emitted):
                break
            self._emitted = aligned((int(needed * SPARE),), layout.EMITTED)
            self._pairs = aligned((int(needed * SPARE),), layout.PAIR)
        self._tile_starts = aligned((active.size + 1,), np.int32)
        self._tile_ends = aligned((active.size,), np.int32)
        binning.sort_into_tiles(
            self._workers,
            self._order[:kept],
            self._emitted,
            slots,
            histogram,
            self._pairs,
            self._tile_starts,
            self._next,
        )

    def backward(self, v_planes: F32, weight: F32, geometry: bool) -> Gradients:
        n, cameras = self._count, self._cameras
        if len(self._v_pairs) < len(self._emitted):
            self._v_pairs = aligned((len(self._emitted),), layout.SPLAT_GRADIENT)
        compositing.composite_backward(
            self._splats[: n * cameras],
            self._pairs,
            self._tile_starts,
            self._tile_ends,
            self._drawn,
            self._next,
            self._scratch,
            self._width,
            self._height,
            self._planes[:cameras].reshape(-1),
            v_planes.reshape(-1),
            weight.reshape(-1),
            self._v_pairs,
        )
        pair_sums.sum_pairs(
            self._workers,
            self._slots[: n * cameras],
            self._v_pairs,
            self._v_splats[: n * cameras],
            self._v_view_colors[: n * cameras],
            self._v_colors[:n],
            self._contribution[:n],
            self._next,
        )
        if not geometry:
            nothing = np.zeros((0, 0), np.float32)
            return Gradients(
                means=nothing,
                quats=nothing,
                scales=nothing,
                opacities=nothing,
                colors=self._v_colors[:n],
                sh_rest=nothing,
                poses=np.zeros((0, 6)),
                contribution=self._contribution[:n],
            )
        poses = np.empty((cameras, 6))
        for camera, pinhole in enumerate(self._pinholes):
            rows = slice(camera * n, (camera + 1) * n)
            poses[camera] = self._projector.backward(
                pinhole,
                self._splats[rows],
                self._v_splats[rows],
                self._v_view_colors[rows],
                accumulate=camera > 0,
            )
        means, quats, scales, opacities, sh_rest = self._projector.gradients()
        return Gradients(
            means, quats, scales, opacities, self._v_colors[:n], sh_rest, poses, self._contribution[:n]
        )

    def median(self) -> tuple[F32, I32]:
        cameras = self._cameras
        median.median(
            self._splats[: self._count * cameras],
            self._pairs,
            self._tile_starts,
            self._tile_ends,
            self._drawn,
            self._next,
            self._scratch,
            self._width,
            self._height,
            self._median_depths[:cameras].reshape(-1),
            self._median_rows[:cameras].reshape(-1),
        )
        return self._median_depths[:cameras], self._median_rows[:cameras]


def _integral(tiles: Bool) -> I32:
    """[C, rows + 1, columns + 1]: entry y, x counts the active tiles above y and left of x."""
    cameras, rows, columns = tiles.shape
    sums = np.zeros((cameras, rows + 1, columns + 1), np.int32)
    np.cumsum(tiles, 1, out=sums[:, 1:, 1:])
    np.cumsum(sums, 2, out=sums)
    return sums
