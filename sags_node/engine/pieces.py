"""Moving runs of pixels between whole pictures and the small scratch array that a kernel computes in.

A loop over many arrays does not vectorise, because LLVM would have to prove that none overlap; a loop over
planes of one scratch array does (see `jit`). Pictures are flat here, [P] with P pixels; a run starts at pixel
`start` (uint64) and has `count` pixels. Where `count` is a constant these loops become straight copies.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sags_node.kernels.jit import inlined
from sags_node.types import F32, Bool

u8 = np.uint64
ZERO, ONE = np.float32(0.0), np.float32(1.0)


@inlined
def load(scratch: F32, plane: Any, picture: F32, start: Any, count: int) -> None:
    for k in range(count):
        scratch[plane + u8(k)] = picture[start + u8(k)]


@inlined
def load_mask(scratch: F32, plane: Any, mask: Bool, start: Any, count: int) -> None:
    """True as 1, False as 0."""
    for k in range(count):
        scratch[plane + u8(k)] = ONE if mask[start + u8(k)] else ZERO


@inlined
def load_frame(
    scratch: F32, stride: int, planes: F32, image: F32, tissue: Bool, depth: F32, start: Any, count: int
) -> None:
    """What was drawn and what was seen, into the first ten planes, `stride` apart: red, green, blue, depth
    and coverage of `planes` [5, P]; red, green, blue of `image` [3 P], interleaved; `depth`; `tissue`."""
    for plane in range(5):
        load(scratch, u8(plane * stride), planes[plane], start, count)
    red, green, blue = u8(5 * stride), u8(6 * stride), u8(7 * stride)
    for k in range(count):
        i = u8(3) * (start + u8(k))
        scratch[red + u8(k)] = image[i]
        scratch[green + u8(k)] = image[i + u8(1)]
        scratch[blue + u8(k)] = image[i + u8(2)]
    load(scratch, u8(8 * stride), depth, start, count)
    load_mask(scratch, u8(9 * stride), tissue, start, count)


@inlined
def store(scratch: F32, plane: Any, picture: F32, start: Any, count: int) -> None:
    for k in range(count):
        picture[start + u8(k)] = scratch[plane + u8(k)]


@inlined
def clear(scratch: F32, plane: Any, first: int, end: int) -> None:
    for k in range(first, end):
        scratch[plane + u8(k)] = ZERO
