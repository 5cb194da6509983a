"""How sure a pose is: the information (inverse covariance) that measurements give of its six freedoms.

A small motion is a rotation vector (rad) about a centre, and a translation (m). Of points with one error in
all directions this is the target registration error of J. M. Fitzpatrick, J. B. West and C. R. Maurer
("Predicting error in rigid-body point-based registration", IEEE TMI 17(5), 1998). Its spread about a target
is Gaussian, so nine of ten follow as in Fitzpatrick and West ("The distribution of target registration
error in rigid-body point-based registration", IEEE TMI 20(9), 2001).
"""

from __future__ import annotations

import numpy as np

from sags_node.geometry import Array
from sags_node.types import F64

PICKED = 1e-3  # m along each axis: what people pick landmarks to, before the pairs say more
PICKED_COUNTS = 6  # residuals that this guess is worth
NINE_OF_TEN = 1.2816  # standard deviations, below which nine of ten of a normal distribution lie


def motion_rows(arms: Array, directions: F64) -> F64:
    """How far points [N, 3] (m, from the centre) go along directions [N, 3] in a small motion: [N, 6]."""
    return np.hstack([np.cross(arms, directions), directions])


def picking_error(residuals: Array) -> float:
    """Standard deviation (m) along each axis of picked points, by what their rigid fit left [k, 3].

    The fit takes six freedoms of them away. Three or four pairs tell little, so `PICKED` counts as well.
    """
    squares = np.square(residuals).sum() + PICKED_COUNTS * PICKED**2
    return float(np.sqrt(squares / (residuals.size - 6 + PICKED_COUNTS)))


def of_pairs(arms: Array, error: float) -> F64:
    """The information [6, 6] of points [k, 3] (m, from the centre) known to `error` (m) along each axis."""
    rows = motion_rows(np.repeat(arms, 3, axis=0), np.tile(np.eye(3), (len(arms), 1)))
    return rows.T @ rows / error**2


def nine_of_ten(covariance: F64, arm: Array, bias: F64) -> float:
    """The length (m) below which nine of ten errors of a target stay.

    By two moments of the squared length (Satterthwaite), and the cube root of Wilson and Hilferty.

    Args:
        covariance: [6, 6] of the motion.
        arm: [3] m, the target from the centre.
        bias: [3] m, one standard deviation of what shifts everything along one direction.
    """
    rows = motion_rows(np.tile(arm, (3, 1)), np.eye(3))
    spread = rows @ covariance @ rows.T + np.outer(bias, bias)
    mean = float(np.trace(spread))
    part = 2 / 9 * float(np.sum(spread**2)) / mean**2
    return float(np.sqrt(mean * (1 - part + NINE_OF_TEN * np.sqrt(part)) ** 3))
