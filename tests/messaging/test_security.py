"""Keys, who is let in, and what strangers can do to the node: nothing."""

import json
import logging
import os
import stat
import threading
from contextlib import ExitStack
from pathlib import Path

import hostile
import numpy as np
import pytest
import zmq
from click.testing import CliRunner, Result
from command_line import sags
from independent_client import zmq_socket
from keyed_node import TOPIC, error_of, make_keys, node, of
from running_node import RunningNode
from synthetic import publisher
from waiting import beside, until
from zmq.auth import load_certificate

from sags_node.cli.main import main
from sags_node.client import ClientKeys, client_keys
from sags_node.errors import SagsError, UsageError
from sags_node.messaging.control import ControlClient
from sags_node.messaging.peers import MAX_PEERS, Peers
from sags_node.messaging.roles import Client
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


@pytest.mark.parametrize("name", ["../node", "a/b", "", ".hidden", "a b"])
def test_a_key_name_is_a_file_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="no name for a key"):
        write_key_pair(tmp_path / "keys", name)
    assert not (tmp_path / "keys").exists()


@pytest.mark.fault("keys: readable by others")
@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o644])
def test_a_key_that_others_can_read_is_refused_with_the_fix(tmp_path: Path, keys: Path, mode: int) -> None:
    file, _ = write_key_pair(tmp_path, "node")
    file.chmod(mode)
    with pytest.raises(UsageError, match=rf"run: chmod 600 {file}") as raised:
        read_key_pair(file)
    assert load_certificate(file)[1].decode() not in str(raised.value)  # type: ignore[union-attr]  # there is one
    with (
        pytest.raises(UsageError, match="chmod 600"),
        publisher(tmp_path / "run", key=file, allow=(keys / "clients",)),
    ):
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


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"public-key",
        b"\xff" * 100,
        b'    public-key = "short"\n',
        b'    public-key = "' + b"~" * 40 + b'"\n',
        b'    public-key = "' + b"#" * 40 + b'"\n',
        b"public-key = x" * 1000,
    ],
)
def test_one_bad_entry_in_the_allow_list_is_one_clear_error(
    keys: Path, tmp_path: Path, content: bytes
) -> None:
    write_key_pair(tmp_path, "good")
    (tmp_path / "bad.pub").write_bytes(content)
    with pytest.raises(UsageError, match=r"bad\.pub"):
        read_allow_list([tmp_path])


def test_allow_lists(keys: Path, tmp_path: Path) -> None:
    viewer, stranger = (read_key_pair(keys / f"{name}.key") for name in ("clients/viewer", "stranger"))
    listed = read_allow_list([keys / "clients/viewer.pub", keys / "stranger.pub"])
    assert listed == {viewer.public: Client("viewer"), stranger.public: Client("stranger")}
    with pytest.raises(UsageError, match=r"no \.pub file"):
        read_allow_list([tmp_path])
    with pytest.raises(UsageError, match="holds a secret key"):
        read_allow_list([keys / "node.key"])
    with pytest.raises(UsageError, match="no secret key"):
        read_key_pair(keys / "node.pub")


# ---- who is let in -------------------------------------------------------------------------------------


