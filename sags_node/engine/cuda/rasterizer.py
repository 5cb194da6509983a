"""Draws Gaussians on a GPU and differentiates that: project, bin, composite, and the same backwards."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
import triton
from torch import Tensor

from sags_node.engine import interface
from sags_node.engine.cuda import compositing, layout, pair_sums, projection, projection_backward
from sags_node.engine.cuda import spherical_harmonics as harmonics
from sags_node.engine.cuda.binning import bin_splats
from sags_node.engine.cuda.scene import DeviceGaussians, DeviceGradients, camera_record, check_tensor
from sags_node.engine.failures import DeviceMemoryError
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT as GIVEN_TILE_HEIGHT
from sags_node.errors import UsageError

MAX_PAIRS = 1 << 26  # 3 GiB of gradients
TILE_WIDTH, TILE_HEIGHT = layout.TILE_WIDTH.value, layout.TILE_HEIGHT.value
ROWS_OF_TILES = GIVEN_TILE_HEIGHT // TILE_HEIGHT  # in one of the tiles that callers name; as wide as those


class CudaRasterizer:
    """Everything stays on the device. Not for use by two threads at once.

    Memory beside the pictures: about 200 bytes for each Gaussian, and up to 50 for each pair of a splat and a
    tile that its box touches, twice that while differentiating.
    """

    def __init__(self, width: int, height: int, antialias: bool, device: torch.device) -> None:
        self._width, self._height, self._antialias = width, height, antialias
        self._tiles_x, self._tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
        self._planes = torch.zeros((5, height, width), device=device)
        self._median_depths = torch.zeros((height, width), device=device)
        self._median_rows = torch.full((height, width), -1, dtype=torch.int32, device=device)
        self._all_active = torch.ones((self._tiles_y, self._tiles_x), dtype=torch.int32, device=device)
        self._all_sums = _integral(self._all_active)
        self.device = self._planes.device  # with its number
        self._drawn = False  # there is a drawing to differentiate

    def draw(
        self, gaussians: DeviceGaussians, pinhole: interface.Pinhole, tiles: Tensor | None = None
    ) -> Tensor:
        """Draw for a camera of the rasteriser's picture size.

        Args:
            gaussians: kept until the next call, and must be unchanged for `backward_pass`.
            pinhole: the camera.
            tiles: [ceil(H / 32), ceil(W / 16)] bool, as in `interface.Rasterizer.forward`. None: all.

        Returns:
            Planes [5, H, W] as `interface.Rasterizer.forward` has them, overwritten by the next call.

        Raises:
            UsageError: the Gaussians are on another device, or `tiles` has another shape.
            DeviceMemoryError: too many pairs of splats and tiles, or the device has not enough memory.
        """
        n = len(gaussians)
        check_tensor(gaussians.means, (n, 3), self.device, "means")
        self._gaussians, self._drawn = gaussians, False
        self._camera = camera_record(pinhole, self.device)
        with self._memory_reported():
            self._active = self._all_active if tiles is None else self._small_tiles(tiles)
            sums = self._all_sums if tiles is None else _integral(self._active)
            self._splats = torch.empty((n, layout.SPLAT_FLOATS.value), device=self.device)
            boxes = self._splats.new_empty((n, layout.BOX_INTS.value), dtype=torch.int32)
            counts = boxes.new_empty(n)
            projection.project[(triton.cdiv(n, projection.BLOCK),)](
                gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors,
                gaussians.sh_rest, gaussians.smoothing, self._camera, sums, self._splats, boxes, counts,
                n, self._width, self._height,
                TERMS=gaussians.terms, SMOOTHED=gaussians.smoothing is not None,
                ANTIALIASED=self._antialias, BLOCK=projection.BLOCK,
            )  # fmt: skip
            self._bins = bin_splats(self._splats, boxes, counts, self._active, self._refuse_too_many)
            self._tile_ends = torch.empty_like(self._bins.tile_starts)
            compositing.composite[(self._active.numel(),)](
                self._splats, self._bins.splats, self._bins.tile_starts, self._active, self._planes,
                self._tile_ends, self._width, self._height, num_warps=layout.TILE_WARPS,
            )  # fmt: skip
        self._drawn = True
        return self._planes

    def backward_pass(self, v_planes: Tensor, weight: Tensor) -> DeviceGradients:
        """Gradients of sum(v_planes * planes) for the last `draw`, in fresh tensors.

        Args:
            v_planes: [5, H, W] cotangent of the planes.
            weight: [H, W] pixel weights for the contribution.

        Raises:
            UsageError: nothing was drawn, or a tensor has another shape, type or device.
            DeviceMemoryError: the device has not enough memory.
        """
        self._check_drawn()
        gaussians, bins = self._gaussians, self._bins
        check_tensor(v_planes, (5, self._height, self._width), self.device, "v_planes")
        check_tensor(weight, (self._height, self._width), self.device, "weight")
        n, terms = len(gaussians), gaussians.terms
        with self._memory_reported():
            # zeros for what the ellipse misses or a finished tile hides
            v_pairs = v_planes.new_zeros((len(bins.slots), layout.V_SPLAT_FLOATS.value))
            compositing.composite_backward[(self._active.numel(),)](
                self._splats, bins.splats, bins.slots, bins.tile_starts, self._tile_ends, self._active,
                self._planes, v_planes, weight, v_pairs, self._width, self._height,
                num_warps=layout.TILE_WARPS,
            )  # fmt: skip
            v_splats = v_planes.new_empty((n, layout.V_SPLAT_FLOATS.value))
            v_colors, contribution = v_planes.new_empty((n, 3)), v_planes.new_empty(n)
            pair_sums.sum_pairs[(triton.cdiv(n, pair_sums.BLOCK),)](
                bins.first_slots, bins.counts, v_pairs, v_splats, v_colors, contribution, n,
                BLOCK=pair_sums.BLOCK, num_warps=pair_sums.WARPS,
            )  # fmt: skip
            v_means, v_scales = torch.empty_like(gaussians.means), torch.empty_like(gaussians.scales)
            v_quats, v_opacities = torch.empty_like(gaussians.quats), torch.empty_like(gaussians.opacities)
            projection_backward.project_backward[(triton.cdiv(n, projection_backward.BLOCK),)](
                gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh_rest,
                gaussians.smoothing, self._camera, v_splats, v_means, v_quats, v_scales, v_opacities, n,
                TERMS=terms, SMOOTHED=gaussians.smoothing is not None, ANTIALIASED=self._antialias,
                BLOCK=projection_backward.BLOCK, num_warps=projection_backward.WARPS,
            )  # fmt: skip
            v_sh_rest = v_splats.new_empty((n, terms, 3))
            if terms:
                harmonics.coefficients_backward[(triton.cdiv(n, harmonics.BLOCK),)](
                    gaussians.means, self._camera, v_splats, v_sh_rest, n, TERMS=terms, BLOCK=harmonics.BLOCK
                )  # fmt: skip
        return DeviceGradients(v_means, v_quats, v_scales, v_opacities, v_colors, v_sh_rest, contribution)

    def median_depth(self) -> tuple[Tensor, Tensor]:
        """Depth [H, W] m and row of the Gaussian [H, W] int32 as `interface.Rasterizer.median` has
        them, overwritten by the next call. UsageError where nothing was drawn."""
        self._check_drawn()
        compositing.median[(self._active.numel(),)](
            self._splats, self._bins.splats, self._bins.tile_starts, self._tile_ends, self._active,
            self._median_depths, self._median_rows, self._width, self._height, num_warps=layout.TILE_WARPS,
        )  # fmt: skip
        return self._median_depths, self._median_rows

    def _small_tiles(self, tiles: Tensor) -> Tensor:
        """[tile rows, tile columns] int32: 1 where a tile of the kernels is to be drawn."""
        shape = (-(-self._height // GIVEN_TILE_HEIGHT), self._tiles_x)
        if tuple(tiles.shape) != shape or tiles.dtype != torch.bool:
            raise UsageError(f"tiles is {tiles.dtype} {list(tiles.shape)}, expected bool {list(shape)}")
        rows = tiles.to(self.device).repeat_interleave(ROWS_OF_TILES, 0)
        return rows[: self._tiles_y].to(torch.int32).contiguous()

    def _check_drawn(self) -> None:
        if not self._drawn:
            raise UsageError("nothing was drawn, or the last drawing was refused; draw first")

    def _refuse_too_many(self, pairs: int) -> None:
        if pairs > MAX_PAIRS:
            raise DeviceMemoryError(
                f"drawing {len(self._gaussians)} Gaussians takes {pairs} Gaussian-tile pairs, the limit is "
                f"{MAX_PAIRS}: the Gaussians are too large for the picture; draw fewer or smaller ones"
            )

    @contextmanager
    def _memory_reported(self) -> Iterator[None]:
        try:
            yield
        except torch.OutOfMemoryError as error:
            raise DeviceMemoryError(
                f"the GPU has not enough free memory to draw {len(self._gaussians)} Gaussians at "
                f"{self._width}x{self._height} px: draw fewer or smaller ones, or end what else uses the GPU"
            ) from error


def _integral(active: Tensor) -> Tensor:
    """[rows + 1, columns + 1] int32: entry y, x counts the active tiles above y and left of x."""
    sums = active.cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32)
    return torch.nn.functional.pad(sums, (1, 0, 1, 0))
