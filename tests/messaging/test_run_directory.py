"""The run directory of a node that runs: whatever becomes of it, the node is found again."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from synthetic import publisher, stream
from waiting import until

from sags_node.messaging import publisher as publishing
from sags_node.messaging.rundir import connection_path, read_connection
from sags_node.messaging.subscriber import Subscriber

pytestmark = pytest.mark.live

Remove = Callable[[Path], object]


@pytest.fixture(autouse=True)
def looks_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publishing, "LOOK_SECONDS", 0.02)


def the_directory(run_dir: Path) -> None:
    shutil.rmtree(run_dir)


def the_connection_file(run_dir: Path) -> None:
    connection_path(run_dir, "sags").unlink()


def the_socket(run_dir: Path) -> None:
    (run_dir / "sags.ipc").unlink()


@pytest.mark.fault("run directory: it, its file or its socket is removed")
@pytest.mark.parametrize("remove", [the_directory, the_connection_file, the_socket])
def test_what_is_removed_comes_back(remove: Remove, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run_dir = tmp_path / "run"
    with publisher(run_dir) as running, stream(running), Subscriber(["tf"], run_dir=run_dir) as old:
        assert old.endpoint.startswith("ipc:") and old.wait("tf", 30) is not None
        remove(run_dir)
        until(lambda: "is there again" in caplog.text)
        assert read_connection("sags", run_dir) == running.connection
        assert run_dir.stat().st_mode & 0o777 == 0o700
        with Subscriber(["tf"], run_dir=run_dir) as new:
            assert new.endpoint.startswith("ipc:")
            newest = new.wait("tf", 30)
            assert newest is not None and old.wait("tf", 30, after=newest) is not None
        assert old.lost("tf") == 0
        assert caplog.text.count("is there again") == 1
    assert not (run_dir / "sags.json").exists() and not (run_dir / "sags.ipc").exists()


@pytest.mark.fault("run directory: another node has taken the place")
def test_the_place_that_another_node_has_taken_is_left_to_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run_dir = tmp_path / "run"
    with ExitStack() as meanwhile:
        with publisher(run_dir, ipc=False) as first:
            shutil.rmtree(run_dir)
            second = meanwhile.enter_context(publisher(run_dir, ipc=False))
            for _ in range(10):
                first.poll(10)
            assert caplog.text.count("another node already runs as 'sags'") == 1
        assert read_connection("sags", run_dir) == second.connection


@pytest.mark.fault("run directory: open to others")
def test_a_directory_that_is_open_to_others_is_not_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run_dir = tmp_path / "run"
    with publisher(run_dir) as running:
        shutil.rmtree(run_dir)
        run_dir.mkdir()
        os.chmod(run_dir, 0o777)
        for _ in range(10):
            running.poll(10)
        assert caplog.text.count("is open to other users") == 1 and not any(run_dir.iterdir())
        os.chmod(run_dir, 0o700)
        until(lambda: running.poll(10) or (run_dir / "sags.json").exists())
