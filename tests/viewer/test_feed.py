"""What the viewer takes from a node, over real sockets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from synthetic import health, publisher, stream
from waiting import until

from sags_node.clients.viewer.feed import TOPICS, Feed
from sags_node.messaging.address import NodeAddress

pytestmark = pytest.mark.live


def test_the_node_makes_one_frame_for_each_update_and_nothing_between(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    running_well = replace(health(), latency_ms={"p50": 40.0})
    with publisher(run_dir) as running, stream(running, said=lambda: running_well):
        feed = Feed(NodeAddress(run_dir=run_dir))
        until(lambda: feed.now().model is not None)
        shown = []
        for _ in range(3):
            until(lambda: not any(running.wanted(name) for name in TOPICS))
            moment = feed.now()
            assert moment.problem is None and moment.model is not None, "the whole frame came"
            assert moment.splats is not None and moment.anchors is not None
            shown.append(moment.model.frame_id)
        feed.close()
    assert shown == sorted(set(shown)), "a new one each time"


def test_a_node_of_two_frames_a_second_is_shown_too(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    running_well = replace(health(), latency_ms={"p50": 40.0})
    with publisher(run_dir) as running, stream(running, rate=2.0, said=lambda: running_well):
        feed = Feed(NodeAddress(run_dir=run_dir))
        until(lambda: feed.now().model is not None)
        for _ in range(3):
            moment = feed.now()
            assert moment.problem is None and moment.model is not None
        feed.close()
