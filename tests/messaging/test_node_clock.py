"""The clock of another machine: by arithmetic, and over real sockets with a clock that is off."""

import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zmq
from cable import Cable
from synthetic import at_frame, plane_result, publisher, stream
from waiting import heard, until

from sags_node import workers
from sags_node.errors import SagsError
from sags_node.messaging import node_clock
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.introspection import topic_figures
from sags_node.messaging.node_clock import DRIFT, Exchange, NodeClock, OffsetEstimate
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.subscriber import Subscriber

AHEAD = 0.08  # s
JITTER = 0.02  # s, at most, each way


# ---- by arithmetic ---------------------------------------------------------------------------------------


def exchanged(now: float, ahead: float, there: float, back: float) -> Exchange:
    """Stamps of an exchange whose answer comes `now`, with delays of `there` and `back` seconds."""
    asked, met = now - there - back, now - back + ahead
    return Exchange(*(round(1e9 * t) for t in (asked, met, met, now)))


@pytest.mark.parametrize("drift", [0.0, 200e-6, -DRIFT])
def test_the_offset_lies_within_its_bound_whatever_the_delays(drift: float) -> None:
    rng = random.Random(0)
    estimate = OffsetEstimate()
    assert estimate.at(0.0) is None
    for step in range(600):
        now = 1.0 + 0.25 * step
        ahead = AHEAD + drift * now
        estimate.add(exchanged(now, ahead, rng.uniform(0, JITTER), rng.uniform(0, 3 * JITTER)), now)
        found = estimate.at(now)
        assert found is not None and abs(found.seconds - ahead) <= found.bound + 2e-9  # ns, rounded
        if step > 40:  # the chance that no delay of 40 is in the shortest tenth is 1.5 %, and it costs 2 ms
            assert found.bound < 5e-3
    assert estimate.jumps == 0
    late = estimate.at(now + 10.0)
    assert late is not None and late.bound == pytest.approx(found.bound + 10 * DRIFT)


@pytest.mark.fault("clock: the node's machine sets it by 50 ms")
@pytest.mark.parametrize("by", [0.05, -0.05])
def test_a_clock_that_is_set_is_noticed_at_once(by: float) -> None:
    estimate = OffsetEstimate()
    for now in range(10):
        estimate.add(exchanged(now, AHEAD, 1e-3, 1e-3), now)
    estimate.add(exchanged(10, AHEAD + by, 1e-3, 1e-3), 10)
    found = estimate.at(10)
    assert estimate.jumps == 1
    assert found is not None and abs(found.seconds - AHEAD - by) <= found.bound <= 1e-3 + 1e-9


def test_an_exchange_during_which_a_clock_was_set_says_nothing() -> None:
    estimate = OffsetEstimate()
    estimate.add(Exchange(asked=1000, received=500, answered=2000, came=1400), 1.0)
    assert estimate.at(1.0) is None and estimate.jumps == 0


