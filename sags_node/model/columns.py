"""The parameters of a Gaussian as one row: what a deformation adds to, and what an optimiser steps on.

All are raw: the drawn scale is exp, the drawn opacity the logistic function of what stands here.
"""

from __future__ import annotations

MEAN = slice(0, 3)  # m, world
LOG_SCALE = slice(3, 6)  # of metres
QUAT = slice(6, 10)  # wxyz
COLOR = slice(10, 13)  # RGB 0..1
LOGIT = 13  # of the opacity
COUNT = 14
