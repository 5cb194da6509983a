"""Which client may ask for what, and how often."""

import time
from concurrent.futures import Future
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from independent_client import zmq_socket
from keyed_node import TOPIC, Node, error_of, make_keys, node
from waiting import repeating, until

from sags_node.errors import SagsError
from sags_node.mapping.anchors import MAX_ANCHORS
from sags_node.messaging.control import BURST, FORGET_ABOVE, MAX_PENDING_OF_ONE, RATE, RequestRate
from sags_node.messaging.requests import MAX_VIEW_HZ
from sags_node.messaging.roles import ROLES, Client, needed
from sags_node.messaging.security import read_allow_list, write_key_pair
from sags_node.node.views import MAX_VIEWS

# ---- where a role comes from ---------------------------------------------------------------------------


def test_the_folder_of_a_key_is_its_role(tmp_path: Path) -> None:
    clients = tmp_path / "clients"
    for folder in ("", *ROLES, "others"):
        write_key_pair(clients / folder, f"in_{folder}")
    named = {client.name: client.role for client in read_allow_list([clients]).values()}
    assert named == {"in_": "files", "in_listen": "listen", "in_control": "control", "in_files": "files"}
    (one,) = read_allow_list([clients / "listen/in_listen.pub"]).values()  # given by itself
    assert one == Client("in_listen", "listen")
    (clients / "listen").rename(clients / "Listen")  # must not give it more
    assert list(read_allow_list([clients / "Listen"]).values()) == [one]
    (clients / "Listen").rename(clients / "listen")
    # Who may watch may not therefore hand images in.
    assert {client.name for client in read_allow_list([clients], "source").values()} == {"in_"}


def test_of_a_key_in_several_folders_the_least_role_counts(tmp_path: Path) -> None:
    _, public = write_key_pair(tmp_path / "listen", "twice")
    for folder in (tmp_path, tmp_path / "control"):
        folder.mkdir(exist_ok=True)
        (folder / "twice.pub").write_bytes(public.read_bytes())
    assert list(read_allow_list([tmp_path]).values()) == [Client("twice", "listen")]


def test_an_operation_that_was_forgotten_takes_the_highest_role() -> None:
    """The operations of a node: `tests/node/test_node.py`."""
    assert needed("of_tomorrow") == "files"


# ---- over sockets --------------------------------------------------------------------------------------


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    return make_keys(tmp_path / "keys")


def answering(run_dir: Path, keys: Path | None = None, **config: Any) -> AbstractContextManager[Node]:
    """A node that answers; `wait` never is."""
    names = ("get_status", "pause", "save_model")
    handlers: dict[str, Any] = {name: lambda args: "done" for name in names}
    return node(run_dir, keys, handlers | {"wait": lambda args: Future()}, **config)


@pytest.mark.live
def test_each_role_may_do_its_own_and_what_those_before_it_may(
    tmp_path: Path, keys: Path, caplog: pytest.LogCaptureFixture
) -> None:
    refused = 0
    with answering(tmp_path / "run", keys) as one:
        for role in ROLES:
            with one.asker(f"clients/{role}/{role}") as asker:
                for op, least in (("get_status", "listen"), ("pause", "control"), ("save_model", "files")):
                    if ROLES.index(role) >= ROLES.index(least):
                        assert asker.request(op) == "done"
                    else:
                        refused += 1
                        why = f"takes the role '{least}'.*into the folder '{least}'"
                        with pytest.raises(SagsError, match=why):
                            asker.request(op)
        with one.subscriber("clients/listen/listen") as subscriber:
            assert subscriber.wait(TOPIC, 60) is not None
        assert one.running.connections["control"]["requests_not_allowed"] == refused == 3
    said = [record for record in caplog.records if "requests_not_allowed" in record.getMessage()]
    assert len(said) == 1 and "listen" in said[0].getMessage()  # the others came within seconds


@pytest.mark.live
@pytest.mark.fault("keys: a client's role is changed while it runs")
def test_a_role_changes_while_a_client_is_connected(tmp_path: Path, keys: Path) -> None:
    folders = keys / "clients"
    with answering(tmp_path / "run", keys) as one:
        with one.asker("clients/control/control") as asker:
            assert asker.request("pause") == "done"
            (folders / "control/control.pub").rename(folders / "listen/control.pub")
            until(lambda: "takes the role" in error_of(asker, "pause"))
            assert asker.request("get_status") == "done"
            (folders / "listen/control.pub").rename(folders / "files/control.pub")
            until(lambda: not error_of(asker, "save_model"))


