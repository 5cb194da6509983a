"""The CPU's rasteriser: filter, colour, project, bin, composite, and the same backwards."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sags_node.engine.interface import DILATION_VARIANCE, MIP_VARIANCE, Gradients
from sags_node.engine.rasterizer import (
    binning,
    compositing,
    layout,
    median,
    projection,
    projection_backward,
    smoothing,
    spherical_harmonics,
)
from sags_node.engine.rasterizer.arguments import check_size, checked, checked_cotangents, drawn, view_of
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_HEIGHT_BITS, TILE_WIDTH, TILE_WIDTH_BITS
from sags_node.errors import SagsError
from sags_node.kernels.jit import aligned, read_only
from sags_node.kernels.threads import thread_count
from sags_node.kernels.vectors import RECORD
from sags_node.types import F32, I32, Bool, Camera, Gaussians

MAX_PAIRS = 1 << 25  # 2 GiB of gradients
PARTS = 4  # parts of the splats per worker
SPARE = 1.25  # a buffer that grows gets this many times the size it needs
Records = NDArray[Any]  # of a structured type of `layout`


class CpuRasterizer:
    """`interface.Rasterizer` in Numba's kernels.

    Buffers grow with the numbers of Gaussians and pairs and are never given back.
    """

    def __init__(self, width: int, height: int, antialias: bool) -> None:
        """See `rasterize.make_rasterizer`."""
        self._width, self._height = width, height
        self._shape = width, height, TILE_WIDTH_BITS, TILE_HEIGHT_BITS
        self._tiles = -(-width // TILE_WIDTH) * -(-height // TILE_HEIGHT)
        variance = MIP_VARIANCE if antialias else DILATION_VARIANCE
        self._screen_filter = np.float32(variance), np.float32(antialias)
        self._given: Gaussians | None = None  # what was drawn last
        self._next = aligned((1,), np.int64)  # shared counter of the workers
        self._reserved = aligned((1,), np.int64)
        self._all_active = read_only(np.ones(self._tiles, np.bool_))
        self._all_drawn = np.arange(self._tiles, dtype=np.int32)
        self._tile_starts = aligned((self._tiles + 1,), np.int32)
        self._tile_ends = aligned((self._tiles,), np.int32)
        self._allocate_workers(thread_count())
        self._allocate_splats(1024)
        self._v_sh_rest = aligned((0, 0, 3))
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
        self._projection_scratch = aligned((workers, projection_backward.SCRATCH))
        self._histogram = aligned((PARTS * workers, self._tiles), np.int32)

    def _allocate_splats(self, room: int) -> None:
        self._splats = aligned((room,), layout.SPLAT)
        self._slots = aligned((room,), layout.SLOTS)
        self._runs = aligned((-(-room // binning.BLOCK),), layout.SLOTS)
        self._order, self._spare_order, self._keys, self._spare_keys = (
            aligned((room,), np.int32) for _ in range(4)
        )
        self._depths, self._opacities, self._v_opacities, self._contribution, self._spread = (
            aligned((room,)) for _ in range(5)
        )
        self._scales, self._colors, self._slopes = (aligned((room, 3)) for _ in range(3))
        self._no_slopes = read_only(aligned((room, 3)))
        self._v_means, self._v_scales, self._v_colors, self._v_slopes = (aligned((room, 3)) for _ in range(4))
        self._v_quats = aligned((room, 4))

    def forward(self, gaussians: Gaussians, camera: Camera, tiles: Bool | None = None) -> F32:
        check_size(self._width, self._height, camera, tiles)
        gaussians, self._view = checked(gaussians), view_of(camera)
        self._centre = tuple(map(np.float32, camera.T_world_cam[:3, 3]))
        n = len(gaussians)
        if n > len(self._splats):
            self._allocate_splats(int(n * SPARE))
        if thread_count() != self._workers:
            self._allocate_workers(thread_count())
        splats = self._splats[:n]
        self._project(gaussians, splats)
        self._bin(splats, tiles)
        lists = splats, self._pairs, self._tile_starts
        compositing.composite(*lists, *self._work, self._planes.reshape(-1), self._tile_ends)
        self._given = gaussians
        return self._planes

    def _project(self, gaussians: Gaussians, splats: Records) -> None:
        """Apply the 3D filter, compute the colours seen from the camera, and project."""
        n = len(gaussians)
        slopes = self._no_slopes[:n] if gaussians.slopes is None else gaussians.slopes
        self._unfiltered = self._filtered = gaussians.scales, gaussians.opacities, slopes
        if gaussians.smoothing is not None:
            filtered = self._scales[:n], self._opacities[:n], self._slopes[:n]
            smoothing.smooth(gaussians.scales, gaussians.opacities, gaussians.smoothing, slopes, *filtered)
            self._filtered = read_only(filtered[0]), read_only(filtered[1]), read_only(filtered[2])
        scales, opacities, slopes = self._filtered
        colors = gaussians.colors
        if gaussians.sh_rest is not None:
            seen = self._colors[:n]
            spherical_harmonics.color(gaussians.means, colors, gaussians.sh_rest, self._centre, seen)
            colors = read_only(seen)
        projection.project(
            gaussians.means, gaussians.quats, scales, opacities, colors, slopes, self._view,
            self._screen_filter, self._projection_scratch, self._next, splats.view(np.float32),
            self._depths[:n],
        )  # fmt: skip

    def _bin(self, splats: Records, tiles: Bool | None) -> None:
        """Make the lists of splats, near to far, of the tiles to draw."""
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
                    f"drawing {len(splats)} Gaussians takes about {needed} Gaussian-tile pairs, the limit is "
                    f"{MAX_PAIRS}: the Gaussians are too large for the image; draw fewer or smaller ones"
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
        given = drawn(self._given, "backward")
        v_planes, weight = checked_cotangents(v_planes, weight, self._width, self._height)
        if len(self._v_pairs) < RECORD * len(self._emitted):
            self._v_pairs = aligned((RECORD * len(self._emitted),))
        flat = self._planes.reshape(-1), v_planes.reshape(-1), weight.reshape(-1)
        compositing.composite_backward(*self._blended(given), *self._work, *flat, self._v_pairs)
        return self._project_backward(given)

    def _project_backward(self, given: Gaussians) -> Gradients:
        """Turn the gradients of pairs into those of Gaussians."""
        n, terms = len(given), 0 if given.sh_rest is None else given.sh_rest.shape[1]
        if n > len(self._v_sh_rest) or terms != self._v_sh_rest.shape[1]:
            self._v_sh_rest = aligned((len(self._splats), terms, 3))
        found = Gradients(
            self._v_means[:n], self._v_quats[:n], self._v_scales[:n], self._v_opacities[:n],
            self._v_colors[:n], self._v_slopes[:n], self._v_sh_rest[:n], self._contribution[:n],
            self._spread[:n],
        )  # fmt: skip
        scales, opacities, slopes = self._filtered
        projection_backward.project_backward(
            given.means, given.quats, scales, opacities, slopes, self._view, self._screen_filter,
            self._projection_scratch, self._next, self._slots[:n], self._v_pairs, found.colors,
            found.contribution, found.spread, found.means, found.quats, found.scales, found.opacities,
            found.slopes,
        )  # fmt: skip
        if given.sh_rest is not None:
            spherical_harmonics.color_backward(
                given.means, given.sh_rest, self._centre, found.colors, found.sh_rest, found.means
            )
        if given.smoothing is not None:
            scales, opacities, slopes = self._unfiltered
            smoothing.smooth_backward(
                scales, opacities, given.smoothing, slopes, found.scales, found.opacities, found.slopes
            )
        return found

    def median(self) -> tuple[F32, I32]:
        found = self._median_depths, self._median_rows
        blended = self._blended(drawn(self._given, "median"))
        median.median(*blended, *self._work, *(array.reshape(-1) for array in found))
        return found

    @property
    def _work(self) -> tuple[Any, Any, Any, Any, Any]:
        """The arguments common to all kernels whose workers take tile after tile."""
        return self._drawn, self._next, self._scratch, self._width, self._height

    def _blended(self, given: Gaussians) -> tuple[Any, Any, Any, Any]:
        """The splats and pairs that the last `forward` blended, and where each tile's pairs begin and end."""
        return self._splats[: len(given)], self._pairs, self._tile_starts, self._tile_ends


def _integral(tiles: Bool) -> I32:
    """[rows + 1, columns + 1]: entry y, x counts the active tiles above y and left of x."""
    rows, columns = tiles.shape
    sums = np.zeros((rows + 1, columns + 1), np.int32)
    np.cumsum(tiles, 0, out=sums[1:, 1:])
    np.cumsum(sums, 1, out=sums)
    return sums
