"""How the drift of a trajectory is told from what its scene does again and again."""

from __future__ import annotations

import numpy as np
import pytest

from sags_node.evaluation.trajectory import drift
from sags_node.mapping.camera_pose import exponential

PERIOD, ROUNDS = 40, 5


def test_a_drift_is_told_from_a_swing() -> None:
    """1 mm and 0.2 degrees in all; the means of first and last period are four fifths of that apart."""
    count = PERIOD * ROUNDS
    known = np.tile(np.eye(4), (count + 1, 1, 1))
    estimated = []
    for k in range(count + 1):
        gone, swing = k / count, np.sin(2 * np.pi * k / PERIOD)
        twist = [1e-3 * gone, 1.2e-3 * swing, 0, 0, 0, np.radians(0.2) * gone]
        estimated.append(exponential(np.array(twist)))
    found = drift(np.stack(estimated), known, PERIOD)
    assert found["drift_mm"] == pytest.approx(0.8, abs=1e-6) == found["worst_drift_mm"]
    assert found["drift_deg"] == pytest.approx(0.16, abs=1e-6)
    assert found["end_mm"] == pytest.approx(1.0, abs=1e-6)
    assert found["end_deg"] == pytest.approx(0.2, abs=1e-6)
