"""A live feed that repeats its picture is found; one that only looks alike, and a recording, are not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from watching import judged

from sags_node.types import U8, StereoFrame
from sags_node.vision.freeze_watch import FreezeWatch

HEIGHT, WIDTH = 48, 64
S = 1_000_000_000


def picture(seed: int) -> U8:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def live(i: int, rate: float, left: U8, right: U8 | None) -> StereoFrame:
    stamp = 100 * S + round(i * S / rate)
    return StereoFrame(i, stamp, stamp, left, right, t_arrival_ns=stamp + 1)


def feed(rate: float = 30.0, eyes: int = 2, start: int = 0) -> Iterator[StereoFrame]:
    """The same pictures for ever, in memory of their own."""
    i = start
    while True:
        yield live(i, rate, picture(0), picture(1) if eyes == 2 else None)
        i += 1


def told(watch: FreezeWatch, frame: StereoFrame) -> bool:
    """Whether it is held, which goes with the warning."""
    why = judged(watch, frame).hold
    assert [finding.text for finding in watch.findings] == [why] * bool(why)
    assert all(finding.code == "picture_frozen" for finding in watch.findings)
    return bool(why)


@pytest.mark.parametrize("eyes", [1, 2])
@pytest.mark.parametrize(("rate", "first"), [(60, 18), (30, 9), (25, 8), (10, 3), (2, 1)])
def test_a_feed_is_frozen_after_three_tenths_of_a_second_by_its_stamps(
    rate: float, first: int, eyes: int
) -> None:
    watch = FreezeWatch()
    found = [told(watch, frame) for frame, _ in zip(feed(rate, eyes), range(first + 5), strict=False)]
    assert found == [False] * first + [True] * 5


def test_it_is_over_with_the_first_picture_that_differs() -> None:
    watch, frames = FreezeWatch(), feed()
    assert any([told(watch, next(frames)) for _ in range(20)])
    assert not told(watch, replace(next(frames), left=picture(2)))
    again = [told(watch, next(frames)) for _ in range(12)]
    assert again.index(True) >= 9


@pytest.mark.parametrize("eye", ["left", "right"])
@pytest.mark.parametrize("row", [0, HEIGHT // 2, HEIGHT - 1])
def test_one_bit_in_one_eye_is_a_new_picture(eye: str, row: int) -> None:
    watch = FreezeWatch()
    for frame, i in zip(feed(), range(60), strict=False):
        changed = getattr(frame, eye).copy()
        changed[row, 7, 1] ^= i % 2
        assert not told(watch, replace(frame, **{eye: changed}))


def test_one_eye_that_stands_still_is_no_frozen_feed() -> None:
    """The eyes are compared with each other for that."""
    watch = FreezeWatch()
    frames = zip(feed(), range(60), strict=False)
    assert not any(told(watch, replace(frame, right=picture(i))) for frame, i in frames)


def test_what_repeats_pictures_to_reach_a_rate_does_not_freeze() -> None:
    """A scope of 25 and one of 5 Hz behind a converter to 60."""
    for rate in (25, 5):
        watch = FreezeWatch()
        for i in range(240):
            at = i * rate // 60
            assert not told(watch, live(i, 60, picture(2 * at), picture(2 * at + 1)))


def test_a_recording_may_repeat_itself() -> None:
    watch = FreezeWatch()
    frames = zip(feed(), range(60), strict=False)
    assert not any(told(watch, replace(frame, t_arrival_ns=0)) for frame, _ in frames)


def test_a_clock_that_is_set_back_thaws_nothing() -> None:
    watch, frames = FreezeWatch(), feed(start=100)
    assert [told(watch, next(frames)) for _ in range(12)][-1]
    assert all(told(watch, frame) for frame, _ in zip(feed(start=0), range(5), strict=False))
