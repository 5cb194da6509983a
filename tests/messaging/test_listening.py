"""Where a publisher listens: sockets, run directory and the file that tells of them."""

import json
import os
import re
import resource
import shlex
import shutil
import stat
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zmq
from independent_client import zmq_socket
from synthetic import health, publisher, stream
from waiting import until

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import PublishConfig
from sags_node.errors import SagsError, UsageError
from sags_node.messaging import publisher as publishing
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.rundir import RunDirectory, read_connection
from sags_node.messaging.subscriber import Subscriber

pytestmark = pytest.mark.live


def test_run_directory_and_connection_file_are_private(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with publisher(run_dir) as running:
        file = run_dir / "sags.json"
        assert stat.S_IMODE(run_dir.stat().st_mode) == 0o700
        assert all(stat.S_IMODE(each.stat().st_mode) == 0o600 for each in (file, run_dir / "sags.ipc"))
        said = json.loads(file.read_text())
        assert said["pid"] == os.getpid() and said["protocol"] == "1.0" and said["ns"] == "sags"
        assert said["public_key"] is None and said["session"] == "session-1"
        assert said["data"] == running.connection.data
        assert said["data"][0] == f"ipc://{run_dir}/sags.ipc"
        assert said["control"].startswith("tcp://127.0.0.1:")
        assert read_connection("sags", run_dir) == running.connection
    assert not file.exists() and not (run_dir / "sags.ipc").exists()
    with pytest.raises(SagsError, match="sags run"):
        read_connection("sags", run_dir)


@pytest.mark.fault("run directory: the connection file is damaged")
def test_a_damaged_connection_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "sags.json").write_bytes(b"{" * 100_000)
    with pytest.raises(SagsError, match="damaged"):
        read_connection("sags", tmp_path)


@pytest.mark.fault("run directory: somebody else may have written the connection file")
def test_a_connection_file_of_somebody_else_is_not_believed(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with publisher(run_dir) as running:
        for path, wrong, right in ((run_dir, 0o720, 0o700), (run_dir / "sags.json", 0o602, 0o600)):
            path.chmod(wrong)
            with pytest.raises(UsageError, match=f"chmod go-w {path}"):
                read_connection("sags", run_dir)
            path.chmod(right)
        link = tmp_path / "link"
        link.symlink_to(run_dir)
        for path in (link, run_dir) if os.getuid() == 0 else ():
            assert read_connection("sags", path) == running.connection
            os.chown(path, 65534, -1, follow_symlinks=False)
            with pytest.raises(UsageError, match="not yours alone"):
                read_connection("sags", path)
            os.chown(path, 0, -1, follow_symlinks=False)


@pytest.mark.fault("socket: one subscriber asks for more views than are noted")
def test_one_subscriber_takes_no_view_from_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publishing, "MAX_PREFIXES", 4)
    with publisher(tmp_path / "run") as running, ExitStack() as stay:
        endpoint = running.connection.data[-1]
        with zmq_socket(zmq.SUB, endpoint) as greedy:
            for number in range(5):
                greedy.subscribe(f"sags/view/{number}")
            until(lambda: running.poll(10) or running.watches_view("4"))
            other = stay.enter_context(zmq_socket(zmq.SUB, endpoint))
            other.subscribe("sags/view/surgeon/image")
            until(lambda: running.poll(10) or running.connections["data"]["open"] == 2)
        until(lambda: running.poll(10) or running.connections["data"]["open"] == 1)
        assert running.watches_view("surgeon") and running.wanted("view/surgeon/image")
        assert not running.wanted("left/depth")


@pytest.mark.parametrize("endpoint", [
    "tcp://*:5556", "tcp://0.0.0.0:5556", "tcp://192.168.1.4:5556", "tcp://[::]:5556", "tcp://eth0:5556",
    "udp://127.0.0.1:1", "127.0.0.1:5556", "tcp://", "ipc://@sags", "tcp://127.0.0.1:99999",
])  # fmt: skip
@pytest.mark.parametrize("key", ["data", "control"])
def test_other_machines_are_refused(tmp_path: Path, key: str, endpoint: str) -> None:
    value: Any = (endpoint,) if key == "data" else endpoint
    with pytest.raises(UsageError) as refused, publisher(tmp_path / "run", **{key: value}):
        pass
    fixes = r"set publish\.key and publish\.allow.* publish\.insecure:=true|is no endpoint|every user"
    assert re.search(fixes, str(refused.value))
    assert not (tmp_path / "run").exists()


