"""`sags run` under a service manager: what systemd is told, what it is told by the exit code, and the log."""

import json
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import RUN_HERE, killed, sags, start
from places import SESSION
from waiting import START_SECONDS

from sags_node.node import service_manager
from sags_node.node.node import Node
from sags_node.node.service_manager import PINGS, ServiceManager
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.pipeline.warm_up import warm_up

WATCHDOG = 0.6  # s


class Manager:
    """The other side of the protocol."""

    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self.address = address
        self.heard: list[tuple[str, float]] = []

    def environment(self, pid: int | None = None) -> dict[str, str]:
        period = {"WATCHDOG_USEC": str(round(WATCHDOG * 1e6))}
        return {"NOTIFY_SOCKET": self.address, **period} | ({} if pid is None else {"WATCHDOG_PID": str(pid)})

    def listen(self, seconds: float, until: str | None = None) -> list[str]:
        """All that comes for so long, or until a message begins so."""
        came = []
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            self._socket.settimeout(left)
            try:
                message = self._socket.recv(4096).decode()
            except TimeoutError:
                break
            came.append(message)
            if until is not None and message.startswith(until):
                return came
        assert until is None, f"no {until} within {seconds} s, only {came}"
        return came

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    listening = Manager(str(tmp_path / "notify"))
    yield listening
    listening.close()


def test_a_ping_needs_all_loops_and_is_sent_seldom(manager: Manager, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0  # s
    monkeypatch.setattr(service_manager, "time", SimpleNamespace(monotonic=lambda: now))
    told = ServiceManager(manager.environment())
    told.turned("mapping")
    assert manager.listen(0.05) == []
    for _ in range(60):
        told.turned("mapping")
        told.turned("publishing")
        now += WATCHDOG / 60
    pings = manager.listen(0.05)
    assert set(pings) == {"WATCHDOG=1"} and PINGS <= len(pings) <= PINGS + 1
    now += WATCHDOG / PINGS
    for _ in range(3):
        told.turned("publishing")
    assert manager.listen(0.05) == []


def test_nothing_is_sent_where_nobody_asked_or_listens(manager: Manager) -> None:
    alone = ServiceManager({})
    other = manager.environment(pid=os.getpid() + 1)
    for told in (alone, ServiceManager(other)):  # the watchdog of another process
        told.turned("mapping")
        told.turned("publishing")
    alone.ready()
    assert manager.listen(0.05) == []
    assert not other, "children would believe that it is for them"
    told = ServiceManager(manager.environment())
    manager.close()
    told.ready()


@pytest.mark.fault("process: the mapping hangs")
@pytest.mark.live
def test_pings_end_when_the_mapping_hangs(
    manager: Manager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    overrides = [f"publish.run_dir:={tmp_path / 'run'}", *RUN_HERE, "source.pace:=step", "source.loop:=true"]
    session = open_session(SESSION, [*overrides, "mapping.max_gaussians:=2000"])
    warm_up(session.config)
    node = Node(session.config, session.rig, session.source, manager=ServiceManager(manager.environment()))
    hang, hangs, released = (threading.Event() for _ in range(3))
    process = Pipeline.process

    def hanging(*arguments: object) -> object:
        if hang.is_set():
            hangs.set()
            released.wait(60)
        return process(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Pipeline, "process", hanging)
    node.start()
    try:
        manager.listen(START_SECONDS, until="WATCHDOG=1")
        hang.set()
        assert hangs.wait(60)
        manager.listen(0.1)  # those of before
        assert manager.listen(3 * WATCHDOG).count("WATCHDOG=1") <= 1  # for which the mapping had come round
        released.set()
        manager.listen(60, until="WATCHDOG=1")
    finally:
        released.set()
        node.stop()


@pytest.mark.live
def test_a_service_is_told_and_tells(manager: Manager, phantom_session: Path, run_dir: Path) -> None:
    command = ["--log", "json", "run", phantom_session, "source.loop:=true", *RUN_HERE]
    with killed(start(command, **manager.environment())) as process:
        manager.listen(START_SECONDS, until="READY=1")
        manager.listen(60, until="STATUS=running")
        for _ in range(3):
            manager.listen(60, until="WATCHDOG=1")
        healthy = sags("health", "--json")
        assert healthy.exit_code == 0 and json.loads(healthy.stdout)["healthy"] is True
        os.killpg(process.pid, signal.SIGTERM)
        manager.listen(60, until="STOPPING=1")
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 0
    assert all(isinstance(json.loads(line)["message"], str) for line in stderr.splitlines())
    gone = sags("health")
    assert gone.exit_code == 1 and "error:" in gone.stderr


def test_an_error_is_one_event_of_the_log(tmp_path: Path) -> None:
    process = start(["--log", "json", "run", tmp_path / "none.yaml"])
    _, stderr = process.communicate(timeout=START_SECONDS)
    event = json.loads(stderr)
    assert process.returncode == 2 and event["level"] == "error" and "none.yaml" in event["message"]
    assert event["time"].endswith("+00:00")
