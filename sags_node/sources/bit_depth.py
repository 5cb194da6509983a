"""Converts images of more than 8 bits, or of floating-point numbers, to 8 bits."""

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
    """Converts images [H, W, 3] of one type to 8 bits.

    Files do not tell which value is white. It is taken for the largest value of 8, 10, 12, 14 or 16 bits: the
    fewest that hold `some` images. For floating-point numbers it is 1, if that holds them. With `levels`,
    white is the largest value of an integer type.
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
        """Return the image in 8 bits, a new array.

        Raises:
            SagsError: it is brighter than the value taken for white.
        """
        from sags_node.sources.pixels import spread  # a kernel; other images do not need it loaded

        if picture.max() > self.white:
            raise SagsError(
                f"{file} holds {picture.max():g}, but by others {self.white} is white; set source.levels, or "
                "save PNG of 8 bit"
            )
        if picture.dtype == np.float32:
            picture = np.rint(np.clip(picture, 0, None) * (self._full / self.white)).astype(np.uint16)
        return spread(picture, self._levels)

    def tell(self, folder: Path) -> None:
        """Log the value taken for white, unless it is the largest one of the type."""
        if self.dtype == np.float32 or self.white != self._full:
            bits = "floating numbers" if self.dtype == np.float32 else f"{self.white.bit_length()} of 16 bits"
            share = 1.0 if self.dtype == np.float32 else self.white / self._full
            log.warning(
                "%s holds %s: %d is taken for white; set source.levels:=[0,%.4g] to say so, or another share",
                *(folder, bits, self.white, share),
            )
