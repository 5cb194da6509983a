"""Stock ROS 2 messages as CDR, built with the rosbags type store.

Images and point clouds are split in `prefix, data[, suffix]`, so that the bulk data is sent from the
array it lies in. The parts joined are byte for byte what a CDR library writes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from sags_node.geometry import matrix_to_quat
from sags_node.messaging import topics
from sags_node.messaging.wire import Buffer, DType, Message, WireError
from sags_node.types import F64, Camera, Eye, Side

WORLD_FRAME = "world"
LEFT_FRAME = "left_optical_frame"
RIGHT_FRAME = "right_optical_frame"
FRAMES: dict[Side, str] = {"left": LEFT_FRAME, "right": RIGHT_FRAME}
IMAGE_ENCODINGS: dict[str, tuple[DType, int]] = {  # ROS name: dtype, channels
    "rgb8": ("uint8", 3),
    "rgba8": ("uint8", 4),
    "bgr8": ("uint8", 3),
    "bgra8": ("uint8", 4),
    "mono8": ("uint8", 1),
    "32FC1": ("float32", 1),
}
COMPRESSED = topics.COMPRESSED_IMAGE
POSE = "geometry_msgs/msg/PoseStamped"
NODES = "rmw_dds_common/msg/ParticipantEntitiesInfo"
UINT32_FIELDS = ("id", "id_high")
PACKED_FIELDS = (*UINT32_FIELDS, "rgb")  # 32-bit words that are not numbers on a scale
OTHER_IN_ROS1 = {  # types whose ROS 1 version has other fields
    "sensor_msgs/msg/Range", "shape_msgs/msg/SolidPrimitive", "visualization_msgs/msg/Marker",
    "visualization_msgs/msg/MarkerArray",
    *(f"visualization_msgs/msg/InteractiveMarker{part}" for part in ("", "Control", "Init", "Update")),
}  # fmt: skip
_POINT_FIELD_UINT32, _POINT_FIELD_FLOAT32 = 6, 7

_store = get_typestore(Stores.ROS2_JAZZY)
_ros = _store.types


@dataclass(frozen=True, slots=True)
class Content:
    """What one message carries, apart from its number and its stamps."""

    type: str
    parts: tuple[Buffer, ...]
    encoding: str = ""
    shape: tuple[int, ...] = ()
    dtype: DType = ""
    scale: float = 0.0  # size of one step of a thin image of integers; 0: none
    window: tuple[int, ...] = ()  # of a thin image: x, y, and px of the whole image per px of its own
    relative: bool = False  # its lengths have no unit
    detail_age_ns: int | None = None  # ns from the oldest image in a view to its frame; None: the model alone

    def cdr(self) -> bytes:
        """The whole message."""
        return b"".join(self.parts)


@cache
def type_hash(type_name: str) -> str:
    """The RIHS01 hash by which ROS 2 tells versions of a type apart."""
    return str(_store.hash_rihs01(type_name))


def parse(message: Message) -> Any:
    """The ROS message object of a received message.

    Raises:
        WireError: the type is not a stock type of this protocol, its hash differs or the CDR is damaged.
    """
    name = message.meta.type
    if name not in {topic.type for topic in (*topics.TOPICS, *topics.PLAYER_TOPICS)}:
        raise WireError(f"{message.topic}: unknown type {name!r}")
    if message.meta.type_hash != type_hash(name):
        raise WireError(f"{message.topic}: another version of {name} than ours")
    try:
        return decode(message.cdr(), name)
    except WireError as error:
        raise WireError(f"{message.topic}: {error}") from None


def knows(type_name: str) -> bool:
    """Tell whether this is a stock ROS 2 type."""
    return type_name in _store.fielddefs


@cache
def definition(type_name: str) -> str:
    """The `ros2msg` text of a stock type and of all that it is made of."""
    return str(_store.generate_msgdef(type_name, ros_version=2)[0])


def decode(data: Buffer, type_name: str) -> Any:
    """The ROS message object in the CDR of a stock type; its arrays lie in `data`.

    Raises:
        WireError: the CDR is damaged.
    """
    try:
        return _store.deserialize_cdr(data, type_name)
    except (SerdeError, ValueError, UnicodeError) as error:
        raise WireError(f"damaged {type_name}: {error}") from None


def from_ros1(raw: bytes, type_name: str) -> bytes:
    """Convert a ROS 1 message to CDR. A type that is not stock, or differs in ROS 1, stays as it is.

    Raises:
        WireError: it is damaged.
    """
    if not knows(type_name) or type_name in OTHER_IN_ROS1:
        return raw
    try:
        return bytes(_store.ros1_to_cdr(raw, type_name))
    except (SerdeError, ValueError, UnicodeError, AssertionError) as error:
        raise WireError(f"damaged {type_name}: {error}") from None


def compressed_image(file: bytes, form: str, header: Any) -> bytes:
    """`sensor_msgs/CompressedImage` of an image file, with the header of the image's message."""
    return _serialize(_ros[COMPRESSED](header, form, np.frombuffer(file, np.uint8)))