@pytest.mark.fault("socket: the port is taken")
def test_one_name_one_node(tmp_path: Path) -> None:
    """A second one is told all the keys that it needs, by its name or by the first port that is taken."""
    first = PublishConfig(data=("tcp://127.0.0.1:*",), control="tcp://127.0.0.1:*", run_dir=tmp_path / "run")
    with Publisher(first, "sags", "session", {}) as running:
        data, control = running.connection.data[1], running.connection.control
        same = first.model_copy(update={"data": (data,), "control": control})
        other_data = same.model_copy(update={"data": first.data})
        for config, ns, said in (
            (same, "sags", "another node already runs as 'sags' .* ns:=NAME .*overlay: --own-ns NAME"),
            (same, "other", f"{data} is already in use"),
            (other_data, "other", f"{control} is already in use"),
        ):
            with pytest.raises(SagsError, match=said) as refused, Publisher(config, ns, "session", {}):
                pass
            keys = [word for word in shlex.split(str(refused.value)) if word.startswith("publish.")]
            followed = load_launch(None, [*keys, f"publish.run_dir:={first.run_dir}"]).publish
            with Publisher(followed, "other", "session", {}) as second:
                assert len(second.connection.data) == 2 and second.connection.control not in (None, control)
    with publisher(tmp_path / "run"):
        pass


@pytest.mark.parametrize("ns", ["", "../sags", "a b", "a\nb", "a//b"])
def test_no_sender_has_a_name_that_no_topic_may_have(ns: str, tmp_path: Path) -> None:
    """Neither a node nor an overlay or a player, whose names no launch file has checked."""
    config = PublishConfig(data=("tcp://127.0.0.1:*",), control=None, run_dir=tmp_path / "run")
    with pytest.raises(UsageError, match="is no namespace"), Publisher(config, ns, "session"):
        pass
    assert not (tmp_path / "run").exists()


@pytest.mark.fault("process: it may open fewer files than its clients need")
def test_a_low_limit_of_files_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (publishing.ENOUGH_FILES - 1, before[1]))
        with publisher(tmp_path / "run"):
            assert "ulimit -n" in caplog.text
        resource.setrlimit(resource.RLIMIT_NOFILE, (publishing.FEWEST_FILES - 1, before[1]))
        with pytest.raises(UsageError, match="ulimit -n"), publisher(tmp_path / "run"):
            pass
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_run_directory_that_is_open_a_link_or_too_long_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    (tmp_path / "real").mkdir(mode=0o700)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    for run_dir, said in (
        (tmp_path, "chmod 700"),
        (tmp_path / "link", "not a directory of yours"),
        (tmp_path / ("x" * 100), "too long"),
    ):
        with pytest.raises(UsageError, match=said), publisher(run_dir):
            pass


def test_no_control_socket(tmp_path: Path) -> None:
    with publisher(tmp_path / "run", data=(), control=None) as running:
        assert running.connection.control is None and len(running.connection.data) == 1
        running.publish_health(health())
        assert running.poll(0) is False


# ---- the run directory of a node that runs: whatever becomes of it, the node is found again ------------


@pytest.fixture(autouse=True)
def looks_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publishing, "LOOK_SECONDS", 0.02)


@pytest.mark.fault("run directory: it, its file or its socket is removed")
@pytest.mark.parametrize("what", [".", "sags.json", "sags.ipc"], ids=["directory", "file", "socket"])
def test_what_is_removed_comes_back(what: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run_dir = tmp_path / "run"
    with publisher(run_dir) as running, stream(running), Subscriber(["tf"], run_dir=run_dir) as old:
        assert old.endpoint.startswith("ipc:") and old.wait("tf", 30) is not None
        if what == ".":  # at once: while it is emptied, the node would put its file back
            shutil.rmtree(run_dir.rename(tmp_path / "gone"))
        else:
            (run_dir / what).unlink()
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
def test_a_place_that_was_taken_is_left(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
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


def test_a_relative_run_directory_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    place = RunDirectory(Path("run"), "sags")
    try:
        assert place.ipc_endpoint == f"ipc://{tmp_path}/run/sags.ipc"
    finally:
        place.close()
