"""The consumer's side of a connection: where the node is, which keys it wants, and why it refuses."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import zmq
from zmq.utils.monitor import recv_monitor_message

from sags_node.errors import SagsError, UsageError
from sags_node.messaging.rundir import read_connection
from sags_node.messaging.security import KeyPair, public_key, read_key_pair
from sags_node.messaging.sockets import HANDSHAKES, HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS

HANDSHAKE_MS = 5000
LOOK_S = 0.1  # s between looks for a node that is not there
RETRIES = 3  # failed handshakes in a row that count as a refusal; one alone may be a node that restarts

_HOW = "make a key pair with sags keygen, have its .pub put into publish.allow, give --key (client_keys)"


@dataclass(frozen=True, slots=True)
class ClientKeys:
    """A consumer's key pair, and the public key of the node where no connection file tells it."""

    own: KeyPair
    node: bytes | None = None


def client_keys(key: Path | str | None, node_key: str | None) -> ClientKeys | None:
    """Read the client's own `.key` file, and the node's public key (40 characters or a `.pub` file).

    Raises:
        UsageError: a file is not what it should be, or the node's key is given without an own one.
    """
    if key is None:
        if node_key is not None:
            raise UsageError(f"--server-key (node_key) needs --key: {_HOW}")
        return None
    return ClientKeys(read_key_pair(Path(key)), None if node_key is None else public_key(node_key))


@dataclass(frozen=True, slots=True)
class Address:
    """One socket of a node. `keys` are for tcp only: ipc is guarded by the rights of its file."""

    endpoint: str
    keys: ClientKeys | None = None


class Clock(Protocol):
    """A clock of another machine: `node_clock.NodeClock`."""

    @property
    def problem(self) -> str | None: ...
    def latest_ns(self) -> int: ...


@dataclass(frozen=True, slots=True)
class NodeAddress:
    """Where a sender is: a node, an overlay or a player. A socket that is not given is read from the
    connection file.

    Attributes:
        ns: namespace of its topics, and name of its connection file.
        endpoint: its data socket.
        control: its control socket.
        run_dir: of its connection file; default: the user's own.
        clock: of the sender's machine, which stamps what it sends; None: this machine's clock.
    """

    ns: str = "sags"
    endpoint: str | None = None
    control: str | None = None
    run_dir: Path | None = None
    keys: ClientKeys | None = None
    clock: Clock | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "ns", self.ns.strip("/"))  # as ROS writes it: /sags

    def now_ns(self) -> int:
        """Return the latest time (ns) that the sender's clock may show now."""
        return time.time_ns() if self.clock is None else self.clock.latest_ns()

    def data(self) -> Address:
        """The data socket given, or the quickest one in the connection file.

        Raises:
            SagsError: no node with that name runs here.
            UsageError: it wants keys that are not given, or keys are given that it does not want.
        """
        if self.endpoint is not None:
            return _given(self.endpoint, self.keys)
        connection = read_connection(self.ns, self.run_dir)
        return _known(connection.data[0], connection.public_key, self.keys)

    def control_socket(self) -> Address:
        """The control socket given, or the one in the connection file; see `data`.

        Raises:
            SagsError: also when the node has none, or a recording is played there.
        """
        if self.control is not None:
            return _given(self.control, self.keys)
        connection = read_connection(self.ns, self.run_dir)
        if connection.recording is not None:
            raise SagsError(
                f"a recording is played as '{self.ns}': it takes no requests, so it holds no anchors and no "
                f"views; a node does, with the recording's images: sags run "
                f"{shlex.quote(str(connection.recording))}"
            )
        if connection.control is None:
            raise SagsError(f"the node '{self.ns}' has no control socket; start it with publish.control set")
        return _known(connection.control, connection.public_key, self.keys)


def found(find: Callable[[], Address], deadline: float) -> Address:
    """Return the address of a node; while there is none, wait for it until `deadline` (s, monotonic).

    Raises:
        UsageError: there is one, and it wants other keys.
        SagsError: none came in time.
    """
    while True:
        try:
            return find()
        except UsageError:
            raise
        except SagsError:
            if time.monotonic() >= deadline:
                raise
        time.sleep(LOOK_S)