def file_form(encoding: str, kind: str) -> str:
    """Return the `format` of a JPEG or PNG file (`kind`), as ROS's compressed_image_transport writes it.

    `encoding` is that of the image.
    """
    stored = encoding.replace("rgb", "bgr")  # the channel order of OpenCV, which writes and reads these files
    return f"{encoding}; {kind} compressed {stored}"


def thin_picture(
    data: NDArray[np.uint8],
    kind: str,
    encoding: str,
    stamp_ns: int,
    frame: str,
    scale: float,
    window: tuple[int, int, int],
) -> Content:
    """`sensor_msgs/CompressedImage` whose file is a separate part; `scale` 0: the pixels are not steps of
    a depth or confidence."""
    form = file_form(encoding, kind)
    message = _ros[COMPRESSED](_header(stamp_ns, frame), form, np.empty(0, np.uint8))
    start = _serialize(message)[:-4]  # without the length of the empty data
    parts = (start + _length(data), data.data)
    return Content(COMPRESSED, parts, form, data.shape, "uint8", scale, window)


def picture_file(data: bytes, stamp_ns: int, frame: str = LEFT_FRAME) -> Content:
    """`sensor_msgs/CompressedImage` of a JPEG or PNG file."""
    kind = "png" if data.startswith(b"\x89PNG") else "jpeg"
    message = _ros[COMPRESSED](_header(stamp_ns, frame), kind, np.frombuffer(data, np.uint8))
    return Content(COMPRESSED, (_serialize(message),))


def image(array: NDArray[Any], encoding: str, stamp_ns: int, frame: str = LEFT_FRAME) -> Content:
    """`sensor_msgs/Image` of an image [H, W] or [H, W, C] in one of `IMAGE_ENCODINGS`."""
    dtype, channels = IMAGE_ENCODINGS[encoding]
    height, width = array.shape[:2]
    assert array.dtype == dtype and array.size == height * width * channels, (array.shape, array.dtype)
    bytes_per_row = width * channels * array.itemsize
    empty = np.empty(0, np.uint8)
    message = _ros[topics.IMAGE](_header(stamp_ns, frame), height, width, encoding, 0, bytes_per_row, empty)
    start = _serialize(message)[:-4]  # without the length of the empty data
    data = np.ascontiguousarray(array)
    return Content(topics.IMAGE, (start + _length(data), data.data), encoding, array.shape, dtype)


def camera_info(camera: Camera, stamp_ns: int, frame: str = LEFT_FRAME, baseline: float = 0.0) -> Content:
    """`sensor_msgs/CameraInfo` of a rectified camera; `baseline` (m) only for the right eye."""
    P = np.zeros((3, 4))
    P[:, :3] = camera.K
    P[0, 3] = -camera.K[0, 0] * baseline
    return _camera_info(camera.width, camera.height, np.zeros(5), camera.K, np.eye(3), P, stamp_ns, frame)


def uncalibrated(camera_info: bytes) -> bytes:
    """The `CameraInfo` with zero matrices, which is how ROS says that a camera is not calibrated."""
    message = decode(camera_info, topics.CAMERA_INFO)
    zeros = {name: np.zeros_like(getattr(message, name)) for name in "krp"}
    return _serialize(replace(message, **zeros))


def eye_info(eye: Eye, stamp_ns: int) -> Content:
    """`sensor_msgs/CameraInfo` of a calibrated camera that gives raw images."""
    return _camera_info(eye.width, eye.height, eye.distortion, eye.K, eye.R, eye.P, stamp_ns, LEFT_FRAME)


