"""Drawing on a GPU: planes and gradients of `interface.Backend` by gsplat's kernels and torch's autograd.

gsplat (V. Ye et al., JMLR 2025) is a package of its own, `pip install 'sags-node[gsplat]'`, and builds its
kernels with CUDA's compiler at its first use. What differs from our engine stands in benchmarks/gpu.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np
import torch

from sags_node.engine.device import choose_device
from sags_node.engine.interface import (
    DILATION_VARIANCE,
    MIN_QUAT_NORM,
    MIP_VARIANCE,
    NEAR_PLANE,
    Gradients,
    Pinhole,
)
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.engine.reference.rasterizer import rotations
from sags_node.errors import UsageError
from sags_node.types import F32, I32, SH_DEGREE_0, Bool, Gaussians

if TYPE_CHECKING:
    from torch import Tensor

DIFFERENTIATED = (
    "means",
    "quats",
    "scales",
    "opacities",
    "colors",
    "sh_rest",
    "slopes",
)  # of `types.Gaussians`
LARGEST = 1e12  # m: the square of as many px is finite
HARMLESS = {"quats": 1.0, "scales": 1.0}  # in rows that are not drawn; in the other tables 0


def gpu() -> torch.device:
    """The current GPU. UsageError: none can be used."""
    choose_device("cuda")
    return torch.device("cuda", torch.cuda.current_device())


def sent(gaussians: Gaussians, device: torch.device) -> dict[str, Tensor]:
    """What is drawn of Gaussians, by its name in `types.Gaussians`, copied to the device."""
    arrays = {name: getattr(gaussians, name) for name in (*DIFFERENTIATED, "smoothing")}
    return {
        name: torch.tensor(array, dtype=torch.float32, device=device)
        for name, array in arrays.items()
        if array is not None
    }


class Drawing:
    """One drawing by gsplat, to be differentiated as often as wanted unless gradients are switched off.

    Attributes:
        planes: [5, H, W] as `interface.Rasterizer.forward` has them.
    """

    def __init__(self, tables: Mapping[str, Tensor], pinhole: Pinhole, antialias: bool = True) -> None:
        """
        Args:
            tables: as `sent` gives them; may be changed afterwards.
        """
        usable = _usable(tables)
        leaves = {
            name: _leaf(tables[name], usable, HARMLESS.get(name, 0.0))  # with the opacity 0 nothing is drawn
            for name in DIFFERENTIATED
            if name in tables
        }
        # Features of value 0 whose cotangents are the pixels' weight times 1, x, y, x^2, x y, y^2: their
        # gradients are the contribution and the moments that `spread` is made of.
        leaves["statistics"] = leaves["opacities"].new_zeros((len(usable), 6)).requires_grad_()
        view, K = _camera_matrices(pinhole, usable.device)
        scales, opacities, kept = leaves["scales"], leaves["opacities"], torch.ones_like(leaves["scales"])
        if "smoothing" in tables:
            scales, kept = _smoothed(scales, torch.where(usable, tables["smoothing"], 0.0))
            opacities = opacities * kept.topk(2).values.prod(1)
        slopes = leaves["slopes"] * kept if "slopes" in leaves else torch.zeros_like(leaves["means"])
        places, covariance, gradient = _in_picture(leaves, scales, slopes, view, pinhole, antialias)
        self._places, self._covariance = places.detach(), covariance.detach()
        colors = _seen_colors(leaves, view) - (gradient * places).sum(1, keepdim=True)
        features = torch.cat([colors, gradient, leaves["statistics"]], 1)
        rendered, alphas = _rasterize(
            (leaves["means"], leaves["quats"], scales, opacities, features), view, K, pinhole, antialias
        )
        self._leaves = leaves
        summed = torch.cat([rendered, alphas], 2).permute(2, 0, 1)  # r g b, gradient 2, statistics 6, z, w
        # sum of w (c + g . (p - m)) = sum of w (c - g . m) + (sum of w g) . p at a pixel p
        y, x = self._pixels = _pixel_places(pinhole, usable.device)
        self._all = torch.cat(
            [summed[:3] + summed[3] * x + summed[4] * y, summed[5:]]
        )  # r g b, statistics 6, z, w
        self.planes = torch.cat([self._all[:3], self._all[9:]]).detach()

    def backward(self, v_planes: Tensor, weight: Tensor) -> dict[str, Tensor]:
        """Gradients of sum(v_planes * planes), by name as in `interface.Gradients`.

        Args:
            v_planes: [5, H, W] cotangent of the planes.
            weight: [H, W] pixel weights for the contribution.
        """
        y, x = self._pixels
        moments = torch.stack([weight * power for power in (1, x, y, x * x, x * y, y * y)])
        cotangent = torch.cat([v_planes[:3], moments, v_planes[3:]])
        found = torch.autograd.grad(
            self._all, list(self._leaves.values()), cotangent, retain_graph=True, materialize_grads=True
        )
        gradients = dict(zip(self._leaves, found, strict=True))
        one, by_x, by_y, xx, xy, yy = gradients.pop("statistics").unbind(1)
        mean_x, mean_y = self._places.unbind(1)
        about_mean = torch.stack(
            [
                xx - mean_x * (2 * by_x - mean_x * one),
                xy - mean_x * by_y - mean_y * by_x + mean_x * mean_y * one,
                yy - mean_y * (2 * by_y - mean_y * one),
            ],
            1,
        )
        conic = torch.linalg.inv(self._covariance)
        conic = torch.stack([conic[:, 0, 0], 2 * conic[:, 0, 1], conic[:, 1, 1]], 1)
        return gradients | {"contribution": one, "spread": (conic * about_mean).sum(1).clamp(min=0)}


class GsplatBackend:
    """Backend `gsplat`: arrays of the host in and out, copied on every call.

    All tiles are drawn; `tiles` says which of them are shown.
    """

    def __init__(self, width: int, height: int, antialias: bool) -> None:
        """UsageError: no GPU can be used."""
        self._device, self._antialias = gpu(), antialias
        self._planes = torch.zeros((5, height, width), device=self._device)

    def forward(self, gaussians: Gaussians, pinhole: Pinhole, tiles: Bool | None) -> F32:
        self._drawing = Drawing(sent(gaussians, self._device), pinhole, self._antialias)
        self._shown = torch.ones_like(self._planes[0], dtype=torch.bool)
        if tiles is not None:
            self._shown = pixels_of(torch.tensor(tiles, device=self._device), self._shown.shape)
        self._planes = torch.where(self._shown, self._drawing.planes, self._planes)
        planes: F32 = self._planes.cpu().numpy()
        return planes

    def backward(self, v_planes: F32, weight: F32) -> Gradients:
        given = (torch.tensor(array, device=self._device) for array in (v_planes, weight))
        found = self._drawing.backward(*(torch.where(self._shown, values, 0.0) for values in given))
        arrays = {name: values.cpu().numpy() for name, values in found.items()}
        count = len(found["means"])
        absent = {"sh_rest": np.zeros((count, 0, 3), np.float32), "slopes": np.zeros((count, 3), np.float32)}
        return Gradients(**absent | arrays)

    def median(self) -> tuple[F32, I32]:
        raise UsageError("gsplat gives no median depth; choose the numba or reference backend for it")


def pixels_of(tiles: Tensor, shape: tuple[int, ...]) -> Tensor:
    """The pixels [H, W] of the tiles [rows, columns] of a picture of that shape, as `focus.pixels_of`."""
    rows = tiles.repeat_interleave(TILE_HEIGHT, 0)[: shape[0]]
    return rows.repeat_interleave(TILE_WIDTH, 1)[:, : shape[1]]


def _rasterize(
    drawn: tuple[Tensor, ...], view: Tensor, K: Tensor, pinhole: Pinhole, antialias: bool
) -> tuple[Tensor, Tensor]:
    """gsplat's own call with our camera model: sums over the Gaussians of w features and w z, [H, W, F + 1],
    and of w, [H, W, 1]. `drawn`: means, quats, scales, opacities, features [N, F]."""
    import gsplat

    if len(drawn[0]) == 0:  # which gsplat does not promise to draw; sums of nothing keep the graph
        features = drawn[4]
        nothing = features.sum() + view.new_zeros((pinhole.height, pinhole.width, 1))
        return nothing.expand(-1, -1, features.shape[1] + 1), nothing
    rendered, alphas, _ = gsplat.rasterization(
        *drawn, view[None], K[None], pinhole.width, pinhole.height,
        near_plane=NEAR_PLANE,
        eps2d=MIP_VARIANCE if antialias else DILATION_VARIANCE,
        rasterize_mode="antialiased" if antialias else "classic",
        render_mode="RGB+D",
        packed=False,  # the faster one where most Gaussians are in the picture
    )  # fmt: skip
    return rendered[0], alphas[0]


def _seen_colors(leaves: Mapping[str, Tensor], view: Tensor) -> Tensor:
    """[N, 3] as the camera sees them."""
    colors, rest = leaves["colors"], leaves.get("sh_rest")
    if rest is None or rest.shape[1] == 0:
        return colors
    import gsplat

    directions = leaves["means"] - torch.linalg.inv(view)[:3, 3]
    coefficients = torch.cat([colors[:, None] / SH_DEGREE_0, rest], 1)
    seen: Tensor = gsplat.spherical_harmonics(round(sqrt(rest.shape[1] + 1)) - 1, directions, coefficients)
    return seen


def _in_picture(
    leaves: Mapping[str, Tensor],
    scales: Tensor,
    slopes: Tensor,
    view: Tensor,
    pinhole: Pinhole,
    antialias: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Where the Gaussians are in the picture, from its middle, [N, 2] px, their covariance there [N, 2, 2]
    px^2, and how their luminance changes [N, 2] 1/px: a V^T cov^-1, as `reference.project` has it."""
    R, t = view[:3, :3], view[:3, 3]
    x, y, z = (leaves["means"] @ R.T + t).unbind(1)
    z = torch.where(z > NEAR_PLANE, z, 1.0)  # what is not drawn must be finite
    scales = torch.where(scales < LARGEST, scales, 1.0)
    low_x, high_x, low_y, high_y = pinhole.limits
    fx, fy, zero = pinhole.fx / z, pinhole.fy / z, torch.zeros_like(z)
    J = torch.stack(
        [
            torch.stack([fx, zero, -fx * (x / z).clamp(low_x, high_x)], 1),
            torch.stack([zero, fy, -fy * (y / z).clamp(low_y, high_y)], 1),
        ],
        1,
    )
    V = J @ R @ rotations(leaves["quats"]) * scales[:, None, :]
    variance = MIP_VARIANCE if antialias else DILATION_VARIANCE
    covariance = V @ V.transpose(1, 2) + variance * torch.eye(2, device=V.device)
    gradient = torch.linalg.solve(covariance, V @ slopes[:, :, None])[:, :, 0]
    middle_x, middle_y = pinhole.cx - 0.5 * pinhole.width, pinhole.cy - 0.5 * pinhole.height
    return torch.stack([fx * x + middle_x, fy * y + middle_y], 1), covariance, gradient


