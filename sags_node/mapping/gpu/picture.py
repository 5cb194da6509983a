"""A picture on a GPU: what is drawn, and what it should show."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from sags_node.engine.gpu.rasterizer import DeviceRasterizer
from sags_node.mapping.focus import tile_grid
from sags_node.mapping.gpu import kernels
from sags_node.mapping.refiner import DEPTH_SCALE, DEPTH_WEIGHT
from sags_node.types import F32, U8, Bool


class Picture:
    """Pictures of one size.

    Attributes:
        rasterizer: draws them.
        is_fetched: what was drawn last is on the host.
    """

    def __init__(self, width: int, height: int, device: wp.Device) -> None:
        self._device = device
        self.rasterizer = DeviceRasterizer(width, height, device)
        self.is_fetched = False
        self._planes = wp.zeros((5, height, width), dtype=float, device="cpu", pinned=device.is_cuda)
        self._v_planes = wp.zeros((5, height, width), dtype=float, device=device)
        self._weight = wp.zeros((height, width), dtype=float, device=device)
        self._sums = wp.zeros(1, dtype=wp.vec2, device=device)
        shape = tile_grid(np.empty((height, width), np.bool_)).shape
        self._residuals = wp.zeros(shape, dtype=float, device=device)

    def show(self, image: U8, tissue: Bool, depth: F32) -> None:
        """From now on it should show that: RGB [H, W, 3], where that counts [H, W], and m [H, W]."""
        self._seen = [
            wp.array(image, dtype=wp.uint8, device=self._device),
            wp.array(tissue, dtype=wp.bool, device=self._device),
        ]
        self._depth = wp.array(depth, dtype=float, device=self._device)

    def fetched(self, anew: bool = False) -> F32:
        """The planes [5, H, W] as they were drawn last, on the host; overwritten by the next that are."""
        if anew or not self.is_fetched:
            wp.copy(self._planes, self.rasterizer.planes)
            wp.synchronize_device(self._device)
            self.is_fetched = True
        planes: F32 = self._planes.numpy()
        return planes

    def compare(self) -> tuple[wp.array, wp.array]:
        """`engine.losses.tissue.tissue_loss` of what was drawn last: the gradient by its planes [5, H, W] and
        the pixels' weight [H, W]."""
        self._sums.zero_()
        blocks = -(-self._weight.size // kernels.PIXELS)
        self._launch(kernels.tissue_loss, blocks * kernels.PIXELS, [
            self.rasterizer.planes, *self._seen, self._depth, DEPTH_WEIGHT, DEPTH_SCALE,
            self._v_planes, self._weight, self._sums,
        ])  # fmt: skip
        return self._v_planes, self._weight

    def loss(self) -> float:
        """The mean absolute colour residual of the last `compare`."""
        residuals, pixels = self._sums.numpy()[0].tolist()
        return residuals / (3.0 * pixels) if pixels > 0 else 0.0

    def residuals(self) -> F32:
        """`focus.sum_residuals` of all tiles, on the host."""
        found = self._residuals
        self._launch(kernels.sum_residuals, found.shape, [self.rasterizer.planes, *self._seen, found])
        sums: F32 = found.numpy()
        return sums

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim, inputs=inputs, device=self._device, block_dim=kernels.PIXELS)
