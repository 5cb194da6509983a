"""A consumer written from the wire contract alone: ZeroMQ, msgpack, numpy, and nothing of this package.

Every check is a function with the expectation as its parameter, so that the same client judges a
synthetic publisher and a running node.
"""

import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import msgpack
import numpy as np
import zmq

META_KEYS = {
    *("v", "type", "type_hash", "seq", "frame_id", "stamp_ns", "publish_ns", "session"),
    *("epoch", "step", "encoding", "shape", "dtype", "dropped"),
}
SPLAT_FIELDS = [
    *("x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_w", "rot_x", "rot_y", "rot_z"),
    *("f_dc_0", "f_dc_1", "f_dc_2", "opacity", "id"),
]
SH_DEGREE_0 = 0.28209479


@dataclass(frozen=True)
class Received:
    topic: str
    meta: dict[str, Any]
    parts: list[bytes]

    def array(self) -> np.ndarray:
        return np.frombuffer(self.parts[1], self.meta["dtype"]).reshape(self.meta["shape"])

    def cdr(self) -> bytes:
        return b"".join(self.parts)


@contextmanager
def zmq_socket(kind: int, endpoint: str, *options: tuple[int, Any], bind: bool = False) -> Iterator[Any]:
    """A plain socket, connected or bound."""
    context = zmq.Context()
    socket = context.socket(kind)
    for option, value in options:
        socket.setsockopt(option, value)
    (socket.bind if bind else socket.connect)(endpoint)
    try:
        yield socket
    finally:
        context.destroy(linger=0)


def subscribed(endpoint: str, *prefixes: str, high_water: int = 1000) -> AbstractContextManager[Any]:
    """A socket that gets what begins so."""
    wanted = ((zmq.SUBSCRIBE, prefix.encode()) for prefix in prefixes)
    return zmq_socket(zmq.SUB, endpoint, (zmq.RCVHWM, high_water), *wanted)


def collect(endpoint: str, names: Sequence[str], count: int, timeout: float) -> dict[str, list[Received]]:
    """The first `count` messages of every topic of the node `sags`, or what has come after `timeout` s."""
    received: dict[str, list[Received]] = {name: [] for name in names}
    deadline = time.monotonic() + timeout
    with subscribed(endpoint, *(f"sags/{name}" for name in names)) as socket:
        while time.monotonic() < deadline and min(len(got) for got in received.values()) < count:
            if not socket.poll(50):
                continue
            topic, meta, *parts = socket.recv_multipart()
            name = topic.decode().removeprefix("sags/")
            # A subscription is a prefix: that to a depth brings its confidence too.
            if name in received and len(received[name]) < count:
                received[name].append(Received(topic.decode(), msgpack.unpackb(meta), parts))
    return received


def request(endpoint: str, op: str, args: Mapping[str, Any], timeout: float = 60.0) -> dict[str, Any]:
    """One request on the control socket."""
    with zmq_socket(zmq.REQ, endpoint) as socket:
        socket.send(msgpack.packb({"v": "1.0", "id": 7, "op": op, "args": dict(args)}))
        assert socket.poll(int(timeout * 1000)), f"no answer to {op}"
        reply = msgpack.unpackb(socket.recv())
    assert reply["v"] == "1.0" and reply["id"] == 7, reply
    return reply


# ---- checks --------------------------------------------------------------------------------------------


def check_meta(message: Received, ros_type: str) -> None:
    """Every key of the contract, of its kind."""
    meta = message.meta
    assert set(meta) >= META_KEYS, META_KEYS - set(meta)
    assert meta["v"] == "1.0"
    assert meta["type"] == ros_type
    assert meta["type_hash"].startswith("RIHS01_") and len(meta["type_hash"]) == 71
    for key in ("seq", "stamp_ns", "publish_ns", "epoch", "step", "dropped"):
        assert isinstance(meta[key], int) and meta[key] >= 0, (key, meta[key])
    assert meta["stamp_ns"] <= meta["publish_ns"] <= time.time_ns()


def check_sequence(messages: Sequence[Received]) -> int:
    """`seq` and `stamp_ns` grow within one session and epoch; returns how many messages were lost."""
    lost = 0
    for before, after in pairwise(messages):
        assert after.meta["session"] == before.meta["session"]
        assert after.meta["seq"] > before.meta["seq"]
        if after.meta["epoch"] == before.meta["epoch"]:
            assert after.meta["stamp_ns"] > before.meta["stamp_ns"]
        lost += after.meta["seq"] - before.meta["seq"] - 1
    return lost


def check_image(message: Received, encoding: str, width: int, height: int) -> np.ndarray:
    """The image, of the size and encoding expected."""
    check_meta(message, "sensor_msgs/msg/Image")
    channels = {"rgb8": [3], "rgba8": [4], "mono8": [], "32FC1": []}[encoding]
    assert message.meta["encoding"] == encoding
    assert message.meta["shape"] == [height, width, *channels]
    assert message.meta["dtype"] == ("float32" if encoding == "32FC1" else "uint8")
    return message.array()