@pytest.mark.live
@pytest.mark.parametrize("with_keys", [False, True])
def test_who_needs_no_key_may_do_everything(tmp_path: Path, keys: Path, with_keys: bool) -> None:
    """On loopback without keys, and by ipc also where there are some."""
    control = f"ipc://{tmp_path}/control.ipc" if with_keys else "tcp://127.0.0.1:*"
    with answering(tmp_path / "run", keys if with_keys else None, control=control) as one:
        with one.asker() as asker:
            assert asker.request("save_model") == "done"


# ---- how often -----------------------------------------------------------------------------------------


def test_the_limit_is_above_what_a_node_can_be_asked_for() -> None:
    assert RATE > MAX_VIEWS * MAX_VIEW_HZ
    assert BURST > MAX_ANCHORS + MAX_VIEWS


def test_a_bucket_gives_its_burst_and_then_its_rate() -> None:
    now = [7.0]
    rate = RequestRate(rate=10, burst=5, clock=lambda: now[0])
    assert [rate.wait(b"a") for _ in range(5)] == [0.0] * 5
    assert rate.wait(b"a") == pytest.approx(0.1)
    assert rate.wait(b"b") == 0.0  # another one's is its own
    now[0] += 0.05
    assert rate.wait(b"a") == pytest.approx(0.05)  # who was refused has lost nothing
    taken = 0
    for _ in range(1000):  # 10 s, asked 100 times a second
        now[0] += 0.01
        taken += rate.wait(b"a") == 0.0
    assert taken == pytest.approx(100, abs=1)
    now[0] += 100.0
    assert sum(rate.wait(b"a") == 0.0 for _ in range(20)) == 5  # no more than its burst is ever saved up


class Name(bytes):
    """Of a client; tells how many are held in memory."""

    held = 0

    def __init__(self, _: bytes) -> None:
        Name.held += 1

    def __del__(self) -> None:
        Name.held -= 1


def test_clients_are_forgotten_when_nothing_is_lost_by_it() -> None:
    now = [0.0]
    rate = RequestRate(rate=10, burst=2, clock=lambda: now[0])
    for number in range(3 * FORGET_ABOVE):
        now[0] += 0.1  # so that those before it are full again
        assert rate.wait(Name(b"%d" % number)) == 0.0
        assert Name.held <= FORGET_ABOVE
    assert rate.wait(b"%d" % number) == 0.0 and rate.wait(b"%d" % number) > 0.0


@pytest.mark.live
def test_a_client_that_was_refused_asks_again_by_itself_while_it_may_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates = iter((20, 1e-3))
    made = lambda: RequestRate(rate=next(rates), burst=1)  # noqa: E731
    monkeypatch.setattr("sags_node.messaging.control.RequestRate", made)
    with answering(tmp_path / "run") as one, one.asker() as asker:
        began = time.monotonic()
        assert [asker.request("pause", timeout=60) for _ in range(5)] == ["done"] * 5
        assert time.monotonic() - began > 0.19  # four waits of 1/20 s
    with answering(tmp_path / "run") as one, one.asker() as asker:
        assert asker.request("pause", timeout=60) == "done"
        with pytest.raises(SagsError, match=r"requests a second of one client"):
            asker.request("pause", timeout=5)


@pytest.mark.live
@pytest.mark.fault("socket: flooded with requests")
def test_a_flood_of_requests_does_not_slow_others(tmp_path: Path) -> None:
    with answering(tmp_path / "run") as one:
        running = one.running
        answers: list[Any] = []

        def flood(number: int) -> None:
            # What is owed to one client leaves room for the others, too.
            op = "wait" if number < 2 * MAX_PENDING_OF_ONE else "ping"
            if flooder.poll(1, zmq.POLLOUT):
                flooder.send(msgpack.packb({"v": "1.0", "id": 0, "op": op}))
            while flooder.poll(0):
                answers.append(msgpack.unpackb(flooder.recv()))

        began = time.monotonic()
        with zmq_socket(zmq.DEALER, running.connection.control) as flooder, repeating(flood):
            until(lambda: running.connections["control"]["requests_too_often"])
            with one.asker() as asker:
                for _ in range(100):
                    assert asker.request("pause", timeout=60) == "done"
                with pytest.raises(SagsError, match=r"no answer|not begun in the time"):  # not refused
                    asker.request("wait", timeout=0.2)
        served = sum(one["ok"] for one in answers)
        assert served <= BURST + RATE * (time.monotonic() - began)
        refused = [one for one in answers if one.get("code") == "too_often"]
        assert refused and all(0 < one["retry_after_s"] <= 1 / RATE for one in refused)
