"""Keys and roles, who is let in and may ask for what, and what strangers can do to the node: nothing."""

import json
import logging
import os
import socket
import stat
import threading
import time
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from typing import Any

import hostile
import msgpack
import numpy as np
import pytest
import zmq
from click.testing import CliRunner, Result
from command_line import refused, sags
from independent_client import zmq_socket
from keyed_node import TOPIC, Node, error_of, make_keys, node, of
from running_node import RunningNode
from synthetic import publisher
from waiting import beside, repeating, until
from zmq.auth import load_certificate

from sags_node.cli.main import main
from sags_node.client import ClientKeys, client_keys
from sags_node.errors import SagsError, UsageError
from sags_node.messaging import control
from sags_node.messaging.control import ControlClient
from sags_node.messaging.peers import MAX_PEERS, Peers
from sags_node.messaging.roles import ROLES, Client, needed
from sags_node.messaging.security import read_allow_list, read_key_pair, write_key_pair
from sags_node.messaging.subscriber import Subscriber
from sags_node.processes import resident_mb

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_keys(tmp_path_factory.mktemp("keys"))


# ---- key files -----------------------------------------------------------------------------------------


def test_keygen_writes_a_private_and_a_public_file(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        outcome = CliRunner().invoke(main, ["keygen", "node", "--out", str(tmp_path / "keys")])
    finally:
        os.umask(old)
    assert outcome.exit_code == 0
    secret_file, public_file = tmp_path / "keys/node.key", tmp_path / "keys/node.pub"
    assert stat.S_IMODE(secret_file.stat().st_mode) == 0o600
    assert stat.S_IMODE(secret_file.parent.stat().st_mode) == 0o700
    public, secret = load_certificate(secret_file)
    assert secret is not None and zmq.curve_public(secret) == public
    assert load_certificate(public_file) == (public, None)
    pair = read_key_pair(secret_file)
    assert (pair.public, pair.secret) == (public, secret)
    for said in (outcome.output, public_file.read_text(), repr(pair), str(pair)):
        assert secret.decode() not in said


@pytest.mark.parametrize("there", ["node.key", "node.pub"])
def test_keygen_never_overwrites(tmp_path: Path, there: str) -> None:
    (tmp_path / there).write_text("precious")
    outcome = CliRunner().invoke(main, ["keygen", "node", "--out", str(tmp_path)])
    assert outcome.exit_code == 2
    assert [file.name for file in tmp_path.iterdir()] == [there]
    assert (tmp_path / there).read_text() == "precious"


@pytest.mark.fault("keys: readable by others")
@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o644])
def test_a_key_that_others_can_read_is_refused_with_the_fix(tmp_path: Path, keys: Path, mode: int) -> None:
    file, _ = write_key_pair(tmp_path, "node")
    file.chmod(mode)
    with pytest.raises(UsageError, match=rf"run: chmod 600 {file}") as raised:
        read_key_pair(file)
    assert load_certificate(file)[1].decode() not in str(raised.value)  # type: ignore[union-attr]  # there is one
    guarded = publisher(tmp_path / "run", key=file, allow=(keys / "clients",))
    with pytest.raises(UsageError, match="chmod 600"), guarded:
        pass
    file.chmod(0o600)
    read_key_pair(file)


@pytest.mark.fault("keys: anybody may write to the allow list")
@pytest.mark.parametrize("place", [".", "listen", "viewer.pub"])
def test_an_allow_list_that_anybody_may_write_to_is_refused(tmp_path: Path, place: str) -> None:
    write_key_pair(tmp_path, "viewer")
    (tmp_path / "listen").mkdir()
    assert len(read_allow_list([tmp_path])) == 1
    (tmp_path / place).chmod(0o777)
    with pytest.raises(UsageError, match=r"so let himself in; run: chmod o-w "):
        read_allow_list([tmp_path])


