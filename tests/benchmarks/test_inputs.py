"""What a live pair costs, by each way into the node: real pipelines and real senders."""

import pytest
from gstreamer import need_gstreamer

from benchmarks.node.inputs import RATE, measure_inputs

pytestmark = pytest.mark.live


@pytest.mark.parametrize("way", ["gst, two branches", "push", "ros2"])
def test_what_a_pair_costs_is_measured(way: str) -> None:
    if way.startswith("gst"):
        need_gstreamer()
    if way == "ros2":
        pytest.importorskip("cyclonedds", reason="ROS 2 needs: pip install '.[ros2]'")
    (row,) = measure_inputs(0.5, way, lambda *_: None)
    assert row["way"] == way and row["unequal"] == 0
    assert 0 < row["pairs"] <= 0.5 * RATE + 8  # more than come in that time only where some waited
    assert row["node_ms"] > 0 and row["sender_ms"] > 0
    assert 0 < row["latency_ms_p50"] <= row["latency_ms_p99"]
