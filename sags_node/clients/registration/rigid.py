"""The rigid transform that best moves some points to others."""

from __future__ import annotations

import numpy as np

from sags_node.geometry import rigid, transform
from sags_node.types import F64

ROUNDS = 8  # of reweighting
LEAST_ERROR = 1e-3  # m; anchors off by less than this keep their weight
LEAST_SPREAD = 0.05  # second over first singular value: below it points lie on a line


def kabsch(model: F64, places: F64, weights: F64) -> F64:
    """The rigid transform [4, 4] that moves points [k, 3] to places [k, 3] with the least weighted squares.

    Kabsch's solution (A solution for the best rotation to relate two sets of vectors, Acta Cryst. A32, 1976).
    `weights` [k] sum to one. The caller sees to it that the points do not lie on a line.
    """
    middle, goal = weights @ model, weights @ places
    U, _, Vt = np.linalg.svd(((model - middle) * weights[:, None]).T @ (places - goal))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = Vt.T @ flip @ U.T
    return rigid(R, goal - R @ middle)


def rigid_fit(model: F64, places: F64, weights: F64) -> tuple[F64, float]:
    """The rigid transform [4, 4] that best moves points [k, 3] to places [k, 3], and the error left (m, RMS).

    `kabsch`, repeated with the weights of Geman and McClure, so that a few anchors that went astray do not
    count. The caller sees to it that the points do not lie on a line.
    """
    robust = weights / weights.sum()
    for _ in range(ROUNDS):
        T = kabsch(model, places, robust)
        squares = np.square(transform(T, model) - places).sum(1)
        scale = max(LEAST_ERROR**2, float(np.median(squares)))
        robust = weights * (scale / (scale + squares)) ** 2
        robust /= robust.sum()
    return T, float(np.sqrt(robust @ squares))


def on_a_line(points: F64) -> bool:
    """True when points [k, 3] lie so nearly on a line that no rotation follows from them."""
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(spread[1] < LEAST_SPREAD * spread[0] or spread[0] == 0)
