"""A node that restarts, dies or falls silent is followed as soon as it is back."""

import subprocess
import sys
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from cable import Cable
from command_line import killed
from keyed_node import make_keys, node
from places import HELPERS
from ports import free_port
from synthetic import publisher, stream
from waiting import until

from sags_node.errors import SagsError, UsageError
from sags_node.messaging import address
from sags_node.messaging.control import ControlClient
from sags_node.messaging.subscriber import Subscriber

pytestmark = pytest.mark.live


def _node(
    run_dir: Path, session: str, port: int, ipc: bool
) -> AbstractContextManager[subprocess.Popen[bytes]]:
    """A publisher in its own process, which ends with SIGKILL and so leaves its files behind."""
    program = (
        "import time; from pathlib import Path; from synthetic import publisher, stream\n"
        f"data, handlers = ('tcp://127.0.0.1:{port}',), {{'who': lambda args: {session!r}}}\n"
        f"with publisher(Path({str(run_dir)!r}), handlers, data=data, ipc={ipc}) as running:\n"
        f"    running.session = {session!r}\n"
        "    with stream(running):\n"
        "        time.sleep(60)\n"
    )
    return killed(subprocess.Popen([sys.executable, "-c", program], cwd=HELPERS))


@pytest.mark.fault("process: the node is killed, another begins in its place")
def test_a_killed_node_is_followed(tmp_path: Path) -> None:
    """To the same port, to the same ipc socket, and to another port by who has it from the file."""
    run_dir, port = tmp_path / "run", free_port()
    with _node(run_dir, "first", port, ipc=True):
        until((run_dir / "sags.json").exists)
        by_port, by_file = (
            Subscriber(["tf"], run_dir=run_dir, endpoint=end) for end in (f"tcp://127.0.0.1:{port}", None)
        )
        asker = ControlClient(run_dir=run_dir)
        for subscriber in (by_port, by_file):
            found = subscriber.wait("tf", 30)
            assert found is not None and found.meta.session == asker.request("who", timeout=30) == "first"
    with by_port, by_file, asker:
        for session, ipc, following in (("second", True, (by_port, by_file)), ("third", False, (by_file,))):
            until(lambda following=following: not any(each.ok("tf") for each in following))
            before, asked = [each.endpoint for each in following], asker.endpoint
            with pytest.raises(SagsError, match=f"no answer from {asked} in 0.3 s"):
                asker.request("who", timeout=0.3)
            with _node(run_dir, session, port if ipc else free_port(), ipc):
                for each in following:
                    until(lambda each=each, session=session: each.latest("tf").meta.session == session)
                    until(lambda each=each: each.ok("tf"))
                    assert each.lost("tf") == 0
                assert asker.request("who", timeout=30) == session and asker.endpoint != asked
                assert ([each.endpoint for each in following] == before) == ipc


def _answers(asker: ControlClient) -> bool:
    try:
        return asker.request("ping", timeout=0.5) == "pong"
    except SagsError:
        return False


@pytest.mark.fault("socket: the cable is cut, that of requests too")
def test_a_silent_connection_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that lost its power closes nothing: only a missing heartbeat tells."""
    monkeypatch.setattr(address, "HEARTBEAT_MS", 100)
    monkeypatch.setattr(address, "HEARTBEAT_TIMEOUT_MS", 300)
    with publisher(tmp_path / "run", ipc=False) as running, stream(running):
        with Cable(running.connection.data[0]) as cable:
            with Subscriber(["tf"], endpoint=cable.endpoint) as subscriber:
                assert subscriber.wait("tf", 30) is not None
                before = cable.connections
                cable.cut()
                until(lambda: not subscriber.ok("tf"))
                until(lambda: subscriber.ok("tf"))
                assert cable.connections > before
        with Cable(str(running.connection.control)) as cable, ControlClient(cable.endpoint) as asker:
            assert asker.request("ping", timeout=30) == "pong"
            cable.cut()
            until(lambda: _answers(asker))
            assert cable.connections == 2


def test_a_client_says_why_it_has_no_node_whatever_becomes_of_it(tmp_path: Path) -> None:
    """There is none yet, it wants a key, it does not, it has ended, and the next one wants a key again."""
    run_dir, keys = tmp_path / "run", make_keys(tmp_path / "keys")
    with Subscriber(["tf"], run_dir=run_dir, may_be_absent=True) as subscriber:
        assert "no node runs as 'sags'" in str(subscriber.problem("tf")) and not subscriber.endpoint
        with node(run_dir, keys, ipc=False):
            until(lambda: "wants a key" in str(subscriber.problem("tf")))
        with node(run_dir):
            until(lambda: subscriber.ok("tf"))
            assert subscriber.refusal is None
            asker = ControlClient(run_dir=run_dir)
            assert asker.request("ping") == "pong"
        until(lambda: "no node runs as 'sags'" in str(subscriber.problem("tf")))
        with asker, node(run_dir, keys, ipc=False):
            until(lambda: "wants a key" in str(subscriber.problem("tf")))
            with pytest.raises(UsageError, match="wants a key"):
                asker.request("ping")
            with pytest.raises(UsageError, match="wants a key"):
                Subscriber(["tf"], run_dir=run_dir, may_be_absent=True)