def _pixel_places(pinhole: Pinhole, device: torch.device) -> tuple[Tensor, Tensor]:
    """y [H, 1] and x [W] px of pixel centres from the picture's middle."""
    y = torch.arange(pinhole.height, device=device) + 0.5 - 0.5 * pinhole.height
    x = torch.arange(pinhole.width, device=device) + 0.5 - 0.5 * pinhole.width
    return y[:, None], x


def _camera_matrices(pinhole: Pinhole, device: torch.device) -> tuple[Tensor, Tensor]:
    """World to camera [4, 4] and K [3, 3]. gsplat's first pixel has its centre at 0.5, like ours."""
    view, K = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
    view[:3, :3], view[:3, 3] = pinhole.R, pinhole.t
    K[0, 0], K[1, 1], K[:2, 2] = pinhole.fx, pinhole.fy, (pinhole.cx, pinhole.cy)
    return torch.from_numpy(view).to(device), torch.from_numpy(K).to(device)


def _usable(tables: Mapping[str, Tensor]) -> Tensor:
    """[N] what our engines draw: everything finite, and a direction."""
    usable: Tensor = torch.linalg.vector_norm(tables["quats"], dim=1) > MIN_QUAT_NORM
    for values in tables.values():
        usable = usable & torch.isfinite(values.flatten(1) if values.ndim > 1 else values[:, None]).all(1)
    return usable


def _leaf(values: Tensor, usable: Tensor, otherwise: float) -> Tensor:
    """A copy of `values` [N, ...] to differentiate by, with `otherwise` in the rows that are not usable."""
    rows = usable.reshape(-1, *[1] * (values.ndim - 1))
    return torch.where(rows, values, otherwise).requires_grad_()


def _smoothed(scales: Tensor, smoothing: Tensor) -> tuple[Tensor, Tensor]:
    """Scales after the 3D filter of Mip-Splatting, which gsplat lacks, and those before as a share of them,
    [N, 3] each; as `reference.project` has it."""
    variance = torch.clamp(smoothing, min=0)[:, None]
    filtered = torch.sqrt(scales.square() + variance)
    filtered = torch.where(variance == 0, scales, filtered)
    return filtered, scales / filtered
