"""The readable twin of the CPU kernels in torch: the same formulas in any precision, gradients by autograd.

Slow: seconds per picture. For tests, and for whoever wants to know what the kernels compute.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sags_node.engine.interface import (
    MAX_OPACITY,
    MIN_ALPHA,
    MIN_QUAT_NORM,
    MIP_VARIANCE,
    NEAR_PLANE,
    Gradients,
    Pinhole,
)
from sags_node.types import F32, Gaussians

if TYPE_CHECKING:  # torch takes seconds to import; only who draws with this backend pays
    from torch import Tensor

TILE = 64  # px; pictures are blended tile by tile to bound memory


class ReferenceRasterizer:
    """Backend `reference`, in float64."""

    def forward(self, gaussians: Gaussians, pinhole: Pinhole) -> F32:
        import torch

        arrays = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors
        self._inputs = [torch.tensor(array, dtype=torch.float64, requires_grad=True) for array in arrays]
        self._planes = render(pinhole, *self._inputs)
        return self._planes.detach().numpy().astype(np.float32)

    def backward(self, v_planes: F32, weight: F32, geometry: bool) -> Gradients:
        import torch

        cotangent = torch.tensor(v_planes, dtype=torch.float64)
        # the red plane is the sum of w * red: its gradient with the pixel weights as cotangent is the sum of
        # w * weight
        red = torch.tensor(weight, dtype=torch.float64)
        (by_red,) = torch.autograd.grad(
            self._planes[0], self._inputs[4], red, retain_graph=True, materialize_grads=True
        )
        found = torch.autograd.grad(
            self._planes, self._inputs, cotangent, retain_graph=True, materialize_grads=True
        )
        by_means, by_quats, by_scales, by_opacities, by_colors = (
            gradient.numpy().astype(np.float32) for gradient in found
        )
        kept = None if geometry else 0
        return Gradients(
            by_means[:kept],
            by_quats[:kept],
            by_scales[:kept],
            by_opacities[:kept],
            by_colors,
            contribution=by_red[:, 0].numpy().astype(np.float32),
        )


def render(
    pinhole: Pinhole, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor
) -> Tensor:
    """Planes [5, H, W]; differentiable in all five tensors (shapes as in `types.Gaussians`)."""
    import torch

    usable = torch.nonzero(_usable(means, quats, scales, opacities, colors, pinhole))[:, 0]
    mean2d, covariance, opacity, depth = project(
        means[usable], quats[usable], scales[usable], opacities[usable], pinhole
    )
    features = torch.cat([colors[usable], depth[:, None], torch.ones_like(depth)[:, None]], 1)
    near_to_far = torch.argsort(depth.detach(), stable=True)
    near_to_far = near_to_far[(opacity > MIN_ALPHA)[near_to_far]]
    mean2d, covariance, opacity, features = (
        values[near_to_far] for values in (mean2d, covariance, opacity, features)
    )
    bands = []
    for y in range(0, pinhole.height, TILE):
        bottom = min(y + TILE, pinhole.height)
        tiles = [
            _blend_tile(mean2d, covariance, opacity, features, x, y, min(x + TILE, pinhole.width), bottom)
            for x in range(0, pinhole.width, TILE)
        ]
        bands.append(torch.cat(tiles, 2))
    return torch.cat(bands, 1)


def _usable(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, pinhole: Pinhole
) -> Tensor:
    """[N] True for finite Gaussians in front of the near plane that have a direction."""
    import torch

    everything = torch.cat([means, quats, scales, opacities[:, None], colors], 1)
    z = _camera_points(means, pinhole)[:, 2]
    directed = torch.linalg.vector_norm(quats, dim=1) > MIN_QUAT_NORM
    usable: Tensor = torch.isfinite(everything).all(1) & (z > NEAR_PLANE) & directed
    return usable


def _camera_points(means: Tensor, pinhole: Pinhole) -> Tensor:
    import torch

    R, t = torch.as_tensor(pinhole.R, dtype=means.dtype), torch.as_tensor(pinhole.t, dtype=means.dtype)
    return torch.addmm(t, means, R.T)


def project(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, pinhole: Pinhole
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """mean2d [N, 2] px, filtered covariance [N, 2, 2] px^2, filtered opacity [N], depth [N] m. EWA projection
    (Zwicker et al. 2001) with the 2D Mip filter (Mip-Splatting, Yu et al. 2024)."""
    import torch

    x, y, z = _camera_points(means, pinhole).unbind(1)
    mean2d = torch.stack([pinhole.fx * x / z + pinhole.cx, pinhole.fy * y / z + pinhole.cy], 1)
    low_x, high_x, low_y, high_y = pinhole.limits
    held_x, held_y = torch.clamp(x / z, low_x, high_x), torch.clamp(y / z, low_y, high_y)
    zero = torch.zeros_like(z)
    J = torch.stack(
        [
            torch.stack([pinhole.fx / z, zero, -pinhole.fx * held_x / z], 1),
            torch.stack([zero, pinhole.fy / z, -pinhole.fy * held_y / z], 1),
        ],
        1,
    )
    V = J @ torch.as_tensor(pinhole.R, dtype=z.dtype) @ _rotations(quats) * scales[:, None, :]
    covariance = V @ V.transpose(1, 2)
    filtered = covariance + MIP_VARIANCE * torch.eye(2, dtype=z.dtype)
    det0 = torch.linalg.cross(V[:, 0], V[:, 1]).square().sum(1)  # Cauchy-Binet
    kept = torch.sqrt(det0 / torch.linalg.det(filtered))
    return mean2d, filtered, torch.clamp(opacities * kept, max=MAX_OPACITY), z


def _rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3]."""
    import torch

    w, x, y, z = torch.nn.functional.normalize(quats, dim=1, eps=0).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, 1)


