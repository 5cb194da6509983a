"""Messages as they arrive: the one place that reads the data socket on the consumer's side."""

import difflib
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager

import zmq

from sags_node.errors import SagsError, UsageError
from sags_node.messaging import cdr, topics, wire
from sags_node.messaging.address import Address, HandshakeWatch, NodeAddress, connect
from sags_node.messaging.sockets import receive_frames

MAX_MESSAGE_BYTES = 128 << 20  # of one part: a 4096 x 4096 image of 8 bytes a pixel
RECEIVE_HIGH_WATER = 32
POLL_MS = 100  # after which a reader notices that it should end


def check_topic(name: str) -> topics.Topic:
    """The entry of a topic named without its namespace.

    Raises:
        UsageError: there is no such topic.
    """
    topic = topics.find(name)
    if topic is None and name.startswith(topics.THIN):
        topics.thin_picture(name)  # says what is wrong with it
    if topic is None:
        near = difflib.get_close_matches(name, topics.BY_NAME, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"topics: {', '.join(topics.BY_NAME)}"
        raise UsageError(f"unknown topic '{name}'; {hint}")
    return topic


@contextmanager
def data_socket(
    address: Address, prefixes: Sequence[str], high_water: int = RECEIVE_HIGH_WATER
) -> Iterator[tuple[zmq.Socket[bytes], HandshakeWatch]]:
    """Open a SUB socket for every topic that begins with one of `prefixes`, with its handshake watch.

    Raises:
        SagsError: the endpoint is malformed.
    """
    context = zmq.Context()
    try:
        socket = context.socket(zmq.SUB)
        socket.setsockopt(zmq.RCVHWM, high_water)
        for prefix in prefixes:
            socket.setsockopt_string(zmq.SUBSCRIBE, prefix)
        yield socket, connect(socket, address, MAX_MESSAGE_BYTES)
    finally:
        context.destroy(linger=0)


def receive(socket: zmq.Socket[bytes]) -> wire.Message:
    """The next message; its parts are views of the memory it was received into.

    Raises:
        WireError: it is malformed.
        zmq.Again: nothing has arrived.
    """
    return wire.decode([frame.buffer for frame in receive_frames(socket, wire.MAX_PARTS)])


def _refuse(topic: str, why: str) -> None:
    raise SagsError(why)


def listen_to(
    node: NodeAddress,
    names: Sequence[str],
    seconds: float | None,
    high_water: int = RECEIVE_HIGH_WATER,
    refused: Callable[[str, str], None] = _refuse,
) -> Generator[tuple[wire.Message, int] | None, None, None]:
    """Yield every message of some topics and its time of arrival (ns), for up to `seconds`.

    Topics may be named with or without the namespace; naming none means all. Up to `high_water` messages wait
    when the caller is slow.

    Yields None at least every `POLL_MS` while none of them arrives, so that a caller can keep time.
    Malformed messages are left out. If a thin image cannot be made, its topic brings the reason: `refused`
    gets the topic and the reason instead.

    Raises:
        UsageError: an unknown topic.
        SagsError: no endpoint is known, the node refuses this client, or it says why it cannot make a thin
            image.
    """
    ns = node.ns
    known = [check_topic(topics.plain_name(ns, name)) for name in names]
    wanted = {topics.full_name(ns, topic.name): topic.type for topic in known}
    prefixes = sorted(wanted) or [f"{ns}/"]
    deadline = None if seconds is None else time.monotonic() + seconds
    with data_socket(node.data(), prefixes, high_water) as (socket, watch):
        while deadline is None or time.monotonic() < deadline:
            if not socket.poll(POLL_MS):
                if (refusal := watch.refusal()) is not None:
                    raise SagsError(refusal)
                yield None
                continue
            try:
                message = receive(socket)
                if message.meta.type == topics.STRING and wanted.get(message.topic) == cdr.COMPRESSED:
                    refused(message.topic, cdr.parse(message).data)
                    yield None
                    continue
            except wire.WireError:
                continue
            # A subscription is a prefix: that to `depth` also brings `depth_confidence`.
            yield None if wanted and message.topic not in wanted else (message, time.time_ns())