THE_NODE = NodeAddress()  # the default: the node of this machine


def _given(endpoint: str, keys: ClientKeys | None) -> Address:
    if endpoint.startswith("ipc:") or keys is None:
        return Address(endpoint)
    if keys.node is None:
        raise UsageError(
            f"{endpoint}: --key needs --server-key (client_keys: node_key), the .pub of the node"
        )
    return Address(endpoint, keys)


def _known(endpoint: str, node_key: str | None, keys: ClientKeys | None) -> Address:
    if endpoint.startswith("ipc:") or (node_key is None and keys is None):
        return Address(endpoint)
    if keys is None:
        raise UsageError(f"{endpoint} wants a key: {_HOW}")
    if node_key is None:
        raise UsageError(f"{endpoint} is not encrypted; leave out --key, or set publish.key for the node")
    return Address(endpoint, ClientKeys(keys.own, keys.node or node_key.encode()))


def connect(socket: zmq.Socket[bytes], address: Address, max_message_bytes: int) -> HandshakeWatch:
    """Connect a consumer's socket, bound what it takes in, and watch it from its own thread.

    Raises:
        SagsError: the endpoint is malformed.
    """
    endpoint = address.endpoint
    socket.setsockopt(zmq.MAXMSGSIZE, max_message_bytes)
    socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
    socket.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)  # a machine without power closes no connection
    socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, HEARTBEAT_TIMEOUT_MS)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.IPV6, int("[" in endpoint))
    if address.keys is not None:
        assert address.keys.node is not None  # `_given` and `_known` make sure
        socket.setsockopt(zmq.CURVE_PUBLICKEY, address.keys.own.public)
        socket.setsockopt(zmq.CURVE_SECRETKEY, address.keys.own.secret)
        socket.setsockopt(zmq.CURVE_SERVERKEY, address.keys.node)
    watch = HandshakeWatch(socket, address)
    try:
        socket.connect(endpoint)
    except zmq.ZMQError as error:
        raise SagsError(
            f"cannot connect to {endpoint}: {error.strerror}; e.g. tcp://127.0.0.1:5556"
        ) from None
    return watch


class HandshakeWatch:
    """Watches the handshakes of a consumer's socket: by itself a refused socket is merely silent."""

    def __init__(self, socket: zmq.Socket[bytes], address: Address) -> None:
        self._monitor = socket.get_monitor_socket(HANDSHAKES)
        self._address = address
        self._failures = 0  # in a row
        self._last = (0, 0)  # event and value of the last one

    def refusal(self) -> str | None:
        """Return why the node refuses this client, and how to fix it; None: it does not."""
        while self._monitor.poll(0):
            said = recv_monitor_message(self._monitor)
            if said["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._failures = 0
            else:
                self._failures += 1
                self._last = (int(said["event"]), int(said["value"]))
        return self._explained() if self._failures else None

    def _explained(self) -> str | None:
        endpoint, keys = self._address.endpoint, self._address.keys
        plain = keys is None
        if keys is not None and keys.own.public == keys.node:
            return (
                f"{endpoint} refuses: --key and --server-key (client_keys) are one pair; --key takes this "
                "client's own .key (sags keygen), --server-key the .pub of the node"
            )
        if self._last[0] == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            return f"{endpoint} refuses this key: have its .pub put into publish.allow, then start this anew"
        if self._last[1] == zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH:
            if plain:
                return f"{endpoint} wants a key: {_HOW}, and --server-key"
            return f"{endpoint} is not encrypted; leave out --key, or set publish.key for the node"
        if self._failures < RETRIES:
            return None
        # Some nodes are too quick: the connection is gone before their greeting was read.
        why = f"it probably wants a key: {_HOW}, and --server-key"
        if not plain:
            why = "is it encrypted at all, and is --server-key (node_key) the public key of this very node?"
        return f"{endpoint} breaks off the connection; {why}"
