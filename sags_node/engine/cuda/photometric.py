"""The training loss of SAGS and EndoGaussian on the device; `engine.losses.photometric` states its terms.

From planes to their cotangent nothing is read back to the host: sums become factors in a kernel of their own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton

from sags_node.engine.cuda import photometric_kernels as kernels
from sags_node.engine.cuda.photometric_kernels import BLOCK, PROGRAMS
from sags_node.engine.cuda.ssim import Dissimilarity
from sags_node.engine.losses.photometric import NO_LEAST, LossTerms, LossWeights
from sags_node.engine.losses.tissue import COVERED, DEPTH_COVERED

if TYPE_CHECKING:
    from torch import Tensor


class PhotometricLoss:
    """The loss for pictures of one size on one device. Keeps 128 bytes of memory per pixel.

    Args:
        width, height: px.
        weights: of the terms.
        device: where all tensors lie.
        normalised: how planes become colour and depth; see `engine.losses.photometric`.
    """

    def __init__(
        self,
        width: int,
        height: int,
        weights: LossWeights,
        device: torch.device,
        normalised: bool = True,
    ) -> None:
        self.weights = weights
        self._normalised = normalised
        self._least = (float(COVERED), float(DEPTH_COVERED)) if normalised else (NO_LEAST, NO_LEAST)
        self._size = height, width
        self._pixels = height * width
        self._programs = triton.cdiv(self._pixels, BLOCK)

        def room(*shape: int) -> Tensor:
            return torch.empty(shape, dtype=torch.float32, device=device)

        self._drawn, self._truth = room(4, height, width), room(3, height, width)
        self._v_similar, self._depth_residual = room(3, height, width), room(height, width)
        self._sums = room(self._programs, kernels.SUMS.value)
        self._variations = room(self._programs, 2)
        self._factors = room(kernels.FACTORS)
        self._terms = torch.zeros(kernels.TERMS, dtype=torch.float64, device=device)
        self._dissimilarity = Dissimilarity(width, height, device)
        self._dissimilar = torch.zeros((), dtype=torch.float64, device=device)

    def evaluate(
        self,
        planes: Tensor,
        image: Tensor,
        tissue: Tensor,
        depth: Tensor,
        v_planes: Tensor,
        weight: Tensor,
        unseen: Tensor | None = None,
    ) -> None:
        """Compare planes with a frame and write the gradient of the weighted sum of all terms; `terms` then
        says their values. NaN and infinity in the frame or the planes take a pixel out. The same bits every
        time. All tensors lie contiguous on the loss's device.

        Args:
            planes: [5, H, W] of the rasteriser, one camera.
            image: [H, W, 3] RGB 0..1.
            tissue: [H, W] bool, True where the pixel is to be explained.
            depth: [H, W] m, 0 unknown.
            v_planes: [5, H, W] written: the gradient with respect to `planes`.
            weight: [H, W] written: derivative of a pixel's colour by its planes where the colour counts,
                else 0.
            unseen: [H, W] bool, where the two kinds of smoothness apply; None: everywhere.
        """
        weights = self.weights
        similar = weights.similarity != 0
        kernels.compare[(self._programs,)](
            planes, image, tissue, depth, self._drawn, self._truth, weight, self._depth_residual, self._sums,
            self._pixels, *self._least, NORMALISED=self._normalised, BLOCK=BLOCK,
        )  # fmt: skip
        kernels.combine[(1,)](
            self._sums, self._factors, self._terms, self._programs,
            weights.color, weights.similarity, weights.inverse_depth, weights.correlation, weights.coverage,
            PROGRAMS=PROGRAMS,
        )  # fmt: skip
        if similar:
            self._dissimilar = self._dissimilarity.forward(self._drawn[:3], self._truth, weight)
            self._dissimilarity.backward(self._factors[kernels.BY_SIMILARITY.value], self._v_similar)
        kernels.backward_pass[(self._programs,)](
            planes, tissue, tissue if unseen is None else unseen, self._drawn, self._truth, weight,
            self._depth_residual, self._v_similar, self._factors, v_planes, self._variations, *self._size,
            weights.smoothness / (3 * self._pixels), weights.depth_smoothness / self._pixels,
            NORMALISED=self._normalised, SIMILAR=similar, EVERYWHERE=unseen is None, BLOCK=BLOCK,
        )  # fmt: skip

    @property
    def color(self) -> Tensor:
        """The colour term of the last `evaluate`, [] float64 on the device; the next overwrites it."""
        return self._terms[kernels.COLOR.value]

    def terms(self) -> LossTerms:
        """Values of the last `evaluate`. Waits for the device."""
        color, inverse_depth, correlation, coverage, colors = self._terms.tolist()
        variation, depth_variation = self._variations.sum(dim=0, dtype=torch.float64).tolist()
        weights = self.weights
        return LossTerms(
            color=color,
            similarity=self._dissimilar.item() / colors,
            inverse_depth=inverse_depth,
            correlation=correlation,
            smoothness=variation / (3 * self._pixels) if weights.smoothness != 0 else 0.0,
            depth_smoothness=depth_variation / self._pixels if weights.depth_smoothness != 0 else 0.0,
            coverage=coverage,
        )
