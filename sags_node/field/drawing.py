"""From raw rows to an image, as one differentiable step: activation, 3D filter, rasteriser.

The 3D filter comes after the deformation, where a Gaussian's depth is known (`model.alias_free`); its
variance has no gradient, as in Mip-Splatting. The 2D filter is part of the rasteriser.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sags_node.engine.interface import Rasterizer
from sags_node.field.canvas import Canvas, smoothing
from sags_node.field.decoder import HEADS
from sags_node.model.alias_free import smoothing_variances
from sags_node.types import F32, I64, Camera, Gaussians

# What is drawn, by its name in `types.Gaussians`; the first five make up a row
TABLES = ("means", "quats", "scales", "opacities", "colors", "slopes")


def activate(rows: Tensor) -> tuple[Tensor, ...]:
    """Turn rows [N, 14] into means [N, 3] m, quats [N, 4], scales [N, 3] m, opacities [N], colours [N, 3]."""
    # Split at once: for parts taken one by one, autograd would make a gradient of whole rows each
    means, log_scales, quats, colors, logits = torch.split(rows, list(HEADS.values()), 1)
    return means, quats, log_scales.exp(), logits[:, 0].sigmoid(), colors


def deactivate(gaussians: Gaussians) -> F32:
    """Return raw rows [N, 14] of Gaussians: the inverse of `activate`."""
    opacities = np.clip(gaussians.opacities, 1e-6, 1 - 1e-6)
    logits = np.log(opacities / (1 - opacities))[:, None]
    parts = [gaussians.means, np.log(gaussians.scales), gaussians.quats, gaussians.colors, logits]
    return np.concatenate(parts, axis=1, dtype=np.float32)


def to_gaussians(
    activated: Sequence[Tensor], slopes: Tensor | None, ids: I64, cameras: Sequence[Camera] | None
) -> Gaussians:
    """Make Gaussians to draw of what `activate` returns and slopes [N, 3]. `cameras`: those they were fitted
    to, for the 3D filter; None: no filter."""
    means, quats, scales, opacities, colors = (
        np.ascontiguousarray(part.detach().cpu().numpy()) for part in activated
    )
    return Gaussians(
        means, quats, scales, opacities, colors, ids,
        smoothing=None if cameras is None else smoothing_variances(means, cameras),
        slopes=None if slopes is None else slopes.detach().cpu().numpy(),
    )  # fmt: skip


class Drawing:
    """Gaussians drawn for a camera. Only the last drawing of a rasteriser can be differentiated.

    Attributes:
        planes: [5, H, W] of `Rasterizer.forward`, differentiable in rows and slopes.
        v_means, contribution, spread: as `interface.Gradients` has them, after `differentiate`.
    """

    v_means: Tensor
    contribution: Tensor
    spread: Tensor

    def __init__(
        self,
        rasterizer: Rasterizer | Canvas,
        camera: Camera,
        rows: Tensor,
        slopes: Tensor | None,
        ids: I64,
        cameras: Sequence[Camera] | None,
    ) -> None:
        """See `to_gaussians`; `rows` [N, 14] are raw."""
        activated = activate(rows)
        self.rasterizer, self.camera, self.cameras = rasterizer, camera, cameras
        self.weight: Tensor | None = None
        if not isinstance(rasterizer, Canvas):
            self.gaussians = to_gaussians(activated, slopes, ids, cameras)
        self.planes: Tensor = _Rasterize.apply(*activated, slopes, self)  # type: ignore[no-untyped-call]

    def differentiate(self, loss: Tensor | F32, weight: Tensor | F32) -> None:
        """Add the gradients of a loss to all leaves that the drawing came from.

        Args:
            loss: made of the planes; or its gradient by them, [5, H, W].
            weight: [H, W] of the pixels, for `contribution` and `spread`.
        """
        self.weight = torch.as_tensor(weight)
        if isinstance(loss, Tensor):
            loss.backward()  # type: ignore[no-untyped-call]
        else:
            self.planes.backward(torch.from_numpy(loss))  # type: ignore[no-untyped-call]

    def gradients(self, loss: Tensor, weight: Tensor, leaves: Sequence[Tensor]) -> Sequence[Tensor | None]:
        """Return the gradients of a loss by `leaves`. Unlike `differentiate`, this adds them to nothing, so
        that several threads may draw at once. None: the drawing does not come from that leaf."""
        self.weight = weight
        return torch.autograd.grad(loss, leaves, allow_unused=True)


class _Rasterize(torch.autograd.Function):
    """The rasteriser, of either kind, as a torch function."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor,
        slopes: Tensor | None, drawing: Drawing,
    ) -> Tensor:  # fmt: skip
        ctx.drawing, ctx.has_slopes = drawing, slopes is not None
        rasterizer, cameras = drawing.rasterizer, drawing.cameras
        if not isinstance(rasterizer, Canvas):
            return torch.from_numpy(rasterizer.forward(drawing.gaussians, drawing.camera))
        slopes = torch.zeros_like(means) if slopes is None else slopes
        tables = dict(zip(TABLES, (means, quats, scales, opacities, colors, slopes), strict=True))
        filters = torch.zeros_like(opacities) if cameras is None else smoothing(means, cameras)
        return rasterizer.forward(tables | {"smoothing": filters}, drawing.camera)

    @staticmethod
    def backward(ctx: Any, v_planes: Tensor) -> tuple[Tensor | None, ...]:
        drawing: Drawing = ctx.drawing
        weight = torch.zeros_like(v_planes[0]) if drawing.weight is None else drawing.weight
        if isinstance(drawing.rasterizer, Canvas):
            found = drawing.rasterizer.backward(v_planes, weight)
        else:
            arrays = drawing.rasterizer.backward(v_planes.numpy(), weight.numpy())
            names = (*TABLES, "contribution", "spread")
            found = {name: torch.from_numpy(getattr(arrays, name)) for name in names}
        # Copies: the rasteriser overwrites its own in the next drawing, which may come before these are read
        drawing.v_means, drawing.contribution, drawing.spread = (
            found[name].clone() for name in ("means", "contribution", "spread")
        )
        *v_rows, v_slopes = (found[name] for name in TABLES)
        return *v_rows, v_slopes if ctx.has_slopes else None, None
