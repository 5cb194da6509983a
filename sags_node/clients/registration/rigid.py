"""The rigid transform that best moves some points to others, and how sure it is: the information (inverse
covariance) that measurements give of its six freedoms.

A small motion is a rotation vector (rad) about a centre, and a translation (m). For points whose error is
equal in all directions, this is the target registration error of J. M. Fitzpatrick, J. B. West and C. R.
Maurer ("Predicting error in rigid-body point-based registration", IEEE TMI 17(5), 1998). The error at a
target is Gaussian, so the bound of nine of ten errors follows as in Fitzpatrick and West ("The distribution
of target registration error in rigid-body point-based registration", IEEE TMI 20(9), 2001).
"""

import numpy as np

from sags_node.geometry import Array, rigid, transform
from sags_node.types import F64

ROUNDS = 8  # of reweighting
LEAST_ERROR = 1e-3  # m; the least scale of the weights: anchors that are off by much less keep theirs
LEAST_SPREAD = 0.05  # second over first singular value: below it points lie on a line
PICKED = 1e-3  # m along each axis: prior for the error with which people pick landmarks
PICKED_COUNTS = 6  # residuals that this prior is worth
NINE_OF_TEN = 1.2816  # standard deviations, below which nine of ten of a normal distribution lie


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
    """Tell whether points [k, 3] lie so nearly on a line that no rotation follows from them."""
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(spread[1] < LEAST_SPREAD * spread[0] or spread[0] == 0)


def motion_rows(arms: Array, directions: F64) -> F64:
    """The Jacobian [N, 6] of points [N, 3] (m, from the centre) along directions [N, 3] for small motions."""
    return np.hstack([np.cross(arms, directions), directions])


def picking_error(residuals: Array) -> float:
    """The standard deviation (m) of picked points along each axis, by the residuals [k, 3] of a rigid fit.

    The fit uses up six degrees of freedom. Three or four pairs tell little, so the prior `PICKED` counts.
    """
    squares = np.square(residuals).sum() + PICKED_COUNTS * PICKED**2
    return float(np.sqrt(squares / (residuals.size - 6 + PICKED_COUNTS)))


def of_pairs(arms: Array, error: float) -> F64:
    """The information [6, 6] from points [k, 3] (m, from the centre) known to `error` (m) along each axis."""
    rows = motion_rows(np.repeat(arms, 3, axis=0), np.tile(np.eye(3), (len(arms), 1)))
    return rows.T @ rows / error**2


def nine_of_ten(covariance: F64, arm: Array, bias: F64) -> float:
    """The length (m) below which nine of ten errors of a target stay.

    By two moments of the squared length (Satterthwaite), and the cube root of Wilson and Hilferty.

    Args:
        covariance: [6, 6] of the motion.
        arm: [3] m, the target from the centre.
        bias: [3] m, one standard deviation of an error that shifts everything along one direction.
    """
    rows = motion_rows(np.tile(arm, (3, 1)), np.eye(3))
    spread = rows @ covariance @ rows.T + np.outer(bias, bias)
    mean = float(np.trace(spread))
    part = 2 / 9 * float(np.sum(spread**2)) / mean**2
    return float(np.sqrt(mean * (1 - part + NINE_OF_TEN * np.sqrt(part)) ** 3))
