"""Commands that listen: beside no node, beside one that has died, and beside a running one."""

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import (
    RUN_HERE,
    figures_at_last,
    figures_of,
    pure_json,
    refused,
    sags,
    start,
    stopped,
    wait_for,
)
from waiting import heard, until

from sags_node.clients.overlay import run as overlay
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LIVE_PARAMETERS
from sags_node.messaging import introspection as topic
from sags_node.messaging.received import ReceivedText
from sags_node.messaging.subscriber import Subscriber

pytestmark = [pytest.mark.live, pytest.mark.usefixtures("run_dir")]


# ---- beside no node --------------------------------------------------------------------------------------


def test_a_bridge_says_that_it_waits_for_a_node(run_dir: Path) -> None:
    process = start(["bridge", "web", "--port", "0", "--ns", "other", "--json"])
    assert "waiting: no node runs as 'other'" in process.stderr.readline()
    process.terminate()
    assert process.wait(60) == 0


def test_the_overlay_waits_for_a_node(run_dir: Path) -> None:
    process = start(["overlay", "--json"])
    assert process.stderr is not None and "waiting (Ctrl-C ends)" in process.stderr.readline()
    with Subscriber([], ns="overlay", run_dir=run_dir) as subscriber:
        status = subscriber.wait("status", 60)
        assert isinstance(status, ReceivedText)
        assert json.loads(status.text)["state"] == "blank"
        assert json.loads(status.text)["reason"] == "waiting for the node"
    stdout, _ = stopped(process)
    assert process.returncode == 0 and pure_json(stdout)["frames"] == 0


@pytest.mark.parametrize("command", ["topic list", "topic echo tf", "topic hz tf", "overlay"])
def test_a_node_that_has_died_without_a_word(
    command: str, run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its connection file is still there, and nobody answers."""
    run_dir.mkdir(mode=0o700)
    endpoint = f"ipc://{run_dir}/sags.ipc"
    dead = {"protocol": "1.0", "ns": "sags", "session": "a", "pid": 1, "data": [endpoint], "control": None}
    (run_dir / "sags.json").write_text(json.dumps(dead))
    monkeypatch.setattr(topic, "PATIENCE", 0.2)
    monkeypatch.setattr(overlay, "PATIENCE", 0.2)
    words = f"{command} --seconds 0.6".split() if "echo" not in command else command.split()
    waits = ("waiting (Ctrl-C ends): ",) if command == "overlay" else ()
    refused(1, *words, said=("no ", endpoint, "is the node running", *waits))


# ---- beside a node ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def node(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where a running node's run directory lies: the folder `XDG_RUNTIME_DIR` should name."""
    runtime = tmp_path_factory.mktemp("runtime")
    process = start(["run", phantom_session, "source.loop:=true", *RUN_HERE], XDG_RUNTIME_DIR=runtime)
    wait_for(process, (runtime / "sags/sags.json").exists)
    yield runtime
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)


