"""Records that the CPU kernels hand to each other. Each fills one or a quarter of a 64-byte cache line.

They are structured dtypes so that a changed layout changes the type of the kernels' arguments and with it
the key of Numba's disk cache.
"""

from __future__ import annotations

import numpy as np

# A Gaussian projected to one camera. With d = pixel - mean2d, u = whiten_xx dx + whiten_xy dy and
# v = whiten_yy dy, its alpha is 2**(log2_opacity - u^2 - v^2). The triangular factor of the conic is kept
# instead of the conic because a sum of squares cannot cancel: long thin Gaussians stay exact in float32.
SPLAT = np.dtype(
    {
        "names": [
            "mean_x",  # px, first pixel's centre at 0.5
            "mean_y",
            "whiten_xx",  # 1/px, scaled so that the exponent is one of base 2
            "whiten_xy",
            "whiten_yy",
            "log2_opacity",  # after the 2D Mip filter
            "extent",  # largest u^2 + v^2 that is drawn; 0: this splat is not drawn
            "red",
            "green",
            "blue",
            "depth",  # m
        ],
        "formats": ["f4"] * 11,
        "itemsize": 64,
    }
)

# One splat in one tile.
PAIR = np.dtype(
    [
        ("splat", "i4"),
        ("slot", "i4"),  # where this pair's gradient goes: pairs of one splat are neighbours there
        ("row_begin", "i4"),  # rows of the tile that the splat touches
        ("row_end", "i4"),
    ]
)

# A pair before it is sorted into its tile; it stands at its slot.
EMITTED = np.dtype([("tile", "i4"), ("row_begin", "i2"), ("row_end", "i2")])

# The slots of one splat's pairs.
SLOTS = np.dtype([("first", "i4"), ("count", "i4")])

# Sums over pixels of g = dL/d(log alpha): moments in the whitened coordinates u, v of the Gaussian.
SPLAT_GRADIENT = np.dtype(
    {
        "names": [
            "sum",
            "u",
            "v",
            "uu",
            "uv",
            "vv",
            "red",
            "green",
            "blue",
            "depth",
            "contribution",
        ],
        "formats": ["f4"] * 11,
        "itemsize": 64,
    }
)
