"""A real node, a real recorder, and a real kill."""

import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import RUN_HERE, killed, pure_json, refused, sags, start, stopped, wait_for
from recorded_plane import by_topic
from rosbags.highlevel import AnyReader
from waiting import START_SECONDS, until

from sags_node.bags.bag import read_messages
from sags_node.clients.recording.info import bag_info
from sags_node.config.schema import PhantomSource
from sags_node.errors import SagsError
from sags_node.messaging.control import ControlClient
from sags_node.messaging.received import ReceivedImage, TopicName
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.topics import TOPICS
from sags_node.phantom import write_session
from sags_node.pipeline.session import open_session

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def node(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """`sags run` in its own process; its run directory."""
    home = tmp_path_factory.mktemp("node")
    command = ["run", phantom_session, "source.loop:=true", "mapping.budget_ms:=20", *RUN_HERE]
    process = start(command, XDG_RUNTIME_DIR=home)
    try:
        wait_for(process, (home / "sags/sags.json").exists)
        with Subscriber(["tf"], run_dir=home / "sags") as subscriber:
            assert subscriber.wait("tf", START_SECONDS) is not None
        yield home
    finally:
        stopped(process)


def frames_pass(home: Path, count: int) -> None:
    """So many that the node publishes."""
    with Subscriber(["tf"], run_dir=home / "sags") as subscriber:
        newest = None
        for _ in range(count):
            newest = subscriber.wait("tf", 60, after=newest)
            assert newest is not None


def recording_tf(bag: Path) -> list[str]:
    """A command."""
    return [sys.executable, "-m", "sags_node", "bag", "record", "-o", str(bag), "--topics", "tf"]


def start_recorder(home: Path, *arguments: object) -> subprocess.Popen[str]:
    return start(["bag", "record", *arguments], XDG_RUNTIME_DIR=home)


@pytest.mark.fault("process: the recorder is killed")
def test_a_killed_recording_is_recovered_and_replayed(node: Path, tmp_path: Path) -> None:
    seen: dict[int, dict[str, np.ndarray]] = {}
    eyes = [TopicName(f"{eye}/image_rect_color", ReceivedImage) for eye in ("left", "right")]
    with Subscriber(eyes, run_dir=node / "sags") as subscriber:
        process = start_recorder(node, "-o", tmp_path / "bag")
        bag_file = tmp_path / "bag/bag_0.mcap"
        deadline = time.monotonic() + 60
        newest = None
        while not (bag_file.exists() and bag_file.stat().st_size > 40e6):
            assert time.monotonic() < deadline
            newest = subscriber.wait(eyes[0], 1, after=newest)
            pair = newest and subscriber.aligned(eyes, newest.stamp_ns, timeout=0.5)
            if newest and pair:
                seen[newest.stamp_ns] = {name: pair[name].array.copy() for name in eyes}
        process.kill()
        process.wait()
    assert not (tmp_path / "bag/metadata.yaml").exists()
    result = sags("bag", "recover", tmp_path / "bag", "-o", tmp_path / "saved", "--json")
    assert result.exit_code == 3
    done = json.loads(result.stdout)
    assert done["chunks_damaged"] <= 1 and done["messages_lost"] == 0
    with AnyReader([tmp_path / "saved"]) as reader:
        assert reader.message_count == done["messages"] > 50
        every_second = {"/sags/diagnostics"}  # may not have come yet
        wanted = {f"/sags/{topic.name}" for topic in TOPICS}
        assert {c.topic for c in reader.connections} | every_second == wanted
    session = open_session(tmp_path / "saved", ["source.pace:=step"])
    compared = 0
    with session.source as source:
        for frame in source:
            published = seen.get(frame.t_capture_ns)
            if published is not None:
                assert np.array_equal(frame.left, published[eyes[0]])
                assert np.array_equal(frame.right, published[eyes[1]])
                compared += 1
    assert compared >= 5
    assert session.rig.baseline > 0 and session.rig.left.width == frame.left.shape[1]


def test_ctrl_c_closes_the_file_and_a_signal_takes_a_snapshot(node: Path, tmp_path: Path) -> None:
    straight = start_recorder(
        node, "-o", tmp_path / "bag", "--json", "--topics", "left/depth", "--topics", "/sags/tf"
    )
    ring = start_recorder(node, "-o", tmp_path / "ring", "--json", "--snapshot-mode", "1")
    assert straight.stderr is not None and ring.stderr is not None
    for process in (straight, ring):
        assert process.stderr is not None and "recording" in process.stderr.readline()
    frames_pass(node, 20)
    ring.send_signal(signal.SIGUSR1)
    assert any("snapshot_000" in line for line in ring.stderr)  # on a busy host messages may be lost before
    for process in (straight, ring):
        process.send_signal(signal.SIGINT)
        stdout, _ = process.communicate(timeout=30)
        assert process.returncode == 0
        summary = json.loads(stdout)
        assert summary["messages"] > 5
    assert {m.topic for m in read_messages(tmp_path / "bag")} == {"/sags/left/depth", "/sags/tf"}
    assert (tmp_path / "bag/metadata.yaml").exists()
    assert bag_info(tmp_path / "ring/snapshot_000")["messages"] > 5


@pytest.mark.fault("process: the recorder's terminal goes")
def test_the_end_of_the_terminal_closes_the_file(node: Path, tmp_path: Path) -> None:
    """As `ssh` that is cut off leaves it: the kernel sends SIGHUP, and nothing can be printed any more."""
    ours, theirs = pty.openpty()
    program = subprocess.Popen(
        ["setsid", "--ctty", "--wait", *recording_tf(tmp_path / "bag")],
        env={**os.environ, "XDG_RUNTIME_DIR": str(node)},
        stdin=theirs, stdout=theirs, stderr=theirs,
    )  # fmt: skip
    with killed(program) as process:
        os.close(theirs)
        until(lambda: b"recording: " in os.read(ours, 1000), START_SECONDS)
        frames_pass(node, 20)
        os.close(ours)
        process.wait(30)
    assert (tmp_path / "bag/metadata.yaml").exists()
    assert bag_info(tmp_path / "bag")["messages"] > 0


def test_a_recorder_that_nohup_started_outlives_its_terminal(node: Path, tmp_path: Path) -> None:
    command = ["nohup", *recording_tf(tmp_path / "bag")]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(node)}
    with killed(subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)) as process:
        while b"recording: " not in process.stderr.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGHUP)
        time.sleep(1)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


