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
from command_line import killed, refused, sags, start
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


OPEN = ("without keys or encryption", "--insecure")


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("openigtlink --host 0.0.0.0", ("--host 0.0.0.0 would show", *OPEN)),
        ("foxglove --host 0.0.0.0", ("--host 0.0.0.0 would show", *OPEN)),
        ("web --host 0.0.0.0", ("--host 0.0.0.0 would show", *OPEN)),
        ("ros2 --interface eth0", ("--interface eth0 would show", *OPEN)),
        ("ros2 --interface 'no such' --insecure", ("no such",)),
        ("ros2 --interface none0 --insecure", ("there are:",)),
        ("ros2 --view a/b", ("--view 'a/b'",)),
    ],
)
def test_a_place_or_a_view_that_may_not_be_or_cannot_be_is_refused(
    command: str, said: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    if said[-1] not in OPEN:  # that is said before ROS is needed
        pytest.importorskip("cyclonedds", reason="ROS 2 needs: pip install '.[ros2]'")
    monkeypatch.setattr(os, "nice", lambda by: 0)  # this process goes on
    refused(2, "bridge", *shlex.split(command), said=said)


@pytest.mark.parametrize(
    ("command", "module", "said"),
    [
        ("openigtlink", "pyigtl", ("needs pyigtl", "pip install '.[bridges]'")),
        ("foxglove", "foxglove", ("needs foxglove-sdk", "pip install '.[bridges]'")),
        ("web", "websockets", ("needs websockets", "pip install '.[bridges]'")),
        ("ros2", "cyclonedds.domain", ("pip install '.[ros2]'",)),
    ],
)
def test_a_missing_extra_is_named_with_the_way_to_get_it(
    command: str, module: str, said: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr(os, "nice", lambda by: 0)
    refused(2, "bridge", command, said=said)


def test_the_help_says_when_to_use_which() -> None:
    text = sags("bridge", "--help").stdout
    assert "3D Slicer" in text and "sags bridge openigtlink" in text
    assert all(command in text for command in ("sags bridge foxglove", "sags bridge ros2", "sags view"))
    assert "Unity" in text and "sags bridge web" in text and "sags bridge gst" in text
