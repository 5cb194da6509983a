"""gsplat as a second backend on a GPU: the planes and gradients of `interface.Backend` from its kernels.

gsplat (V. Ye et al., JMLR 2025) is a package of its own, `pip install 'sags-node[gsplat]'`, and builds its
kernels with CUDA's compiler at its first use. What differs from our engines stands in benchmarks/gpu.md.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from math import sqrt

import numpy as np
import torch
from torch import Tensor

from sags_node.engine.cuda.backend import DeviceBackend
from sags_node.engine.cuda.scene import DeviceGaussians, DeviceGradients
from sags_node.engine.failures import DeviceMemoryError
from sags_node.engine.interface import (
    DILATION_VARIANCE,
    MIN_QUAT_NORM,
    MIP_VARIANCE,
    NEAR_PLANE,
    Pinhole,
)
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.errors import UsageError
from sags_node.types import SH_DEGREE_0


def gsplat_backend(width: int, height: int, antialias: bool) -> DeviceBackend:
    """Backend `gsplat`. UsageError: it cannot be used here."""
    return DeviceBackend(GsplatRasterizer(width, height, antialias, usable_device()))


def usable_device() -> torch.device:
    """The current GPU, for gsplat. Builds its kernels where that was not done yet, which takes minutes.

    Raises:
        UsageError: gsplat is not installed, there is no GPU, or its kernels cannot be built.
    """
    if importlib.util.find_spec("gsplat") is None:
        raise UsageError(
            "the gsplat backend needs gsplat, which is not installed: pip install 'sags-node[gsplat]', "
            "or choose another backend"
        )
    if not torch.cuda.is_available():
        raise UsageError(
            "the gsplat backend found no GPU: this torch has no CUDA build or sees no driver (try "
            "nvidia-smi); fix that, or choose the numba backend"
        )
    try:
        with redirect_stdout(sys.stderr):  # it reports its progress; our results are alone on stdout
            from gsplat.cuda import _backend  # nothing public says whether the kernels are there
    except Exception as error:  # CUDA's compiler and the one that it calls fail in many ways
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UsageError(f"gsplat's kernels could not be built: {first}; see its installation") from error
    if _backend._C is None:
        raise UsageError(
            "gsplat is installed without kernels and found no CUDA compiler to build them; install the CUDA "
            "toolkit of torch's version (nvcc), or a wheel of gsplat for it, or choose the cuda backend"
        )
    return torch.device("cuda", torch.cuda.current_device())


class GsplatRasterizer:
    """As `CudaRasterizer`: everything stays on the device. Not for use by two threads at once."""

    def __init__(self, width: int, height: int, antialias: bool, device: torch.device) -> None:
        self._width, self._height, self._antialias = width, height, antialias
        self._planes = torch.zeros((5, height, width), device=device)
        self.device = self._planes.device
        self._drawn = False

    def draw(self, gaussians: DeviceGaussians, pinhole: Pinhole, tiles: Tensor | None = None) -> Tensor:
        """As `CudaRasterizer.draw`. All tiles are drawn; `tiles` says which of them are shown."""
        self._drawn = False
        n = len(gaussians)
        with self._memory_reported(n):
            usable = _usable(gaussians)
            self._means = _leaf(gaussians.means, usable)
            self._quats = _leaf(gaussians.quats, usable, 1.0)
            self._scales = _leaf(gaussians.scales, usable, 1.0)
            self._opacities = _leaf(gaussians.opacities, usable)  # at 0 nothing is drawn
            self._colors = _leaf(gaussians.colors, usable)
            sh_rest = gaussians.means.new_zeros((n, 0, 3)) if gaussians.sh_rest is None else gaussians.sh_rest
            self._sh_rest = _leaf(sh_rest, usable)
            # a feature of value 0 whose cotangent is the pixels' weight: its gradient is the contribution
            self._statistic = torch.zeros_like(self._opacities)[:, None].requires_grad_()
            view, K = camera_matrices(pinhole, self.device)
            scales, opacities = self._scales, self._opacities
            if gaussians.smoothing is not None:
                smoothing = torch.where(usable, gaussians.smoothing, 0.0)
                scales, opacities = _smoothed(scales, opacities, smoothing)
            features = torch.cat([self._seen_colors(view), self._statistic], 1)
            self._rendered, self._alphas = self.rasterize(
                self._means, self._quats, scales, opacities, features, view, K
            )
            red_green_blue, depth = self._rendered[..., :3], self._rendered[..., 4:]
            now = torch.cat([red_green_blue, depth, self._alphas], 2).detach().permute(2, 0, 1)
            self._shown = self._shown_pixels(tiles)
            self._planes.copy_(torch.where(self._shown, now, self._planes))
        self._drawn = True
        return self._planes

    def rasterize(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        view: Tensor,
        K: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """gsplat's own call with our camera model, differentiable: sums over the Gaussians of w features and
        w z, [H, W, F + 1], and of w, [H, W, 1].

        Args:
            means, quats, scales, opacities: as in `types.Gaussians`.
            features: [N, F].
            view, K: as `camera_matrices` gives them.
        """
        import gsplat

        if len(means) == 0:  # which gsplat does not promise to draw; sums of nothing keep the graph
            nothing = features.sum() + means.new_zeros((self._height, self._width, 1))
            return nothing.expand(-1, -1, features.shape[-1] + 1), nothing
        rendered, alphas, _ = gsplat.rasterization(
            means, quats, scales, opacities, features, view[None], K[None], self._width, self._height,
            near_plane=NEAR_PLANE,
            eps2d=MIP_VARIANCE if self._antialias else DILATION_VARIANCE,
            rasterize_mode="antialiased" if self._antialias else "classic",
            render_mode="RGB+D",
            packed=False,  # the faster one where most Gaussians are in the picture
        )  # fmt: skip
        return rendered[0], alphas[0]

    def backward_pass(self, v_planes: Tensor, weight: Tensor) -> DeviceGradients:
        """As `CudaRasterizer.backward_pass`."""
        self._check_drawn()
        n = len(self._means)
        leaves = [self._means, self._quats, self._scales, self._opacities, self._colors, self._sh_rest]
        v_planes = torch.where(self._shown, v_planes, 0.0)
        weight = torch.where(self._shown, weight, 0.0)
        v_rendered = torch.cat([v_planes[:3], weight[None], v_planes[3:4]]).permute(1, 2, 0)
        with self._memory_reported(n):
            means, quats, scales, opacities, colors, sh_rest, statistic = torch.autograd.grad(
                (self._rendered, self._alphas),
                [*leaves, self._statistic],
                (v_rendered, v_planes[4, ..., None]),
                retain_graph=True,
                materialize_grads=True,
            )
        return DeviceGradients(means, quats, scales, opacities, colors, sh_rest, statistic[:, 0])

    def median_depth(self) -> tuple[Tensor, Tensor]:
        """UsageError: gsplat has none."""
        raise UsageError("gsplat gives no median depth; choose the numba, cuda or reference backend for it")

    def _seen_colors(self, view: Tensor) -> Tensor:
        """[N, 3] as the camera sees them."""
        terms = self._sh_rest.shape[1]
        if terms == 0:
            return self._colors
        import gsplat

        directions = self._means - torch.linalg.inv(view)[:3, 3]
        coefficients = torch.cat([self._colors[:, None] / SH_DEGREE_0, self._sh_rest], 1)
        seen: Tensor = gsplat.spherical_harmonics(round(sqrt(terms + 1)) - 1, directions, coefficients)
        return seen

    def _shown_pixels(self, tiles: Tensor | None) -> Tensor:
        """[H, W]"""
        if tiles is None:
            return torch.ones((1, 1), dtype=torch.bool, device=self.device)
        pixels = tiles.to(self.device).repeat_interleave(TILE_HEIGHT, 0).repeat_interleave(TILE_WIDTH, 1)
        return pixels[: self._height, : self._width]

    def _check_drawn(self) -> None:
        if not self._drawn:
            raise UsageError("nothing was drawn, or the last drawing failed; draw first")

    @contextmanager
    def _memory_reported(self, count: int) -> Iterator[None]:
        try:
            yield
        except torch.OutOfMemoryError as error:
            raise DeviceMemoryError(
                f"the GPU has not enough free memory for gsplat to draw {count} Gaussians at "
                f"{self._width}x{self._height} px: draw fewer or smaller ones, or end what else uses the GPU"
            ) from error


def camera_matrices(pinhole: Pinhole, device: torch.device) -> tuple[Tensor, Tensor]:
    """World to camera [4, 4] and K [3, 3]. gsplat's first pixel has its centre at 0.5, like ours."""
    view, K = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
    view[:3, :3], view[:3, 3] = pinhole.R, pinhole.t
    K[0, 0], K[1, 1], K[:2, 2] = pinhole.fx, pinhole.fy, (pinhole.cx, pinhole.cy)
    return torch.from_numpy(view).to(device), torch.from_numpy(K).to(device)


