"""How much a view flickers where nothing moves: standard deviations in time, beside those of the input."""

import cv2
import numpy as np

from sags_node.mapping.right_eye import right_eye_mask
from sags_node.tools.evaluation.run import MappedFrame
from sags_node.types import F32, U8, Bool

FRAMES = 30  # in a row
BLOCK = 8  # px: camera noise of 4 grey levels has half a level left in the mean of a block
STILL = 1.0  # grey level: standard deviation in time of a block's mean, up to which nothing moves there
LEAST = 0.2  # share of the image: with less still tissue the scene moves, and what seems still is plain


class Flicker:
    """Takes frames in turn; gives figures after every thirtieth.

    A pixel counts where the input stands still around it, and where all of the frames show tissue there.
    """

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._frames = 0
        self._pictures: dict[str, _Spread] = {}
        self._depths: dict[str, _Spread] = {}
        self._blocks = _Spread()
        self._tissue: Bool | None = None

    def __call__(self, picture: U8, shown: MappedFrame) -> dict[str, float] | None:
        """Take in the next frame.

        Args:
            picture: [H, W, 3] the input of the left eye.
            shown: what the run made of it.

        Returns:
            After thirty frames: `input`, `picture` and, where it was shown, `right` (where it shows the same
            tissue for certain): root mean square over pixels, in grey levels; `depth_mm` of the drawn and
            `measured_depth_mm` of the stereo stage's depth: medians over the pixels that have it in all
            frames; `share`: of the tissue that is still. None before, and where hardly anything is still.
        """
        height, width = picture.shape[:2]
        size = max(1, width // BLOCK), max(1, height // BLOCK)
        self._blocks.add(cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA))
        pictures = {"input": picture, "picture": shown.rgb}
        if shown.right_rgb is not None:
            pictures["right"] = shown.right_rgb
        for name, values in pictures.items():
            self._pictures.setdefault(name, _Spread()).add(values.astype(np.float32))
        for name, depth in (("depth_mm", shown.depth), ("measured_depth_mm", shown.measured_depth)):
            self._depths.setdefault(name, _Spread()).add(np.where(depth > 0, depth * 1e3, np.float32(np.nan)))
        self._tissue = shown.tissue if self._tissue is None else self._tissue & shown.tissue
        self._frames += 1
        if self._frames < FRAMES:
            return None
        figures = self._figures(self._tissue, shown)
        self._begin()
        return figures

    def _figures(self, tissue: Bool, shown: MappedFrame) -> dict[str, float] | None:
        still = (self._blocks.deviation() <= STILL).all(-1).astype(np.uint8)
        where = tissue & (cv2.resize(still, tissue.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0)
        if where.mean() < LEAST:
            return None
        depths, focal_px = shown.depth[where & (shown.depth > 0)], float(shown.snapshot.camera.K[0, 0])
        masks = {"right": right_eye_mask(where, depths, focal_px, shown.baseline)}
        figures = {
            name: float(np.sqrt(np.mean(np.square(spread.deviation()[mask]))))
            for name, spread in self._pictures.items()
            if (mask := masks.get(name, where)).any()
        }
        for name, spread in self._depths.items():
            deviation = spread.deviation()[where]
            known = deviation[np.isfinite(deviation)]
            if known.size:
                figures[name] = float(np.median(known))
        return {**figures, "share": float(where.sum() / tissue.sum())}


class _Spread:
    """The standard deviation in time of each value of an array; NaN where one was NaN."""

    def __init__(self) -> None:
        self._count = 0

    def add(self, values: F32) -> None:
        if self._count == 0:  # differences from the first are small: float32 is enough
            self._first = values
            self._sum, self._squares = np.zeros_like(values), np.zeros_like(values)
        difference = values - self._first
        self._sum += difference
        self._squares += difference * difference
        self._count += 1

    def deviation(self) -> F32:
        """The standard deviation of the values so far (divided by N, not by N - 1)."""
        mean = self._sum / np.float32(self._count)
        found: F32 = np.sqrt(np.maximum(self._squares / np.float32(self._count) - mean * mean, 0))
        return found
