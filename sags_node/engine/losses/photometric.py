"""The training loss of SAGS and EndoGaussian between drawn planes and a frame, with its gradient.

With coverage A, colour c and depth d of a pixel, each term is a mean over the pixels it applies to (the two
kinds of smoothness over the whole picture, so that a small region is not pulled harder than a large one):

    color             |c - image|                           tissue
    similarity        1 - SSIM(c, image)                    tissue, see `ssim`
    inverse_depth     |1/d - 1/depth|                       tissue with a depth
    correlation       1 - Pearson(1/d, 1/depth)             tissue with a depth
    smoothness        total variation of c                  where tissue was never seen
    depth_smoothness  total variation of d                  where tissue was never seen
    coverage          max(0, 0.9 - A)                       tissue

Two ways to read the planes: normalised, c = C / A and d = D / A, where a pixel with little coverage says
nothing; or plain, c = C over black and d = D, as EndoGaussian and the released SAGS do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from sags_node.engine.losses import photometric_kernels as kernels
from sags_node.engine.losses.pieces import PIECE
from sags_node.engine.losses.smoothness import add_total_variation
from sags_node.engine.losses.ssim import Dissimilarity
from sags_node.engine.losses.tissue import COVERED, DEPTH_COVERED
from sags_node.kernels.jit import aligned, read_only
from sags_node.kernels.threads import thread_count
from sags_node.types import F32, F64, U8, Bool

NO_LEAST = -1.0  # plain planes mean something everywhere
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


@dataclass(frozen=True, slots=True)
class LossTerms:
    """Values of the terms, not weighted. 0 where a term applies to no pixel; similarity and the two kinds of
    smoothness are also 0 when their weight is 0."""

    color: float
    similarity: float
    inverse_depth: float  # 1/m
    correlation: float
    smoothness: float
    depth_smoothness: float  # m
    coverage: float

    def total(self, weights: LossWeights) -> float:
        """What `PhotometricLoss` wrote the gradient of."""
        return float(sum(getattr(weights, term.name) * getattr(self, term.name) for term in fields(self)))


class PhotometricLoss:
    """The loss for pictures of one size. Keeps 86 bytes of memory per pixel. Not for two threads at once.

    Args:
        width, height: px.
        weights: of the terms.
        normalised: how planes become colour and depth; see the text of this module.
    """

    def __init__(self, width: int, height: int, weights: LossWeights, normalised: bool = True) -> None:
        pixels = width * height
        self.weights = weights
        self._normalised = normalised
        self._least = (COVERED, DEPTH_COVERED) if normalised else (np.float32(NO_LEAST), np.float32(NO_LEAST))
        self._drawn, self._v_drawn = aligned((4, height, width)), aligned((4, height, width))
        self._truth, self._depth_residual = aligned((3, height, width)), aligned((pixels,))
        self._sums = np.zeros((-(-pixels // PIECE), kernels.SUMS), np.float32)
        self._everywhere = np.ones((height, width), np.bool_)
        self._scratch = aligned((thread_count(), kernels.SCRATCH))
        self._dissimilarity = Dissimilarity(width, height)

    def evaluate(
        self,
        planes: F32,
        image: U8,
        tissue: Bool,
        depth: F32,
        v_planes: F32,
        weight: F32,
        unseen: Bool | None = None,
    ) -> LossTerms:
        """Compare planes with a frame and write the gradient of the weighted sum of all terms. NaN and
        infinity in the frame or the planes take a pixel out. Any number of threads gives the same bits.

        Args:
            planes: [5, H, W] of `Rasterizer.forward`, one camera.
            image: [H, W, 3] RGB; above, its bytes over 255.
            tissue: [H, W] True where the pixel is to be explained.
            depth: [H, W] m, 0 unknown. For a monocular network, whose inverse depth has an unknown scale and
                offset: 1 / that, and the term `correlation`.
            v_planes: [5, H, W] written: the gradient with respect to `planes`.
            weight: [H, W] written: derivative of a pixel's colour by its planes where the colour counts, else
                0; for `Rasterizer.backward`.
            unseen: [H, W] where the two kinds of smoothness apply; None: everywhere, as in the released code.
        """
        _, height, width = planes.shape
        pixels = width * height
        if len(self._scratch) != thread_count():
            self._scratch = aligned((thread_count(), kernels.SCRATCH))
        scratch = self._scratch
        drawn, truth = self._drawn.reshape(4, pixels), self._truth.reshape(3, pixels)
        kernels.compare(
            read_only(planes), read_only(image), read_only(tissue), read_only(depth),
            self._normalised, *self._least, scratch, drawn, truth, weight, self._depth_residual, self._sums,
        )  # fmt: skip
        sums = self._sums.astype(np.float64)
        residuals, used, depth_residuals, measured, lacks, tissues = (
            sums[:, : kernels.DRAWN_MEAN].sum(0).tolist()
        )
        correlation = _correlate(sums)
        similarity = self._compare_structure(weight, used)
        region = self._everywhere if unseen is None else unseen
        smoothness, depth_smoothness = self._smooth(region)
        weights = self.weights
        factors = [
            weights.color / max(3 * used, 1),
            weights.inverse_depth / max(measured, 1),
            weights.coverage / max(tissues, 1),
            weights.correlation * correlation.by_given,
            correlation.given_mean,
            weights.correlation * correlation.by_drawn,
            correlation.drawn_mean,
        ]
        kernels.backward_pass(
            read_only(planes), read_only(tissue), read_only(drawn), read_only(truth), read_only(weight),
            read_only(self._depth_residual), read_only(self._v_drawn.reshape(4, pixels)),
            self._normalised, np.array(factors, np.float32), scratch, v_planes,
        )  # fmt: skip
        return LossTerms(
            residuals / max(3 * used, 1),
            similarity,
            depth_residuals / max(measured, 1),
            correlation.loss,
            smoothness,
            depth_smoothness,
            lacks / max(tissues, 1),
        )

    def _compare_structure(self, weight: F32, used: float) -> float:
        """1 - SSIM; begins `v_drawn` with its gradient."""
        if self.weights.similarity == 0 or used == 0:
            self._v_drawn[:] = 0
            return 0.0
        total = self._dissimilarity.forward(self._drawn[:3], self._truth, weight)
        self._dissimilarity.backward(self.weights.similarity / (3 * used), self._v_drawn[:3])
        self._v_drawn[3] = 0
        return total / (3 * used)

    def _smooth(self, region: Bool) -> tuple[float, float]:
        """Total variation of colour and of depth per pixel of the picture; adds its gradient to `v_drawn`."""
        weights, pixels = self.weights, region.size
        color = depth = 0.0
        if weights.smoothness != 0:
            scale = weights.smoothness / (3 * pixels)
            for k in range(3):
                color += add_total_variation(self._drawn[k], region, scale, self._v_drawn[k])
        if weights.depth_smoothness != 0:
            scale = weights.depth_smoothness / pixels
            depth = add_total_variation(self._drawn[3], region, scale, self._v_drawn[3])
        return color / (3 * pixels), depth / pixels


@dataclass(frozen=True, slots=True)
class _Correlation:
    """1 - Pearson correlation of drawn and given inverse depths. Its derivative by a drawn one x, with the
    given one y, is -by_given (y - given_mean) + by_drawn (x - drawn_mean)."""

    loss: float
    by_given: float
    given_mean: float
    by_drawn: float
    drawn_mean: float


def _correlate(sums: F64) -> _Correlation:
    """From the statistics of the pieces (Chan et al. 1983)."""
    counts = sums[:, kernels.DEPTHS]
    total = max(counts.sum(), 1)
    drawn, given = sums[:, kernels.DRAWN_MEAN], sums[:, kernels.GIVEN_MEAN]
    drawn_mean, given_mean = float(counts @ drawn / total), float(counts @ given / total)
    drawn_off, given_off = drawn - drawn_mean, given - given_mean
    drawn_squares = sums[:, kernels.DRAWN_SQUARES].sum() + counts @ drawn_off**2
    given_squares = sums[:, kernels.GIVEN_SQUARES].sum() + counts @ given_off**2
    products = sums[:, kernels.PRODUCTS].sum() + counts @ (drawn_off * given_off)
    least = FLAT**2 * total
    if drawn_squares <= least * drawn_mean**2 or given_squares <= least * given_mean**2:
        return _Correlation(0.0, 0.0, 0.0, 0.0, 0.0)
    by_given = 1 / math.sqrt(drawn_squares * given_squares)
    value = float(products * by_given)
    return _Correlation(1 - value, by_given, given_mean, value / float(drawn_squares), drawn_mean)
