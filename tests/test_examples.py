"""The examples, run as their first lines say; others stand beside the tests of what they use."""

import json
import os
import runpy
import signal
import subprocess
import sys
import threading
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from bridging import SEEN, Pinned, anchored_at, sockets
from command_line import killed
from places import ROOT, SESSION
from synthetic import plane_result, stream
from waiting import until

from sags_node.errors import SagsError
from sags_node.messaging.received import ReceivedCloud, ReceivedText
from sags_node.messaging.subscriber import Subscriber
from sags_node.types import FrameResult

pytestmark = [pytest.mark.live, pytest.mark.alone]


def says_that_it_runs(overlay: Subscriber) -> bool:
    status = overlay.latest("status")
    return isinstance(status, ReceivedText) and json.loads(status.text)["state"] == "running"


def holds_one(node: Subscriber) -> bool:
    cloud = node.latest("anchors")
    return isinstance(cloud, ReceivedCloud) and len(cloud.points) == 1


def test_all_start_and_end_together_and_the_notebook_plots_what_was_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plt = pytest.importorskip("matplotlib.pyplot", reason="plots need the extra report")
    (tmp_path / "run").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.setenv("BRIDGE", "web --port 0")
    monkeypatch.chdir(tmp_path)
    words = [SESSION, "source.loop:=true", "publish.data:=[]", "publish.control:=tcp://127.0.0.1:*"]
    together = subprocess.Popen([ROOT / "examples/all_at_once.sh", *words], start_new_session=True)
    try:
        with (
            Subscriber(["anchors"], patience=60) as node,
            Subscriber([], ns="overlay", patience=60) as overlay,
        ):
            until(lambda: says_that_it_runs(overlay) and holds_one(node))
            topics = [
                word for name in ("left/render/depth", "points", "anchors") for word in ("--topics", name)
            ]
            record = [sys.executable, "-m", "sags_node", "bag", "record", "-o", "out/case1", *topics]
            recorder = subprocess.Popen(record)
            last = node.latest("anchors")
            until(lambda: (node.latest("anchors") or last).meta.seq > last.meta.seq + 50)
            recorder.send_signal(signal.SIGINT)
            assert recorder.wait(60) in (0, 3), "3: some messages were lost"
    finally:
        together.terminate()
        together.wait(60)
    with pytest.raises(ProcessLookupError):
        os.killpg(together.pid, 0)  # nothing of it is left
    with pytest.raises(SagsError):
        Subscriber([], ns="overlay", patience=0)

    monkeypatch.setattr(plt, "show", lambda: None)
    notebook = json.loads((ROOT / "examples/play_a_bag.ipynb").read_text(encoding="utf-8"))
    assert all(cell.get("outputs", []) == [] for cell in notebook["cells"])
    code = "\n".join("".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code")
    names: dict[str, object] = {}
    plt.switch_backend("agg")
    exec(code.replace("SECONDS = 5.0", "SECONDS = 1.0"), names)
    plt.close("all")
    depth, path = np.asarray(names["depth"]), np.asarray(names["path"])
    assert 0.03 < np.nanmedian(depth) < 0.2 and len(np.unique(path[:, 0])) > 1, (
        "a frame, and the anchor in more"
    )


@pytest.mark.parametrize(("failing", "named"), [("bridge", "sags bridge ros3"), ("overlay", "sags overlay")])
def test_what_is_started_together_ends_when_a_part_fails_and_says_which(
    failing: str, named: str, tmp_path: Path
) -> None:
    sags = tmp_path / "sags"
    sags.write_text(f'#!/bin/sh\n[ "$1" = {failing} ] && exit 2\nexec sleep 60\n', encoding="utf-8")
    sags.chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "BRIDGE": "ros3"}
    command = [ROOT / "examples/all_at_once.sh", "mine.yaml"]
    # the pipe is closed once none of its processes is left
    ended = subprocess.run(
        command, env=environment, stderr=subprocess.PIPE, text=True, check=False, timeout=30
    )
    assert ended.returncode == 2 and ended.stderr.startswith(f"{named} ended with exit code 2")


def following(run_dir: Path) -> AbstractContextManager[subprocess.Popen[str]]:
    """The example that follows a point."""
    command = [sys.executable, ROOT / "examples/follow_point.py", "20", "20"]
    environment, pipe = os.environ | {"XDG_RUNTIME_DIR": str(run_dir.parent)}, subprocess.PIPE
    return killed(subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True))


def test_a_point_is_not_followed_into_another_session_of_the_node(tmp_path: Path) -> None:
    run_dir, first, second = tmp_path / "sags", Pinned(SEEN), Pinned(SEEN)
    with following(run_dir) as example:
        with sockets(run_dir, first.handlers) as running, stream(running, anchored_at):
            assert "m" in example.stdout.readline()
        with sockets(run_dir, second.handlers) as running, stream(running, anchored_at):
            _, errors = example.communicate(timeout=60)
    assert example.returncode == 1 and "started anew" in errors
    assert len(first.added) == 1 and not first.removed + second.added + second.removed


