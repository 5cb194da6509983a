"""The CPU backend: project, bin, composite, and the same backwards, over memory it keeps."""

from __future__ import annotations

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
    """Buffers grow with the numbers of Gaussians and pairs and are never given back."""

    def __init__(self, width: int, height: int, antialias: bool) -> None:
        self._width, self._height = width, height
        self._shape = width, height, TILE_WIDTH_BITS, TILE_HEIGHT_BITS
        self._tiles = -(-width // TILE_WIDTH) * -(-height // TILE_HEIGHT)
        self._projector = Projector(antialias)
        self._next = aligned((1,), np.int64)  # shared counter of the workers
        self._reserved = aligned((1,), np.int64)
        self._all_active = read_only(np.ones(self._tiles, np.bool_))
        self._all_drawn = np.arange(self._tiles, dtype=np.int32)
        self._tile_starts = aligned((self._tiles + 1,), np.int32)
        self._tile_ends = aligned((self._tiles,), np.int32)
        self._allocate_workers(thread_count())
        self._allocate_splats(1024)
        self._emitted = aligned((4096,), layout.EMITTED)
        self._pairs = aligned((4096,), layout.PAIR)
        self._v_pairs = aligned((0,))
        self._planes = aligned((5, height, width))
        self._median_depths = aligned((height, width))
        self._median_rows = aligned((height, width), np.int32)
        self._median_rows[:] = -1

    def _allocate_workers(self, workers: int) -> None:
        self._workers = workers
        self._scratch = aligned((workers, compositing.SCRATCH))
        self._histogram = aligned((PARTS * workers, self._tiles), np.int32)

    def _allocate_splats(self, room: int) -> None:
        self._splats = aligned((room,), layout.SPLAT)
        self._slots = aligned((room,), layout.SLOTS)
        self._runs = aligned((-(-room // binning.BLOCK),), layout.SLOTS)
        self._depths = aligned((room,))
        self._order, self._spare_order, self._keys, self._spare_keys = (
            aligned((room,), np.int32) for _ in range(4)
        )
        self._v_colors = aligned((room, 3))
        self._contribution, self._spread = aligned((room,)), aligned((room,))

    def forward(self, gaussians: Gaussians, pinhole: Pinhole, tiles: Bool | None) -> F32:
        n = self._count = len(gaussians)
        if n > len(self._splats):
            self._allocate_splats(int(n * SPARE))
        if thread_count() != self._workers:
            self._allocate_workers(thread_count())
        splats = self._splats[:n]
        self._projector.project(gaussians, pinhole, splats, self._depths[:n])
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
            self._planes.reshape(-1),
            self._tile_ends,
        )
        return self._planes

    def _bin(self, splats: Records, tiles: Bool | None) -> None:
        """Lists of splats, near to far, for the tiles to draw."""
        depths, slots = self._depths[: len(splats)], self._slots[: len(splats)]
        active, self._drawn = self._all_active, self._all_drawn
        if tiles is not None:
            active = read_only(tiles.reshape(-1))
            self._drawn = np.flatnonzero(active).astype(np.int32)
            binning.drop_untouched(splats, depths, _integral(tiles).reshape(-1), *self._shape)
        kept = binning.sort_by_depth(
            depths, slots, self._order, self._spare_order, self._keys, self._spare_keys
        )
        order = self._order[:kept]
        while True:
            binning.emit_pairs(
                splats,
                order,
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
        n = self._count
        if len(self._v_pairs) < RECORD * len(self._emitted):
            self._v_pairs = aligned((RECORD * len(self._emitted),))
        compositing.composite_backward(
            self._splats[:n],
            self._pairs,
            self._tile_starts,
            self._tile_ends,
            self._drawn,
            self._next,
            self._scratch,
            self._width,
            self._height,
            self._planes.reshape(-1),
            v_planes.reshape(-1),
            weight.reshape(-1),
            self._v_pairs,
        )
        v_colors, contribution, spread = self._v_colors[:n], self._contribution[:n], self._spread[:n]
        means, quats, scales, opacities, sh_rest, slopes = self._projector.backward(
            self._slots[:n], self._v_pairs, v_colors, contribution, spread
        )
        return Gradients(means, quats, scales, opacities, v_colors, slopes, sh_rest, contribution, spread)

    def median(self) -> tuple[F32, I32]:
        median.median(
            self._splats[: self._count],
            self._pairs,
            self._tile_starts,
            self._tile_ends,
            self._drawn,
            self._next,
            self._scratch,
            self._width,
            self._height,
            self._median_depths.reshape(-1),
            self._median_rows.reshape(-1),
        )
        return self._median_depths, self._median_rows


def _integral(tiles: Bool) -> I32:
    """[rows + 1, columns + 1]: entry y, x counts the active tiles above y and left of x."""
    rows, columns = tiles.shape
    sums = np.zeros((rows + 1, columns + 1), np.int32)
    np.cumsum(tiles, 0, out=sums[1:, 1:])
    np.cumsum(sums, 1, out=sums)
    return sums
