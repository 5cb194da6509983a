"""When content is stale: the rules, with a clock of our own."""

from typing import Any

import numpy as np
import pytest
from made_messages import MS, meta

from sags_node.messaging.freezes import freezes_of
from sags_node.messaging.freshness import STALE_AFTER, WINDOW, Freshness


def followed(
    sequence: list[int], period_ms: float = 33.0, changes: dict[str, Any] | None = None, **settings: Any
) -> Freshness:
    """What follows messages `sequence` of a sender with that period."""
    fresh = Freshness(**settings)
    for seq in sequence:
        fresh.accept(meta(seq, seq * period_ms, **(changes or {})))
    return fresh


@pytest.mark.fault("CPU: the node makes one frame a second")
@pytest.mark.parametrize(
    ("count", "period_ms", "changes", "max_age", "limit_ms"),
    [
        (30, 33, {}, None, 330),  # ten periods
        (30, 33, {}, 0.1, 100),
        (30, 33, {}, 10.0, 330),
        (30, 1000, {}, None, 1000 * STALE_AFTER),  # ten would be ten seconds
        (30, 1000, {}, 2.0, 2000),  # who wants older content says so
        (30, 1000, {"frame_id": -1}, None, 10_000),  # shows no frame: `status` comes once a second
        (1, 33, {}, None, 1000 * STALE_AFTER),  # before the period is known
        (1, 33, {}, 5.0, 1000),  # ten of 0.1 s
        (5, 1500, {}, 20, 1000),  # the first frames of a node on a busy machine do not tell the period
        (6, 1500, {}, 20, 15_000),
    ],
)
def test_content_is_stale_after_its_limit(
    count: int, period_ms: int, changes: dict[str, Any], max_age: float | None, limit_ms: float
) -> None:
    fresh = followed(list(range(1, count + 1)), period_ms, changes)
    newest = count * period_ms
    assert fresh.problem(round((newest + limit_ms - 1) * MS), max_age) is None
    assert "too old" in str(fresh.problem(round((newest + limit_ms + 1) * MS), max_age))


@pytest.mark.fault("clock: the sender's is 0.9 s ahead, and it falls silent")
@pytest.mark.parametrize("ahead", [0, 500, 900])
def test_silence_is_stale_whatever_the_stamps_say(ahead: int) -> None:
    now = [0.0]
    fresh = Freshness(clock=lambda: now[0])
    for seq in range(1, 31):
        fresh.accept(meta(seq, seq * 33 + ahead))
    for silent, is_stale in ((0.32, False), (0.34, True)):  # ten periods
        now[0] = silent
        assert (fresh.problem(round((30 * 33 + 1000 * silent - 10) * MS)) is not None) == is_stale


def test_nothing_is_fresh_before_the_first() -> None:
    assert Freshness().problem(0) == "nothing received yet"


def test_losses_do_not_stretch_the_period_but_count() -> None:
    fresh = followed([1, 2, 3, 5, 6, 9])
    assert fresh.period == pytest.approx(0.033) and fresh.lost == 3


@pytest.mark.parametrize("rate_hz", [None, 30.0])
def test_what_was_not_asked_for_is_not_lost(rate_hz: float | None) -> None:
    fresh = followed([1, 2, 3], rate_hz=rate_hz)
    fresh.ask_anew()
    for seq in (900, 901, 903):
        fresh.accept(meta(seq, seq * 33))
        assert fresh.lost == (seq == 903) and (fresh.problem(round(seq * 33 * MS)) is None) == (seq != 903)


@pytest.mark.fault("network: a fifth of the messages is lost")
@pytest.mark.parametrize(("every", "stale"), [(12, False), (5, True)])
def test_stale_under_ninety_percent(every: int, stale: bool) -> None:
    """Every fifth lost is 80 %, every twelfth 92 %."""
    fresh = followed([seq for seq in range(1, 80) if seq % every])
    problem = fresh.problem(80 * 33 * MS)
    assert (problem is not None and "too few" in problem) == stale
    for seq in range(80, 110):  # it recovers
        fresh.accept(meta(seq, seq * 33.0))
    assert fresh.problem(110 * 33 * MS) is None


def test_a_declared_rate_must_be_kept() -> None:
    now = 30 * 33 * MS
    assert followed(list(range(1, 31)), rate_hz=30.0).problem(now) is None
    assert "too few" in str(followed(list(range(1, 31)), rate_hz=40.0).problem(now))


@pytest.mark.fault("network: messages come twice, or late")
def test_repeats_and_late_ones_are_not_news() -> None:
    fresh = followed([1, 2, 3])
    assert not fresh.accept(meta(3, 99)) and not fresh.accept(meta(2, 99)) and fresh.lost == 0
    assert fresh.accept(meta(1, 50, session="restarted")) and fresh.lost == 0
    assert fresh.accept(meta(2, 1, session="restarted", epoch=1))  # the recording looped: stamps jump back
    assert not fresh.accept(meta(3, 2, session="restarted", epoch=0))


@pytest.mark.fault("clock: the node's is 2 s ahead of the consumer's")
def test_a_clock_ahead_is_not_fresh() -> None:
    assert "ahead" in str(followed([1, 2, 3]).problem(-2000 * MS))


def test_an_event_topic_never_grows_old() -> None:
    assert followed([1], periodic=False).problem(10**18) is None


@pytest.mark.fault("network: two nodes send under one name")
def test_two_nodes_under_one_name_are_found_and_a_restart_is_not() -> None:
    fresh = Freshness()

    def hear(session: str, first: int, count: int) -> str | None:
        for seq in range(first, first + count):
            fresh.accept(meta(seq, seq * 33, session=session))
        return fresh.problem((first + count) * 33 * MS)

    for number, session in enumerate(("a", "b", "c")):  # started anew twice
        assert hear(session, 1 + 30 * number, 30) is None
    for seq in range(100, 140):  # another one comes in between
        problem = hear("cd"[seq % 2], seq, 1)
        assert seq < 102 or "two nodes" in str(problem)
    assert "two nodes" in str(hear("c", 140, WINDOW - 1))
    assert hear("c", 140 + WINDOW, 2) is None


# ---- what counts as a freeze, by the definition --------------------------------------------------------


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