def test_a_point_that_was_removed_is_followed_no_more(tmp_path: Path) -> None:
    run_dir, node, removed = tmp_path / "sags", Pinned(SEEN), threading.Event()

    def frame(number: int) -> FrameResult:
        result = anchored_at(number)
        return replace(result, anchors=plane_result().anchors) if removed.is_set() else result

    with following(run_dir) as example, sockets(run_dir, node.handlers) as running, stream(running, frame):
        assert "m" in example.stdout.readline()
        removed.set()
        _, errors = example.communicate(timeout=60)
    assert example.returncode == 1 and "somebody else removed the point" in errors
    assert len(node.added) == 1 and not node.removed


@pytest.mark.parametrize(
    ("example", "said"),
    [
        ("follow_point.py x 20", "invalid float value"),
        ("tissue_masks.py", "required: endpoint"),
        ("tissue_masks.py nonsense", "error: 'nonsense' is no endpoint"),
        ("record_board.py FILE", "error: cannot write"),
        ("record_board.py FULL", "exists already"),
        ("send_phantom.py push --rate 0", "must be above 0"),
        ("send_phantom.py push --size 64 64 --endpoint nonsense", "error: cannot connect to nonsense"),
    ],
)
def test_wrong_use_of_an_example_is_one_message(tmp_path: Path, example: str, said: str) -> None:
    (tmp_path / "full/bag").mkdir(parents=True)
    (tmp_path / "file").touch()
    name, *words = (word.lower() if word.isupper() else word for word in example.split())
    command = [sys.executable, ROOT / "examples" / name, *words]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300)
    assert ended.returncode in (1, 2) and said in ended.stderr and "Traceback" not in ended.stderr


@pytest.fixture
def follow(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The node of rclpy, its own code beside stand-ins for ROS; tests/bridge/test_ros2_rclpy.py has ROS."""

    class Node:
        def __init__(self, name: str) -> None:
            self.sent: list[Any] = []

        def __getattr__(self, name: str) -> MagicMock:
            return MagicMock()

        def create_publisher(self, *_: Any) -> Any:
            return SimpleNamespace(publish=self.sent.append)

    for name in ("rclpy", "geometry_msgs.msg", "sensor_msgs.msg", "std_msgs.msg"):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    monkeypatch.setitem(sys.modules, "rclpy.node", SimpleNamespace(Node=Node))
    return runpy.run_path(str(ROOT / "examples/ros2/follow_tissue.py"))["FollowTissue"]()


def test_of_two_nodes_of_rclpy_each_follows_its_own_anchor(follow: Any) -> None:
    """Both ask on one topic, and hear both answers."""
    follow.pixel, follow.asking = SimpleNamespace(x=150.0, y=120.0), MagicMock()
    answers = [({"u": 20.0, "v": 20.0}, 1), ({"u": 150.0, "v": 120.0}, 2)]
    for args, number in answers:
        said = {"request": "add_anchor_at_pixel", "args": args, "result": {"id": number}}
        follow.answered(SimpleNamespace(data=json.dumps(said)))
    assert follow.anchor == 2


def test_the_node_of_rclpy_ends_with_the_node_that_it_follows(follow: Any) -> None:
    follow.anchor = 1
    columns = ("x", "y", "z", "id", "age", "confidence", "depth_confidence")

    def cloud(stamp: float, age: float) -> Any:
        row = np.array([0.01, 0.02, 0.07, 0, age, 1, 1], "<f4")
        row[3:4].view("<u4")[:] = 1
        header = SimpleNamespace(stamp=SimpleNamespace(sec=int(stamp), nanosec=int(stamp % 1 * 1e9)))
        fields = [SimpleNamespace(name=name, offset=4 * at) for at, name in enumerate(columns)]
        return SimpleNamespace(header=header, fields=fields, data=row.tobytes(), point_step=4 * len(columns))

    now = 1.7e9
    for late in (2.0, 2.03, 60.0, 86400.0):
        follow.came(cloud(now + late, late - 1.0))
    follow.came(cloud(now - 100.0, 86399.0))  # the clock was set back: ages stand still
    follow.came(cloud(now - 99.0, 86400.0))
    assert len(follow.sent) == 6
    with pytest.raises(SystemExit, match="started anew"):
        follow.came(cloud(now + 200000.0, 100000.0))  # older than ours was, and pinned since
    nothing = cloud(now, 1.0)
    nothing.data = b""
    with pytest.raises(SystemExit, match="the point was removed"):
        follow.came(nothing)
    assert len(follow.sent) == 6
