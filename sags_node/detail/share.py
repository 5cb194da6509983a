"""How far to trust what is carried: learnt from how well it did in the frames before.

For each tile of a source's image, least squares give the share of the second guess in the mix of both that
comes closest to the truth. Where highlights jump, or the motion is wrong, it is small.
"""

import numpy as np

from sags_node.detail.seen import SeenFrame
from sags_node.types import F32, F64, U8, Bool

TILES = 16  # along the longer side of an image
REMEMBERED = 0.8  # part of the sums that is kept from one lesson to the next
BELIEVED = 1e-3  # squared colours 0..1 that both sums begin with: the share begins at 1


class Share:
    """The share of a second guess in the mix of two. One thread learns; any may ask."""

    def __init__(self) -> None:
        self._sums: F64 | None = None  # [2, rows, columns]: lacking times difference, difference squared

    def learn(self, first: U8, second: U8, truth: U8, where: Bool) -> None:
        """Learn from one image how far to trust the second guess of it.

        Args:
            first, second: [h, w, 3] the two guesses.
            truth: [h, w, 3] the image that was then seen.
            where: [h, w] which pixels count.
        """
        height, width = where.shape
        step = max(1, max(height, width) // TILES)
        rows, columns = -(-height // step), -(-width // step)
        base = first.astype(np.float32)
        differs = (second.astype(np.float32) - base) * where[..., None]
        lacks = truth.astype(np.float32) - base
        found = np.stack([(lacks * differs).sum(-1), (differs * differs).sum(-1)]) / np.float32(255**2)
        found = np.pad(found, ((0, 0), (0, rows * step - height), (0, columns * step - width)))
        tiles: F64 = found.reshape(2, rows, step, columns, step).sum((2, 4), dtype=np.float64)
        if self._sums is None or self._sums.shape != tiles.shape:
            self._sums = np.full(tiles.shape, BELIEVED)
        self._sums = REMEMBERED * self._sums + tiles

    def tiles(self) -> F32:
        """Return the learnt share 0..1 of each tile [rows, columns]; before the first lesson [1, 1] of 1."""
        if self._sums is None:
            return np.ones((1, 1), np.float32)
        lacking, squared = self._sums
        return np.asarray(np.clip(lacking / squared, 0, 1), np.float32)

    def of_gaussians(self, source: SeenFrame) -> F32:
        """Return the share [N] of each Gaussian of a frame: that of the tile of the image where it lies."""
        tiles = self.tiles()
        factors = tiles.shape[1] / source.camera.width, tiles.shape[0] / source.camera.height
        places = np.clip(
            (np.nan_to_num(source.pixels) + 0.5) * factors, 0, (tiles.shape[1] - 1, tiles.shape[0] - 1)
        )
        columns, rows = places.astype(np.intp).T
        return np.asarray(tiles[rows, columns])
