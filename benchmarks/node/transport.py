"""`benchmarks transport`: what it costs to send one image to another process."""

import multiprocessing
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from benchmarks.node.processes import program
from sags_node.errors import SagsError
from sags_node.messaging.address import Address, ClientKeys, connect
from sags_node.messaging.security import KeyPair
from sags_node.messaging.sockets import bind
from sags_node.messaging.stream import MAX_MESSAGE_BYTES

FRAME_BYTES = 4_000_000
RATE = 30.0  # frames per second, so that nothing waits in a queue
WARM_UP = 10  # frames
STARTING, ARRIVING = 60.0, 10.0  # s, at most


def measure_transport(frames: int) -> list[dict[str, Any]]:
    """Measure the milliseconds from the send call to the arrival of a 4 MB frame, for each way a node offers.

    Sender and receiver are two processes of this machine.

    Raises:
        SagsError: the receiver does not start, or gets nothing.
    """
    node, client = (KeyPair(*zmq.curve_keypair()) for _ in range(2))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, endpoint, own in (
            ("ipc", f"ipc://{Path(folder) / 'bench'}", None),
            ("tcp", "tcp://127.0.0.1:*", None),
            ("tcp + CURVE", "tcp://127.0.0.1:*", node),
        ):
            keys = None if own is None else ClientKeys(client, node.public)
            took_ms = np.array(list(_send(name, endpoint, own, keys, frames)))[WARM_UP:]
            p50, p90 = np.percentile(took_ms, (50, 90))
            rows.append({"transport": name, "ms_p50": round(p50, 2), "ms_p90": round(p90, 2)})
    return rows


def _send(
    name: str, endpoint: str, own: KeyPair | None, keys: ClientKeys | None, frames: int
) -> Iterator[float]:
    context = zmq.Context()
    context.linger = 0
    socket = context.socket(zmq.XPUB)
    address = Address(bind(socket, endpoint, "publish.data", own), keys)
    here, there = multiprocessing.Pipe()
    with context, program(_receive, address, there):
        if not socket.poll(round(1000 * STARTING)):  # its subscription
            raise SagsError(f"the receiver did not start within {STARTING:g} s")
        socket.recv()
        frame = np.random.default_rng(0).integers(0, 255, FRAME_BYTES, np.uint8)
        for _ in range(WARM_UP + frames):
            sent_ns = time.monotonic_ns()
            socket.send_multipart([b"", frame.data], copy=False)
            if not here.poll(ARRIVING):
                raise SagsError(f"{name}: a frame did not arrive within {ARRIVING:g} s")
            yield (here.recv() - sent_ns) * 1e-6
            time.sleep(1 / RATE)


def _receive(address: Address, there: Connection) -> None:
    """Tell when each frame has come, on the clock that all processes share."""
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.subscribe("")
    connect(socket, address, MAX_MESSAGE_BYTES)
    while True:
        socket.recv_multipart(copy=False)
        there.send(time.monotonic_ns())