@pytest.mark.parametrize("content", [
    b"", b"public-key", b"\xff" * 100, b"public-key = x" * 1000,
    *(b'    public-key = "%s"\n' % key for key in (b"short", b"~" * 40, b"#" * 40)),
])  # fmt: skip
def test_one_bad_entry_in_the_allow_list_is_one_clear_error(tmp_path: Path, content: bytes) -> None:
    write_key_pair(tmp_path, "good")
    (tmp_path / "bad.pub").write_bytes(content)
    with pytest.raises(UsageError, match=r"bad\.pub"):
        read_allow_list([tmp_path])


def test_allow_lists(keys: Path, tmp_path: Path) -> None:
    viewer, stranger = (read_key_pair(keys / f"{name}.key") for name in ("clients/viewer", "stranger"))
    listed = read_allow_list([keys / "clients/viewer.pub", keys / "stranger.pub"])
    assert listed == {viewer.public: Client("viewer"), stranger.public: Client("stranger")}
    for read, place, said in (
        (read_allow_list, [tmp_path], r"no \.pub file"),
        (read_allow_list, [keys / "node.key"], "holds a secret key"),
        (read_key_pair, keys / "node.pub", "no secret key"),
        (read_key_pair, keys / "nobody.key", "there is no key file .*check the path, or make a pair"),
        (read_allow_list, [keys / "clients", keys / "nobody.pub"], "there is no key file"),
    ):
        with pytest.raises(UsageError, match=said):
            read(place)


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


def test_the_least_role_counts_of_a_key_in_several_folders(tmp_path: Path) -> None:
    """And the highest of an operation that was forgotten; those of a node: `tests/node/test_node.py`."""
    _, public = write_key_pair(tmp_path / "listen", "twice")
    for folder in (tmp_path, tmp_path / "control"):
        folder.mkdir(exist_ok=True)
        (folder / "twice.pub").write_bytes(public.read_bytes())
    assert list(read_allow_list([tmp_path]).values()) == [Client("twice", "listen")]
    assert needed("of_tomorrow") == "files"


# ---- who is let in -------------------------------------------------------------------------------------