def test_other_machines_only_with_keys_or_with_a_warning(
    tmp_path: Path, keys: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with node(tmp_path / "run", keys, data=("tcp://*:*",)) as secured:
        assert secured.running.connection.data[-1].startswith("tcp://0.0.0.0:")
    assert not caplog.records
    with publisher(tmp_path / "run", data=("tcp://*:*",), insecure=True):
        assert "anybody" in caplog.text


def test_a_listed_key_gets_data_and_answers(tmp_path: Path, keys: Path) -> None:
    run_dir = tmp_path / "run"
    viewer = of(keys, "clients/viewer")
    by_file = {"run_dir": run_dir, "keys": ClientKeys(viewer.own)}
    with node(run_dir, keys) as secured:
        for subscriber, asker in (
            (secured.subscriber("clients/viewer"), secured.asker("clients/viewer")),
            (Subscriber([TOPIC], **by_file), ControlClient(**by_file)),
        ):
            with subscriber, asker:
                assert subscriber.wait(TOPIC, 60) is not None and subscriber.refusal is None
                assert asker.request("ping") == "pong"
        said = json.loads((run_dir / "sags.json").read_text())
        assert said["public_key"] == viewer.node.decode()  # type: ignore[union-attr]  # `of` sets it
        secret = read_key_pair(keys / "node.key").secret.decode()
        assert secret not in (run_dir / "sags.json").read_text()


@pytest.mark.parametrize("which", ["data", "control"])
@pytest.mark.parametrize(
    ("client", "server", "why"),
    [
        ("stranger", "node", "refuses this key"),
        (None, "node", "wants a key"),
        ("clients/viewer", "stranger", "is --server-key (node_key) the public key of this very node"),
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
        assert running.connections[which]["unlisted_key"] == (client == "stranger")
        other = {"data": "control", "control": "data"}[which]
        assert running.connections[other] == dict.fromkeys(running.connections[other], 0)
        assert not running.wanted(TOPIC)


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
            assert stays.wait(TOPIC, 60) is not None
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


def test_ipc_needs_no_key_and_belongs_to_its_user(tmp_path: Path, keys: Path) -> None:
    run_dir = tmp_path / "run"
    with node(run_dir, keys), Subscriber([TOPIC], run_dir=run_dir) as subscriber:
        assert subscriber.endpoint.startswith("ipc:")
        assert subscriber.wait(TOPIC, 30) is not None
        assert stat.S_IMODE((run_dir / "sags.ipc").stat().st_mode) == 0o600


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


def test_refusals_reach_the_log_but_do_not_fill_it(
    tmp_path: Path, keys: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stranger = of(keys, "stranger")
    with caplog.at_level(logging.DEBUG, "sags_node"), node(tmp_path / "run", keys) as secured:
        for _ in range(20):
            with secured.subscriber("stranger") as subscriber:
                until(lambda subscriber=subscriber: subscriber.refusal is not None)
        until(lambda: secured.running.connections["data"]["unlisted_key"] == 20)
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) == 2
    assert any(stranger.own.public.decode() in warning for warning in warnings)
    assert stranger.own.secret.decode() not in caplog.text


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


def test_a_peer_of_the_old_protocol_is_no_subscriber(tmp_path: Path) -> None:
    """ZMTP 1.0 has no signature: any bytes could be a subscription to everything."""
    with publisher(tmp_path / "run") as running, hostile.raw(running.connection.data[-1]) as stranger:
        stranger.sendall(b"\x01\x00\x02\x00\x01")
        stranger.settimeout(0.05)
        for _ in range(20):
            running.poll(20)
        assert not running.wanted(TOPIC)
        until(lambda: running.connections["data"] == {**running.connections["data"], "open": 0, "refused": 1})


@pytest.mark.fault("socket: too many connections")
def test_peers_are_capped_and_those_who_are_in_stay_in(tmp_path: Path) -> None:
    with node(tmp_path / "run") as attacked:
        running = attacked.running
        with attacked.serves_on() as subscriber:
            crowd = hostile.crowd(running.connection.data[-1], MAX_PEERS + 30)
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
    ("which", "kind", "block"), [("data", b"SUB", SUBSCRIPTIONS), ("control", b"DEALER", ENDLESS)]
)
def test_a_flood_is_cut_off(tmp_path: Path, which: str, kind: bytes, block: bytes) -> None:
    """Endless subscriptions and endless messages; ZeroMQ would keep them all."""
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


def test_a_secured_node_as_a_process_and_its_clients(
    phantom_session: Path, keys: Path, tmp_path: Path
) -> None:
    secured = (f"publish.key:={keys}/node.key", f"publish.allow:={keys}/clients", "publish.data:=[tcp://*:*]")
    with RunningNode(phantom_session, tmp_path, *secured) as process:
        port = process.data.rpartition(":")[2]
        where = ["--endpoint", f"tcp://127.0.0.1:{port}"]
        listed = [*where, "--key", f"{keys}/clients/viewer.key", "--server-key", f"{keys}/node.pub"]
        # A busy machine may send none at first.
        good = until(lambda: json.loads(tf_rate(*listed).stdout or "{}"))
        assert good["average_rate"] > 0
        stranger = [*where, "--key", f"{keys}/stranger.key", "--server-key", f"{keys}/node.pub"]
        assert until(lambda: said_once(tf_rate(*stranger), "refuses this key")).exit_code == 1
        assert until(lambda: said_once(tf_rate(*where), "wants a key")).exit_code == 1
        viewer = ClientKeys(read_key_pair(keys / "clients/viewer.key"))
        with ControlClient(run_dir=process.run_dir, keys=viewer) as asker:
            connections = asker.request("get_status")["connections"]
        assert connections["data"]["unlisted_key"] >= 1 and connections["data"]["refused"] >= 2
    said = process.said()
    assert "Traceback" not in said
    assert read_key_pair(keys / "stranger.key").public.decode() in said.replace("\n", "").replace(" ", "")


def said_once(result: Result, words: str) -> Result | None:
    """The result, once it says these words: on a busy machine a refusal may come after the listening."""
    return result if words in result.stderr else None


def tf_rate(*options: str) -> Result:
    return sags("topic", "hz", "tf", "--seconds", "1.5", "--json", *options)


def _descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))
