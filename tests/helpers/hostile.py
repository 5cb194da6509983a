"""Strangers: requests that are none, raw bytes on a port, and peers that speak ZeroMQ to do harm."""

import socket
import time
from typing import Any

import msgpack
import numpy as np


def _random_value(rng: np.random.Generator, depth: int = 0) -> Any:
    choices: list[Any] = [
        None, True, -1, 2**64 - 1, float("nan"), "x" * int(rng.integers(300)), rng.bytes(20),
    ]  # fmt: skip
    if depth < 3:
        choices += [
            [_random_value(rng, depth + 1) for _ in range(int(rng.integers(4)))],
            {str(i): _random_value(rng, depth + 1) for i in range(int(rng.integers(4)))},
            msgpack.ExtType(int(rng.integers(128)), b"ext"),
        ]
    return choices[int(rng.integers(len(choices)))]


def random_request(rng: np.random.Generator) -> bytes:
    kind = int(rng.integers(6))
    if kind == 0:
        return rng.bytes(int(rng.integers(200)))
    if kind == 1:
        return b"\x91" * int(rng.integers(1, 60_000))  # arrays in arrays
    if kind == 2:
        return b"\x81\xa4args" + b"\x81" * 2000 + b"\xc0"  # maps as keys of maps
    fields = {"v": "1.0", "id": int(rng.integers(99)), "op": "echo", "args": {"a": _random_value(rng)}}
    if kind == 3:
        fields[str(rng.choice(["v", "id", "op", "args"]))] = _random_value(rng)
    body = bytearray(msgpack.packb(fields))
    if kind == 4:
        body[int(rng.integers(len(body)))] = int(rng.integers(256))
    return bytes(body)


def is_reply(body: bytes) -> bool:
    reply = msgpack.unpackb(body, strict_map_key=False, ext_hook=lambda code, data: data)
    return reply["v"] == "1.0" and isinstance(reply["ok"], bool)


def raw(endpoint: str) -> socket.socket:
    """A plain tcp connection to a ZeroMQ endpoint."""
    host, port = endpoint.removeprefix("tcp://").split(":")
    return socket.create_connection((host, int(port)), timeout=2)


def greet(connection: socket.socket, kind: bytes) -> None:
    """Make a raw connection a ZMTP 3.0 peer without encryption, of socket type `kind`."""
    connection.sendall(b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(16) + b"\x00" + bytes(31))
    received = b""
    while len(received) < 64:
        more = connection.recv(64 - len(received))
        if not more:
            raise ConnectionError("cut off before the greeting")
        received += more
    ready = b"\x05READY\x0bSocket-Type" + len(kind).to_bytes(4, "big") + kind
    connection.sendall(b"\x04" + bytes([len(ready)]) + ready)


def flood(endpoint: str, kind: bytes, block: bytes, seconds: float) -> int:
    """Send `block` of ZMTP frames again and again, connecting anew when cut off; the bytes sent."""
    sent = 0
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            with raw(endpoint) as connection:
                greet(connection, kind)
                while time.monotonic() < deadline:
                    connection.sendall(block)
                    sent += len(block)
        except OSError:
            continue
    return sent
