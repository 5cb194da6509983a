"""Gaussians follow control nodes, rotation included (embedded deformation: Sumner et al., SIGGRAPH 2007).

A node carries a row of deltas (`columns`): a shift t, a rotation 1 + dq, and what is added to log scale,
colour and opacity logit. A Gaussian x with nodes n_k and weights w_k becomes

    x' = x + sum_k w_k (R_k (x - n_k) - (x - n_k) + t_k)        R_k of the unit quaternion of 1 + dq_k
    q' = (sum_k w_k (1 + dq_k)) q
    everything else: + sum_k w_k delta_k
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from sags_node.engine.jit import kernel, parallel_kernel, read_only
from sags_node.model import columns
from sags_node.types import F32, I32

GROUPS = 32  # of Gaussians, whose sums over nodes are added in order: the same bits on any number of threads
COUNT = columns.COUNT
f4 = np.float32
ONE, TWO = f4(1), f4(2)


def skin(rows: F32, nodes: F32, deltas: F32, index: I32, weight: F32, skinned: F32) -> None:
    """Deform Gaussians by their nodes.

    Args:
        rows: [N, 14] of `columns`, canonical.
        nodes: [M, 3] m, canonical.
        deltas: [M, 14].
        index: [N, K] the nodes of each Gaussian.
        weight: [N, K], summing to 1.
        skinned: [N, 14] written.
    """
    _skin(read_only(rows), read_only(nodes), read_only(deltas), read_only(index), read_only(weight), skinned)


def skin_backward(
    rows: F32, nodes: F32, deltas: F32, index: I32, weight: F32, v_skinned: F32
) -> tuple[F32, F32]:
    """Gradients of sum(v_skinned * skinned): by rows [N, 14] and by deltas [M, 14]. The rest is constant."""
    v_rows = np.empty_like(rows)
    partial = np.zeros((GROUPS, *deltas.shape), f4)
    _skin_backward(
        read_only(rows), read_only(nodes), read_only(deltas), read_only(index), read_only(weight),
        read_only(v_skinned), v_rows, partial,
    )  # fmt: skip
    return v_rows, partial.sum(axis=0)


@kernel
def _turn(q: F32, x: F32, turned: F32) -> None:
    """`turned` = R(q) x, q unit."""
    w, a, b, c = q[0], q[1], q[2], q[3]
    u0 = TWO * (b * x[2] - c * x[1])
    u1 = TWO * (c * x[0] - a * x[2])
    u2 = TWO * (a * x[1] - b * x[0])
    turned[0] = x[0] + w * u0 + b * u2 - c * u1
    turned[1] = x[1] + w * u1 + c * u0 - a * u2
    turned[2] = x[2] + w * u2 + a * u1 - b * u0


@kernel
def _unit(delta: F32, q: F32) -> Any:
    """`q` = the unit quaternion of 1 + delta; returns the length before."""
    q[0] = ONE + delta[6]
    for k in range(3):
        q[1 + k] = delta[7 + k]
    length = max(np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), f4(1e-12))
    for k in range(4):
        q[k] /= length
    return length


@kernel
def _skin_one(row: F32, nodes: F32, deltas: F32, index: I32, weight: F32, skinned: F32) -> None:
    blend = np.zeros(COUNT, np.float32)
    q, arm, turned = np.empty(4, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    for k in range(len(index)):
        w, delta, node = weight[k], deltas[index[k]], nodes[index[k]]
        _unit(delta, q)
        for a in range(3):
            arm[a] = row[a] - node[a]
        _turn(q, arm, turned)
        for a in range(3):
            blend[a] += w * (turned[a] - arm[a])
        for a in range(COUNT):
            blend[a] += w * delta[a]
    for a in range(COUNT):
        skinned[a] = row[a] + blend[a]
    w0, w1, w2, w3 = ONE + blend[6], blend[7], blend[8], blend[9]
    q0, q1, q2, q3 = row[6], row[7], row[8], row[9]
    skinned[6] = w0 * q0 - w1 * q1 - w2 * q2 - w3 * q3
    skinned[7] = w0 * q1 + w1 * q0 + w2 * q3 - w3 * q2
    skinned[8] = w0 * q2 - w1 * q3 + w2 * q0 + w3 * q1
    skinned[9] = w0 * q3 + w1 * q2 - w2 * q1 + w3 * q0


@kernel
def _skin_one_backward(
    row: F32, nodes: F32, deltas: F32, index: I32, weight: F32, v_skinned: F32, v_row: F32, v_deltas: F32
) -> None:
    blend = np.zeros(4, np.float32)  # of the rotations
    for k in range(len(index)):
        for a in range(4):
            blend[a] += weight[k] * deltas[index[k], 6 + a]
    blend[0] += ONE
    for a in range(COUNT):
        v_row[a] = v_skinned[a]
    # q' = b q: to q by the conjugate of b from the left, to b by the conjugate of q from the right
    b0, b1, b2, b3 = blend[0], blend[1], blend[2], blend[3]
    q0, q1, q2, q3 = row[6], row[7], row[8], row[9]
    v0, v1, v2, v3 = v_skinned[6], v_skinned[7], v_skinned[8], v_skinned[9]
    v_row[6] = b0 * v0 + b1 * v1 + b2 * v2 + b3 * v3
    v_row[7] = b0 * v1 - b1 * v0 - b2 * v3 + b3 * v2
    v_row[8] = b0 * v2 + b1 * v3 - b2 * v0 - b3 * v1
    v_row[9] = b0 * v3 - b1 * v2 + b2 * v1 - b3 * v0
    v_blend = np.empty(4, np.float32)
    v_blend[0] = q0 * v0 + q1 * v1 + q2 * v2 + q3 * v3
    v_blend[1] = q0 * v1 - q1 * v0 + q2 * v3 - q3 * v2
    v_blend[2] = q0 * v2 - q1 * v3 - q2 * v0 + q3 * v1
    v_blend[3] = q0 * v3 + q1 * v2 - q2 * v1 - q3 * v0
    q, arm, turned = np.empty(4, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    v_q, back = np.empty(4, np.float32), np.empty(4, np.float32)
    v = v_skinned[0:3]
    for a in range(3):
        v_row[a] = v[a]
    for k in range(len(index)):
        w, delta, node, v_delta = weight[k], deltas[index[k]], nodes[index[k]], v_deltas[index[k]]
        length = _unit(delta, q)
        for a in range(3):
            arm[a] = row[a] - node[a]
        # by the arm: R^T v - v
        back[0] = q[0]
        for a in range(3):
            back[1 + a] = -q[1 + a]
        _turn(back, v, turned)
        for a in range(3):
            v_row[a] += w * (turned[a] - v[a])
        # by the unit quaternion of R(q) arm = arm + 2 w (u x arm) + 2 u x (u x arm)
        cx = arm[1] * v[2] - arm[2] * v[1]
        cy = arm[2] * v[0] - arm[0] * v[2]
        cz = arm[0] * v[1] - arm[1] * v[0]
        dot_v = q[1] * v[0] + q[2] * v[1] + q[3] * v[2]
        dot_arm = q[1] * arm[0] + q[2] * arm[1] + q[3] * arm[2]
        both = arm[0] * v[0] + arm[1] * v[1] + arm[2] * v[2]
        v_q[0] = TWO * (q[1] * cx + q[2] * cy + q[3] * cz)
        v_q[1] = TWO * (q[0] * cx + dot_v * arm[0] + dot_arm * v[0] - TWO * q[1] * both)
        v_q[2] = TWO * (q[0] * cy + dot_v * arm[1] + dot_arm * v[1] - TWO * q[2] * both)
        v_q[3] = TWO * (q[0] * cz + dot_v * arm[2] + dot_arm * v[2] - TWO * q[3] * both)
        radial = v_q[0] * q[0] + v_q[1] * q[1] + v_q[2] * q[2] + v_q[3] * q[3]
        for a in range(4):
            v_delta[6 + a] += w * ((v_q[a] - radial * q[a]) / length + v_blend[a])
        for a in range(6):
            v_delta[a] += w * v_skinned[a]
        for a in range(10, COUNT):
            v_delta[a] += w * v_skinned[a]


@parallel_kernel
def _skin(rows: F32, nodes: F32, deltas: F32, index: I32, weight: F32, skinned: F32) -> None:
    for i in prange(len(rows)):
        _skin_one(rows[i], nodes, deltas, index[i], weight[i], skinned[i])


@kernel
def _skin_group_backward(
    group: int, rows: F32, nodes: F32, deltas: F32, index: I32, weight: F32, v_skinned: F32, v_rows: F32,
    v_deltas: F32,
) -> None:  # fmt: skip
    count = len(rows)
    for i in range(group * count // GROUPS, (group + 1) * count // GROUPS):
        _skin_one_backward(rows[i], nodes, deltas, index[i], weight[i], v_skinned[i], v_rows[i], v_deltas)


@parallel_kernel
def _skin_backward(
    rows: F32, nodes: F32, deltas: F32, index: I32, weight: F32, v_skinned: F32, v_rows: F32, partial: F32
) -> None:
    for group in prange(GROUPS):
        _skin_group_backward(group, rows, nodes, deltas, index, weight, v_skinned, v_rows, partial[group])
