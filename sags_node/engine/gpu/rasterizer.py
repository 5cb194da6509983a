"""Rasterisers on a Warp device. `DeviceRasterizer` copies nothing to the host but the number of pairs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from sags_node.engine.gpu import binning, compositing, projection, runtime
from sags_node.engine.gpu.binning import LANES, TILE
from sags_node.engine.interface import DILATION_VARIANCE, MIP_VARIANCE, Gradients
from sags_node.engine.rasterizer import spherical_harmonics
from sags_node.engine.rasterizer.arguments import check_size, checked, checked_cotangents, drawn, view_of
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.errors import SagsError
from sags_node.types import F32, I32, Bool, Camera, Gaussians

MAX_PAIRS = 1 << 26  # 6 GB: what the CPU's engine draws, too, in tiles of twice the size
SPARE = 1.25  # a buffer that grows gets this many times the size it needs
KINDS: dict[str, Any] = {
    "means": wp.vec3, "quats": wp.vec4, "scales": wp.vec3, "opacities": float, "colors": wp.vec3,
    "slopes": wp.vec3, "smoothing": float,
}  # types of the inputs, by their names in `types.Gaussians`  # fmt: skip
DERIVED: dict[str, Any] = {
    "means": wp.vec3, "quats": wp.vec4, "scales": wp.vec3, "opacities": float, "colors": wp.vec3,
    "slopes": wp.vec3, "contribution": float, "spread": float,
}  # types of the results, by their names in `interface.Gradients`  # fmt: skip


class DeviceRasterizer:
    """Draws Gaussians in arrays of a device and differentiates the drawing. Not for two threads at once.

    Buffers grow with the numbers of Gaussians and pairs and are never given back.

    Attributes:
        planes: [5, H, W] as `interface.Rasterizer.forward` has them, overwritten by the next `forward`.
    """

    def __init__(self, width: int, height: int, device: wp.Device | str, antialias: bool = True) -> None:
        """
        Args:
            width, height: px.
            device: Warp's.
            antialias: as `rasterize.make_rasterizer` has it.
        """
        runtime.start()
        self.device = wp.get_device(device)
        self._size = [width, height]
        self._filter = [MIP_VARIANCE if antialias else DILATION_VARIANCE, int(antialias)]
        self._shape = (-(-height // TILE), -(-width // TILE))
        self._tiles = self._shape[0] * self._shape[1]
        self.planes = self._new((5, height, width))
        self._everywhere = self._new(self._tiles, int)
        self._everywhere.fill_(1)
        self._active = self._everywhere
        self._starts, self._tile_ends = self._new(self._tiles + 1, int), self._new(self._tiles, int)
        self._view = self._new(20)
        self._total = wp.zeros(1, dtype=wp.int64, device="cpu", pinned=self.device.is_cuda)
        self._room = self._pair_room = 0
        self._hold(1024)
        self._hold_pairs(4096)

    def forward(self, tables: Mapping[str, wp.array], view: F32, tiles: Bool | None = None) -> wp.array:
        """Draw for a camera.

        Args:
            tables: by the names and of the types of `KINDS`.
            view: of `arguments.view_of`, for a camera of the rasteriser's image size.
            tiles: as `interface.Rasterizer.forward` has them.

        Returns:
            `planes`.

        Raises:
            SagsError: the image needs more memory than the engine allows itself.
        """
        n = self._count = len(tables["means"])
        self._tables = tables
        if n > self._room:
            self._hold(int(n * SPARE))
        self._view.assign(view)
        self._choose(tiles)
        total = self._sort_by_depth(tables) if n else 0
        if total > MAX_PAIRS:
            raise SagsError(
                f"drawing {n} Gaussians takes {total} Gaussian-tile pairs, the limit is {MAX_PAIRS}: the "
                "Gaussians are too large for the image; draw fewer or smaller ones"
            )
        if total > self._pair_room:
            self._hold_pairs(int(total * SPARE))
        self._sort_into_tiles(total)
        self._tile_ends.zero_()
        self._launch(compositing.composite, (self._tiles, LANES), [
            self._splats, self._pairs, self._starts, *self._size, self._active, self.planes, self._tile_ends,
        ])  # fmt: skip
        return self.planes

    def backward(self, v_planes: wp.array, weight: wp.array) -> dict[str, wp.array]:
        """Return gradients of sum(v_planes * planes) for the last `forward`; its tables must be unchanged.

        Args:
            v_planes: [5, H, W] cotangent of the planes.
            weight: [H, W] pixel weights for the contribution.

        Returns:
            By the names and of the types of `DERIVED`, overwritten by the next `backward`.
        """
        found = {name: array[: self._count] for name, array in self._found.items()}
        if self._count == 0:
            return found
        self._sums.zero_()
        self._launch(compositing.composite_backward, (self._tiles, LANES), [
            self._splats, self._pairs, self._starts, self._tile_ends, *self._size, self._active, self.planes,
            v_planes, weight, self._slots, self._sums,
        ])  # fmt: skip
        given = [
            self._tables[name] for name in ("means", "quats", "scales", "opacities", "slopes", "smoothing")
        ]
        self._launch(projection.project_backward, self._count, [
            *given, self._view, *self._filter, self._own_slots, self._records,
            *(found[name] for name in ("means", "quats", "scales", "opacities", "colors", "slopes")),
            found["contribution"], found["spread"],
        ])  # fmt: skip
        return found

    def median(self) -> tuple[wp.array, wp.array]:
        """Return the depth [H, W] (m) at which the transmittance of the last `forward` falls to one half, and
        the row of the Gaussian there [H, W]; as `interface.Rasterizer.median`."""
        if self._medians is None:
            shape = self.planes.shape[1:]
            self._medians = self._new(shape), self._new(shape, int)
            self._medians[1].fill_(-1)
        self._launch(compositing.median, (self._tiles, LANES), [
            self._splats, self._pairs, self._starts, *self._size, self._active, *self._medians,
        ])  # fmt: skip
        return self._medians

    def _choose(self, tiles: Bool | None) -> None:
        """Set which of this engine's tiles are drawn, given those of the CPU's engine."""
        self._active = self._everywhere
        if tiles is not None:
            chosen = np.repeat(np.repeat(tiles, TILE_HEIGHT // TILE, 0), TILE_WIDTH // TILE, 1)
            rows, columns = self._shape
            flat = np.ascontiguousarray(chosen[:rows, :columns], np.int32).ravel()
            self._active = wp.array(flat, dtype=int, device=self.device)

    def _sort_by_depth(self, tables: Mapping[str, wp.array]) -> int:
        """Project the Gaussians and sort the splats, near to far. Return how many pairs they make."""
        n, counts, ends = self._count, self._counts[: self._count], self._ends[: self._count]
        self._launch(projection.project, n, [
            *(tables[name] for name in KINDS), self._view, *self._filter, self._splats, self._keys,
            self._order,
        ])  # fmt: skip
        wp.utils.radix_sort_pairs(self._keys, self._order, n, end_bit=31)
        self._launch(binning.count_pairs, n, [
            self._splats, self._keys, self._order, *self._size, self._active, counts,
        ])  # fmt: skip
        wp.utils.array_scan(counts, ends, inclusive=True)
        wp.copy(self._total, ends, src_offset=n - 1, count=1)
        if self.device.is_cuda:
            wp.synchronize_stream(self.device.stream)
        return int(self._total.numpy()[0])

    def _sort_into_tiles(self, total: int) -> None:
        if self._count:
            self._launch(binning.emit_pairs, self._count, [
                self._splats, self._keys, self._order, *self._size, self._active, self._counts, self._ends,
                self._pair_tiles, self._slots, self._slot_splats, self._own_slots,
            ])  # fmt: skip
            wp.utils.radix_sort_pairs(self._pair_tiles, self._slots, total, end_bit=self._tiles.bit_length())
        self._launch(binning.find_ranges, total + 1, [
            self._pair_tiles, self._slots, self._slot_splats, total, self._starts, self._pairs,
        ])  # fmt: skip

    def _hold(self, room: int) -> None:
        """Make room for `room` Gaussians."""
        self._room = room
        self._splats = self._new((room, projection.RECORD), wp.vec4)
        self._keys, self._order = self._new(2 * room, int), self._new(2 * room, int)  # half is for sorting
        self._counts, self._ends = self._new(room, wp.int64), self._new(room, wp.int64)
        self._own_slots = self._new(room, wp.vec2i)
        self._found = {name: self._new(room, kind) for name, kind in DERIVED.items()}

    def _hold_pairs(self, room: int) -> None:
        self._pair_room = room
        self._pair_tiles, self._slots = self._new(2 * room, int), self._new(2 * room, int)
        self._slot_splats, self._pairs = self._new(room, int), self._new(room, int)
        self._records = self._new(room, projection.vec16)
        self._sums = wp.array(ptr=self._records.ptr, shape=(room, 16), dtype=float, device=self.device)

    def _new(self, shape: Any, kind: Any = float) -> wp.array:
        return wp.zeros(shape, dtype=kind, device=self.device)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim, inputs=inputs, device=self.device, block_dim=LANES)

    _medians: tuple[wp.array, wp.array] | None = None


class WarpRasterizer:
    """An `interface.Rasterizer` on a device. It takes and gives arrays of the host, copied on every call."""

    def __init__(self, width: int, height: int, antialias: bool, device: wp.Device) -> None:
        """See `rasterize.make_rasterizer`."""
        self._width, self._height = width, height
        self._on_device = DeviceRasterizer(width, height, device, antialias)
        self._device = device
        self._given: Gaussians | None = None  # what was drawn last

    def forward(self, gaussians: Gaussians, camera: Camera, tiles: Bool | None = None) -> F32:
        check_size(self._width, self._height, camera, tiles)
        gaussians, view = checked(gaussians), view_of(camera)
        given, self._centre = gaussians, tuple(map(np.float32, camera.T_world_cam[:3, 3]))
        if gaussians.sh_rest is not None:  # the only step that runs on the host
            seen = np.empty_like(gaussians.colors)
            spherical_harmonics.color(
                gaussians.means, gaussians.colors, gaussians.sh_rest, self._centre, seen
            )
            gaussians = replace(gaussians, colors=seen)
        planes: F32 = self._on_device.forward(sent(gaussians, self._device), view, tiles).numpy()
        self._given = given
        return planes

    def backward(self, v_planes: F32, weight: F32) -> Gradients:
        last = drawn(self._given, "backward")
        cotangents = checked_cotangents(v_planes, weight, self._width, self._height)
        given = (wp.array(array, dtype=float, device=self._device) for array in cotangents)
        found = {name: array.numpy() for name, array in self._on_device.backward(*given).items()}
        rest = last.sh_rest
        v_rest = np.zeros((len(last), 0 if rest is None else rest.shape[1], 3), np.float32)
        if rest is not None:
            spherical_harmonics.color_backward(
                last.means, rest, self._centre, found["colors"], v_rest, found["means"]
            )
        return Gradients(**found, sh_rest=v_rest)

    def median(self) -> tuple[F32, I32]:
        drawn(self._given, "median")
        depths, rows = self._on_device.median()
        return depths.numpy(), rows.numpy()


def sent(gaussians: Gaussians, device: wp.Device) -> dict[str, wp.array]:
    """Copy Gaussians to the device, as the tables that `DeviceRasterizer.forward` takes."""
    count = len(gaussians)
    absent = {"slopes": np.zeros((count, 3), np.float32), "smoothing": np.zeros(count, np.float32)}
    given = {name: getattr(gaussians, name) for name in KINDS}
    return {
        name: wp.array(absent[name] if array is None else array, dtype=KINDS[name], device=device)
        for name, array in given.items()
    }
