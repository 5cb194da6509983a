"""The training loss of SAGS and EndoGaussian between drawn planes and a frame.

    L = lambda_1 L_colour + lambda_2 L_depth + lambda_3 TV(colour) + lambda_4 TV(depth)

With coverage A, colour c = C / A and depth d = D / A of a pixel, each term is a mean over the pixels it
applies to (the two kinds of smoothness over the whole image, so that a small region is not pulled harder
than a large one):

    color             |c - image|, or softer                tissue                         lambda_1
    inverse_depth     |1/d - 1/depth|                       tissue with a depth            lambda_2
    smoothness        total variation of c                  where tissue was never seen    lambda_3
    depth_smoothness  total variation of d                  where tissue was never seen    lambda_4

Beyond the paper's four, with a weight of 0 unless it is set:

    correlation       1 - Pearson(1/d, 1/depth)             tissue with a depth; monocular
    similarity        1 - SSIM(c, image)                    tissue
    coverage          max(0, 0.9 - A)                       tissue
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sags_node.field import twins
from sags_node.field.loss_kernel import COVERED, DEPTH_COVERED, FULL, NEAREST, TERMS, compare_by_kernels
from sags_node.types import F32, U8, Bool

FLAT = 1e-6  # inverse depths whose relative spread is below this have no correlation


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Weights of the terms. The defaults are those of EndoGaussian and the released SAGS for stereo, whose
    depths are in mm. For monocular depth they take correlation 1e-3 and inverse_depth 0; gsplat's surgical
    trainer takes color 0.8 and similarity 0.2."""

    color: float = 1.0
    similarity: float = 0.0
    inverse_depth: float = 1e-3  # per 1/m: 1 per 1/mm
    correlation: float = 0.0
    smoothness: float = 0.03
    depth_smoothness: float = 30.0  # per m: 0.03 per mm
    coverage: float = 0.0  # not in the paper; a pixel without coverage cannot learn from normalised planes


class Compared(NamedTuple):
    """Planes against a frame."""

    loss: Tensor  # the weighted sum of all terms, differentiable in the planes
    terms: dict[str, Tensor]  # by the names of `LossWeights`, not weighted; those that apply
    weight: Tensor  # [H, W] derivative of a pixel's colour by its planes where the colour counts, else 0


def compare(
    planes: Tensor,
    image: U8 | Tensor,
    tissue: Bool | Tensor,
    depth: F32 | Tensor,
    unseen: Bool | Tensor,
    weights: LossWeights,
    softness: float = 0,
) -> Compared:
    """The loss, differentiable in the planes. NaN and infinity in frame or planes take a pixel out.

    What is not on the planes' device is copied there.

    Args:
        planes: [5, H, W] of `Rasterizer.forward`.
        image: [H, W, 3] RGB, bytes; the loss compares colours with them over 255.
        tissue: [H, W] True where the pixel is to be explained.
        depth: [H, W] m, 0 unknown. For a monocular network, whose inverse depth has an unknown scale and
            offset: 1 / that, and the term `correlation`.
        unseen: [H, W] where the two kinds of smoothness apply.
        weights: of the terms.
        softness: s of sqrt(d^2 + s^2) - s, the loss of a difference d of colours (Charbonnier et al. 1994).
            Well below s it follows d^2, as PSNR does. 0, as in the paper: |d|.
    """
    if twins.by_kernels(planes) and not (weights.correlation or weights.similarity):
        return _by_kernels(planes, image, tissue, depth, unseen, weights, softness)
    device = planes.device
    explained, given = torch.as_tensor(tissue, device=device), torch.as_tensor(depth, device=device)
    given, truth = given.to(planes.dtype), torch.as_tensor(image, device=device)
    truth = truth.to(planes.dtype).permute(2, 0, 1) / 255
    sound = planes.detach().sum(0).isfinite()
    planes = torch.where(sound, planes, 0)
    coverage = planes[4]
    covered, deep = coverage > COVERED, coverage > DEPTH_COVERED
    drawn = planes[:4] * (1 / torch.where(covered, coverage, 1))  # one division, not four and their gradients
    color, distance = drawn[:3], drawn[3]
    used = explained & covered
    count = used.sum().clamp(min=1)
    terms = {"color": (_charbonnier(color - truth, softness) * used).sum() / (3 * count)}
    measured = explained & deep & given.isfinite() & (given > 0) & (distance > NEAREST)
    if weights.inverse_depth or weights.correlation:
        inverse_drawn, inverse_given = (1 / torch.where(measured, each, 1) for each in (distance, given))
        apart = (inverse_drawn - inverse_given).abs()  # 0 where nothing was measured
        terms["inverse_depth"] = apart.sum() / measured.sum().clamp(min=1)
        if weights.correlation:
            terms["correlation"] = 1 - correlation(inverse_drawn[measured], inverse_given[measured])
    if weights.similarity:
        terms["similarity"] = dissimilarity(color, truth, used) / (3 * count)
    if isinstance(unseen, Tensor) or unseen.any():  # testing a tensor would wait for the device
        region = torch.as_tensor(unseen, device=device)
        terms["smoothness"] = total_variation(color, region, covered) / (3 * region.numel())
        terms["depth_smoothness"] = total_variation(distance[None], region, deep) / region.numel()
    if weights.coverage:
        lack = (FULL - coverage).clamp(min=0) * (explained & sound)
        terms["coverage"] = lack.sum() / explained.sum().clamp(min=1)
    loss = torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum()
    return Compared(loss, terms, torch.where(used, 1 / coverage.detach(), 0).float())


