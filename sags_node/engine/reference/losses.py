"""The readable twins of `ssim`, `smoothness` and `photometric` in torch: gradients by autograd."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # torch takes seconds to import
    from torch import Tensor


def dissimilarity(picture: Tensor, truth: Tensor, counted: Tensor) -> Tensor:
    """Sum of 1 - SSIM (Wang et al. 2004, equation 13) over the counted pixels [H, W] and the channels of
    pictures [3, H, W]. Pixels that do not count are set to the truth in both pictures."""
    import torch

    offsets = torch.arange(-5, 6, dtype=picture.dtype)
    profile = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    window = torch.outer(profile, profile) / profile.sum() ** 2
    rows, columns = (torch.tensor(np.pad(np.arange(n), 5, mode="reflect")) for n in picture.shape[1:])

    def blur(values: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(values[:, None, rows][..., columns], window[None, None])[:, 0]

    shown = torch.where(counted, picture, truth)
    x, y = blur(shown), blur(truth)
    variance_x, variance_y = blur(shown**2) - x**2, blur(truth**2) - y**2
    covariance = blur(shown * truth) - x * y
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * x * y + c1) * (2 * covariance + c2)
    similarity = similarity / ((x**2 + y**2 + c1) * (variance_x + variance_y + c2))
    return (1 - similarity)[:, counted].sum()


def total_variation(picture: Tensor, region: Tensor, known: Tensor) -> Tensor:
    """Sum of |a - b| over neighbours in `picture` [H, W], both known, at least one of them in the region."""
    across = (region[:, 1:] | region[:, :-1]) & known[:, 1:] & known[:, :-1]
    down = (region[1:] | region[:-1]) & known[1:] & known[:-1]
    return (picture[:, 1:] - picture[:, :-1])[across].abs().sum() + (picture[1:] - picture[:-1])[
        down
    ].abs().sum()


def photometric(
    planes: Tensor, image: Tensor, tissue: Tensor, depth: Tensor, unseen: Tensor, normalised: bool
) -> dict[str, Tensor]:
    """The terms of `photometric.LossTerms` by name, for sound pictures with at least one tissue pixel."""
    import torch

    coverage = planes[4]
    everywhere = torch.ones_like(tissue)
    covered = coverage > 0.05 if normalised else everywhere
    deep = coverage > 0.3 if normalised else everywhere
    divisor = coverage if normalised else torch.ones_like(coverage)
    color = planes[:3] / divisor
    drawn_depth = planes[3] / divisor
    truth = image.permute(2, 0, 1)
    used = tissue & covered
    measured = tissue & deep & (depth > 0) & (drawn_depth > 1e-3)
    drawn_inverse, given_inverse = 1 / drawn_depth[measured], 1 / depth[measured]
    pixels = tissue.numel()
    return {
        "color": (color - truth)[:, used].abs().mean(),
        "similarity": dissimilarity(color, truth, used) / (3 * used.sum()),
        "inverse_depth": (drawn_inverse - given_inverse).abs().mean(),
        "correlation": 1
        - torch.nn.functional.cosine_similarity(
            drawn_inverse - drawn_inverse.mean(), given_inverse - given_inverse.mean(), dim=0
        ),
        "smoothness": torch.stack([total_variation(plane, unseen, covered) for plane in color]).sum()
        / (3 * pixels),
        "depth_smoothness": total_variation(drawn_depth, unseen, deep) / pixels,
        "coverage": torch.clamp(0.9 - coverage[tissue], min=0).mean(),
    }
