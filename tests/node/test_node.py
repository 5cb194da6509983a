"""The running node, seen from outside: real processes, real sockets, real faults."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import independent_client
import numpy as np
import pytest
from places import ROOT
from running_node import RunningNode
from waiting import START_SECONDS, until

from sags_node.errors import SagsError
from sags_node.messaging.control import ControlClient
from sags_node.messaging.roles import needed
from sags_node.messaging.subscriber import Subscriber

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def node(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    # No frame is left out, so what is shown does not depend on how busy the machine is.
    with RunningNode(phantom_session, tmp_path_factory.mktemp("node"), "source.pace:=fast") as running:
        with Subscriber(["splats"], endpoint=running.data) as subscriber:
            assert subscriber.wait("splats", timeout=START_SECONDS) is not None  # there is a model
        yield running


def test_each_operation_has_its_role(node: RunningNode) -> None:
    """One that was forgotten takes the highest, and no client of a lower one could use it."""
    with ControlClient(node.connection["control"]) as asker, pytest.raises(SagsError) as refused:
        asker.request("what is there?")
    names = str(refused.value).split("this node knows: ")[1].split(", ")
    assert len(names) > 15
    for name in names:
        reads = name in ("ping", "measure") or name.startswith("get_")
        writes = "recording" in name or "save" in name or "snapshot" in name
        assert needed(name) == ("listen" if reads else "files" if writes else "control"), name


def truth_depth(session: Path, frame_id: int) -> np.ndarray:
    import cv2

    files = sorted((session / "depth").glob("*.png"))
    return cv2.imread(str(files[frame_id % len(files)]), cv2.IMREAD_UNCHANGED) * np.float32(2.5e-6)


def test_a_stranger_reads_pictures_depth_points_and_splats(node: RunningNode, phantom_session: Path) -> None:
    """Everything a consumer needs, from the contract alone, in metres against the phantom's truth."""
    names = [
        "left/image_rect_color", "right/image_rect_color", "left/render/image", "right/render/image",
        "left/render/depth", "left/depth", "left/tissue_mask", "left/camera_info", "right/camera_info",
        "points", "splats", "tf", "status",
    ]  # fmt: skip
    width, height = 320, 256

    def covered() -> tuple[dict[str, list[independent_client.Received]], float, float] | None:
        """A model that is young, or had little time, does not cover everything yet."""
        by_name = independent_client.collect(node.data, names, count=12, timeout=40)
        assert not [name for name, messages in by_name.items() if not messages]
        rendered = by_name["left/render/depth"][-1]
        depth = independent_client.check_image(rendered, "32FC1", width, height)
        truth = truth_depth(phantom_session, rendered.meta["frame_id"])
        median, p90, coverage = independent_client.depth_error(depth, truth)
        return (by_name, median, p90) if coverage > 0.9 else None

    by_name, median, p90 = until(covered)
    assert median < 0.8e-3 and p90 < 4e-3
    for messages in by_name.values():
        independent_client.check_sequence(messages)
    for name, encoding in (
        ("left/image_rect_color", "rgb8"), ("right/image_rect_color", "rgb8"),
        ("left/render/image", "rgba8"), ("right/render/image", "rgba8"), ("left/tissue_mask", "mono8"),
        ("left/depth", "32FC1"),
    ):  # fmt: skip
        independent_client.check_image(by_name[name][-1], encoding, width, height)

    left = independent_client.camera_info(by_name["left/camera_info"][-1])
    right = independent_client.camera_info(by_name["right/camera_info"][-1])
    baseline = -right["P"][0, 3] / right["P"][0, 0]
    assert 0.003 < baseline < 0.006 and (left["width"], left["height"]) == (width, height)

    splats = by_name["splats"][-1]
    columns = independent_client.check_splats(splats)
    pose = independent_client.camera_pose(by_name["tf"][-1])
    means = np.stack([columns[k] for k in "xyz"], 1)
    local = (means - pose[:3, 3]) @ pose[:3, :3]
    K = left["K"]
    u = np.rint(K[0, 0] * local[:, 0] / local[:, 2] + K[0, 2]).astype(int)
    v = np.rint(K[1, 1] * local[:, 1] / local[:, 2] + K[1, 2]).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    surface = truth_depth(phantom_session, splats.meta["frame_id"])[v[inside], u[inside]]
    error = np.abs(local[inside, 2] - surface)[surface > 0]
    assert inside.mean() > 0.9 and np.median(error) < 1e-3
    assert len(by_name["points"][-1].array()) <= len(means)


