"""What every live source does with its images: pairs, numbers, epochs, and their end, on stamps alone."""

from typing import Any

import numpy as np
import pytest
from waiting import beside

from sags_node.sources.pairing import QUEUE_LENGTH, LivePairs, Picture
from sags_node.types import Side, StereoFrame

MS = 1_000_000
IMAGE = np.zeros((4, 8, 3), np.uint8)


def put(pairs: LivePairs, *moments: float, side: Side) -> None:
    for t_ms in moments:
        pairs.add(side, Picture(round(t_ms * MS), IMAGE))


def taken(pairs: LivePairs) -> list[StereoFrame]:
    """What is there."""
    pairs.end()
    return list(pairs)


def numbered(pairs: LivePairs) -> list[tuple[int, int, int]]:
    """Number, and stamps of both eyes, ms."""
    frames = taken(pairs)
    return [(f.frame_id, round(f.t_capture_ns / MS), round(f.t_capture_right_ns / MS)) for f in frames]


@pytest.mark.parametrize(
    ("left", "right", "pairs", "alone"),
    [
        # Left 0 has right 30 only, which is too far and nearer to left 33; right 101 waits.
        ((0, 33, 66), (30, 70, 101), [(1, 33, 30), (2, 66, 70)], 1),
        ((0, 16), (15,), [(1, 16, 15)], 1),  # a nearer successor within the tolerance
        (range(0, 3300, 33), (), [], 100 - QUEUE_LENGTH),  # one eye alone neither pairs nor grows
    ],
)
def test_pairs_are_those_of_the_nearest_stamps(left: Any, right: Any, pairs: Any, alone: int) -> None:
    source = LivePairs(20)
    put(source, *left, side="left")
    put(source, *right, side="right")
    assert numbered(source) == pairs and source.dropped == alone


@pytest.mark.parametrize("phase_ms", [-16.0, -7.0, 0.0, 9.0, 16.0])
def test_free_running_cameras_pair_from_the_first_moment(phase_ms: float) -> None:
    """Two 30 Hz cameras, any phase, some jitter: all but the odd image at the start find a partner."""
    rng = np.random.default_rng(3)
    moments = [(1000 / 30 * n + rng.normal(0, 0.2) + 50, "left") for n in range(200)]
    moments += [(1000 / 30 * n + phase_ms + rng.normal(0, 0.2) + 50, "right") for n in range(200)]
    source, pairs = LivePairs(20), []
    for t, eye in sorted(moments):
        put(source, t, side=eye)  # type: ignore[arg-type]
        pairs += numbered(source)
    assert len(pairs) >= 199
    assert max(abs(left - right) for _, left, right in pairs) <= 20


@pytest.mark.fault("clock: set back by an hour between the eyes")
def test_recovers_when_the_wall_clock_is_set_back() -> None:
    source, pairs = LivePairs(20), []
    put(source, 3_600_000, side="right")  # its partner came after the clock was set back one hour
    for n in range(10):
        put(source, 33 * n, side="left")
        put(source, 33 * n + 1, side="right")
        pairs += numbered(source)
    assert len(pairs) >= 10 - QUEUE_LENGTH


@pytest.mark.fault("clock: set forward by an hour under a camera")
@pytest.mark.fault("clock: set back under a camera")
@pytest.mark.fault("stamp: a sender's image comes twice")
@pytest.mark.parametrize(
    ("moments", "epochs"),
    [
        ((10_000, 10_020, 3_610_000, 3_610_020), [0, 0, 0, 0]),
        ((10_000, 10_020, 5_000, 5_020), [0, 0, 1, 1]),
        ((10_000, 10_033, 10_033, 10_066), [0, 0, 0]),  # one that comes twice is one frame
        ((10_145, 10_033, 10_066, 10_178), [0, 0]),  # the clock is known better now: no new epoch
    ],
)
def test_a_clock_that_is_set_is_seen(moments: tuple[int, ...], epochs: list[int]) -> None:
    source = LivePairs(20)
    put(source, *moments, side="left")
    put(source, *moments, side="right")
    frames = taken(source)
    assert [frame.epoch for frame in frames] == epochs
    assert {frame.t_capture_ns // MS for frame in frames} <= {*moments}
    assert source.dropped == len(moments) - len(epochs)


@pytest.mark.parametrize("end", [LivePairs.stop, LivePairs.end])
def test_who_waits_for_pictures_is_told_of_the_end(end: Any) -> None:
    source = LivePairs(20)
    with beside(lambda: list(source)):  # it has ended when this is left
        end(source)
