"""Gaussians follow control nodes, rotation included (embedded deformation: Sumner et al., SIGGRAPH 2007).

A node carries a row of deltas (`columns`): a shift t, a rotation 1 + dq, and what is added to log scale,
colour and opacity logit. A Gaussian x with nodes n_k and weights w_k becomes

    x' = x + sum_k w_k (A_k (x - n_k) + t_k)        A_k = R_k - 1, R_k of the unit quaternion of 1 + dq_k
    q' = (1 + sum_k w_k dq_k) q
    everything else: + sum_k w_k delta_k

All sums are linear in what a node alone determines: [A_k | t_k - A_k n_k] and its other deltas. So each node
writes that down once, as its record; a Gaussian blends the records of its four nodes and applies the blend.
Places are measured from the middle of the nodes: A_k x and A_k n_k cancel, far from it in many digits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from sags_node.engine.rasterizer.projection import rotation
from sags_node.kernels.jit import inlined, kernel, parallel_kernel, read_only, square_root, stack_floats
from sags_node.model import columns
from sags_node.model.rotation import SHORTEST
from sags_node.types import F32, I32

f4 = np.float32
u8 = np.uint64
ZERO, ONE, TWO = f4(0), f4(1), f4(2)

BLOCK = 64  # Gaussians that are blended before the blends are applied
GROUPS = 16  # of Gaussians, whose sums over nodes are added in order: the same bits on any number of threads
COUNT = columns.COUNT

# A record: three rows of [A | t - A n], the deltas from log scale to logit, and a 0 that fills the vectors.
RECORD = 24
OTHERS = u8(9)  # column c >= 3 of `columns` stands at c + OTHERS
QW, QX, QY, QZ = (u8(columns.QUAT.start + k) for k in range(4))  # dq in a row
W, X, Y, Z = QW + OTHERS, QX + OTHERS, QY + OTHERS, QZ + OTHERS  # and in a record

Quat = tuple[Any, Any, Any, Any]


def skin(rows: F32, nodes: F32, deltas: F32, index: I32, weight: F32, skinned: F32) -> None:
    """Deform Gaussians by their nodes.

    Args:
        rows: [N, 14] of `columns`, canonical.
        nodes: [M, 3] m, canonical.
        deltas: [M, 14].
        index: [N, 4] the nodes of each Gaussian.
        weight: [N, 4], summing to 1.
        skinned: [N, 14] written.
    """
    middle, _, records = _records(nodes, deltas)
    _skin(read_only(rows), middle, records, read_only(index), read_only(weight), skinned)


def skin_backward(
    rows: F32, nodes: F32, deltas: F32, index: I32, weight: F32, v_skinned: F32
) -> tuple[F32, F32]:
    """Gradients of sum(v_skinned * skinned): by rows [N, 14] and by deltas [M, 14]. The rest is constant."""
    middle, places, records = _records(nodes, deltas)
    v_rows, v_deltas = np.empty_like(rows), np.empty_like(deltas)
    v_records = np.empty((GROUPS, *records.shape), f4)
    _skin_backward(
        read_only(rows), middle, records, read_only(index), read_only(weight), read_only(v_skinned),
        v_rows, v_records,
    )  # fmt: skip
    _records_backward(places, read_only(deltas), v_records.sum(axis=0), v_deltas)
    return v_rows, v_deltas


def _records(nodes: F32, deltas: F32) -> tuple[F32, F32, F32]:
    """The middle of the nodes [3], the nodes as seen from there [M, 3], and their records [M, RECORD]."""
    middle = nodes.mean(axis=0)
    places = read_only(nodes - middle)
    records = np.empty((len(nodes), RECORD), f4)
    _write_records(places, read_only(deltas), records)
    return read_only(middle), places, read_only(records)


@inlined
def _product(a: Quat, b: Quat) -> Quat:
    """Hamilton product. The gradient of sum(v * a b) by a is v b*, by b it is a* v."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@inlined
def _conjugate(q: Quat) -> Quat:
    return q[0], -q[1], -q[2], -q[3]


@inlined
def _unit(w: Any, x: Any, y: Any, z: Any) -> tuple[Any, ...]:
    """The unit quaternion, and 1 / the length before."""
    scale = ONE / max(square_root(w * w + x * x + y * y + z * z), f4(SHORTEST))
    return w * scale, x * scale, y * scale, z * scale, scale


