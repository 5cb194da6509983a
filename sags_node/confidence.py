"""How far to trust a depth: its predicted error as one number from 0 to 1.

    confidence = 2 ** (-error / 3 mm)        error = 3 mm * log2(1 / confidence)

`error` is predicted: nine of ten real errors are smaller. So 0.5 says within 3 mm, 0.8 within 1 mm, 0.25
within 6 mm. Below 1/64 (18 mm) no depth is stated.
"""

from typing import Any

import numpy as np

from sags_node.types import F32, F64

HALVING = 3e-3  # m of error by which the confidence halves
LEAST = 1 / 64  # lowest confidence with which a depth is stated
SURE = 0.5  # lowest confidence with which a depth may decide something
SURE_OF_ANCHOR = (
    0.5  # lowest confidence with which an anchor is taken to be on its tissue, see `overlay.frame`
)
FAINTEST = 1e-30  # lowest confidence that `error_of` tells apart: 0.3 m


def is_sure_in_space(anchor: Any) -> bool:
    """Tell whether an anchor (a row of `anchors`) is surely on its tissue, and its depth is sure."""
    return bool(anchor["confidence"] >= SURE_OF_ANCHOR and anchor["depth_confidence"] >= SURE)


def confidence_of(error: F32 | F64 | np.float32) -> F32:
    """Confidence 0..1 of depths with predicted errors (m)."""
    return np.asarray(np.exp2(-error / HALVING), np.float32)


def error_of(confidence: F32) -> F32:
    """The predicted errors (m) that these confidences stand for."""
    return np.asarray(-HALVING * np.log2(np.maximum(confidence, FAINTEST)), np.float32)
