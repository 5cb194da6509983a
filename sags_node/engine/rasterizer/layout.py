"""Records that the CPU kernels pass to each other. A splat or its gradient fills a 64-byte cache line."""

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
            # Half the width and half the height of the ellipse u^2 + v^2 = extent, px
            "reach_x",
            "reach_y",
            "lowest_x",  # px; the ellipse has its largest dy at this dx
            "slope_u",  # luminance at a pixel: that of the colour + slope_u u + slope_v v
            "slope_v",
        ],
        "formats": ["f4"] * 16,
    }
)

COLUMNS = 2  # of a tile, each 8 px wide

# One splat in one tile
PAIR = np.dtype(
    {
        "names": [
            "splat",
            "slot",  # where this pair's gradient goes: pairs of one splat are neighbours there
            "begin",  # first row that the splat touches in each column, counted from the tile's first
            "end",  # one after the last row; not above `begin`: no row is touched
            "rows",  # `begin` and `end` as one number, for fast copies
        ],
        "formats": ["i4", "i4", ("u1", COLUMNS), ("u1", COLUMNS), "i4"],
        "offsets": [0, 4, 8, 10, 8],
    }
)

# A pair before it is sorted into its tile, stored at its slot.
EMITTED = np.dtype(
    {
        "names": ["splat", "tile", "begin", "end", "rows"],
        "formats": ["i4", "i4", ("u1", COLUMNS), ("u1", COLUMNS), "i4"],
        "offsets": [0, 4, 8, 10, 8],
    }
)

# The slots of the pairs of one splat, or of a block of splats.
SLOTS = np.dtype([("first", "i4"), ("count", "i4")])

# Sums over pixels of g = dL/d(log alpha): moments in the whitened coordinates u, v of the Gaussian.
SPLAT_GRADIENT = np.dtype(
    {
        "names": "sum u v uu uv vv red green blue depth contribution slope_u slope_v spread".split(),
        "formats": ["f4"] * 14,
        "itemsize": 64,
    }
)