@kernel
def _write_records(places: F32, deltas: F32, records: F32) -> None:
    for node in range(len(places)):
        n = u8(node)
        w, x, y, z, _ = _unit(ONE + deltas[n, QW], deltas[n, QX], deltas[n, QY], deltas[n, QZ])
        R = rotation(w, x, y, z)
        records[n, 0], records[n, 1], records[n, 2] = R[0] - ONE, R[1], R[2]
        records[n, 4], records[n, 5], records[n, 6] = R[3], R[4] - ONE, R[5]
        records[n, 8], records[n, 9], records[n, 10] = R[6], R[7], R[8] - ONE
        for axis in range(3):
            a, row = u8(axis), u8(4 * axis)
            turned = ZERO
            for k in range(3):
                turned += records[n, row + u8(k)] * places[n, u8(k)]
            records[n, row + u8(3)] = deltas[n, a] - turned
        for column in range(3, COUNT):
            c = u8(column)
            records[n, c + OTHERS] = deltas[n, c]
        records[n, RECORD - 1] = ZERO


@inlined
def _blend(records: F32, index: I32, weight: F32, first: int, end: int, blends: F32) -> None:
    """`blends` [(end - first) RECORD] = the records of each Gaussian's nodes, weighted and summed."""
    for gaussian in range(first, end):
        i, at = u8(gaussian), u8((gaussian - first) * RECORD)
        n0, n1, n2, n3 = u8(index[i, 0]), u8(index[i, 1]), u8(index[i, 2]), u8(index[i, 3])
        w0, w1, w2, w3 = weight[i, 0], weight[i, 1], weight[i, 2], weight[i, 3]
        # All four nodes at once: with a loop over them LLVM gathers across nodes, 4 times slower.
        for part in range(RECORD):
            c = u8(part)
            near = w0 * records[n0, c] + w1 * records[n1, c]
            blends[at + c] = near + w2 * records[n2, c] + w3 * records[n3, c]


@inlined
def _scatter(
    v_blends: F32, index: I32, weight: F32, first: int, end: int, group: int, v_records: F32
) -> None:
    """Add the gradients of the blends to those of the records of one group."""
    g = u8(group)
    for gaussian in range(first, end):
        i, at = u8(gaussian), u8((gaussian - first) * RECORD)
        n0, n1, n2, n3 = u8(index[i, 0]), u8(index[i, 1]), u8(index[i, 2]), u8(index[i, 3])
        w0, w1, w2, w3 = weight[i, 0], weight[i, 1], weight[i, 2], weight[i, 3]
        for part in range(RECORD):
            c = u8(part)
            v_blend = v_blends[at + c]
            v_records[g, n0, c] += w0 * v_blend
            v_records[g, n1, c] += w1 * v_blend
            v_records[g, n2, c] += w2 * v_blend
            v_records[g, n3, c] += w3 * v_blend


@kernel
def _skin_block(
    first: Any, rows: F32, middle: F32, records: F32, index: I32, weight: F32, skinned: F32
) -> None:
    blends = stack_floats(1536)  # BLOCK RECORD
    end = min(first + BLOCK, len(rows))
    _blend(records, index, weight, first, end, blends)
    for gaussian in range(first, end):
        i, at = u8(gaussian), u8((gaussian - first) * RECORD)
        x, y, z = rows[i, 0] - middle[0], rows[i, 1] - middle[1], rows[i, 2] - middle[2]
        for axis in range(3):
            a, row = u8(axis), at + u8(4 * axis)
            moved = blends[row] * x + blends[row + u8(1)] * y + blends[row + u8(2)] * z
            skinned[i, a] = rows[i, a] + (moved + blends[row + u8(3)])
        for column in range(3, COUNT):
            c = u8(column)
            skinned[i, c] = rows[i, c] + blends[at + c + OTHERS]
        turn = ONE + blends[at + W], blends[at + X], blends[at + Y], blends[at + Z]
        quat = _product(turn, (rows[i, QW], rows[i, QX], rows[i, QY], rows[i, QZ]))
        skinned[i, QW], skinned[i, QX], skinned[i, QY], skinned[i, QZ] = quat