@pytest.mark.fault("node: away for so long that requests fill the socket")
def test_what_nobody_foresaw_does_not_end_the_watch(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a full socket did (`zmq.Again`)."""
    answers: list[Any] = [zmq.Again(), OSError(), exchanged(time.monotonic(), AHEAD, 0, 0)]

    def ask(_: object) -> Exchange:
        answer = answers.pop(0) if len(answers) > 1 else answers[0]
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(node_clock, "exchange", ask)
    monkeypatch.setattr(workers, "PAUSE_S", 0.01)
    with NodeClock("tcp://127.0.0.1:1") as clock:
        until(lambda: clock.offset is not None)


# ---- over sockets ----------------------------------------------------------------------------------------


@contextmanager
def answering(run_dir: Path, clock_ns: Callable[[], int]) -> Iterator[Publisher]:
    """A node on a machine with that clock."""
    plane = plane_result()

    def stamps(args: object) -> dict[str, int]:
        return {"received_ns": clock_ns(), "answered_ns": clock_ns()}

    with publisher(run_dir, {"get_clock": stamps}) as running:
        with stream(running, lambda frame: at_frame(plane, frame, clock_ns())):
            yield running


def ahead_and_drifting() -> int:
    """80 ms ahead, and 100 ppm too fast."""
    return time.time_ns() + round(1e9 * true_offset())


BEGAN = time.monotonic_ns()


def true_offset() -> float:
    """By one clock: between two readings of the wall's a thread may be kept waiting."""
    return AHEAD + 1e-13 * (time.monotonic_ns() - BEGAN)


@pytest.mark.live
def test_a_drifting_clock_is_known_to_a_millisecond(tmp_path: Path) -> None:
    with answering(tmp_path, ahead_and_drifting) as running, NodeClock(run_dir=tmp_path) as clock:
        until(lambda: clock.offset is not None and clock.offset.bound < 1e-3)
        for _ in range(20):
            found = clock.offset
            assert found is not None and abs(found.seconds - true_offset()) <= found.bound + 1e-4
            before = ahead_and_drifting()
            assert clock.latest_ns() >= before
            time.sleep(0.05)
        node = NodeAddress(endpoint=running.connection.data[0], control=clock_endpoint(running))
        delay = heard(partial(topic_figures, "delay", "left/depth", node))
    assert delay["clock_offset_s"] == pytest.approx(true_offset(), abs=delay["clock_bound_s"] + 1e-4)
    assert -delay["clock_bound_s"] <= delay["min_s"] < 2 * AHEAD, "not stamped in the future any more"


@pytest.mark.live
def test_jitter_widens_the_bound_and_does_not_mislead(tmp_path: Path) -> None:
    rng = random.Random(1)
    with (
        answering(tmp_path, ahead_and_drifting) as running,
        Cable(clock_endpoint(running), lambda: rng.uniform(0, JITTER)) as far,
        NodeClock(far.endpoint) as clock,
    ):
        until(lambda: clock.offset is not None and clock.offset.bound < 5e-3)
        found = clock.offset
        assert found is not None and abs(found.seconds - true_offset()) <= found.bound + 1e-4


@pytest.mark.live
def test_a_clock_that_is_set_while_it_is_followed(tmp_path: Path) -> None:
    shift = [0]
    with answering(tmp_path, lambda: time.time_ns() + shift[0]), NodeClock(run_dir=tmp_path) as clock:
        until(lambda: clock.offset is not None and clock.offset.bound < 1e-2)
        shift[0] = 3_000_000_000
        until(lambda: clock.jumps == 1)
        found = clock.offset
        assert found is not None and abs(found.seconds - 3) <= found.bound


@pytest.mark.fault("clock: the node's is 5 s ahead and cannot be asked")
@pytest.mark.live
def test_ages_are_by_the_nodes_clock_and_nothing_is_fresh_without_it(tmp_path: Path) -> None:
    name = "left/render/depth"
    ahead = 5_000_000_000
    with answering(tmp_path, lambda: time.time_ns() + ahead) as running:
        with Subscriber([name], run_dir=tmp_path) as guessing:
            assert guessing.wait(name, 30)
            assert "ahead of this machine's clock" in str(guessing.problem(name))
        with NodeClock(run_dir=tmp_path) as clock, Subscriber([name], run_dir=tmp_path, clock=clock) as sure:
            until(lambda: sure.ok(name))
            shown = sure.read(name)
            assert 0 < shown.age(sure.now_ns()) < 5, "as much as the clock is ahead"
        silent = "tcp://127.0.0.1:1"
        with NodeClock(silent) as unknown, Subscriber([name], run_dir=tmp_path, clock=unknown) as unsure:
            assert unsure.wait(name, 30)
            assert unknown.offset is None and not unsure.ok(name)
        with pytest.raises(SagsError, match=r"not known: no answer"):
            topic_figures(
                "delay", name, NodeAddress(endpoint=running.connection.data[0], control=silent), seconds=1.5
            )


@pytest.mark.live
def test_a_node_of_before_says_what_it_lacks(tmp_path: Path) -> None:
    def lacks(args: object) -> object:
        raise SagsError("unknown op 'get_clock'")

    with publisher(tmp_path, {"get_clock": lacks}) as running, stream(running):
        with NodeClock(run_dir=tmp_path) as clock:
            until(lambda: "unknown op" in str(clock.problem))
            assert clock.status()["offset_ms"] is None


@pytest.mark.live
def test_every_node_tells_its_clock(tmp_path: Path) -> None:
    with publisher(tmp_path) as running, stream(running), NodeClock(run_dir=tmp_path) as clock:
        until(lambda: clock.offset is not None)
        found = clock.offset
        assert found is not None and abs(found.seconds) <= found.bound, "it is this machine's"
        assert clock.problem is None and clock.status()["jumps"] == 0


def clock_endpoint(running: Publisher) -> str:
    assert running.connection.control is not None
    return running.connection.control