def _camera_info(
    width: int, height: int, distortion: F64, K: F64, R: F64, P: F64, stamp_ns: int, frame: str
) -> Content:
    roi = _ros["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    model = "rational_polynomial" if len(distortion) > 5 else "plumb_bob"
    numbers = (np.asarray(matrix, np.float64).ravel() for matrix in (distortion, K, R, P))
    message = _ros[topics.CAMERA_INFO](_header(stamp_ns, frame), height, width, model, *numbers, 0, 0, roi)
    return Content(topics.CAMERA_INFO, (_serialize(message),))


def point_cloud(
    columns: NDArray[np.float32], fields: Sequence[str], stamp_ns: int, dense: bool = True
) -> Content:
    """`sensor_msgs/PointCloud2` in the world frame of rows [N, len(fields)], every field four bytes.

    Columns named in `PACKED_FIELDS` hold the bits of a uint32. `dense`: no position is NaN.
    """
    count, width = columns.shape
    assert columns.dtype == np.float32 and width == len(fields), (columns.shape, columns.dtype)
    kinds = [_POINT_FIELD_UINT32 if name in UINT32_FIELDS else _POINT_FIELD_FLOAT32 for name in fields]
    point_field = _ros["sensor_msgs/msg/PointField"]
    described = [
        point_field(name, 4 * i, kind, 1) for i, (name, kind) in enumerate(zip(fields, kinds, strict=True))
    ]
    empty = np.empty(0, np.uint8)
    header = _header(stamp_ns, WORLD_FRAME)
    row_bytes = 4 * width * count
    message = _ros[topics.POINT_CLOUD](header, 1, count, described, False, 4 * width, row_bytes, empty, dense)
    whole = _serialize(message)
    start, suffix = whole[:-5], whole[-1:]  # around the length of the empty data: is_dense
    data = np.ascontiguousarray(columns)
    parts = (start + _length(data), data.data, suffix)
    return Content(topics.POINT_CLOUD, parts, ",".join(fields), columns.shape, "float32")


def transform(T: F64, stamp_ns: int, parent: str = WORLD_FRAME, child: str = LEFT_FRAME) -> Content:
    """`tf2_msgs/TFMessage` with the pose [4, 4] (m) of one frame in another."""
    w, x, y, z = (float(q) for q in matrix_to_quat(T[:3, :3]))
    translation = _ros["geometry_msgs/msg/Vector3"](*(float(t) for t in T[:3, 3]))
    rotation = _ros["geometry_msgs/msg/Quaternion"](x, y, z, w)
    pose = _ros["geometry_msgs/msg/Transform"](translation, rotation)
    stamped = _ros["geometry_msgs/msg/TransformStamped"](_header(stamp_ns, parent), child, pose)
    return Content(topics.TF, (_serialize(_ros[topics.TF]([stamped])),))


def pose(T: F64, stamp_ns: int, frame: str = WORLD_FRAME) -> Content:
    """`geometry_msgs/PoseStamped` of a pose [4, 4] (m) in `frame`."""
    w, x, y, z = (float(q) for q in matrix_to_quat(T[:3, :3]))
    position = _ros["geometry_msgs/msg/Point"](*(float(t) for t in T[:3, 3]))
    there = _ros["geometry_msgs/msg/Pose"](position, _ros["geometry_msgs/msg/Quaternion"](x, y, z, w))
    return Content(POSE, (_serialize(_ros[POSE](_header(stamp_ns, frame), there)),))


@dataclass(frozen=True, slots=True)
class Status:
    """One line of diagnostics."""

    name: str
    level: int  # 0 OK, 1 WARN, 2 ERROR, 3 STALE
    message: str
    values: Mapping[str, str]


def diagnostics(statuses: Sequence[Status], stamp_ns: int) -> Content:
    """`diagnostic_msgs/DiagnosticArray`."""
    key_value = _ros["diagnostic_msgs/msg/KeyValue"]
    status_type = _ros["diagnostic_msgs/msg/DiagnosticStatus"]
    array = [
        status_type(s.level, s.name, s.message, "", [key_value(k, v) for k, v in s.values.items()])
        for s in statuses
    ]
    return Content(topics.DIAGNOSTICS, (_serialize(_ros[topics.DIAGNOSTICS](_header(stamp_ns, ""), array)),))


def string(text: str) -> Content:
    """`std_msgs/String`."""
    return Content(topics.STRING, (_serialize(_ros[topics.STRING](text)),))


def node_entities(
    guid: bytes, namespace: str, name: str, readers: Sequence[bytes], writers: Sequence[bytes]
) -> bytes:
    """`rmw_dds_common/ParticipantEntitiesInfo` of a process with one node; GUIDs are those of DDS."""

    def gid(each: bytes) -> Any:
        return _ros["rmw_dds_common/msg/Gid"](np.frombuffer(each, np.uint8))

    node_type = _ros["rmw_dds_common/msg/NodeEntitiesInfo"]
    node = node_type(namespace, name, [gid(each) for each in readers], [gid(each) for each in writers])
    return _serialize(_ros[NODES](gid(guid), [node]))


def clock(time_ns: int) -> Content:
    """`rosgraph_msgs/Clock`."""
    return Content(topics.CLOCK, (_serialize(_ros[topics.CLOCK](_time(time_ns))),))


def _header(stamp_ns: int, frame: str) -> Any:
    return _ros["std_msgs/msg/Header"](_time(stamp_ns), frame)


def _time(stamp_ns: int) -> Any:
    return _ros["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 1_000_000_000))


def _serialize(message: Any) -> bytes:
    return bytes(_store.serialize_cdr(message, message.__msgtype__))


def _length(data: NDArray[Any]) -> bytes:
    return data.nbytes.to_bytes(4, "little")
