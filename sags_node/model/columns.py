"""The parameters of a Gaussian as one row: what a deformation adds to, and what an optimiser steps on.

All are raw: the drawn scale is exp, the drawn opacity the logistic function of what stands here.
"""

import math

import numpy as np

from sags_node.types import F32

MEAN = slice(0, 3)  # m, world
LOG_SCALE = slice(3, 6)  # of metres
QUAT = slice(6, 10)  # wxyz
COLOR = slice(10, 13)  # RGB 0..1
LOGIT = 13  # of the opacity
COUNT = 14

# Bounds for optimisers. What no image determines, such as how thin a Gaussian is along the ray, walks at
# random: without bounds a scale reaches 0, or the size of the scene.
LOG_SCALE_RANGE = (math.log(1e-6), math.log(5e-3))  # m
COLOR_RANGE = (-0.5, 1.5)  # wider than what can be shown
LOGIT_RANGE = (-6.0, 6.0)


def bounded(rows: F32) -> F32:
    """Clamp rows [N, 14] to these ranges, and normalise their quaternions; NaN stays NaN."""
    within = rows.copy()
    within[:, LOG_SCALE] = rows[:, LOG_SCALE].clip(*LOG_SCALE_RANGE)
    within[:, COLOR] = rows[:, COLOR].clip(*COLOR_RANGE)
    within[:, LOGIT] = rows[:, LOGIT].clip(*LOGIT_RANGE)
    within[:, QUAT] /= np.linalg.norm(rows[:, QUAT], axis=1, keepdims=True)
    return within
