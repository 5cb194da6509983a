"""Copies runs of pixels between whole images and the small scratch array that a kernel computes in.

A loop over many arrays does not vectorise, because LLVM would have to prove that none overlap; a loop over
planes of one scratch array does (see `jit`). Images are flat here, [P] with P pixels; a run starts at pixel
`start` (uint64) and has `count` pixels. Where `count` is a constant these loops become straight copies.
"""

from typing import Any

import numpy as np

from sags_node.kernels.jit import inlined
from sags_node.types import F32, U8, Bool

u8 = np.uint64
ZERO, ONE = np.float32(0.0), np.float32(1.0)
LEVEL = np.float32(1 / 255)  # one step of an image's bytes, which stand for 0..1

PIECE = 256  # pixels that a kernel takes at a time
PLANE = PIECE + 16  # floats; 64 bytes of padding
# The planes that `load_frame` fills. A kernel's own follow from `FREE` on.
RED, GREEN, BLUE, DEPTH, COVERAGE = (u8(k * PLANE) for k in range(5))
TRUE_RED, TRUE_GREEN, TRUE_BLUE, TRUE_DEPTH, TISSUE = (u8(k * PLANE) for k in range(5, 10))
FREE = 10


@inlined
def load(scratch: F32, plane: Any, picture: F32, start: Any, count: int) -> None:
    for k in range(count):
        scratch[plane + u8(k)] = picture[start + u8(k)]


@inlined
def load_mask(scratch: F32, plane: Any, mask: Bool, start: Any, count: int) -> None:
    """Load a mask: True as 1, False as 0."""
    for k in range(count):
        scratch[plane + u8(k)] = ONE if mask[start + u8(k)] else ZERO


@inlined
def load_frame(
    scratch: F32, planes: F32, image: U8, tissue: Bool, depth: F32, start: Any, count: int
) -> None:
    """Load what was drawn, `planes` [5, P], and what the camera saw: `image` [3 P] interleaved, `depth`,
    `tissue`."""
    for plane in range(5):
        load(scratch, u8(plane * PLANE), planes[plane], start, count)
    for k in range(count):
        i = u8(3) * (start + u8(k))
        scratch[TRUE_RED + u8(k)] = np.float32(image[i]) * LEVEL
        scratch[TRUE_GREEN + u8(k)] = np.float32(image[i + u8(1)]) * LEVEL
        scratch[TRUE_BLUE + u8(k)] = np.float32(image[i + u8(2)]) * LEVEL
    load(scratch, TRUE_DEPTH, depth, start, count)
    load_mask(scratch, TISSUE, tissue, start, count)


@inlined
def store(scratch: F32, plane: Any, picture: F32, start: Any, count: int) -> None:
    for k in range(count):
        picture[start + u8(k)] = scratch[plane + u8(k)]


@inlined
def clear(scratch: F32, plane: Any, first: int, end: int) -> None:
    for k in range(first, end):
        scratch[plane + u8(k)] = ZERO