def _blend_tile(
    mean2d: Tensor,
    covariance: Tensor,
    opacity: Tensor,
    features: Tensor,
    left: int,
    top: int,
    right: int,
    bottom: int,
) -> Tensor:
    """[5, rows, columns] of one tile; the splats come sorted from near to far."""
    import torch

    # the box around the ellipse on which alpha is 1/255
    reach = 2 * torch.log(opacity / MIN_ALPHA)
    box = torch.sqrt(reach[:, None] * torch.diagonal(covariance, dim1=1, dim2=2))
    corner, far_corner = mean2d.new_tensor([left, top]), mean2d.new_tensor([right, bottom])
    touching = torch.nonzero(((mean2d + box > corner) & (mean2d - box < far_corner)).all(1))[:, 0]
    rows, columns = bottom - top, right - left
    ys = torch.arange(top, bottom, dtype=mean2d.dtype) + 0.5
    xs = torch.arange(left, right, dtype=mean2d.dtype) + 0.5
    pixels = torch.stack([xs.repeat(rows), ys.repeat_interleave(columns)], 1)
    offset = pixels[:, None, :] - mean2d[touching]  # [P, S, 2]
    conic = torch.linalg.inv(covariance[touching])
    distance2 = (offset.unsqueeze(2) @ conic @ offset.unsqueeze(3))[:, :, 0, 0]
    alpha = opacity[touching] * torch.exp(-0.5 * distance2)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0.0)
    transmittance = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(alpha[:, :1]), transmittance[:, :-1]], 1)
    planes = (alpha * before) @ features[touching]
    return planes.T.reshape(5, rows, columns)


def tissue_loss(
    planes: Tensor,
    image: Tensor,
    tissue: Tensor,
    depth: Tensor,
    depth_weight: float,
    depth_scale: float,
    coverage_weight: float = 2e-3,
) -> Tensor:
    """Twin of `losses.tissue_loss`: the scalar whose gradient that kernel writes."""
    import torch

    coverage = planes[4]
    covered = tissue & (coverage > 0.05)
    color = planes[:3] / coverage
    squares = (color - image.permute(2, 0, 1)).square().sum(0)
    color_term = 0.5 * squares[covered].sum()
    measured = tissue & (coverage > 0.3) & (depth > 0)
    residual = ((planes[3] / coverage - depth) / depth_scale)[measured]
    huber = torch.where(residual.abs() <= 1, 0.5 * residual.square(), residual.abs() - 0.5)
    coverage_term = torch.clamp(0.9 - coverage[tissue], min=0).sum()
    return color_term + depth_weight * huber.sum() + coverage_weight * coverage_term
