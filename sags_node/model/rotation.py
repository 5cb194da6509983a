"""Quaternions [N, 4], wxyz, as rotations that are put one after the other, and their gradients."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from sags_node.types import F32, F64

F = TypeVar("F", F32, F64)

SHORTEST = 1e-12  # a shorter quaternion has no direction
_CONJUGATE = np.array([1, -1, -1, -1], np.float32)


def product(a: F, b: F) -> F:
    """Hamilton products a b: first b, then a. The gradient of sum(v * a b) by a is v b*, by b it is a* v."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    parts = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    products: F = np.stack(parts, axis=1)
    return products


def conjugate(q: F) -> F:
    """The inverse of unit quaternions."""
    inverse: F = q * _CONJUGATE
    return inverse


def unit(q: F) -> F:
    made: F = q / _length(q)
    return made


def unit_backward(q: F, unit_q: F, v_unit: F) -> F:
    """Gradient of sum(v_unit * unit(q)) by q; `unit_q` is unit(q)."""
    along = np.einsum("ij,ij->i", unit_q, v_unit)[:, None]
    v_q: F = (v_unit - unit_q * along) / _length(q)
    return v_q


def _length(q: F) -> F:
    """[N, 1]"""
    length: F = np.maximum(np.sqrt(np.einsum("ij,ij->i", q, q)), SHORTEST)[:, None]
    return length
