"""The command: a node, a bridge and a peer, each a process of its own; and what the command refuses."""

import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from command_line import killed, refused, start
from igtl_peer import PEER, Peer, built
from places import SESSION
from running_node import RunningNode
from waiting import until

pytestmark = pytest.mark.live


@contextmanager
def bridge(run_dir: Path, *command: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """`sags bridge` and its port."""
    with killed(start(["bridge", *command, "--json", "--run-dir", run_dir])) as process:
        line = process.stdout.readline()  # ends with the process
        assert line, process.stderr.read()
        yield process, json.loads(line)["port"]


def state(joined: Peer) -> str:
    return (joined.newest("SagsState") or ["0"])[0]


@pytest.mark.fault("process: a bridge is killed; the node is killed under a bridge")
def test_a_pinned_anchor_comes_back_and_a_killed_node_leaves_nothing_standing(tmp_path: Path) -> None:
    pytest.importorskip("pyigtl", reason="no OpenIGTLink without: pip install '.[bridges]'")
    program = built(PEER, tmp_path)
    run_dir = tmp_path / "run"
    with bridge(run_dir, "openigtlink", "--port", "0") as (first, port):
        with Peer(program, port, "say", "SagsRequest", "pin 150 120") as early:
            until(lambda: "no node" in " ".join(early.newest("SagsAnswer") or []).lower())
        with RunningNode(SESSION, tmp_path, "source.pace:=realtime") as node:
            with Peer(program, port) as joined:
                until(lambda: state(joined) == "1")
                with Peer(program, port, "say", "SagsRequest", "pin 150 120"):
                    until(lambda: "anchor" in " ".join(joined.newest("SagsAnchors") or []))
                first.send_signal(signal.SIGKILL)  # the node goes on
            with (
                bridge(run_dir, "openigtlink", "--port", str(port)) as (second, _),
                Peer(program, port) as joined,
            ):
                until(lambda: "anchor" in " ".join(joined.newest("SagsAnchors") or []))
                until(lambda: state(joined) == "1")
                os.kill(node.process.pid, signal.SIGKILL)
                until(lambda: (joined.newest("SagsAnchors") or [""])[0].startswith("none"))
                until(lambda: state(joined) == "13")
                second.send_signal(signal.SIGINT)
                assert second.wait(60) == 0
                assert second.stderr is not None and "Traceback" not in second.stderr.read()


OPEN = "would show", "without keys or encryption", "--insecure"
BRIDGES, ROS2 = "pip install '.[bridges]'", "pip install '.[ros2]'"


@pytest.mark.parametrize(
    ("command", "needs", "missing", "said"),
    [
        ("openigtlink --host 0.0.0.0", "", "", ("--host 0.0.0.0", *OPEN)),
        ("foxglove --host 0.0.0.0", "", "", ("--host 0.0.0.0", *OPEN)),
        ("web --host 0.0.0.0", "", "", ("--host 0.0.0.0", *OPEN)),
        ("ros2 --interface eth0", "", "", ("--interface eth0", *OPEN)),  # said before ROS is needed
        ("ros2 --interface 'no such' --insecure", "cyclonedds", "", ("no such",)),
        ("ros2 --interface none0 --insecure", "cyclonedds", "", ("there are:",)),
        ("ros2 --view a/b", "cyclonedds", "", ("--view 'a/b'",)),
        ("openigtlink", "", "pyigtl", ("needs pyigtl", BRIDGES)),
        ("foxglove", "", "foxglove", ("needs foxglove-sdk", BRIDGES)),
        ("web", "", "websockets", ("needs websockets", BRIDGES)),
        ("ros2", "", "cyclonedds.domain", (ROS2,)),
    ],
)
def test_what_may_not_be_or_cannot_be_is_refused(
    command: str, needs: str, missing: str, said: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A place that is open to others, a view that is none, and an extra that is not installed."""
    if needs:
        pytest.importorskip(needs, reason=f"ROS 2 needs: {ROS2}")
    if missing:
        monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.setattr(os, "nice", lambda by: 0)  # this process goes on
    refused(2, "bridge", *shlex.split(command), said=said)
