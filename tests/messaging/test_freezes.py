"""What counts as a freeze, by the definition."""

from __future__ import annotations

import numpy as np
import pytest

from sags_node.messaging.freezes import freezes_of


def moments(interval: float, holes: dict[int, float], count: int = 120) -> list[float]:
    """Of a stream with one interval but for some: number -> s."""
    intervals = [holes.get(i, interval) for i in range(count)]
    return [0.0, *np.cumsum(intervals).tolist()]


@pytest.mark.parametrize(
    ("interval", "hole", "freezes"),
    [
        (1 / 30, 0.17, 0),  # five frames, but not 150 ms more than the mean
        (1 / 30, 0.19, 1),
        (0.5, 1.4, 0),  # 0.9 s more, but not three times the mean
        (0.5, 1.6, 1),
    ],
)
def test_a_freeze_is_long_in_both_ways(interval: float, hole: float, freezes: int) -> None:
    found = freezes_of(moments(interval, {60: hole}))
    assert found.count == freezes
    assert found.seconds == pytest.approx(hole * freezes)


def test_jitter_and_a_lower_rate_are_no_freezes() -> None:
    rng = np.random.default_rng(0)
    jitter = np.cumsum(1 / 30 + rng.uniform(-0.03, 0.03, 600))
    assert freezes_of(jitter.tolist()).count == 0
    slower = moments(1 / 30, dict.fromkeys(range(60, 120), 0.1))
    assert freezes_of(slower).count == 0


def test_freezes_add_up_and_one_does_not_hide_the_next() -> None:
    found = freezes_of(moments(1 / 30, {40: 0.5, 80: 2.0}))
    assert (found.count, found.seconds) == (2, pytest.approx(2.5))
    assert freezes_of([]).count == freezes_of([1.0]).count == 0