def _usable(gaussians: DeviceGaussians) -> Tensor:
    """[N] what our engines draw: everything finite, and a direction."""
    values = [
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities[:, None],
        gaussians.colors,
    ]
    if gaussians.sh_rest is not None:
        values.append(gaussians.sh_rest.flatten(1))
    if gaussians.smoothing is not None:
        values.append(gaussians.smoothing[:, None])
    has_direction = torch.linalg.vector_norm(gaussians.quats, dim=1) > MIN_QUAT_NORM
    usable: Tensor = torch.isfinite(torch.cat(values, 1)).all(1) & has_direction
    return usable


def _leaf(values: Tensor, usable: Tensor, otherwise: float = 0.0) -> Tensor:
    """`values` [N, ...], something harmless in the rows that are not usable, ready to be differentiated."""
    rows = usable.reshape(-1, *[1] * (values.ndim - 1))
    return torch.where(rows, values, otherwise).requires_grad_()


def _smoothed(scales: Tensor, opacities: Tensor, smoothing: Tensor) -> tuple[Tensor, Tensor]:
    """After the 3D filter of Mip-Splatting, which gsplat lacks; as `reference.project` has it."""
    variance = torch.clamp(smoothing, min=0)[:, None]
    filtered = torch.sqrt(scales.square() + variance)
    filtered = torch.where(variance == 0, scales, filtered)
    kept = (scales / filtered).topk(2).values.prod(1)
    return filtered, opacities * kept
