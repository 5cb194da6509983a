"""Messages as bytes: equal to stock ROS 2 CDR, and proof against what strangers send."""

import tracemalloc
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from independent_client import META_KEYS
from made_messages import message_of
from rosbags.typesys import Stores, get_typestore
from synthetic import health, plane_result

from sags_node.messaging import cdr, content, topics
from sags_node.messaging.cdr import Content
from sags_node.messaging.received import ReceivedCloud, interpret
from sags_node.messaging.wire import Message, WireError, decode, encode

STORE = get_typestore(Stores.ROS2_JAZZY)
STAMP = 1_700_000_000_123_456_789


def contents() -> dict[str, Content]:
    """What every topic says of the synthetic frame."""
    result = plane_result(stamp_ns=STAMP)
    said = {name: build(result) for name, build in content.FRAME_CONTENT.items()}
    said["status"] = content.json_text(content.status(health(), result))
    said["parameters"] = content.json_text({"mapping": {"budget_ms": 33.0}})
    said["diagnostics"] = content.diagnostics(health(), STAMP)
    return said


def x_message(said: Content, **changes: Any) -> Message:
    times = {"stamp_ns": STAMP, "publish_ns": STAMP + 1}
    header: dict[str, Any] = {**times, "frame_id": 5, "step": 9, "dropped": 1}
    return message_of("x", said, 3, **{**header, **changes})


@pytest.mark.parametrize("name", topics.BY_NAME)
def test_joined_parts_are_stock_cdr(name: str) -> None:
    assert set(contents()) == set(topics.BY_NAME)
    said = contents()[name]
    assert said.type == topics.BY_NAME[name].type
    joined = x_message(said).cdr()
    ros = STORE.deserialize_cdr(joined, said.type)
    assert bytes(STORE.serialize_cdr(ros, said.type)) == joined
    if hasattr(ros, "header"):
        assert ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec == STAMP
    if name == "diagnostics":
        assert [(part.name, part.level) for part in ros.status] == [("node", 0), ("rectify", 0), ("map", 0)]


def test_type_hash_is_the_published_one() -> None:
    known = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
    assert cdr.type_hash(topics.IMAGE) == known


@pytest.mark.parametrize("frame", ["", "a", "ab", "abc", "abcd", "left_optical_frame"])
def test_image_header_is_aligned_for_every_frame_name(frame: str) -> None:
    picture = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)
    said = cdr.image(picture, "rgb8", STAMP, frame)
    assert np.shares_memory(np.frombuffer(said.parts[1], np.uint8), picture)  # it is not copied
    ros = STORE.deserialize_cdr(x_message(said).cdr(), topics.IMAGE)
    assert (ros.height, ros.width, ros.step, ros.encoding, ros.header.frame_id) == (5, 7, 21, "rgb8", frame)
    assert np.array_equal(ros.data.reshape(5, 7, 3), picture)


def test_point_cloud_fields_describe_the_rows() -> None:
    said = contents()["splats"]
    ros = STORE.deserialize_cdr(x_message(said).cdr(), said.type)
    assert [field.name for field in ros.fields] == list(content.SPLAT_FIELDS)
    assert [field.offset for field in ros.fields] == list(range(0, 80, 4))
    kinds = {field.name: field.datatype for field in ros.fields}
    assert kinds["id"] == kinds["id_high"] == 6  # UINT32
    assert (ros.height, ros.width, ros.point_step, ros.row_step) == (1, said.shape[0], 80, 80 * said.shape[0])
    rows = ros.data.view(np.float32).reshape(-1, 20)
    assert np.allclose(rows[:, :3], plane_result().snapshot.gaussians.means)


def test_ids_beyond_32_bit_stay_those_of_one_gaussian() -> None:
    """At 1500 new ones a frame and 30 Hz they are reached after 26 hours."""
    result = plane_result()
    ids = result.snapshot.gaussians.ids + 2**32 - 1100  # some below, some above
    gaussians = replace(result.snapshot.gaussians, ids=ids)
    said = content.splats(replace(result, snapshot=replace(result.snapshot, gaussians=gaussians)))
    cloud = interpret(x_message(said), 0)
    assert isinstance(cloud, ReceivedCloud)
    received = cloud.points["id"] + (cloud.points["id_high"].astype(np.int64) << 32)
    assert len(np.unique(ids >> 32)) == 2 and np.array_equal(received, ids)


def test_an_empty_cloud_and_an_empty_model_are_messages() -> None:
    said = cdr.point_cloud(np.empty((0, 5), np.float32), content.POINT_FIELDS, STAMP)
    ros = STORE.deserialize_cdr(x_message(said).cdr(), said.type)
    assert ros.width == 0 and len(ros.data) == 0
    assert interpret(x_message(said), 0).meta.shape == [0, 5]


