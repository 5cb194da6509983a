"""Drawing on a device by Warp's kernels, from and to torch's tensors there. Nothing comes to the host."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from sags_node.engine.rasterizer.arguments import view_of
from sags_node.model.alias_free import FILTER_VARIANCE, VIEW_MARGIN
from sags_node.types import Camera


class Canvas:
    """A rasteriser like `interface.Rasterizer`, on tensors. Not thread-safe."""

    def __init__(self, width: int, height: int, device: torch.device, antialias: bool = True) -> None:
        """Draw images of `width` x `height` px on a torch device: a GPU, or the CPU, which is slow."""
        from sags_node.engine.gpu import runtime

        on_device = runtime.device_named(str(device))
        import warp

        from sags_node.engine.gpu.rasterizer import KINDS, DeviceRasterizer

        self._warp, self._kinds = warp, KINDS
        # Warp works on torch's stream, so that neither waits for the other
        self._stream = None if device.type == "cpu" else warp.stream_from_torch(device)
        with self._on_the_stream():
            self._rasterizer = DeviceRasterizer(width, height, on_device, antialias)

    def forward(self, tables: Mapping[str, Tensor], camera: Camera) -> Tensor:
        """Draw planes [5, H, W], which the next drawing overwrites. `tables`: means, quats, scales,
        opacities, colors, slopes and smoothing, as `types.Gaussians` has them."""
        with self._on_the_stream():
            given = {
                name: self._warp.from_torch(
                    table.detach().contiguous(), dtype=self._kinds[name] if table.ndim > 1 else None
                )
                for name, table in tables.items()
            }
            planes: Tensor = self._warp.to_torch(self._rasterizer.forward(given, view_of(camera)))
        return planes

    def backward(self, v_planes: Tensor, weight: Tensor) -> dict[str, Tensor]:
        """Return `interface.Gradients` by their names, overwritten by the next `backward`."""
        with self._on_the_stream():
            arrays = (self._warp.from_torch(each.contiguous()) for each in (v_planes, weight))
            found = self._rasterizer.backward(*arrays)
            return {name: self._warp.to_torch(array) for name, array in found.items()}

    def _on_the_stream(self) -> AbstractContextManager[object]:
        if self._stream is None:
            return nullcontext()
        scope: AbstractContextManager[object] = self._warp.ScopedStream(self._stream, sync_enter=False)
        return scope


def smoothing(means: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Compute `alias_free.smoothing_variances` of means [N, 3] on their device, [N] m^2."""
    intervals = means.new_full((len(means),), torch.inf)
    for camera in cameras:
        view = torch.tensor(camera.viewmat[:3]).to(means, non_blocking=True)
        x, y, z = (means @ view[:, :3].T + view[:, 3]).unbind(1)
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        (across, down), margin = (camera.width, camera.height), VIEW_MARGIN
        u, v = fx * x / z + cx, fy * y / z + cy
        seen = (z > 0) & (u >= -margin * across) & (u < (1 + margin) * across)
        seen &= (v >= -margin * down) & (v < (1 + margin) * down)
        intervals = torch.where(seen, torch.minimum(intervals, z / max(fx, fy)), intervals)
    variances = FILTER_VARIANCE * intervals.square()
    seen = variances.isfinite()
    return torch.where(seen, variances, torch.where(seen, variances, 0).max())