def depth_error(depth: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """Median and 90th percentile of |depth - truth| (m), and the share of known pixels that have depth."""
    known = truth > 0
    given = known & np.isfinite(depth)
    assert not np.any(depth[np.isfinite(depth)] <= 0), "unknown depth must be NaN on the wire"
    error = np.abs(depth[given] - truth[given])
    return float(np.median(error)), float(np.percentile(error, 90)), float(given.sum() / known.sum())


def camera_info(message: Received) -> dict[str, Any]:
    """Size, K [3, 3] and P [3, 4] of a CameraInfo message."""
    check_meta(message, "sensor_msgs/msg/CameraInfo")
    reader = CdrReader(message.cdr())
    stamp_ns, frame = reader.header()
    assert stamp_ns == message.meta["stamp_ns"]
    height, width = reader.read("I"), reader.read("I")
    model = reader.string()
    distortion = [reader.read("d") for _ in range(reader.read("I"))]
    K, R, P = (np.array([reader.read("d") for _ in range(n)]) for n in (9, 9, 12))
    assert model == "plumb_bob" and not any(distortion) and np.array_equal(R.reshape(3, 3), np.eye(3))
    return {"frame": frame, "width": width, "height": height, "K": K.reshape(3, 3), "P": P.reshape(3, 4)}


def check_splats(message: Received) -> dict[str, np.ndarray]:
    """Columns of the splats by name, with values that a renderer can use as they are."""
    check_meta(message, "sensor_msgs/msg/PointCloud2")
    named = message.meta["encoding"].split(",")
    assert named[: len(SPLAT_FIELDS)] == SPLAT_FIELDS, "what came later stands after what was there"
    rows = message.array()[:, : len(SPLAT_FIELDS)].copy()
    columns = {name: rows[:, i] for i, name in enumerate(SPLAT_FIELDS)}
    columns |= {name: message.array()[:, i] for i, name in enumerate(named) if name.startswith("slope_")}
    columns["id"] = rows.view(np.uint32)[:, SPLAT_FIELDS.index("id")]
    assert np.isfinite(rows[:, :-1]).all()
    scales = rows[:, 3:6]
    assert (scales > 0).all() and np.median(scales) < 0.02, "scales are metres, not logarithms"
    assert np.allclose(np.linalg.norm(rows[:, 6:10], axis=1), 1, atol=1e-3), "quaternions have length one"
    opacity = columns["opacity"]
    assert (opacity >= 0).all() and (opacity <= 1).all(), "opacity is 0..1, not a logit"
    assert len(np.unique(columns["id"])) == len(rows)
    return columns


def splat_colors(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """RGB 0..1 [N, 3]."""
    return 0.5 + SH_DEGREE_0 * np.stack([columns[f"f_dc_{i}"] for i in range(3)], axis=1)


def point_colors(message: Received) -> np.ndarray:
    """RGB 0..255 [N, 3] of the packed column of `points`."""
    check_meta(message, "sensor_msgs/msg/PointCloud2")
    assert message.meta["encoding"].split(",")[:4] == ["x", "y", "z", "rgb"]
    packed = message.array().view(np.uint32)[:, 3]
    return np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=1)


def camera_pose(message: Received) -> np.ndarray:
    """`T_world_cam` [4, 4] of the only transform in a TFMessage."""
    check_meta(message, "tf2_msgs/msg/TFMessage")
    reader = CdrReader(message.cdr())
    assert reader.read("I") == 1
    stamp_ns, parent = reader.header()
    child = reader.string()
    assert (stamp_ns, parent, child) == (message.meta["stamp_ns"], "world", "left_optical_frame")
    T = np.eye(4)
    T[:3, 3] = [reader.read("d") for _ in range(3)]
    x, y, z, w = (reader.read("d") for _ in range(4))
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return T


def text(message: Received) -> str:
    """The text of a String message."""
    check_meta(message, "std_msgs/msg/String")
    return CdrReader(message.cdr()).string()


class CdrReader:
    """Plain little-endian CDR: every primitive is aligned to its size, counted after the 4-byte header."""

    def __init__(self, data: bytes) -> None:
        assert data[:2] == b"\x00\x01", "little-endian CDR"
        self._data = data[4:]
        self._at = 0

    def read(self, code: str) -> Any:
        size = struct.calcsize(code)
        self._at += -self._at % size
        (value,) = struct.unpack_from("<" + code, self._data, self._at)
        self._at += size
        return value

    def string(self) -> str:
        length = self.read("I")
        value = self._data[self._at : self._at + length - 1].decode()
        self._at += length
        return value

    def header(self) -> tuple[int, str]:
        seconds, nanoseconds = self.read("i"), self.read("I")
        return seconds * 1_000_000_000 + nanoseconds, self.string()