def test_other_machines_only_with_keys_or_with_a_warning(
    tmp_path: Path, keys: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with node(tmp_path / "run", keys, data=("tcp://*:*",)) as secured:
        assert secured.running.connection.data[-1].startswith("tcp://0.0.0.0:") and not caplog.records
    with publisher(tmp_path / "run", data=("tcp://*:*",), insecure=True):
        assert "anybody" in caplog.text


def test_a_listed_key_gets_data_and_answers(tmp_path: Path, keys: Path) -> None:
    run_dir = tmp_path / "run"
    viewer = of(keys, "clients/viewer")
    by_file = {"run_dir": run_dir, "keys": ClientKeys(viewer.own)}
    with node(run_dir, keys, ipc=False), Subscriber([TOPIC], **by_file) as subscriber:
        assert subscriber.wait(TOPIC, 60) is not None and subscriber.refusal is None
        with ControlClient(**by_file) as asker:
            assert asker.request("ping") == "pong"
        said = (run_dir / "sags.json").read_text()
    assert json.loads(said)["public_key"] == viewer.node.decode()  # type: ignore[union-attr]  # `of` sets it
    assert read_key_pair(keys / "node.key").secret.decode() not in said


@pytest.mark.parametrize("which", ["data", "control"])
@pytest.mark.parametrize(
    ("client", "server", "why"),
    [
        ("stranger", "node", "refuses this key"),
        (None, "node", "wants a key"),
        ("clients/viewer", "stranger", "is --server-key (node_key) the public key of this very node"),
        ("node", "node", "are one pair"),
        ("clients/viewer", "clients/viewer", "are one pair"),
    ],
)
def test_others_are_refused_counted_and_told_why(
    tmp_path: Path, keys: Path, which: str, client: str | None, server: str, why: str
) -> None:
    with node(tmp_path / "run", keys) as secured:
        running = secured.running
        if which == "data":
            with secured.subscriber(client, server) as subscriber:
                until(lambda: why in str(subscriber.problem(TOPIC)))
                assert subscriber.latest(TOPIC) is None
        else:
            with secured.asker(client, server) as asker:
                until(lambda: why in error_of(asker))
        until(lambda: running.connections[which]["refused"] >= 1)
        assert running.connections[which]["unlisted_key"] == (client in ("stranger", "node"))
        other = {"data": "control", "control": "data"}[which]
        assert running.connections[other] == dict.fromkeys(running.connections[other], 0)
        assert not running.wanted(TOPIC)


@pytest.mark.parametrize(
    ("command", "needed"),
    [
        (("view", "--port", 0), "viser"),
        (("bridge", "web", "--port", 0), "websockets"),
        (("bag", "record"), "mcap"),
    ],
)
def test_what_waits_for_a_node_ends_where_that_refuses_it(
    tmp_path: Path, keys: Path, command: tuple[object, ...], needed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(needed, reason=f"{needed} is not installed")
    monkeypatch.setattr("sags_node.cli.node_options.KNOCK", 60.0)  # whatever else the machine does
    monkeypatch.setattr(os, "nice", lambda increment: 0)  # that is for a process of its own
    monkeypatch.chdir(tmp_path)
    with node(tmp_path / "run", keys) as secured:
        running, own = secured.running.connection, ("--key", keys / "clients/viewer.key")
        control = () if command[0] == "bag" else ("--control", running.control)
        where = ("--endpoint", running.data[-1], *control, *own, "--server-key", keys / "stranger.pub")
        refused(1, *command, *where, said=("is --server-key (node_key) the public key of this very node",))
    assert [file.name for file in tmp_path.iterdir()] == ["run"], "nothing was recorded"


@pytest.mark.fault("keys: revoked, added and broken while it runs")
def test_keys_are_revoked_and_added_while_the_node_runs(tmp_path: Path) -> None:
    keys, clients = tmp_path / "keys", tmp_path / "keys/clients"
    for folder, name in ((keys, "node"), (clients, "stays"), (clients, "goes"), (keys, "comes")):
        write_key_pair(folder, name)
    with node(tmp_path / "run", keys) as secured:
        with secured.subscriber("clients/stays") as stays, secured.subscriber("clients/goes") as goes:
            assert stays.wait(TOPIC, 60) is not None and goes.wait(TOPIC, 60) is not None
            (clients / "broken.pub").write_text("no key")  # lets nobody in, and keeps nobody out
            (clients / "goes.pub").unlink()
            until(lambda: goes.refusal)
            before = goes.latest(TOPIC)
            until(lambda: stays.problem(TOPIC) is None)
            assert goes.latest(TOPIC) is before
            with secured.subscriber("comes") as early:
                until(lambda: early.refusal)
            (keys / "comes.pub").rename(clients / "comes.pub")

            def gets_in() -> bool:
                with secured.asker("comes") as asker:
                    return not error_of(asker)

            until(gets_in)
            until(lambda: stays.problem(TOPIC) is None)


def test_missing_and_needless_keys_are_named_at_once(tmp_path: Path, keys: Path) -> None:
    run_dir = tmp_path / "run"
    viewer = ClientKeys(read_key_pair(keys / "clients/viewer.key"))
    with node(run_dir, keys, ipc=False):
        with pytest.raises(UsageError, match="wants a key: make a key pair with sags keygen"):
            ControlClient(run_dir=run_dir)
        with pytest.raises(UsageError, match="wants a key"):
            Subscriber([TOPIC], run_dir=run_dir)
    with publisher(run_dir) as plain:
        with pytest.raises(UsageError, match="is not encrypted; leave out --key"):
            ControlClient(run_dir=run_dir, keys=viewer)
        with (
            ControlClient(plain.connection.control, keys=of(keys, "clients/viewer")) as asker,
            pytest.raises(SagsError, match=r"is not encrypted; leave out --key|is it encrypted at all"),
        ):
            asker.request("ping", timeout=1.0)
    with pytest.raises(UsageError, match=r"--key needs --server-key \(client_keys: node_key\)"):
        Subscriber([TOPIC], endpoint="tcp://127.0.0.1:9", keys=viewer)
    with pytest.raises(UsageError, match=r"--server-key \(node_key\) needs --key: .*client_keys"):
        client_keys(None, str(keys / "node.pub"))
    for own in (keys / "stranger.key", str(keys / "stranger.key")):
        assert client_keys(own, str(keys / "node.pub")) == of(keys, "stranger")


def test_refusals_do_not_fill_the_log(tmp_path: Path, keys: Path, caplog: pytest.LogCaptureFixture) -> None:
    stranger = of(keys, "stranger")
    with caplog.at_level(logging.DEBUG, "sags_node"), node(tmp_path / "run", keys) as secured:
        for _ in range(8):
            with secured.subscriber("stranger") as subscriber:
                until(lambda subscriber=subscriber: subscriber.refusal is not None)
        until(lambda: secured.running.connections["data"]["unlisted_key"] == 8)
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) == 2
    assert any(stranger.own.public.decode() in warning for warning in warnings)
    assert stranger.own.secret.decode() not in caplog.text


# ---- what they may ask for, and how often --------------------------------------------------------------


def answering(run_dir: Path, keys: Path | None = None, **config: Any) -> AbstractContextManager[Node]:
    """A node that answers; `wait` never is."""
    names = ("get_status", "pause", "save_model")
    handlers: dict[str, Any] = {name: lambda args: "done" for name in names}
    return node(run_dir, keys, handlers | {"wait": lambda args: Future()}, **config)


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


@pytest.mark.fault("keys: a client's role is changed while it runs")
def test_a_role_changes_while_a_client_is_connected(tmp_path: Path) -> None:
    keys = make_keys(tmp_path / "keys")
    folders = keys / "clients"
    with answering(tmp_path / "run", keys) as one:
        with one.asker("clients/control/control") as asker:
            assert asker.request("pause") == "done"
            (folders / "control/control.pub").rename(folders / "listen/control.pub")
            until(lambda: "takes the role" in error_of(asker, "pause"))
            assert asker.request("get_status") == "done"
            (folders / "listen/control.pub").rename(folders / "files/control.pub")
            until(lambda: not error_of(asker, "save_model"))


@pytest.mark.parametrize("with_keys", [False, True])
def test_who_needs_no_key_may_do_everything(tmp_path: Path, keys: Path, with_keys: bool) -> None:
    """On loopback without keys, and by ipc also where there are some."""
    where = f"ipc://{tmp_path}/control.ipc" if with_keys else "tcp://127.0.0.1:*"
    with answering(tmp_path / "run", keys if with_keys else None, control=where) as one:
        with one.asker() as asker, Subscriber([TOPIC], run_dir=tmp_path / "run") as subscriber:
            assert asker.request("save_model") == "done"
            assert subscriber.endpoint.startswith("ipc:") and subscriber.wait(TOPIC, 30) is not None


def test_a_bucket_gives_its_burst_and_then_its_rate() -> None:
    now = [7.0]
    rate = control.RequestRate(rate=10, burst=5, clock=lambda: now[0])
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


def test_a_refused_client_asks_again_in_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rates = iter((20, 1e-3))
    limit = control.RequestRate
    monkeypatch.setattr(control, "RequestRate", lambda: limit(rate=next(rates), burst=1))
    with answering(tmp_path / "run") as one, one.asker() as asker:
        began = time.monotonic()
        assert [asker.request("pause", timeout=60) for _ in range(5)] == ["done"] * 5
        assert time.monotonic() - began > 0.19  # four waits of 1/20 s
    with answering(tmp_path / "run") as one, one.asker() as asker:
        assert asker.request("pause", timeout=60) == "done"
        with pytest.raises(SagsError, match=r"requests a second of one client"):
            asker.request("pause", timeout=5)


@pytest.mark.fault("socket: flooded with requests")
def test_a_flood_of_requests_does_not_slow_others(tmp_path: Path) -> None:
    with answering(tmp_path / "run") as one:
        running = one.running
        answers: list[Any] = []

        def flood(number: int) -> None:
            # What is owed to one client leaves room for the others, too.
            op = "wait" if number < 2 * control.MAX_PENDING_OF_ONE else "ping"
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
        assert served <= control.BURST + control.RATE * (time.monotonic() - began)
        refused = [one for one in answers if one.get("code") == "too_often"]
        assert refused and all(0 < one["retry_after_s"] <= 1 / control.RATE for one in refused)


# ---- strangers -----------------------------------------------------------------------------------------


@pytest.mark.fault("socket: random bytes")
@pytest.mark.fault("socket: half open, silent or HTTP")
@pytest.mark.parametrize("with_keys", [False, True])
def test_random_bytes_on_both_ports_while_a_client_receives(
    tmp_path: Path, keys: Path, with_keys: bool
) -> None:
    rng = np.random.default_rng(9)
    greeting = b"\xff" + bytes(8) + b"\x7f"
    starts = (b"", greeting, greeting + b"\x03\x00NULL", b"\x01\x00", b"GET / HTTP/1.1\r\n\r\n")
    with node(tmp_path / "run", keys if with_keys else None) as attacked:
        running, connection = attacked.running, attacked.running.connection
        with attacked.serves_on("clients/viewer"):
            before, opened = resident_mb(), _descriptors()
            for i in range(400):
                endpoint = str(connection.control if i % 2 else connection.data[-1])
                with hostile.raw(endpoint) as stranger:
                    more = rng.bytes(int(rng.integers(1, 3000))) if i % 3 else b""
                    stranger.sendall(starts[i % len(starts)] + more)
            until(lambda: sum(running.connections[name]["refused"] for name in ("data", "control")) == 400)
            assert resident_mb() - before < 30
            until(lambda: _descriptors() <= opened)
        with attacked.asker("clients/viewer") as asker:
            assert asker.request("ping") == "pong"


@pytest.mark.fault("socket: too many connections")
def test_peers_are_capped_and_those_who_are_in_stay_in(tmp_path: Path) -> None:
    with node(tmp_path / "run") as attacked:
        running = attacked.running
        with attacked.serves_on() as subscriber:
            crowd: list[socket.socket] = []
            for _ in range(MAX_PEERS + 30):
                with suppress(ConnectionError):  # it may be cut off before it stands
                    crowd.append(hostile.raw(running.connection.data[-1]))
            until(lambda: running.connections["data"]["too_many"] >= 31)
            until(lambda: running.connections["data"]["open"] <= MAX_PEERS)
            assert subscriber.wait(TOPIC, 30, after=subscriber.latest(TOPIC)) is not None
            for connection in crowd:
                connection.close()
            with attacked.subscriber() as late:
                assert late.wait(TOPIC, 30) is not None


@pytest.mark.fault("socket: a peer vanishes at once, and its descriptor is that of a file when it is noticed")
def test_the_descriptor_of_who_has_gone_is_no_peer() -> None:
    may_look, looks = threading.Event(), threading.Event()

    def revocations() -> int:  # asked by the thread that watches the peers, after each look
        if threading.current_thread() is not threading.main_thread():
            looks.set()
            assert may_look.wait(60)
        return 0

    with zmq_socket(zmq.XPUB, "tcp://127.0.0.1:*", bind=True) as socket:
        peers = Peers(socket, "data", 1000, revocations)
        endpoint = socket.getsockopt_string(zmq.LAST_ENDPOINT)
        assert looks.wait(60)
        before = _descriptors()
        visitors = [hostile.raw(endpoint) for _ in range(20)]
        until(lambda: _descriptors() >= before + 40)  # both ends are open
        for visitor in visitors:
            visitor.close()
        until(lambda: _descriptors() <= before)
        with ExitStack() as files:
            for _ in range(40):
                files.enter_context(open(os.devnull, "rb"))
            may_look.set()
            until(lambda: peers.counts()["refused"] == 20)
            until(lambda: _descriptors() <= before + 40)
            assert peers.counts()["open"] == 0
        peers.close()


SUBSCRIPTIONS = b"".join(b"\x00\xc9\x01" + np.random.default_rng(i).bytes(200) for i in range(2000))
ENDLESS = b"".join(b"\x01\xc9" + bytes(201) for _ in range(2000))  # each part says: more to come


@pytest.mark.fault("socket: flooded")
@pytest.mark.parametrize(
    ("which", "kind", "block"),
    [
        pytest.param("data", b"SUB", SUBSCRIPTIONS, id="subscriptions"),
        pytest.param("control", b"DEALER", ENDLESS, id="an endless message"),
    ],
)
def test_a_flood_is_cut_off(tmp_path: Path, which: str, kind: bytes, block: bytes) -> None:
    """ZeroMQ would keep them all."""
    with node(tmp_path / "run") as attacked:
        running = attacked.running
        endpoint = str(running.connection.control if which == "control" else running.connection.data[-1])
        with attacked.serves_on():
            before = resident_mb()
            sent: list[int] = []
            with beside(lambda: sent.append(hostile.flood(endpoint, kind, block, 2.0))):
                until(lambda: running.connections[which]["flooding"])
            assert sent[0] > len(block)
            assert resident_mb() - before < 100


def test_a_reply_too_large_for_the_client_is_not_taken() -> None:
    def answer() -> None:
        identity, _ = router.recv_multipart()
        router.send_multipart([identity, bytes(8 << 20)])

    with zmq_socket(zmq.ROUTER, "tcp://127.0.0.1:*", bind=True) as router:
        with beside(answer), ControlClient(router.getsockopt_string(zmq.LAST_ENDPOINT)) as asker:
            with pytest.raises(SagsError, match="no answer"):
                asker.request("ping", timeout=0.5)


# ---- the whole, with a process ---------------------------------------------------------------------------


def test_a_secured_node_as_a_process(phantom_session: Path, keys: Path, tmp_path: Path) -> None:
    secured = (f"publish.key:={keys}/node.key", f"publish.allow:={keys}/clients", "publish.data:=[tcp://*:*]")
    with RunningNode(phantom_session, tmp_path, *secured) as process:
        where = "tcp://127.0.0.1:" + process.data.rpartition(":")[2]

        def tf_rate(own: str) -> Result:
            by_key = ("--key", own, "--server-key", f"{keys}/node.pub") if own else ()
            return sags("topic", "hz", "tf", "--endpoint", where, "--seconds", "0.7", "--json", *by_key)

        # A busy machine may send none at first, and a refusal may come after the listening.
        good = until(lambda: json.loads(tf_rate(f"{keys}/clients/viewer.key").stdout or "{}"))
        assert good["average_rate"] > 0
        for own, why in ((f"{keys}/stranger.key", "refuses this key"), ("", "wants a key")):
            until(lambda own=own, why=why: (said := tf_rate(own)).exit_code == 1 and why in said.stderr)
        viewer = ClientKeys(read_key_pair(keys / "clients/viewer.key"))
        with ControlClient(run_dir=process.run_dir, keys=viewer) as asker:
            connections = asker.request("get_status")["connections"]
        assert connections["data"]["unlisted_key"] >= 1 and connections["data"]["refused"] >= 2
    said = process.said()
    assert "Traceback" not in said
    assert read_key_pair(keys / "stranger.key").public.decode() in said.replace("\n", "").replace(" ", "")


def _descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))
