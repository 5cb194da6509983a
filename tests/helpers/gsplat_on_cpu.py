"""gsplat's CUDA stages, replaced by the pure torch versions that it brings along (`gsplat.cuda._torch_impl`),
so that `gsplat.rasterization` itself runs on the CPU.

Its torch compositing wants two things that are missing here: the kernel that lists which Gaussian touches
which pixel, and the package nerfacc. Both stand below, after gsplat's documentation and kernel sources.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from sags_node.engine import device, gsplat_backend

ALPHA_THRESHOLD, MAX_ALPHA, OPAQUE = 1 / 255, 0.999, 1e-4  # of gsplat's kernels


def use_gsplat_on_cpu(patch: pytest.MonkeyPatch) -> None:
    """Replace the stages, and what looks for a GPU, until `patch` is undone."""
    import gsplat
    from gsplat import rendering
    from gsplat.cuda import _torch_impl, _wrapper

    def isect_tiles(means2d: Tensor, radii: Tensor, depths: Tensor, *shape: int, **_: Any) -> Any:
        return _torch_impl._isect_tiles(means2d, radii, depths, *shape)

    def rasterize_to_pixels(*arguments: Any, packed: bool, absgrad: bool, backgrounds: Any) -> Any:
        assert not packed and not absgrad and backgrounds is None
        return _torch_impl._rasterize_to_pixels(*arguments)

    nerfacc = ModuleType("nerfacc")
    for function in (render_weight_from_alpha, accumulate_along_rays):
        setattr(nerfacc, function.__name__, function)
    patch.setitem(sys.modules, "nerfacc", nerfacc)
    patch.setattr(rendering, "fully_fused_projection", projection)
    patch.setattr(rendering, "isect_tiles", isect_tiles)
    patch.setattr(rendering, "isect_offset_encode", _torch_impl._isect_offset_encode)
    patch.setattr(rendering, "rasterize_to_pixels", rasterize_to_pixels)
    patch.setattr(_wrapper, "rasterize_to_indices_in_range", indices_in_range)
    patch.setattr(gsplat, "spherical_harmonics", _torch_impl._spherical_harmonics)
    patch.setattr(device, "find_gpu", lambda: device.Device("cuda", "gsplat's stages in torch"))
    patch.setattr(gsplat_backend, "gpu", lambda: torch.device("cpu"))


def projection(
    means: Tensor, covars: None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, opacities: Tensor, **options: Any,
) -> Any:  # fmt: skip
    """As gsplat's kernel does: what is not seen is left out, and has no gradient."""
    from gsplat.cuda import _torch_impl

    for name, expected in {"packed": False, "radius_clip": 0.0, "sparse_grad": False}.items():
        assert options.pop(name) == expected
    found = []
    for viewmat, K in zip(viewmats, Ks, strict=True):
        camera = (viewmat[None], K[None], width, height)

        def project(rows: Any, camera: Any = camera) -> Any:
            covariances, _ = _torch_impl._quat_scale_to_covar_preci(
                quats[rows], scales[rows], compute_preci=False
            )
            return _torch_impl._fully_fused_projection(means[rows], covariances, *camera, **options)

        with torch.no_grad():
            radii, *_, kept = project(slice(None))
        opaque = opacities * (1 if kept is None else kept[0]) >= ALPHA_THRESHOLD
        rows = torch.nonzero((radii[0] > 0).all(1) & opaque)[:, 0]
        found.append([None if part is None else _spread(part[0], rows, len(means)) for part in project(rows)])
    return [None if parts[0] is None else torch.stack(parts) for parts in zip(*found, strict=True)]


def _spread(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """[N, ...] with `values` in those rows, and 0."""
    return values.new_zeros((count, *values.shape[1:])).index_copy(0, rows, values)


@torch.no_grad()
def indices_in_range(
    start: int, end: int, transmittances: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor,
    width: int, height: int, tile_size: int, offsets: Tensor, flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """What every pixel blends, near to far: Gaussian, pixel and image ids [M]. For a single range."""
    assert start == 0 and bool((transmittances == 1).all())
    images, tile_rows, tile_columns = offsets.shape
    bounds = [*offsets.flatten().tolist(), len(flatten_ids)]
    assert max(b - a for a, b in pairwise(bounds)) <= end * tile_size**2
    found = []
    for image in range(images):
        for row in range(tile_rows):
            for column in range(tile_columns):
                tile = (image * tile_rows + row) * tile_columns + column
                ids = flatten_ids[bounds[tile] : bounds[tile + 1]].long() % means2d.shape[1]
                ys, xs = torch.meshgrid(
                    torch.arange(row * tile_size, min((row + 1) * tile_size, height)),
                    torch.arange(column * tile_size, min((column + 1) * tile_size, width)),
                    indexing="ij",
                )
                pixels = torch.stack([xs.flatten(), ys.flatten()], 1) + 0.5
                dx, dy = (pixels[:, None] - means2d[image, ids]).unbind(2)
                a, b, c = conics[image, ids].unbind(1)
                sigma = 0.5 * (a * dx**2 + c * dy**2) + b * dx * dy
                alpha = torch.clamp_max(opacities[image, ids] * torch.exp(-sigma), MAX_ALPHA)
                touched = (sigma >= 0) & (alpha >= ALPHA_THRESHOLD)
                after = torch.cumprod(torch.where(touched, 1 - alpha, 1.0), 1)
                pixel, nth = torch.nonzero(touched & (after > OPAQUE)).T
                found.append((ids[nth], (ys * width + xs).flatten()[pixel], torch.full_like(nth, image)))
    gaussians, pixels, of_images = (torch.cat(each) for each in zip(*found, strict=True))
    return gaussians, pixels, of_images


def render_weight_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """Blending weights and transmittances [M] of samples that are ordered along each ray."""
    order = torch.argsort(ray_indices, stable=True)
    counts = torch.bincount(ray_indices, minlength=n_rays)
    nth = torch.empty_like(order)
    nth[order] = torch.arange(len(order)) - (torch.cumsum(counts, 0) - counts)[ray_indices[order]]
    table = alphas.new_ones((n_rays, int(counts.max()) + 1))
    table = table.index_put((ray_indices, nth + 1), 1 - alphas)
    before = torch.cumprod(table, 1)[ray_indices, nth]
    return alphas * before, before


def accumulate_along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Sums [n_rays, D] of weights [M] times values [M, D], or of the weights."""
    weighted = weights[:, None] if values is None else weights[:, None] * values
    return weights.new_zeros((n_rays, weighted.shape[1])).index_add(0, ray_indices, weighted)