@pytest.fixture
def beside_node(node: Path, run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command finds the running node by itself."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(node))


def test_topic_tools_in_words_and_in_json(beside_node: None) -> None:
    def listed(seconds: float) -> dict[str, Any] | None:
        said = sags("topic", "list", "--seconds", seconds, "--json").stdout
        if not said:  # nothing came in so short a time
            return None
        rows = {row["topic"]: row for row in pure_json(said)}
        all_came = rows["sags/left/render/depth"]["rate_hz"] and rows["sags/parameters"]["messages"]
        return rows if all_came and rows["sags/right/camera_info"]["messages"] else None

    rows = heard(listed, 0.5)
    assert rows["sags/left/render/depth"]["rate_hz"] > 0
    assert rows["sags/parameters"]["messages"] == 1 and rows["sags/parameters"]["rate_hz"] is None
    assert rows["sags/right/camera_info"]["messages"] > 0
    assert "sags/left/depth" in sags("topic", "list", "--seconds", "1").stdout
    for tool, unit in (("hz", " Hz"), ("bw", "B/s from"), ("delay", " ms")):
        assert unit in said_of("topic", tool, "left/depth")
    two = pure_json(said_of("topic", "hz", "left/depth", "tf", "--json"))
    assert min(two[name]["average_rate"] for name in ("left/depth", "tf")) > 0


def said_of(*command: str) -> str:
    """What a command that listens prints once it has heard enough."""
    return heard(lambda seconds: sags(*command, "--seconds", seconds).stdout)


def test_echo_in_words_and_in_json(beside_node: None) -> None:
    lines = sags("topic", "echo", "left/depth", "--count", "2", "--json").stdout.splitlines()
    assert [pure_json(line)["topic"] for line in lines] == ["sags/left/depth"] * 2
    both = sags("topic", "echo", "tf", "left/depth", "--count", "4", "--json").stdout.splitlines()
    assert {pure_json(line)["topic"] for line in both} == {"sags/tf", "sags/left/depth"}
    transform = sags("topic", "echo", "/sags/tf", "--once").stdout
    assert "rotation: {x: " in transform and transform.endswith("---\n") and "msgtype" not in transform


def test_a_part_of_a_message_is_printed_alone(beside_node: None) -> None:
    once = ("topic", "echo", "left/camera_info", "--once", "--field")
    assert sags(*once, "content.width", "--json").stdout == "320\n"
    assert sags(*once, "content.K.2").stdout == "[0.0, 0.0, 1.0]\n---\n"
    refused(2, *once, "content.widht", said=("unknown key 'content.widht'", "width, height"))


def test_info_says_what_a_topic_is(beside_node: None) -> None:
    info = ("topic", "info", "/sags/left/depth", "--json")
    said = until(lambda: said if (said := figures_of(*info))["messages"] else None)
    assert said["type"] == "sensor_msgs/msg/Image" and "(m)" in said["content"]
    assert said["publishers"] == 1
    assert "publishers: 0" in sags("topic", "info", "clock").stdout
    refused(2, "topic", "info", "left/dept", said=("did you mean 'left/depth'",))


def drawn(text: str) -> dict[str, Any] | None:
    summary: dict[str, Any] = pure_json(text)
    return summary if summary["frames"] else None


def test_overlay_in_words_and_in_json(beside_node: None, tmp_path: Path) -> None:
    still, video = tmp_path / "still.png", tmp_path / "video.mp4"
    command = ("overlay", "--save", still, "--json")
    summary = heard(lambda seconds: drawn(sags(*command, "--seconds", seconds).stdout), 2.0)
    assert summary["saved"] == str(still)
    assert cv2.imread(str(still)).shape == (256, 320, 3)

    def filmed(seconds: float) -> bool:
        said = sags("overlay", "--seconds", seconds, "--save", video).stdout
        assert "with the overlay" in said
        return bool(cv2.VideoCapture(str(video)).read()[0])

    assert heard(filmed, 1.5)
    refused(2, "overlay", "--pin", "5000", "3", said=("pin 5000 3", "320x256"))


# ---- requests --------------------------------------------------------------------------------------------


def test_anchors_are_pinned_listed_and_removed(beside_node: None) -> None:
    assert "no anchors; pin one" in sags("anchor", "list").stdout
    first = figures_at_last("anchor", "pin", "160", "128", "--json")["id"]
    until(lambda: f"anchor {first + 1} in frame" in sags("anchor", "pin", 150.5, 120).stdout)
    rows = {row["id"]: row for row in figures_of("anchor", "list", "--json")}
    while first + 1 not in rows:  # it comes with the next frame
        rows = {row["id"]: row for row in figures_of("anchor", "list", "--json")}
    assert np.hypot(rows[first]["u"] - 160, rows[first]["v"] - 128) < 10 and rows[first]["z"] > 0
    assert rows[first]["unit"] == "m"
    assert str(first) in sags("anchor", "list").stdout
    for anchor in rows:
        assert sags("anchor", "remove", anchor).stdout == f"anchor {anchor} is removed\n"
    refused(1, "anchor", "remove", first, said=(str(first),))
    refused(1, "anchor", "pin", "5000", "3", said=("5000",))


def test_parameters_are_read_and_set(beside_node: None, tmp_path: Path) -> None:
    assert figures_of("param", "get", "mapping.budget_ms", "--json") == {"mapping.budget_ms": None}
    assert figures_of("param", "get", "--json")["source"]["kind"] == "folders"
    assert "max_gaussians:" in sags("param", "get", "mapping").stdout
    assert sags("param", "set", "mapping.budget_ms:=null").stdout == "mapping.budget_ms is null\n"
    assert sags("param", "set", "mapping.budget_ms:=20").stdout == "mapping.budget_ms is 20\n"
    assert f"Only {', '.join(LIVE_PARAMETERS)} can change" in sags("param", "set", "--help").stdout
    assert sags("param", "get", "mapping.budget_ms").stdout == "20.0\n"
    assert sags("param", "set", "mapping.budget_ms:=null").exit_code == 0
    refused(2, "param", "get", "mapping.budget", said=("unknown key 'mapping.budget'", "budget_ms"))
    refused(2, "param", "set", "mapping.budget_ms", "20", said=("write mapping.budget_ms:=20",))
    twice = ("mapping.budget_ms is given twice",)
    refused(2, "param", "set", "mapping.budget_ms:=20", "mapping.budget_ms:=30", said=twice)
    (tmp_path / "mine.yaml").write_text("mapping.budget_ms: 20\nmapping: {budget_ms: 30}\n")
    refused(2, "param", "load", tmp_path / "mine.yaml", said=twice)
    assert sags("param", "set", "mapping.budget_ms:=").stdout == "mapping.budget_ms is null\n"
    refused(1, "param", "set", "mapping.rung:=2", said=("mapping.rung", "cannot be changed", "budget_ms"))


def test_parameters_are_kept_as_a_launch_file_and_loaded(beside_node: None, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(sags("param", "dump").stdout)
    assert load_launch(file).model_dump(mode="json") == figures_of("param", "get", "--json")
    assert sags("param", "load", file).stdout == "all of it is so already\n"
    file.write_text("mapping: {budget_ms: 20}")
    assert sags("param", "load", file).stdout == "mapping.budget_ms is 20\n"
    assert sags("param", "get", "mapping.budget_ms").stdout == "20.0\n"
    file.write_text("mapping: {budget_ms: null, rung: 2}")
    refused(1, "param", "load", file, said=("mapping.rung", "cannot be changed"))
    assert sags("param", "get", "mapping.budget_ms").stdout == "20.0\n"  # all or nothing
    assert sags("param", "set", "mapping.budget_ms:=null").exit_code == 0
    file.write_text("[1, 2]")
    refused(2, "param", "load", file, said=("has no parameters",))


def test_a_node_is_paused_resumed_and_reset(beside_node: None) -> None:
    assert sags("pause").stdout == "paused; sags resume goes on\n"
    assert sags("health").stdout.startswith("paused")
    assert figures_of("resume", "--json") == {"paused": False}
    assert "new model" in sags("reset").stdout
