"""Messages as they arrive: the one place that reads the data socket on the consumer's side."""

from __future__ import annotations

import difflib
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import zmq

from sags_node.errors import SagsError, UsageError
from sags_node.messaging import topics, wire
from sags_node.messaging.rundir import read_connection

MAX_MESSAGE_BYTES = 128 << 20  # of one part: a 4096 x 4096 picture of 8 bytes a pixel
RECEIVE_HIGH_WATER = 32
POLL_MS = 100  # how soon a reader notices that it should end


def data_endpoint(endpoint: str | None, ns: str, run_dir: Path | None = None) -> str:
    """The given endpoint, or the quickest one in the connection file of `ns`.

    Raises:
        SagsError: no node with that name runs here.
    """
    return endpoint if endpoint is not None else read_connection(ns, run_dir).data[0]


def check_topic(name: str) -> topics.Topic:
    """The entry of a topic named without its namespace.

    Raises:
        UsageError: there is no such topic.
    """
    if name not in topics.BY_NAME:
        near = difflib.get_close_matches(name, topics.BY_NAME, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"topics: {', '.join(topics.BY_NAME)}"
        raise UsageError(f"unknown topic '{name}'; {hint}")
    return topics.BY_NAME[name]


@contextmanager
def data_socket(endpoint: str, prefixes: Sequence[str]) -> Iterator[zmq.Socket[bytes]]:
    """A SUB socket for every topic that begins with one of `prefixes`.

    Raises:
        SagsError: the endpoint is malformed.
    """
    context = zmq.Context()
    try:
        socket = context.socket(zmq.SUB)
        socket.setsockopt(zmq.RCVHWM, RECEIVE_HIGH_WATER)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.IPV6, int("[" in endpoint))
        for prefix in prefixes:
            socket.setsockopt_string(zmq.SUBSCRIBE, prefix)
        try:
            socket.connect(endpoint)
        except zmq.ZMQError as error:
            raise SagsError(
                f"cannot connect to {endpoint}: {error.strerror}; e.g. tcp://127.0.0.1:5556"
            ) from None
        yield socket
    finally:
        context.destroy(linger=0)


def receive(socket: zmq.Socket[bytes]) -> wire.Message:
    """The next message, over the memory it was received into.

    Raises:
        WireError: it is none.
        zmq.Again: nothing has arrived.
    """
    frames = [socket.recv(zmq.NOBLOCK, copy=False)]
    while frames[-1].more:
        part = socket.recv(zmq.NOBLOCK, copy=False)
        if len(frames) > wire.MAX_PARTS:
            frames.pop()  # too many already: read to the end, keep nothing more
        frames.append(part)
    return wire.decode([frame.buffer for frame in frames])


def listen(
    names: Sequence[str], endpoint: str | None, ns: str, seconds: float | None, run_dir: Path | None = None
) -> Iterator[tuple[wire.Message, int] | None]:
    """Every message of some topics and its time of arrival, for up to `seconds`.

    Topics may be named with or without `ns`; naming none means all.

    Yields None at least every `POLL_MS` while nothing arrives, so that a caller can keep time. What is no
    message is left out.

    Raises:
        UsageError: an unknown topic.
        SagsError: no endpoint is known.
    """
    known = [check_topic(name.lstrip("/").removeprefix(f"{ns}/")) for name in names]
    prefixes = [topics.full_name(ns, topic.name) for topic in known] or [f"{ns}/"]
    deadline = None if seconds is None else time.monotonic() + seconds
    with data_socket(data_endpoint(endpoint, ns, run_dir), prefixes) as socket:
        while deadline is None or time.monotonic() < deadline:
            if not socket.poll(POLL_MS):
                yield None
                continue
            try:
                yield receive(socket), time.time_ns()
            except wire.WireError:
                continue
