"""What a stereo network learns from: a pair, and what is true of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sags_node.types import F32, U8


class Example(NamedTuple):
    """A rectified pair and its disparity."""

    left: U8  # [H, W, 3] RGB
    right: U8  # [H, W, 3] RGB
    disparity: F32  # [H, W] px of the left picture; 0 unknown

    def seen_by_both(self) -> F32:
        """The disparity, 0 too where it leads out of the right picture."""
        columns = np.arange(self.disparity.shape[1], dtype=np.float32)
        return np.where(columns >= self.disparity, self.disparity, np.float32(0))
