"""Figures of followed points, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from sags_node.evaluation.point_tracks import average_jaccard, calibration_error, reliability


def test_average_jaccard_counts_places_and_visibility() -> None:
    """Four points: near; 5 px off; seen but not said to be; hidden but said to be seen. Three are seen.

    Within 2 and 4 px one is right, and two of those said are not: 1 / (3 + 2). Within 8, 16 and 32 px two are
    right, and one is not: 2 / (3 + 1).
    """
    distances = np.array([1.0, 5.0, 40.0, 1.0])
    visible, said = np.array([1, 1, 1, 0], bool), np.array([1, 1, 0, 1], bool)
    assert average_jaccard(distances, visible, said) == pytest.approx((2 / 5 + 3 * 2 / 4) / 5)
    assert average_jaccard(np.zeros(4), visible, visible) == 1
    assert average_jaccard(np.zeros(4), visible, ~visible) == 0
    assert average_jaccard(np.array([2.0]), np.array([True]), np.array([True]), [2]) == 0  # TAP-Vid: below it
    assert average_jaccard(np.full(4, np.inf), visible, said) == 0


def test_reliability_tells_what_was_said_from_what_was_right() -> None:
    confidence = np.array([0.0, 0.1, 0.55, 0.95, 1.0, 0.9, 0.99])
    bins = reliability(confidence, np.array([0, 1, 1, 1, 1, 0, 1], bool))
    assert [(each.least, each.most, each.count) for each in bins] == [
        (0, 0.02, 1),
        (0.1, 0.2, 1),
        (0.5, 0.6, 1),
        (0.9, 1, 4),
    ]
    assert [each.right for each in bins] == [0, 1, 1, 0.75]
    assert bins[3].said == pytest.approx(0.96)
    assert calibration_error(bins) == pytest.approx((0.9 + 0.45 + 4 * 0.21) / 7)
