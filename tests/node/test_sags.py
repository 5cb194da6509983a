"""A node whose mapper learns the paper's model: what it publishes is what consumers know."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import independent_client as client
import numpy as np
import pytest
from running_node import RunningNode
from waiting import START_SECONDS, until

from sags_node.messaging.control import ControlClient

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def node(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    options = ["mapping.method:=sags", "source.pace:=fast", "mapping.rung:=3"]  # no frame is left out
    running = RunningNode(phantom_session, tmp_path_factory.mktemp("node"), *options)
    yield running
    assert running.stop() == 0, running.said()


def test_renders_depth_points_splats_views_and_anchors_are_published(node: RunningNode) -> None:
    with ControlClient(node.connection["control"]) as control:
        until(lambda: control.request("get_status")["gaussians"], START_SECONDS)
        control.request("open_view", {"name": "near", "width": 160, "height": 128})
        anchor = control.request("add_anchor", {"u": 150, "v": 120})["id"]
        names = ["left/render/image", "right/render/image", "left/depth", "points", "splats", "anchors"]
        names += ["view/near/image"]
        got = client.collect(node.data, [f"sags/{name}" for name in names], 3, START_SECONDS)
    last = {name: got[f"sags/{name}"][-1] for name in names}
    means = client.check_splats(last["splats"])
    assert len(means["x"]) > 1000
    depth = last["left/depth"].array()
    assert np.isfinite(depth).mean() > 0.5
    assert len(last["points"].array()) > 1000
    for name in ("left/render/image", "right/render/image", "view/near/image"):
        assert last[name].array().std() > 10, name
    assert anchor in last["anchors"].array().view(np.uint32)[:, 3]
