"""What the node says of itself, on a clock that only the tests move."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
from synthetic import plane_result

from sags_node.messaging import cdr, content, topics
from sags_node.node import health as health_module
from sags_node.node.health import WAITING_AFTER, Statistics
from sags_node.types import NodeHealth

PERIOD = 1 / 30
TAKEN_IN = plane_result()
HELD = replace(TAKEN_IN, held="the left picture is black")


class Node:
    """Publishes at 30 Hz."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self._statistics = 0.0, Statistics()
        monkeypatch.setattr(health_module.time, "monotonic", lambda: self.now)

    def publish(self, seconds: float, held: bool = False) -> NodeHealth:
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            self._statistics.add(HELD if held else TAKEN_IN, 40.0, {})
        return self._statistics.health({}, False, False, None, {}, {}, {})


@pytest.mark.fault("camera: its cap is on, for longer than a second")
def test_a_node_that_takes_no_frame_in_is_not_well(monkeypatch: pytest.MonkeyPatch) -> None:
    node = Node(monkeypatch)
    said = node.publish(3.0)
    assert content.health_answer(said)["healthy"] and said.state == "running"
    assert node.publish(WAITING_AFTER - 3 * PERIOD, held=True).state == "running"
    said = node.publish(6 * PERIOD, held=True)
    assert content.health_answer(said) == {"healthy": False, "state": "held", "warnings": []}
    assert said.rate_hz == pytest.approx(30)  # pictures go on
    (part,) = content.diagnostics(said, 0).parts
    statuses = cdr.decode(bytes(part), topics.DIAGNOSTICS).status
    assert [int(status.level) for status in statuses[:2]] == [1, 0]  # of the node; of a stage, which works
    assert node.publish(PERIOD).state == "running"
    said = node.publish(0.5, held=True)
    assert said.state == "running" and content.health_answer(said)["healthy"]


def test_the_latency_is_told_while_the_health_is_being_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mapping thread reads it in every frame."""
    statistics = Statistics()
    assert statistics.latency_s == 0
    for latency_ms in (10.0, 20.0, 90.0):
        statistics.add(TAKEN_IN, latency_ms, {})
    with ThreadPoolExecutor(1) as other, statistics._lock:
        assert other.submit(lambda: statistics.latency_s).result(timeout=10) == pytest.approx(0.020)