@parallel_kernel
def _skin(rows: F32, middle: F32, records: F32, index: I32, weight: F32, skinned: F32) -> None:
    for block in prange((len(rows) + BLOCK - 1) // BLOCK):
        _skin_block(np.int64(block) * BLOCK, rows, middle, records, index, weight, skinned)


@kernel
def _skin_group_backward(
    group: Any, rows: F32, middle: F32, records: F32, index: I32, weight: F32, v_skinned: F32, v_rows: F32,
    v_records: F32,
) -> None:  # fmt: skip
    blends, v_blends = stack_floats(1536), stack_floats(1536)  # BLOCK RECORD
    v_records[group] = ZERO
    last = (group + 1) * len(rows) // GROUPS
    for first in range(group * len(rows) // GROUPS, last, BLOCK):
        end = min(first + BLOCK, last)
        _blend(records, index, weight, first, end, blends)
        for gaussian in range(first, end):
            i, at = u8(gaussian), u8((gaussian - first) * RECORD)
            x, y, z = rows[i, 0] - middle[0], rows[i, 1] - middle[1], rows[i, 2] - middle[2]
            v_x, v_y, v_z = v_skinned[i, 0], v_skinned[i, 1], v_skinned[i, 2]
            for axis in range(3):
                a, row = u8(axis), at + u8(4 * axis)
                v = v_skinned[i, a]
                v_blends[row], v_blends[row + u8(1)], v_blends[row + u8(2)] = v * x, v * y, v * z
                v_blends[row + u8(3)] = v
                v_moved = blends[at + a] * v_x + blends[at + a + u8(4)] * v_y + blends[at + a + u8(8)] * v_z
                v_rows[i, a] = v + v_moved
            for column in range(3, COUNT):
                c = u8(column)
                v_rows[i, c] = v_blends[at + c + OTHERS] = v_skinned[i, c]
            v_blends[at + u8(RECORD - 1)] = ZERO
            turn = ONE + blends[at + W], blends[at + X], blends[at + Y], blends[at + Z]
            quat = rows[i, QW], rows[i, QX], rows[i, QY], rows[i, QZ]
            v_quat = v_skinned[i, QW], v_skinned[i, QX], v_skinned[i, QY], v_skinned[i, QZ]
            v_turn = _product(v_quat, _conjugate(quat))
            v_blends[at + W], v_blends[at + X], v_blends[at + Y], v_blends[at + Z] = v_turn
            v_rows[i, QW], v_rows[i, QX], v_rows[i, QY], v_rows[i, QZ] = _product(_conjugate(turn), v_quat)
        _scatter(v_blends, index, weight, first, end, group, v_records)


@parallel_kernel
def _skin_backward(
    rows: F32, middle: F32, records: F32, index: I32, weight: F32, v_skinned: F32, v_rows: F32, v_records: F32
) -> None:
    for group in prange(GROUPS):
        _skin_group_backward(
            np.int64(group), rows, middle, records, index, weight, v_skinned, v_rows, v_records
        )


@kernel
def _records_backward(places: F32, deltas: F32, v_records: F32, v_deltas: F32) -> None:
    v_A = stack_floats(9)
    for node in range(len(places)):
        n = u8(node)
        for axis in range(3):
            a, row = u8(axis), u8(4 * axis)
            v_t = v_records[n, row + u8(3)]
            v_deltas[n, a] = v_t
            for k in range(3):
                v_A[u8(3) * a + u8(k)] = v_records[n, row + u8(k)] - v_t * places[n, u8(k)]
        for column in range(3, COUNT):
            c = u8(column)
            v_deltas[n, c] = v_records[n, c + OTHERS]
        w, x, y, z, scale = _unit(ONE + deltas[n, QW], deltas[n, QX], deltas[n, QY], deltas[n, QZ])
        # through the rotation of the unit quaternion: the skew and the symmetric parts of v_A, its diagonal
        skew_x, skew_y, skew_z = v_A[7] - v_A[5], v_A[2] - v_A[6], v_A[3] - v_A[1]
        yz, xz, xy = v_A[7] + v_A[5], v_A[2] + v_A[6], v_A[3] + v_A[1]
        xx, yy, zz = TWO * v_A[0], TWO * v_A[4], TWO * v_A[8]
        v_w = TWO * (x * skew_x + y * skew_y + z * skew_z)
        v_x = TWO * (w * skew_x + y * xy + z * xz - x * (yy + zz))
        v_y = TWO * (w * skew_y + x * xy + z * yz - y * (xx + zz))
        v_z = TWO * (w * skew_z + x * xz + y * yz - z * (xx + yy))
        # through its length
        along = v_w * w + v_x * x + v_y * y + v_z * z
        v_deltas[n, QW] += (v_w - along * w) * scale
        v_deltas[n, QX] += (v_x - along * x) * scale
        v_deltas[n, QY] += (v_y - along * y) * scale
        v_deltas[n, QZ] += (v_z - along * z) * scale
