"""The readable twin of the CPU kernels in torch: the same formulas in any precision, gradients by autograd.

Slow: seconds per image. The tests compare every rasteriser with it; read it to know what kernels compute.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi, sqrt
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from sags_node.engine.interface import (
    DILATION_VARIANCE,
    FRUSTUM_MARGIN,
    MAX_OPACITY,
    MIN_ALPHA,
    MIN_QUAT_NORM,
    MIP_VARIANCE,
    NEAR_PLANE,
    Gradients,
)
from sags_node.engine.rasterizer.arguments import checked
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.types import F32, I32, Bool, Camera, Gaussians

if TYPE_CHECKING:  # torch takes seconds to import; only who draws with this backend pays
    from torch import Tensor

T = TypeVar("T", bound=np.generic)
TILE = 64  # px; images are blended tile by tile to bound memory


class ReferenceRasterizer:
    """`interface.Rasterizer` in float64, for images of any size."""

    def __init__(self, antialias: bool = True) -> None:
        self._antialias = antialias
        self._shown = np.zeros((5, 0, 0), np.float32)
        self._depths, self._rows = np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int32)

    def forward(self, gaussians: Gaussians, camera: Camera, tiles: Bool | None = None) -> F32:
        import torch

        gaussians = checked(gaussians)
        none = np.zeros((len(gaussians), 0, 3), np.float32)
        arrays = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors]
        arrays.append(np.zeros_like(gaussians.means) if gaussians.slopes is None else gaussians.slopes)
        arrays.append(none if gaussians.sh_rest is None else gaussians.sh_rest)
        smoothing = None
        if gaussians.smoothing is not None:
            smoothing = torch.tensor(gaussians.smoothing, dtype=torch.float64)
        self._inputs = [torch.tensor(array, dtype=torch.float64, requires_grad=True) for array in arrays]
        splats = self._splats = project(camera, self._inputs, smoothing, self._antialias)
        width, height = camera.width, camera.height
        self._planes = blend(splats, width, height)
        depths, rows = median(splats, width, height)
        self._drawn = _drawn_pixels(tiles, width, height)
        self._shown = _over(self._shown, self._planes, self._drawn)
        self._depths = _over(self._depths, depths, self._drawn)
        self._rows = _over(self._rows, rows, self._drawn)
        return self._shown

    def backward(self, v_planes: F32, weight: F32) -> Gradients:
        import torch

        cotangent = torch.tensor(np.where(self._drawn, v_planes, 0), dtype=torch.float64)
        found = torch.autograd.grad(
            self._planes, self._inputs, cotangent, retain_graph=True, materialize_grads=True
        )
        counted = torch.tensor(np.where(self._drawn, weight, 0), dtype=torch.float64)
        sums = contributions(self._splats, counted, len(self._inputs[0]))
        return Gradients(*(gradient.numpy().astype(np.float32) for gradient in (*found, *sums)))

    def median(self) -> tuple[F32, I32]:
        return self._depths, self._rows


def _drawn_pixels(tiles: Bool | None, width: int, height: int) -> Bool:
    """Which pixels [H, W] are drawn."""
    if tiles is None:
        return np.ones((height, width), bool)
    return tiles.repeat(TILE_HEIGHT, 0).repeat(TILE_WIDTH, 1)[:height, :width]


def _over(before: NDArray[T], now: Tensor, drawn: Bool) -> NDArray[T]:
    """`now` where it was drawn; elsewhere `before`, or 0 where that had another shape."""
    if before.shape != tuple(now.shape):
        before = np.zeros(now.shape, before.dtype)
    return np.where(drawn, now.detach().numpy().astype(before.dtype), before)


@dataclass(frozen=True, slots=True)
class Splats:
    """S projected Gaussians from near to far."""

    mean2d: Tensor  # [S, 2] px
    covariance: Tensor  # [S, 2, 2] px^2, after the 2D Mip filter
    opacity: Tensor  # [S] after the filters, above 1/255
    features: Tensor  # [S, 5] r, g, b, z (m), 1
    gradient: Tensor  # [S, 2] of the luminance in the image, 1/px
    rows: Tensor  # [S] which Gaussian this is


def project(
    camera: Camera, inputs: Sequence[Tensor], smoothing: Tensor | None = None, antialias: bool = True
) -> Splats:
    """Project Gaussians by EWA (Zwicker et al. 2001) with both filters of Mip-Splatting (Yu et al. 2024).

    Args:
        camera: OpenCV's; here the first pixel has its centre at (0.5, 0.5).
        inputs: means, quats, scales, opacities, colors, slopes and, where there are any, sh_rest; shapes as
            in `types.Gaussians`.
        smoothing: [N] as in `types.Gaussians`.
        antialias: False puts the dilation of 3D Gaussian Splatting in the place of the 2D filter.
    """
    import torch

    means, quats, scales, opacities, colors, slopes, *harmonics = inputs
    R = torch.tensor(camera.T_world_cam[:3, :3].T.copy(), dtype=means.dtype)
    t = -R @ torch.tensor(camera.T_world_cam[:3, 3], dtype=means.dtype)
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    cx, cy = cx + 0.5, cy + 0.5
    if smoothing is not None:
        variance = torch.clamp(smoothing, min=0)[:, None]
        ratio = torch.where(variance == 0, 1, scales / torch.sqrt(scales.square() + variance))
        scales, opacities = torch.sqrt(scales.square() + variance), opacities * ratio.topk(2).values.prod(1)
        slopes = slopes * ratio
    for sh_rest in harmonics:
        colors = colors + _view_dependent(means + R.T @ t, sh_rest)
    everything = torch.cat([means, quats, scales, opacities[:, None], colors, slopes], 1)
    usable = torch.isfinite(everything).all(1) & (torch.addmm(t, means, R.T)[:, 2] > NEAR_PLANE)
    usable &= torch.linalg.vector_norm(quats, dim=1) > MIN_QUAT_NORM
    rows = torch.nonzero(usable)[:, 0]

    x, y, z = torch.addmm(t, means[rows], R.T).unbind(1)
    mean2d = torch.stack([fx * x / z + cx, fy * y / z + cy], 1)
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * camera.width / fx, FRUSTUM_MARGIN * 0.5 * camera.height / fy
    held_x = torch.clamp(x / z, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    held_y = torch.clamp(y / z, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    J = torch.stack(
        [torch.stack([fx / z, zero, -fx * held_x / z], 1), torch.stack([zero, fy / z, -fy * held_y / z], 1)],
        1,
    )
    V = J @ R @ rotations(quats[rows]) * scales[rows, None, :]
    screen_variance = MIP_VARIANCE if antialias else DILATION_VARIANCE
    covariance = V @ V.transpose(1, 2) + screen_variance * torch.eye(2, dtype=z.dtype)
    det0 = torch.linalg.cross(V[:, 0], V[:, 1]).square().sum(1)  # Cauchy-Binet
    kept = torch.sqrt(det0 / torch.linalg.det(covariance)) if antialias else torch.ones_like(det0)
    opacity = torch.clamp(opacities[rows] * kept, max=MAX_OPACITY)
    features = torch.cat([colors[rows], z[:, None], torch.ones_like(z)[:, None]], 1)

    # a V^T Sigma2D^-1: the expectation of the luminance along a pixel's ray is linear in the pixel
    gradient = torch.linalg.solve(covariance, (V @ slopes[rows, :, None]))[:, :, 0]

    order = torch.argsort(z.detach(), stable=True)
    order = order[(opacity > MIN_ALPHA)[order]]
    return Splats(
        mean2d[order], covariance[order], opacity[order], features[order], gradient[order], rows[order]
    )


def _view_dependent(offsets: Tensor, sh_rest: Tensor) -> Tensor:
    """Colours [N, 3] of spherical harmonics [N, K - 1, 3] seen along offsets [N, 3] from the camera, as in
    3D Gaussian Splatting (Kerbl et al. 2023)."""
    import torch

    x, y, z = torch.nn.functional.normalize(offsets, dim=1, eps=0).unbind(1)
    basis = [-y, z, -x]
    basis = [sqrt(3 / (4 * pi)) * term for term in basis]
    second = [2 * x * y, -2 * y * z, (3 * z * z - 1) / sqrt(3), -2 * x * z, x * x - y * y]
    basis += [sqrt(15 / (16 * pi)) * term for term in second]
    third = [
        -y * (3 * x * x - y * y) * sqrt(5 / 2),
        x * y * z * sqrt(60),
        -y * (5 * z * z - 1) * sqrt(3 / 2),
        z * (5 * z * z - 3),
        -x * (5 * z * z - 1) * sqrt(3 / 2),
        z * (x * x - y * y) * sqrt(15),
        -x * (x * x - 3 * y * y) * sqrt(5 / 2),
    ]
    basis += [sqrt(7 / (16 * pi)) * term for term in third]
    return torch.einsum("nk,nkc->nc", torch.stack(basis, 1)[:, : sh_rest.shape[1]], sh_rest)


def rotations(quats: Tensor) -> Tensor:
    """Return the rotation matrices [N, 3, 3] of quaternions [N, 4]."""
    import torch

    w, x, y, z = torch.nn.functional.normalize(quats, dim=1, eps=0).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, 1)


def blend(splats: Splats, width: int, height: int) -> Tensor:
    """Blend splats into planes [5, H, W]."""
    import torch

    def tile(left: int, top: int, right: int, bottom: int) -> Tensor:
        alpha, before, touching, offset = alphas(splats, left, top, right, bottom)
        brighter = torch.einsum("psk,sk->ps", offset, splats.gradient[touching])
        features = splats.features[touching] + torch.stack(
            [brighter] * 3 + [torch.zeros_like(brighter)] * 2, 2
        )
        weight = alpha * before
        return torch.einsum("ps,psk->kp", weight, features).reshape(5, bottom - top, right - left)

    return _tile_by_tile(tile, width, height)


def median(splats: Splats, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Return the depth (m) and row, [H, W] each, of the first Gaussian behind which no more than half of the
    light is left; 0 and -1 where there is none."""
    import torch

    def tile(left: int, top: int, right: int, bottom: int) -> Tensor:
        alpha, before, touching, _ = alphas(splats, left, top, right, bottom)
        dim = before * (1 - alpha) <= 0.5
        nobody = dim.new_ones(len(dim), 1)
        first = torch.cat([dim, nobody], 1).int().argmax(1)
        depth = torch.cat([splats.features[touching, 3], alpha.new_zeros(1)])
        row = torch.cat([splats.rows[touching], splats.rows.new_full((1,), -1)])
        return torch.stack([depth[first], row[first]]).reshape(2, bottom - top, right - left)

    with torch.no_grad():
        depths, rows = _tile_by_tile(tile, width, height)
    return depths, rows


