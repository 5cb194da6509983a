"""The CPU backend: project, bin, composite, and the same backwards, over memory it keeps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sags_node.engine.interface import Gradients, Pinhole
from sags_node.engine.rasterizer import binning, compositing, layout, median
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_HEIGHT_BITS, TILE_WIDTH, TILE_WIDTH_BITS
from sags_node.engine.rasterizer.projector import Projector, Records
from sags_node.errors import SagsError
from sags_node.kernels.jit import aligned, read_only
from sags_node.kernels.threads import thread_count
from sags_node.kernels.vectors import RECORD
from sags_node.types import F32, I32, Bool, Gaussians

MAX_PAIRS = 1 << 25  # 2 GiB of gradients
PARTS = 4  # of the splats, for each worker
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
        self._allocate_tiles(1, thread_count())
        self._allocate_splats(1024)
        self._emitted = aligned((4096,), layout.EMITTED)
        self._pairs = aligned((4096,), layout.PAIR)
        self._v_pairs = aligned((0,))
        self._planes = aligned((0, 5, height, width))
        self._median_depths = aligned((0, height, width))
        self._median_rows = aligned((0, height, width), np.int32)

    def _allocate_tiles(self, cameras: int, workers: int) -> None:
        """What depends on how many tiles there are and how many work on them."""
        self._cameras, self._workers = cameras, workers
        tiles = cameras * self._tiles
        self._scratch = aligned((workers, compositing.SCRATCH))
        self._histogram = aligned((PARTS * workers, tiles), np.int32)
        self._tile_starts, self._tile_ends = aligned((tiles + 1,), np.int32), aligned((tiles,), np.int32)
        self._all_active = read_only(np.ones(tiles, np.bool_))
        self._all_drawn = np.arange(tiles, dtype=np.int32)

    def _allocate_splats(self, room: int) -> None:
        self._splats = aligned((room,), layout.SPLAT)
        self._slots = aligned((room,), layout.SLOTS)
        self._runs = aligned((-(-room // binning.BLOCK),), layout.SLOTS)
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
        self._median_rows[:] = -1
        self._planes[: len(planes)] = planes
        self._median_depths[: len(planes)] = depths
        self._median_rows[: len(planes)] = rows

    def forward(self, gaussians: Gaussians, pinholes: Sequence[Pinhole], tiles: Bool | None) -> F32:
        n, cameras, workers = len(gaussians), len(pinholes), thread_count()
        self._count = n
        if n * cameras > len(self._splats):
            self._allocate_splats(int(n * cameras * SPARE))
        if cameras > len(self._planes):
            self._allocate_pictures(cameras)
        if (cameras, workers) != (self._cameras, self._workers):
            self._allocate_tiles(cameras, workers)
        self._projector.load(gaussians, pinholes)
        for camera in range(cameras):
            rows = slice(camera * n, (camera + 1) * n)
            self._projector.project(camera, self._splats[rows], self._depths[rows])
        splats = self._splats[: n * cameras]
        self._bin(splats, tiles)
        compositing.composite(
            splats,
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

    def _bin(self, splats: Records, tiles: Bool | None) -> None:
        """Lists of splats, near to far, for the tiles to draw."""
        depths, slots = self._depths[: len(splats)], self._slots[: len(splats)]
        active, self._drawn = self._all_active, self._all_drawn
        if tiles is not None:
            active = read_only(tiles.reshape(-1))
            self._drawn = np.flatnonzero(active).astype(np.int32)
            binning.drop_untouched(splats, depths, self._cameras, _integral(tiles).reshape(-1), *self._shape)
        kept = binning.sort_by_depth(
            depths, slots, self._order, self._spare_order, self._keys, self._spare_keys
        )
        order = self._order[:kept]
        while True:
            binning.emit_pairs(
                splats,
                order,
                self._cameras,
                active,
                *self._shape,
                self._workers,
                self._emitted,
                slots,
                self._runs,
                self._reserved,
                self._histogram,
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
        binning.sort_into_tiles(
            self._workers,
            kept,
            self._emitted,
            self._runs,
            self._histogram,
            self._pairs,
            self._tile_starts,
            self._next,
        )

    def backward(self, v_planes: F32, weight: F32) -> Gradients:
        n, cameras = self._count, self._cameras
        if len(self._v_pairs) < RECORD * len(self._emitted):
            self._v_pairs = aligned((RECORD * len(self._emitted),))
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
        v_colors, contribution = self._v_colors[:n], self._contribution[:n]
        for camera in range(cameras):
            self._projector.backward(
                camera,
                self._slots[camera * n : (camera + 1) * n],
                self._v_pairs,
                accumulate=camera > 0,
                v_view_colors=self._v_view_colors[:n] if cameras > 1 else v_colors,
                v_colors=v_colors,
                contribution=contribution,
            )
        means, quats, scales, opacities, sh_rest = self._projector.gradients()
        return Gradients(means, quats, scales, opacities, v_colors, sh_rest, contribution)

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