def test_points_leave_out_what_is_hidden_or_outside() -> None:
    result = plane_result()
    shown = content.points(result)
    gaussians = result.snapshot.gaussians
    row_with_depth = int((gaussians.opacities >= content.POINT_MIN_OPACITY).sum())
    assert shown.shape == (row_with_depth, 5)
    camera = result.pair.camera
    gaussians.means[0] = camera.T_world_cam[:3, 3] - camera.T_world_cam[:3, 2] * 0.01  # behind the camera
    gaussians.means[1] += camera.T_world_cam[:3, 2].astype(np.float32) * 0.02  # under the surface
    gaussians.means[2] += camera.T_world_cam[:3, 0].astype(np.float32) * 10  # far to the right
    assert content.points(result).shape == (row_with_depth - 3, 5)


# ---- strangers -----------------------------------------------------------------------------------------


def test_round_trip_and_unknown_keys() -> None:
    said = contents()["left/depth"]
    frames = encode(x_message(said))
    fields = msgpack.unpackb(frames[1])
    assert set(fields) == META_KEYS
    frames[1] = msgpack.packb({**fields, "colour_of_the_sky": ["blue", {"deep": 1}], "v": "1.9"})
    back = decode(frames)
    assert back.meta.stamp_ns == STAMP and back.topic == "sags/x"
    assert np.array_equal(back.array(), np.asarray(said.parts[1]), equal_nan=True)


MISSING = object()
FORGERIES: list[tuple[str, Any]] = [
    *((key, MISSING) for key in sorted(META_KEYS - {"v"})),
    *((key, None) for key in sorted(META_KEYS)),
    *((key, -2) for key in ("seq", "frame_id", "stamp_ns", "epoch", "dropped")),
    *((key, 2**63) for key in ("seq", "stamp_ns", "step")),
    *((key, "7") for key in ("seq", "stamp_ns", "shape")),
    *(("v", version) for version in ("2.0", "1")),
    *(("dtype", kind) for kind in ("O", "float64")),
    *(("shape", shape) for shape in ([1] * 5, [-1, 4], [2**31])),
    ("session", "x" * 513),
]


@pytest.mark.parametrize(("key", "value"), FORGERIES)
def test_forged_meta_is_refused(key: str, value: Any) -> None:
    frames = encode(x_message(contents()["left/depth"]))
    fields = {**msgpack.unpackb(frames[1]), key: value}
    frames[1] = msgpack.packb({name: said for name, said in fields.items() if said is not MISSING})
    with pytest.raises(WireError):
        decode(frames)


def test_a_claimed_size_is_never_allocated() -> None:
    said = contents()["left/depth"]
    frames = encode(x_message(said, shape=[2**31 - 1, 2**31 - 1]))
    tracemalloc.start()
    with pytest.raises(WireError, match="claims"):
        decode(frames).array()
    # msgpack: an array of 2^32 - 1 elements, a string of 2^32 - 1 bytes
    for claim in (b"\xdd\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff"):
        with pytest.raises(WireError):
            decode([b"sags/x", claim, b""])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


@pytest.mark.parametrize("frames", [
    [], [b"t"], [b"t", b"\x80"], [b"t", b"\x80", b""],
    [b"\xff\xfe", b"\x80", b""], [b"t" * 256, b"\x80", b""],
    [b"sags/tf\nerror: all is lost", encode(x_message(contents()["tf"]))[1], b""],
    [b"t", b"\x91" * 5000, b""], [b"t", b"\x91" * 4000, b""], [b"t", b"\x80"] + [b""] * 7,
])  # fmt: skip
def test_wrong_parts_are_refused(frames: list[bytes]) -> None:
    with pytest.raises(WireError):
        decode(frames)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        *(("left/depth", {"encoding": said}) for said in ("rgb8", "16UC1")),
        ("left/depth", {"shape": [96 * 64]}),
        *(("left/image_rect_color", {"shape": shape}) for shape in ([64, 96 * 3], [64, 96, 3, 1])),
        *(("splats", {"encoding": ",".join(names)}) for names in ("xyz", "x" * 15, "abcdefghijklmno")),
        ("splats", {"dtype": "uint8"}),
        ("tf", {"type_hash": "RIHS01_0"}),
        ("tf", {"type": "sensor_msgs/msg/Joy"}),
        ("tf", {"type": "sensor_msgs/msg/Image"}),
    ],
)
def test_content_that_does_not_fit_its_meta_is_refused(name: str, changes: dict[str, Any]) -> None:
    with pytest.raises(WireError):
        interpret(x_message(contents()[name], **changes), 0)