def _tile_by_tile(tile: Callable[[int, int, int, int], Tensor], width: int, height: int) -> Tensor:
    """Puts together what `tile(left, top, right, bottom)` gives, [..., rows, columns] each."""
    import torch

    bands = []
    for top in range(0, height, TILE):
        bottom = min(top + TILE, height)
        tiles = [tile(left, top, min(left + TILE, width), bottom) for left in range(0, width, TILE)]
        bands.append(torch.cat(tiles, 2))
    return torch.cat(bands, 1)


def alphas(
    splats: Splats, left: int, top: int, right: int, bottom: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return, for one tile with P pixels, alpha [P, S'], the transmittance before each splat [P, S'], which
    splats these are [S'], and the offsets of the pixels from them [P, S', 2] px."""
    import torch

    # the box around the ellipse on which alpha is 1/255
    mean2d = splats.mean2d
    reach = 2 * torch.log(splats.opacity / MIN_ALPHA)
    box = torch.sqrt(reach[:, None] * torch.diagonal(splats.covariance, dim1=1, dim2=2))
    corner, far_corner = mean2d.new_tensor([left, top]), mean2d.new_tensor([right, bottom])
    touching = torch.nonzero(((mean2d + box > corner) & (mean2d - box < far_corner)).all(1))[:, 0]
    ys = torch.arange(top, bottom, dtype=mean2d.dtype) + 0.5
    xs = torch.arange(left, right, dtype=mean2d.dtype) + 0.5
    pixels = torch.stack([xs.repeat(bottom - top), ys.repeat_interleave(right - left)], 1)
    offset = pixels[:, None, :] - mean2d[touching]  # [P, S', 2]
    conic = torch.linalg.inv(splats.covariance[touching])
    distance2 = (offset.unsqueeze(2) @ conic @ offset.unsqueeze(3))[:, :, 0, 0]
    alpha = splats.opacity[touching] * torch.exp(-0.5 * distance2)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0.0)
    transmittance = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(alpha[:, :1]), transmittance[:, :-1]], 1)
    return alpha, before, touching, offset


def contributions(splats: Splats, weight: Tensor, count: int) -> Tensor:
    """Return the sums over pixels of (blending weight of a Gaussian) * (weight of the pixel [H, W]), and of
    that times the squared distance in standard deviations, [2, count]."""
    import torch

    height, width = weight.shape
    sums = weight.new_zeros(2, count)

    def tile(left: int, top: int, right: int, bottom: int) -> Tensor:
        alpha, before, touching, offset = alphas(splats, left, top, right, bottom)
        seen = weight[top:bottom, left:right]
        counted = alpha * before * seen.reshape(-1, 1)
        conic = torch.linalg.inv(splats.covariance[touching])
        apart = torch.einsum("psi,sij,psj->ps", offset, conic, offset)
        sums[0].index_add_(0, splats.rows[touching], counted.sum(0))
        sums[1].index_add_(0, splats.rows[touching], (counted * apart).sum(0))
        return seen[None]

    with torch.no_grad():
        _tile_by_tile(tile, width, height)
    return sums


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
