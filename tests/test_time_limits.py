"""No wait for another process, thread or device is without an end."""

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from command_line import RUN_HERE
from places import SESSION

from sags_node import processes
from sags_node.config.schema import V4l2Source
from sags_node.errors import SagsError
from sags_node.messaging.publisher import Publisher
from sags_node.node.node import Node
from sags_node.pipeline.session import open_session
from sags_node.pipeline.warm_up import warm_up
from sags_node.sources import live
from sags_node.sources.pairing import Shot
from sags_node.sources.v4l2 import open_cameras

pytestmark = pytest.mark.live

LISTENS = "import time; print('begun', flush=True); time.sleep(99)"
DEAF = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); {LISTENS}"


@pytest.mark.parametrize(
    ("code", "grace", "ended_by"), [(DEAF, 0.1, signal.SIGKILL), (LISTENS, 30.0, signal.SIGTERM)]
)
def test_only_a_process_that_does_not_listen_is_killed(code: str, grace: float, ended_by: int) -> None:
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline()
        assert processes.end(process, grace)
        assert process.returncode == -ended_by


@pytest.mark.fault("process: the publishing thread fails")
def test_a_node_whose_publishing_fails_ends_with_that_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mapping waits until a result is taken where no frame may be lost; nobody takes it any more."""
    taken = threading.Event()

    def fail(*_: Any, **__: Any) -> None:
        if taken.is_set():
            time.sleep(1.0)  # the next result waits by now, and the one after it is computed
            raise SagsError("the socket broke")
        taken.set()

    monkeypatch.setattr(Publisher, "publish_result", fail)
    overrides = ["source.pace:=step", f"publish.run_dir:={tmp_path / 'run'}", *RUN_HERE]
    session = open_session(SESSION, [*overrides, "mapping.max_gaussians:=2000"])
    warm_up(session.config)  # compiles, once on a machine
    node = Node(session.config, session.rig, session.source)
    node.start()
    try:
        with pytest.raises(SagsError, match="the socket broke"):
            assert node.wait(timeout=60), "it did not end"
    finally:
        node.stop()


class HungCamera:
    """A driver that does not come back."""

    rate = 30.0
    size = 640, 480
    released = threading.Event()

    def read(self, timeout: float) -> Shot | None:
        self.released.wait(60)
        return None

    def close(self) -> None:
        assert self.released.is_set(), "closed under its reader"


@pytest.mark.fault("camera: its driver hangs while the node stops")
def test_a_driver_that_does_not_come_back_does_not_keep_the_node(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(live, "CLOSE_S", 0.1)
    config = V4l2Source(left="/dev/left", right="/dev/right")
    try:
        with open_cameras(config, open_device=lambda path, config: HungCamera()) as source:
            source.stop()
            assert list(source) == []
    finally:
        HungCamera.released.set()
    assert caplog.text.count("driver does not answer") == 2
