"""Bags of every kind, written by `rosbags`, with images whose every pixel is known."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from sags_node.config.schema import BagSource
from sags_node.sources.replay import Replay
from sags_node.types import Eye, StereoFrame

ROS2, ROS1 = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
IMAGE, COMPRESSED, INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
WIDTH, HEIGHT = 64, 48
FOCAL, BASELINE = 80.0, 0.005
MS = 1_000_000
START = 1_700_000_000_000_000_000  # ns

Row = tuple[str, Any, int]  # topic, message without stamp, stamp ns


def picture(number: int, eye: int) -> np.ndarray:
    """RGB [H, W, 3]; no two are alike."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([u * 3 + number, v * 5 + 7 * eye, u + v + number * 2], -1).astype(np.uint8)


def header(store: Any, stamp_ns: int) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    kind = store.types["std_msgs/msg/Header"]
    return kind(3, time, "eye") if store is ROS1 else kind(time, "eye")


def image(store: Any, rgb: np.ndarray, stamp_ns: int, encoding: str = "rgb8", padding: int = 0) -> Any:
    """`rgb` as a driver would send it in that encoding, with `padding` bytes after each row."""
    codes = {"bgr8": cv2.COLOR_RGB2BGR, "bgra8": cv2.COLOR_RGB2BGRA, "rgba8": cv2.COLOR_RGB2RGBA}
    codes["mono8"] = cv2.COLOR_RGB2GRAY
    pixels = rgb if encoding == "rgb8" else cv2.cvtColor(rgb, codes[encoding])
    rows = pixels.reshape(len(rgb), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    kind = store.types[IMAGE]
    head = header(store, stamp_ns)
    return kind(head, *rgb.shape[:2], encoding, 0, rows.shape[1], np.ascontiguousarray(rows).ravel())


def compressed(store: Any, rgb: np.ndarray, stamp_ns: int, kind: str = "png") -> Any:
    data = cv2.imencode(f".{kind}", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].ravel()
    return store.types[COMPRESSED](header(store, stamp_ns), f"rgb8; {kind} compressed bgr8", data)


def eye_of(eye: int, focal: float = FOCAL) -> Eye:
    """What `camera_info` tells, unless it is told otherwise."""
    K = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1.0]])
    P = np.column_stack([K, [-focal * BASELINE * eye, 0, 0]])
    return Eye(WIDTH, HEIGHT, K, np.zeros(5), np.eye(3), P)


def camera_info(
    store: Any,
    stamp_ns: int,
    eye: int | Eye,
    model: str = "plumb_bob",
    binning: tuple[int, int] = (0, 0),
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
) -> Any:
    """`roi`: x, y, width, height."""
    said = eye if isinstance(eye, Eye) else eye_of(eye)
    x, y, width, height = roi
    region = store.types["sensor_msgs/msg/RegionOfInterest"](x, y, height, width, False)
    numbers = said.distortion, said.K.ravel(), said.R.ravel(), said.P.ravel()
    head = header(store, stamp_ns), said.height, said.width, model
    return store.types[INFO](*head, *numbers, *binning, region)


def marker(stamp_ns: int) -> Any:
    """A message of ROS 1 whose type has more fields in ROS 2."""
    types = ROS1.types
    point, unit = types["geometry_msgs/msg/Point"](0, 0, 0), types["geometry_msgs/msg/Vector3"](1, 1, 1)
    pose = types["geometry_msgs/msg/Pose"](point, types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1))
    color, time = types["std_msgs/msg/ColorRGBA"](1, 0, 0, 1), types["builtin_interfaces/msg/Duration"](0, 0)
    shown = "tool", 1, 0, 0, pose, unit, color, time, False, [point], [color], "", "", False
    return types["visualization_msgs/msg/Marker"](header(ROS1, stamp_ns), *shown)


def stereo_rows(
    store: Any,
    count: int = 10,
    names: tuple[str, str] = ("/rig/left/image_raw", "/rig/right/image_raw"),
    skew_ms: float = 2.0,
    make: Any = image,
    infos: bool = True,
    **options: Any,
) -> list[Row]:
    """A stereo camera at 25 Hz whose right eye is `skew_ms` late."""
    rows: list[Row] = []
    for number in range(count):
        for eye, name in enumerate(names):
            stamp = START + number * 40 * MS + round(eye * skew_ms * MS)
            rows.append((name, make(store, picture(number, eye), stamp, **options), stamp))
            if infos:
                beside = name.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"
                rows.append((beside, camera_info(store, stamp, eye), stamp))
    return rows


def write_rosbag2(path: Path, rows: list[Row], plugin: str = "MCAP", compression: str | None = None) -> Path:
    """A rosbag2 folder; what was stamped t was recorded 5 ms later."""
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
    if compression is not None:
        writer.set_compression(rosbag2.CompressionMode[compression], rosbag2.CompressionFormat.ZSTD)
    return _written(path, writer, rows, ROS2, ROS2.serialize_cdr)


def write_rosbag1(path: Path, rows: list[Row], compression: str | None = None) -> Path:
    writer = rosbag1.Writer(path)
    if compression is not None:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    return _written(path, writer, rows, ROS1, ROS1.serialize_ros1)


def _written(path: Path, writer: Any, rows: list[Row], store: Any, serialize: Callable[..., Any]) -> Path:
    with writer:
        known: dict[str, Any] = {}
        for topic, message, stamp in rows:
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(known[topic], stamp + 5 * MS, serialize(message, kind))
    return path


def without_metadata(bag: Path) -> Path:
    (bag / "metadata.yaml").unlink()
    return bag


KINDS: dict[str, Callable[[Path], Path]] = {
    "mcap folder": lambda p: write_rosbag2(p / "bag", stereo_rows(ROS2)),
    "mcap file": lambda p: write_rosbag2(p / "bag", stereo_rows(ROS2)) / "bag.mcap",
    "mcap zstd": lambda p: write_rosbag2(p / "bag", stereo_rows(ROS2), compression="STORAGE"),
    "db3 folder": lambda p: write_rosbag2(p / "bag", stereo_rows(ROS2), "SQLITE3"),
    "db3 file": lambda p: write_rosbag2(p / "bag", stereo_rows(ROS2), "SQLITE3") / "bag.db3",
    "db3 whose recorder was killed": lambda p: without_metadata(
        write_rosbag2(p / "bag", stereo_rows(ROS2), "SQLITE3")
    ),
    "db3 messages": lambda p: write_rosbag2(p / "b", stereo_rows(ROS2), "SQLITE3", "MESSAGE"),
    "ros1": lambda p: write_rosbag1(p / "a.bag", stereo_rows(ROS1)),
    "ros1 lz4": lambda p: write_rosbag1(p / "a.bag", stereo_rows(ROS1), "LZ4"),
    "ros1 bz2": lambda p: write_rosbag1(p / "a.bag", stereo_rows(ROS1), "BZ2"),
}


def play(path: Path, **config: Any) -> list[StereoFrame]:
    with Replay(BagSource(path=path, pace="step", **config)) as source:
        return list(source)