def _by_kernels(
    planes: Tensor, image: U8 | Tensor, tissue: Bool | Tensor, depth: F32 | Tensor, unseen: Bool | Tensor,
    weights: LossWeights, softness: float,
) -> Compared:  # fmt: skip
    image, tissue, depth, unseen = (np.asarray(each) for each in (image, tissue, depth, unseen))
    by_term = np.array([getattr(weights, name) for name in TERMS])
    terms, v_planes, weight = compare_by_kernels(
        planes.detach().numpy(), image, tissue, depth, unseen, by_term, softness
    )
    total, gradient = planes.new_tensor(by_term @ terms), torch.from_numpy(v_planes)
    loss: Tensor = _Known.apply(planes, total, gradient)  # type: ignore[no-untyped-call]
    return Compared(loss, dict(zip(TERMS, planes.new_tensor(terms), strict=True)), torch.from_numpy(weight))


class _Known(torch.autograd.Function):
    """A function of the planes whose value and gradient are known already."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
        ctx.gradient = gradient
        return value

    @staticmethod
    def backward(ctx: Any, v_value: Tensor) -> tuple[Tensor, None, None]:
        return v_value * ctx.gradient, None, None


def _charbonnier(difference: Tensor, softness: float) -> Tensor:
    return (difference**2 + softness**2).sqrt() - softness if softness else difference.abs()


def correlation(drawn: Tensor, given: Tensor) -> Tensor:
    """The Pearson correlation; 1 if either is flat, so that there is nothing to learn."""
    a, b = drawn - drawn.mean(), given - given.mean()
    least = FLAT * len(drawn) ** 0.5
    if not (a.norm() > least * drawn.mean().abs() and b.norm() > least * given.mean().abs()):
        return drawn.new_ones(())
    pearson: Tensor = (a @ b) / (a.norm() * b.norm())
    return pearson


def total_variation(picture: Tensor, region: Tensor, known: Tensor) -> Tensor:
    """The sum of |a - b| over neighbours in `picture` [K, H, W], both known, at least one in the region."""
    across = (region[:, 1:] | region[:, :-1]) & known[:, 1:] & known[:, :-1]
    down = (region[1:] | region[:-1]) & known[1:] & known[:-1]
    rows = ((picture[:, :, 1:] - picture[:, :, :-1]).abs() * across).sum()
    return rows + ((picture[:, 1:] - picture[:, :-1]).abs() * down).sum()


def dissimilarity(picture: Tensor, truth: Tensor, counted: Tensor) -> Tensor:
    """The sum of 1 - SSIM (Wang et al. 2004, equation 13) over the counted pixels [H, W] and the channels
    of images [3, H, W]. Pixels that do not count are set to the truth in both images."""
    offsets = torch.arange(-5, 6, dtype=picture.dtype, device=picture.device)
    profile = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    window = torch.outer(profile, profile) / profile.sum() ** 2
    rows, columns = (
        torch.tensor(np.pad(np.arange(n), 5, mode="reflect"), device=picture.device)
        for n in picture.shape[1:]
    )

    def blur(values: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(values[:, None, rows][..., columns], window[None, None])[:, 0]

    shown = torch.where(counted, picture, truth)
    x, y = blur(shown), blur(truth)
    variance_x, variance_y = blur(shown**2) - x**2, blur(truth**2) - y**2
    covariance = blur(shown * truth) - x * y
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * x * y + c1) * (2 * covariance + c2)
    similarity = similarity / ((x**2 + y**2 + c1) * (variance_x + variance_y + c2))
    return torch.where(counted, 1 - similarity, 0).sum()
