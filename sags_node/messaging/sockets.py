"""What every socket here has in common: bounded memory, and never more read than a message may hold."""

import errno
import os
from collections.abc import Iterator
from typing import Self

import zmq

from sags_node.errors import SagsError
from sags_node.messaging.security import ZAP_DOMAIN, KeyPair

OWN_SOCKETS = "'publish.data:=[tcp://127.0.0.1:*]' 'publish.control:=tcp://127.0.0.1:*'"  # of a second node
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 2000, 6000
RECEIVE_BUFFER = 16384  # bytes in the kernel; those of an expelled peer are still read
HANDSHAKES = (  # events of a socket's monitor
    zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
HANDSHAKE_MS = 3000  # a peer that has not finished its handshake by then is cut off


class Closes:
    """Something whose `with` block ends with `close`."""

    def close(self) -> None:
        """Give back what it holds."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def limit(
    socket: zmq.Socket[bytes], send_high_water: int, receive_high_water: int, max_part_bytes: int
) -> None:
    """Bound what one peer can make a bound socket hold. ZeroMQ cannot bound the number of parts."""
    socket.setsockopt(zmq.SNDHWM, send_high_water)
    socket.setsockopt(zmq.RCVHWM, receive_high_water)
    socket.setsockopt(zmq.MAXMSGSIZE, max_part_bytes)
    socket.setsockopt(zmq.RCVBUF, RECEIVE_BUFFER)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
    socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, HEARTBEAT_TIMEOUT_MS)
    socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
    socket.setsockopt(zmq.ZAP_DOMAIN, ZAP_DOMAIN)


def bind(socket: zmq.Socket[bytes], endpoint: str, option: str, keys: KeyPair | None) -> str:
    """Bind and return the endpoint as bound (a `*` port becomes its number).

    With `keys` a tcp endpoint speaks CURVE; an ipc endpoint never does: only the owner may open its file.

    Args:
        option: the key of the launch file that names the endpoint, or of the command line; for the message.

    Raises:
        SagsError: the endpoint is taken or cannot be bound.
    """
    ipc = endpoint.startswith("ipc:")
    socket.setsockopt(zmq.IPV6, int("[" in endpoint))
    if keys is not None:
        socket.setsockopt(zmq.CURVE_SECRETKEY, keys.secret)
    socket.setsockopt(zmq.CURVE_SERVER, int(keys is not None and not ipc))  # of what is bound from here on
    try:
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        ours = dict.fromkeys(("publish.data", "publish.control"), OWN_SOCKETS)
        examples = ours | {"--endpoint": "--endpoint tcp://127.0.0.1:5560"}
        hint = f"choose another, e.g. {examples.get(option, f'{option}:=tcp://127.0.0.1:5561')}"
        taken = error.errno == errno.EADDRINUSE
        reason = "is already in use" if taken else f"cannot be bound: {error.strerror}"
        raise SagsError(f"{endpoint} {reason}; {hint}") from None
    bound = socket.getsockopt_string(zmq.LAST_ENDPOINT)
    if ipc:
        os.chmod(bound.removeprefix("ipc://"), 0o600)
    return bound


def waiting(socket: zmq.Socket[bytes], most: int, most_parts: int) -> Iterator[list[zmq.Frame]]:
    """Read the messages that have arrived, at most `most` of them, so that no peer occupies the reader.
    `most_parts` is the limit of `receive_frames`."""
    for _ in range(most):
        try:
            yield receive_frames(socket, most_parts)
        except zmq.Again:
            return


def receive_frames(socket: zmq.Socket[bytes], most: int) -> list[zmq.Frame]:
    """The next message, without waiting. Of the parts beyond `most` only the last one is kept.

    Raises:
        zmq.Again: nothing has arrived.
    """
    frames = [socket.recv(zmq.NOBLOCK, copy=False)]
    while frames[-1].more:
        frame = socket.recv(zmq.NOBLOCK, copy=False)
        if len(frames) > most:
            frames.pop()
        frames.append(frame)
    return frames
