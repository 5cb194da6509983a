"""Eight bits of picture files that have more, or hold floating numbers."""

import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sags_node.config.schema import Levels
from sags_node.errors import SagsError
from sags_node.types import U8

log = logging.getLogger(__name__)

WHITES = (255, 1023, 4095, 16383, 65535)  # the brightest values of 8, 10, 12, 14 and 16 bit


class EightBits:
    """Makes pictures [H, W, 3] of one type eight bit.

    Files do not say which value is white. It is the brightest one of the fewest bits that hold all of `some`
    pictures, or 1 of floating numbers. With `levels` it is the brightest value of the type, but of floating
    numbers.
    """

    def __init__(self, some: Iterable[NDArray[Any]], levels: Levels | None = None) -> None:
        brightest = 0.0
        self.dtype: np.dtype[Any] = np.dtype(np.uint8)
        for picture in some:
            brightest, self.dtype = max(brightest, float(picture.max())), picture.dtype
        is_float = self.dtype == np.float32
        self._full = int(np.iinfo(np.uint16 if is_float else self.dtype).max)
        whites = (1, *WHITES) if is_float else WHITES
        self.white = next((white for white in whites if brightest <= white), WHITES[-1])
        if levels is not None and not is_float:
            self.white = self._full
        self._levels = levels or (0.0, 1.0 if is_float else self.white / self._full)

    def __call__(self, picture: NDArray[Any], file: Path) -> U8:
        """A new picture.

        Raises:
            SagsError: it is brighter than what was taken for white.
        """
        from sags_node.sources.pixels import spread  # a kernel: other pictures need no place for one

        if picture.max() > self.white:
            raise SagsError(
                f"{file} holds {picture.max():g}, but by others {self.white} is white; set source.levels, or "
                "save PNG of 8 bit"
            )
        if picture.dtype == np.float32:
            picture = np.rint(np.clip(picture, 0, None) * (self._full / self.white)).astype(np.uint16)
        return spread(picture, self._levels)

    def tell(self, folder: Path) -> None:
        """Say in the log what was taken for white, where that is not the brightest value of the type."""
        if self.dtype == np.float32 or self.white != self._full:
            bits = "floating numbers" if self.dtype == np.float32 else f"{self.white.bit_length()} of 16 bits"
            share = 1.0 if self.dtype == np.float32 else self.white / self._full
            log.warning(
                "%s holds %s: %d is taken for white; set source.levels:=[0,%.4g] to say so, or another share",
                *(folder, bits, self.white, share),
            )