def test_control_socket_reads_changes_and_saves(node: RunningNode, tmp_path: Path) -> None:
    control = node.connection["control"]
    with ControlClient(control) as client:
        assert client.request("ping") is not None
        status = client.request("get_status")
        assert status["gaussians"] > 1000
        assert client.request("get_parameters")["mapping"]["budget_ms"] is None
        assert client.request("set_parameters", {"mapping.budget_ms": 50})["mapping"]["budget_ms"] == 50
        with pytest.raises(SagsError, match="cannot be changed while running"):
            client.request("set_parameters", {"source.loop": False})
        with pytest.raises(SagsError, match=r"mapping\.skip_still cannot be changed while running"):
            client.request("set_parameters", {"mapping.budget_ms": 50, "mapping.skip_still": False})
        with pytest.raises(SagsError, match="budget_ms"):
            client.request("set_parameters", {"mapping.budget_ms": -1})
        file = tmp_path / "model.ply"
        saved = client.request("save_model", {"path": str(file)})
        assert saved["gaussians"] > 1000 and file.stat().st_size > 1000 * 68
        with pytest.raises(SagsError, match="exists already"):
            client.request("save_model", {"path": str(file)})
        with pytest.raises(SagsError, match="zero character"):
            client.request("save_model", {"path": "a\0b.ply"})
        with pytest.raises(SagsError, match="unknown"):
            client.request("make_coffee")


def test_no_thread_gives_way_to_others(node: RunningNode) -> None:
    """They share the interpreter: one that is kept from the processor while it holds it keeps all waiting."""
    threads = [int(thread) for thread in os.listdir(f"/proc/{node.process.pid}/task")]
    assert len(threads) > 5
    assert {os.sched_getscheduler(thread) for thread in threads} == {os.SCHED_OTHER}
    own = os.getpriority(os.PRIO_PROCESS, node.process.pid)
    assert {os.getpriority(os.PRIO_PROCESS, thread) for thread in threads} == {own}


@pytest.mark.fault("process: the node is killed")
def test_a_killed_node_goes_stale_and_reads_fail(node: RunningNode) -> None:
    """What was received from a dead node must not be taken for the present. The last of these tests: it ends
    the node of the others."""
    name = "left/render/image"
    with Subscriber([name], endpoint=node.data) as subscriber:
        assert subscriber.wait(name, timeout=30) is not None
        until(lambda: subscriber.ok(name))
        node.process.kill()
        node.process.wait(30)
        until(lambda: not subscriber.ok(name))
        with pytest.raises(SagsError):
            subscriber.read(name)


def test_what_a_mapper_of_the_papers_model_shows_is_published_as_any_others(
    phantom_session: Path, tmp_path: Path
) -> None:
    """Renders, depth, points, splats, views and anchors."""
    options = ["mapping.method:=sags", "source.pace:=fast", "mapping.rung:=3"]  # no frame is left out
    with RunningNode(phantom_session, tmp_path, *options) as node:
        with ControlClient(node.connection["control"]) as control:
            until(lambda: control.request("get_status")["gaussians"], START_SECONDS)
            control.request("open_view", {"name": "near", "width": 160, "height": 128})
            anchor = control.request("add_anchor", {"u": 150, "v": 120})["id"]
            names = ["left/render/image", "right/render/image", "left/depth", "points", "splats", "anchors"]
            names += ["view/near/image"]
            got = independent_client.collect(node.data, names, 3, START_SECONDS)
        assert node.stop() == 0, node.said()
    last = {name: messages[-1] for name, messages in got.items()}
    assert len(independent_client.check_splats(last["splats"])["x"]) > 1000
    assert np.isfinite(last["left/depth"].array()).mean() > 0.5
    assert len(last["points"].array()) > 1000
    for name in ("left/render/image", "right/render/image", "view/near/image"):
        assert last[name].array().std() > 10, name
    assert anchor in last["anchors"].array().view(np.uint32)[:, 3]


def test_the_consumer_of_the_readme_runs_as_it_stands(
    phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Depth in metres, in five lines and their imports."""
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len([line for line in code.splitlines() if line]) <= 6
    running = RunningNode(phantom_session, tmp_path)
    (running.run_dir.parent / "sags").symlink_to(running.run_dir)  # where clients look by themselves
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(running.run_dir.parent))
    consumer = subprocess.Popen(
        [sys.executable, "-u", "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert consumer.stdout is not None
        said_first = islice(consumer.stdout, 50)
        lines = list(islice((line for line in said_first if not line.startswith("depth nan")), 5))
    finally:
        running.stop()
        said = consumer.communicate(timeout=60)[1]  # nothing comes any more, so it ends
    assert consumer.returncode == 0 and len(lines) == 5, said
    for line in lines:
        found = re.fullmatch(r"depth (\S+) m\n", line)
        assert found is not None and 0.05 < float(found[1]) < 0.1, line
