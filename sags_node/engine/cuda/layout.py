"""Records that the GPU kernels hand to each other: rows of float32 tensors, and the tiles of a picture.

Triton's interpreter takes a `tl.constexpr` on the right of an operator only: kernels write `x * WHITEN2`.
"""

from __future__ import annotations

import triton.language as tl

# A Gaussian projected to one camera, as `engine.rasterizer.layout.SPLAT` has it: alpha is
# 2**(log2_opacity - u^2 - v^2) with u = whiten_xx dx + whiten_xy dy and v = whiten_yy dy.
MEAN_X, MEAN_Y = tl.constexpr(0), tl.constexpr(1)  # px, first pixel's centre at 0.5
WHITEN_XX, WHITEN_XY, WHITEN_YY = tl.constexpr(2), tl.constexpr(3), tl.constexpr(4)
LOG2_OPACITY = tl.constexpr(5)  # after the filters
RED, GREEN, BLUE = tl.constexpr(6), tl.constexpr(7), tl.constexpr(8)
DEPTH = tl.constexpr(9)  # m
SPLAT_FLOATS = tl.constexpr(12)  # 48 bytes: three reads of 16

# Sums over pixels of g = dL/d(log alpha), of one splat in one tile and then of one splat: moments in u, v.
V_SUM, V_U, V_V = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2)
V_UU, V_UV, V_VV = tl.constexpr(3), tl.constexpr(4), tl.constexpr(5)
V_RED, V_GREEN, V_BLUE = tl.constexpr(6), tl.constexpr(7), tl.constexpr(8)
V_DEPTH, V_WEIGHT = tl.constexpr(9), tl.constexpr(10)
V_SPLAT_FLOATS = tl.constexpr(12)

# A camera: rows of the world-to-camera rotation (9), translation (3), fx fy cx cy, the limits of x/z and y/z
# in the Jacobian (low high low high), the centre in the world (3).
TRANSLATION, INTRINSICS = tl.constexpr(9), tl.constexpr(12)
LIMITS, CENTRE = tl.constexpr(16), tl.constexpr(20)
CAMERA_FLOATS = tl.constexpr(24)

# Tiles that a splat may touch: first column, first row, number of columns.
BOX_LEFT, BOX_TOP, BOX_COLUMNS = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2)
BOX_INTS = tl.constexpr(4)

# A tile is the work of one warp, four pixels a thread: its sums need neither shared memory nor a barrier.
# Four of them, one below the other, make a tile of the CPU backend and of the callers.
TILE_WIDTH_BITS, TILE_HEIGHT_BITS = tl.constexpr(4), tl.constexpr(3)
TILE_WIDTH, TILE_HEIGHT = tl.constexpr(16), tl.constexpr(8)
TILE_PIXELS = tl.constexpr(128)
TILE_WARPS = 1
