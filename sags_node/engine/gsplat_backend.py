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
from sags_node.errors import UsageError
from sags_node.types import F32, I32, SH_DEGREE_0, Bool, Gaussians

if TYPE_CHECKING:
    from torch import Tensor

DIFFERENTIATED = ("means", "quats", "scales", "opacities", "colors", "sh_rest")  # of `types.Gaussians`
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
        # A feature of value 0 whose cotangent is the pixels' weight: its gradient is the contribution.
        leaves["statistic"] = torch.zeros_like(leaves["opacities"])[:, None].requires_grad_()
        view, K = _camera_matrices(pinhole, usable.device)
        scales, opacities = leaves["scales"], leaves["opacities"]
        if "smoothing" in tables:
            scales, opacities = _smoothed(scales, opacities, torch.where(usable, tables["smoothing"], 0.0))
        features = torch.cat([_seen_colors(leaves, view), leaves["statistic"]], 1)
        rendered, alphas = _rasterize(
            (leaves["means"], leaves["quats"], scales, opacities, features), view, K, pinhole, antialias
        )
        self._leaves = leaves
        self._all = torch.cat([rendered, alphas], 2).permute(2, 0, 1)  # r g b, statistic, z, w
        self.planes = torch.cat([self._all[:3], self._all[4:]]).detach()

    def backward(self, v_planes: Tensor, weight: Tensor) -> dict[str, Tensor]:
        """Gradients of sum(v_planes * planes), by name as in `interface.Gradients`.

        Args:
            v_planes: [5, H, W] cotangent of the planes.
            weight: [H, W] pixel weights for the contribution.
        """
        cotangent = torch.cat([v_planes[:3], weight[None], v_planes[3:]])
        found = torch.autograd.grad(
            self._all, list(self._leaves.values()), cotangent, retain_graph=True, materialize_grads=True
        )
        gradients = dict(zip(self._leaves, found, strict=True))
        return gradients | {"contribution": gradients.pop("statistic")[:, 0]}


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
        return Gradients(**{"sh_rest": np.zeros((len(found["means"]), 0, 3), np.float32)} | arrays)

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


def _smoothed(scales: Tensor, opacities: Tensor, smoothing: Tensor) -> tuple[Tensor, Tensor]:
    """After the 3D filter of Mip-Splatting, which gsplat lacks; as `reference.project` has it."""
    variance = torch.clamp(smoothing, min=0)[:, None]
    filtered = torch.sqrt(scales.square() + variance)
    filtered = torch.where(variance == 0, scales, filtered)
    kept = (scales / filtered).topk(2).values.prod(1)
    return filtered, opacities * kept
