"""Whether a picture was compressed so hard that the borders of the codec's blocks stand out."""

from __future__ import annotations

from typing import Any

import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import U8
from sags_node.vision.watch.picture_fit import GREEN

BLOCK = 8  # px: of JPEG and its kin
EVERY = 16  # rows
# So many times the picture's mean step are the steps across borders larger than those beside them. Recorded
# endoscopies have 0.1 to 0.3; JPEG of quality 50 to 30 has 0.3 to 1.3, of quality 10, which keeps 28 to
# 30 dB, 1.3 to 2.4.
BLOCKY = 1.0


def is_blocky(picture: U8) -> bool:
    """Tell whether blocks show in a picture [H, W, 3] as it came. Resizing and rectifying hide them."""
    return bool(_excess(picture) > BLOCKY)


@kernel
def _excess(picture: U8) -> Any:
    """By how much steps across the borders of blocks, wherever these begin, exceed those beside them, over
    the mean step. A picture that was enlarged by repeating pixels has such steps at other places too."""
    height, width, _ = picture.shape
    blocks = (width - 3) // BLOCK
    sums = np.zeros(BLOCK + 2, np.float32)  # of the steps at each place in a block, and in the next two
    for y in range(0, height, EVERY):
        for block in range(blocks):
            for place in range(BLOCK + 2):
                x = block * BLOCK + place
                sums[place] += abs(np.float32(picture[y, x + 1, GREEN]) - np.float32(picture[y, x, GREEN]))
    most, second, total = np.float32(0), np.float32(0), np.float32(0)
    for place in range(1, BLOCK + 1):
        excess = sums[place] - np.float32(0.5) * (sums[place - 1] + sums[place + 1])
        second = max(second, min(most, excess))
        most = max(most, excess)
        total += sums[place]
    count = np.float32(blocks * (1 + (height - 1) // EVERY))
    mean = total / np.float32(BLOCK)
    return (most - second) / (mean + np.float32(0.5) * count)