def test_recording_on_the_control_socket(node: Path, tmp_path: Path) -> None:
    with ControlClient(run_dir=node / "sags") as control:
        for wrong in ({}, {"path": "x", "speed": 3}, {"path": "x", "compression": "gif"}):
            with pytest.raises(SagsError, match="start_recording takes path"):
                control.request("start_recording", wrong, timeout=60)
        args = {"path": str(tmp_path / "bag"), "topics": ["left/depth"]}
        assert control.request("start_recording", args, timeout=60) == {"recording": str(tmp_path / "bag")}
        with pytest.raises(SagsError, match="running already"):
            control.request("start_recording", args, timeout=60)
        with pytest.raises(SagsError, match="snapshot_seconds"):  # the recording goes on
            control.request("take_snapshot", timeout=60)
        frames_pass(node, 15)
        summary = control.request("stop_recording", timeout=60)
        assert summary["messages"] == len(by_topic(tmp_path / "bag")["left/depth"]) > 3
        with pytest.raises(SagsError, match="exists already; name a new folder"):
            control.request("start_recording", args, timeout=60)


# ---- `sags bag record --session`: a recording goes through a node into a bag, and nothing is left ------


FRAMES = 6
WARM_UP = 2  # more, before them


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("session") / "played"
    write_session(
        PhantomSource(seconds=(WARM_UP + FRAMES) / 10, width=160, height=128, seed=3), folder, rate=10.0
    )
    return folder


def test_every_frame_after_the_warm_up_is_recorded_and_plays_again(session: Path, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    asked = (f"source.warm_up:={WARM_UP}", "--json")
    said = pure_json(sags("bag", "record", "-o", bag, "--session", session, *asked).stdout)
    assert (said["frames"], said["lost"], said["dropped"]) == (FRAMES, 0, 0)
    for topic in ("left/image_rect_color", "left/render/depth", "right/render/image", "splats"):
        assert said["topics"][f"sags/{topic}"]["messages"] == FRAMES
    with open_session(bag, ["source.pace:=step"]).source as source:
        assert len([frame for frame in source if frame.right is not None]) == FRAMES


def test_what_does_not_go_together_is_refused(session: Path, tmp_path: Path) -> None:
    record = ("bag", "record", "-o", tmp_path)
    refused(2, *record, "mapping.rung:=1", said=("mapping.rung:=1", "needs a recording"))
    refused(2, *record, "--session", session, "--seconds", "2", said=("no --snapshot-mode",))
    refused(2, *record, "--session", session, said=("exists already",))
    refused(2, *record, "--session", "source.kind:=v4l2", said=("name no recording",))
