"""Three-vectors inside kernels: tuples of three blocks."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def dot(a: tl.tuple, b: tl.tuple) -> tl.tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross(a: tl.tuple, b: tl.tuple) -> tl.tuple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def add(a: tl.tuple, b: tl.tuple) -> tl.tuple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@triton.jit
def multiply(a: tl.tuple, b: tl.tuple) -> tl.tuple:
    """Element by element."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@triton.jit
def combine(s: tl.tensor, a: tl.tuple, t: tl.tensor, b: tl.tuple) -> tl.tuple:
    """s a + t b."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@triton.jit
def select(condition: tl.tensor, a: tl.tuple) -> tl.tuple:
    """a, and 0 where the condition fails."""
    return tl.where(condition, a[0], 0.0), tl.where(condition, a[1], 0.0), tl.where(condition, a[2], 0.0)


@triton.jit
def size(a: tl.tuple) -> tl.tensor:
    """Sum of the absolute values; NaN and infinity show in it."""
    return tl.abs(a[0]) + tl.abs(a[1]) + tl.abs(a[2])


@triton.jit
def times_matrix(rows: tl.tuple, a: tl.tuple) -> tl.tuple:
    """M a for the three rows of M."""
    return dot(rows[0], a), dot(rows[1], a), dot(rows[2], a)


@triton.jit
def times_transposed(rows: tl.tuple, a: tl.tuple) -> tl.tuple:
    """M^T a for the three rows of M."""
    return add(combine(a[0], rows[0], a[1], rows[1]), multiply((a[2], a[2], a[2]), rows[2]))


@triton.jit
def rotate(w: tl.tensor, q: tl.tuple, a: tl.tuple) -> tl.tuple:
    """`a` turned by the unit quaternion (w, q); by (-w, q) it is turned back."""
    t = cross(q, a)
    t = add(t, t)
    return add(a, combine(w, t, 1.0, cross(q, t)))


@triton.jit
def load_vector(pointer: tl.tensor) -> tl.tuple:
    """The same three numbers for the whole block."""
    return tl.load(pointer), tl.load(pointer + 1), tl.load(pointer + 2)


@triton.jit
def load3(pointers: tl.tensor, mask: tl.tensor) -> tl.tuple:
    return (
        tl.load(pointers, mask=mask, other=0.0),
        tl.load(pointers + 1, mask=mask, other=0.0),
        tl.load(pointers + 2, mask=mask, other=0.0),
    )


@triton.jit
def store3(pointers: tl.tensor, a: tl.tuple, mask: tl.tensor) -> None:
    tl.store(pointers, a[0], mask=mask)
    tl.store(pointers + 1, a[1], mask=mask)
    tl.store(pointers + 2, a[2], mask=mask)
