"""Bytes of strangers: sound ones with some damage, and what each reader of the product does with them.

A reader gives values or an error of ours in one line, within a few seconds and without much memory. Anything
else is a fault of the product.
"""

import gzip
import io
import resource
import shutil
import signal
import struct
import tarfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import hostile
import msgpack
import msgspec
import numpy as np
from bag_files import KINDS, play
from dvrk_files import frame_record, write_session
from hypothesis import strategies as st
from made_messages import message_of
from numbered_pictures import write_video
from onnx_networks import save_matcher
from places import ROOT
from simulated_node import Socket
from stamped_videos import write
from synthetic import plane_result

from sags_node.bags.pictures import decode_file
from sags_node.clients.overlay.mesh import mesh_of
from sags_node.clients.overlay.scene import ObjectSpec
from sags_node.clients.recording.info import bag_info
from sags_node.clients.recording.recover import recover
from sags_node.config import schema as cfg
from sags_node.config.launch_file import load_launch
from sags_node.errors import SagsError
from sags_node.media.picture_file import claimed_size
from sags_node.messaging import cdr, content, thin, topics
from sags_node.messaging.control import ControlServer
from sags_node.messaging.received import ReceivedImage, interpret
from sags_node.messaging.requests import (
    AnchorName,
    AnchorRequest,
    MeasureRequest,
    ViewName,
    ViewRequest,
    parse,
)
from sags_node.messaging.wire import decode, encode
from sags_node.rig.check import check_rig
from sags_node.rig.read import read_rig
from sags_node.sources.bags import read_rig as read_bag_rig
from sags_node.sources.dvrk import read_sidecar
from sags_node.sources.numbered import open_numbered
from sags_node.sources.pose_track import PoseTrack
from sags_node.sources.source import open_source
from sags_node.sources.truth import load_array, load_npy
from sags_node.tools.export.surface_files import Surface, encoded
from sags_node.vision.onnx_depth import DepthNetwork
from sags_node.vision.tissue_topic import TopicMasks

LONGEST = 10.0  # s for one input
MOST_MEMORY = 2 << 30  # bytes beyond those at the beginning: a 64 Mpx image, decoded, and its copies
PARTS = b"|~|~"  # between the parts of a message of several
NUMBERS = [
    struct.pack(order + kind, value)
    for order in "<>"
    for kind, values in (
        ("H", (0, 1, 0x7FFF, 0xFFFF)),
        ("I", (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)),
        ("Q", (0, 1, 2**33, 2**60, 2**63, 2**64 - 1)),
        ("d", (0.0, 1e300, float("nan"), float("inf"), -1.0)),
    )
    for value in values
]
WORDS = [
    b"\n", b"\r", b"\0", b" ", b"-", b"9" * 30, b"nan", b"1e999", b"[" * 50, b"{", b": ", b"&a", b"*a", b"!!",
]  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn, sound: Sequence[bytes]) -> bytes:
    """One of these with up to six changes, of which most are where the structure is: at either end."""
    data = bytearray(draw(st.sampled_from(sound)))
    for _ in range(draw(st.integers(1, 6))):
        size = len(data)
        where = draw(st.sampled_from(("start", "end", "anywhere")))
        near = min(size, 400)
        at = draw(st.integers(0, size if where == "anywhere" else near))
        at = size - at if where == "end" else at
        length = draw(st.sampled_from((1, 2, 4, 8, 60)))
        match draw(st.sampled_from(("flip", "number", "word", "bytes", "delete", "repeat", "cut"))):
            case "flip" if at < size:
                data[at] ^= 1 << draw(st.integers(0, 7))
            case "number":
                number = draw(st.sampled_from(NUMBERS))
                data[at : at + len(number)] = number
            case "word":
                data[at:at] = draw(st.sampled_from(WORDS))
            case "bytes":
                new = draw(st.binary(min_size=1, max_size=8))
                data[at : at + len(new)] = new
            case "delete":
                del data[at : at + length]
            case "repeat":
                data[at:at] = data[at : at + length] * draw(st.sampled_from((1, 2, 300)))
            case "cut":
                del data[at:]
    return bytes(data)


@dataclass(frozen=True)
class Target:
    """A reader.

    Attributes:
        sound: makes what it reads well, in an empty folder.
        use: reads what may be damaged, in an empty folder; a `SagsError` is right.
    """

    sound: Callable[[Path], Sequence[bytes]]
    use: Callable[[bytes, Path], object]

    def try_out(self, data: bytes, folder: Path) -> bool:
        """Whether it was read.

        Raises:
            AssertionError, or what else came: a fault of the reader.
        """
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        try:
            with ended_in_time():
                self.use(data, folder)
        except SagsError as error:
            assert str(error) and "\n" not in str(error), f"not one line: {str(error)!r}"
            return False
        return True


class HungError(BaseException):
    """It took too long; no reader may catch this."""


@contextmanager
def ended_in_time() -> Iterator[None]:
    def hung(*_: object) -> None:
        raise HungError(f"no end within {LONGEST} s")

    before = signal.signal(signal.SIGALRM, hung)
    signal.setitimer(signal.ITIMER_REAL, LONGEST)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def bounded_memory(most: int = MOST_MEMORY) -> Iterator[None]:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


# ---- control -------------------------------------------------------------------------------------------


def requests(_: Path) -> list[bytes]:
    rng = np.random.default_rng(0)
    view = {"name": "top", "width": 64, "height": 48}
    good: list[tuple[str, dict[str, Any]]] = [
        ("echo", {"a": [1, {"b": None}]}),
        ("add_anchor", {"u": 3, "v": 4.5, "ahead_ms": "auto"}),
        ("add_anchor", {"x": 0.1, "y": 0.0, "z": -1e-3}),
        ("remove_anchor", {"id": 5}),
        ("measure", {"anchors": [1, 2], "area": False}),
        ("close_view", {"name": "top"}),
        ("open_view", {**view, "fov": 60.0, "T_world_cam": np.eye(4).tolist()}),
        ("open_view", {**view, "K": np.diag((50, 50, 1)).tolist()}),
    ]
    packed = [msgpack.packb({"v": "1.0", "id": 7, "op": op, "args": args}) for op, args in good]
    return packed + [hostile.random_request(rng) for _ in range(200)]


HANDLERS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "echo": lambda args: args,
    "add_anchor": lambda args: msgspec.to_builtins(parse(AnchorRequest, args)),
    "remove_anchor": lambda args: parse(AnchorName, args).id,
    "measure": lambda args: msgspec.to_builtins(parse(MeasureRequest, args)),
    "close_view": lambda args: parse(ViewName, args).name,
    "open_view": lambda args: msgspec.to_builtins(parse(ViewRequest, args)),
}


def answer(data: bytes, _: Path) -> None:
    """Every request is answered once, and none is an error of ours."""
    socket = Socket()
    socket.incoming.append([b"peer", data])
    ControlServer(socket, HANDLERS).serve()  # type: ignore[arg-type]
    ((envelope, body),) = socket.sent
    assert envelope == b"peer" and hostile.is_reply(body)
    assert b"internal error" not in body, body


# ---- messages ------------------------------------------------------------------------------------------


def messages(*names: str) -> list[bytes]:
    """These topics of a frame, or all."""
    result = plane_result(stamp_ns=1_000_000)
    told = [name for name in names or content.FRAME_CONTENT if content.tells_of(result, name)]
    made = [message_of(name, content.FRAME_CONTENT[name](result), stamp_ms=1) for name in told]
    return [PARTS.join(bytes(part) for part in encode(one)) for one in made]


def read_message(data: bytes, _: Path) -> ReceivedImage | None:
    got = interpret(decode(data.split(PARTS)), 0)
    if not isinstance(got, ReceivedImage):
        return None
    assert got.array.nbytes <= len(data)
    return got


def use_mask(data: bytes, folder: Path) -> None:
    got = read_message(data, folder)
    if got is not None:
        pair = plane_result(stamp_ns=1_000_000).pair
        tissue = TopicMasks(cfg.TissueConfig(), lambda _: (got.stamp_ns, got.array))(pair)
        assert tissue.shape == pair.left.shape[:2] and tissue.dtype == bool


def thin_files(_: Path) -> list[bytes]:
    names = ("depth/png", "image_rect_color/jpeg", "tissue_mask/png", "render/image/alpha")
    asked = {name: topics.thin_picture(f"thin/half/left/{name}") for name in names}
    return [bytes(made.parts[1]) for made in thin.thin_pictures(plane_result(), asked).values()]


def poses(_: Path) -> list[bytes]:
    return [bytes(cdr.pose(np.eye(4), 5).parts[0]), bytes(cdr.transform(np.eye(4), 5).parts[0])]


def read_pose(data: bytes, _: Path) -> None:
    for kind in (cdr.POSE, topics.TF):
        track = PoseTrack()
        try:
            track.add(data, kind)
        except SagsError:
            continue
        assert np.isfinite(track.at(5)).all()


# ---- files ---------------------------------------------------------------------------------------------


def pictures(_: Path) -> list[bytes]:
    rgb = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    deep = np.random.default_rng(0).integers(0, 65535, (24, 32), np.uint16)
    progressive = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    made = [cv2.imencode(kind, rgb)[1] for kind in (".png", ".jpg", ".tiff")]
    made += [cv2.imencode(".png", deep)[1], cv2.imencode(".jpg", rgb, progressive)[1]]
    return [one.tobytes() for one in made]


def read_picture(data: bytes, _: Path) -> None:
    claimed_size(memoryview(data))
    decode_file(np.frombuffer(data, np.uint8), "picture")


BAGS = ("mcap file", "mcap zstd", "db3 file", "ros1", "ros1 lz4", "ros1 bz2")


def bag(kind: str) -> Target:
    suffix = {"mcap": ".mcap", "db3": ".db3", "ros1": ".bag"}[kind.split(maxsplit=1)[0]]

    def sound(folder: Path) -> list[bytes]:
        KINDS[kind](folder)
        return [next(folder.rglob(f"*{suffix}")).read_bytes()]

    def use(data: bytes, folder: Path) -> None:
        file = folder / f"x{suffix}"
        file.write_bytes(data)
        if suffix == ".mcap":
            try:
                recover(file, folder / "saved")
            except SagsError as error:
                assert "\n" not in str(error) and not (folder / "saved").exists()
        with bounded_memory(1 << 30):
            load_launch(file)
            bag_info(file)
            read_bag_rig(cfg.BagSource(path=file))
            play(file)

    return Target(sound, use)


def arrays(folder: Path) -> list[bytes]:
    numbers = np.random.default_rng(0).normal(size=(8, 4, 4))
    for name, save in (("a.npz", np.savez), ("b.npz", np.savez_compressed)):
        save(folder / name, T_world_cam=numbers)
    np.save(folder / "c.npy", numbers)
    return [file.read_bytes() for file in sorted(folder.iterdir())]


def read_arrays(data: bytes, folder: Path) -> None:
    (folder / "a").write_bytes(data)
    read = partial(load_array, key="T_world_cam") if data[:1] == b"P" else load_npy
    assert read(folder / "a", shape=(None, 4, 4)).shape[1:] == (4, 4)


def sidecars(folder: Path) -> list[bytes]:
    session = write_session(folder / "session", [frame_record(number) for number in range(3)])
    return [(session / "stereo.json").read_bytes()]


def read_dvrk(data: bytes, folder: Path) -> None:
    (folder / "stereo.json").write_bytes(data)
    read_sidecar(folder / "stereo.json")


def archive_of(names: Iterable[str], content: Callable[[str], bytes]) -> bytes:
    raw = io.BytesIO()
    with tarfile.open(fileobj=raw, mode="w") as archive:
        for name in names:
            member = tarfile.TarInfo(name)
            member.size = len(content(name))
            archive.addfile(member, io.BytesIO(content(name)))
    return raw.getvalue()


def read_numbered(data: bytes, folder: Path) -> None:
    (folder / "frames.tar.gz").write_bytes(gzip.compress(data, 1) if data[-1:] == b"\0" else data)
    files = open_numbered(folder / "frames", ".json", 1000)
    for number in (1, 0, 2, 9):
        files.read(number)
    files.close()


def read_launch(data: bytes, folder: Path) -> None:
    (folder / "launch.yaml").write_bytes(data)
    try:
        load_launch(folder)
    except SagsError as error:  # a line for each mistake, and not all of a thousand
        assert len(str(error).splitlines()) < 50
        raise SagsError(str(error).splitlines()[0]) from None


RIG = [ROOT / f"calib/d4d/{side}.yaml" for side in ("left", "right")]


def read_ros_rig(data: bytes, folder: Path) -> None:
    shutil.copy(RIG[1], folder)
    (folder / "left.yaml").write_bytes(data)
    check_rig(read_rig(folder))


def read_archive(data: bytes, folder: Path) -> None:
    (folder / "calibrationdata.tar.gz").write_bytes(gzip.compress(data, 1))
    check_rig(read_rig(folder))


def opencv_rigs(folder: Path) -> list[bytes]:
    made = []
    for suffix in (".yml", ".xml"):
        file = cv2.FileStorage(str(folder / f"rig{suffix}"), cv2.FILE_STORAGE_WRITE)
        K = np.array([[500.0, 0, 320], [0, 500, 256], [0, 0, 1]])
        for name, matrix in (("M1", K), ("D1", np.zeros((1, 5))), ("M2", K), ("D2", np.zeros((1, 5))),
                             ("R", np.eye(3)), ("T", np.array([[-0.005], [0], [0]]))):  # fmt: skip
            file.write(name, matrix)
        file.release()
        made.append((folder / f"rig{suffix}").read_bytes())
    return made


def read_opencv_rig(data: bytes, folder: Path) -> None:
    file = folder / ("rig.xml" if data[:10].count(b"<") else "rig.yml")
    file.write_bytes(data)
    check_rig(read_rig(file, (640, 512)))


CORNERS = "0 0 0\n0.01 0 0\n0.01 0.01 0\n0 0.01 0\n"
MESHES = {  # a square, as text
    "ply": "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    f"{CORNERS}3 0 1 2\n4 0 1 2 3\n",
    "obj": f"v {CORNERS.strip()}\n".replace("\n0", "\nv 0") + "f 1 2 3 4\nf 1/1/1 2//2 -1\n",
    "stl": "solid a\nfacet normal 0 0 1\nouter loop\n"
    "vertex 0 0 0\nvertex 0.01 0 0\nvertex 0.01 0.01 0\nendloop\nendfacet\nendsolid a\n",
    "pcd": "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 4\nHEIGHT 1\n"
    f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA ascii\n{CORNERS}",
    "xyz": CORNERS,
}


def mesh_files(kind: str) -> Target:
    def sound(_: Path) -> list[bytes]:
        points, triangles = np.eye(4, 3, dtype=np.float32), np.array([(0, 1, 2), (0, 1, 3)], np.int32)
        square = Surface(points, np.zeros((4, 3), np.uint8), points, triangles)
        return [MESHES[kind].encode(), *([] if kind == "xyz" else [encoded(f".{kind}", square)])]

    def use(data: bytes, folder: Path) -> None:
        file = folder / f"mesh.{kind}"
        file.write_bytes(data)
        mesh = mesh_of(ObjectSpec(file=file))
        assert mesh is not None and np.isfinite(mesh.vertices).all()
        assert mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh.vertices)

    return Target(sound, use)


def networks(folder: Path) -> list[bytes]:
    said = {"inputs": "[first, second]", "normalization": "bytes", "meaning": "disparity"}
    fixed = save_matcher(folder / "a.onnx", size=(64, 48), metadata=said)
    padded = save_matcher(folder / "b.onnx", metadata={**said, "multiple": "16"})
    return [fixed.read_bytes(), padded.read_bytes()]


def open_network(data: bytes, folder: Path) -> None:
    file = folder / "network.onnx"
    file.write_bytes(data)
    network = DepthNetwork(cfg.OnnxConfig(path=file, threads=1), (64, 48), 0.4)
    picture = np.zeros((48, 64, 3), np.uint8)
    assert network(picture, picture).shape == (48, 64)


def films(folder: Path) -> list[bytes]:
    shown = [np.random.default_rng(n).integers(0, 255, (48, 128, 3), np.uint8) for n in range(4)]
    made = (
        write_video(folder / "a.avi", shown),
        *(write(folder / f"a.{each}", shown) for each in ("mp4", "mkv", "ts")),
    )
    return [file.read_bytes() for file in made]


def read_film(data: bytes, folder: Path) -> None:
    file = folder / "film"
    file.write_bytes(data)
    halves = cfg.GeometryConfig(layout="side_by_side")
    config = cfg.VideosSource(left=file, geometry=halves, pace="step", frames=8, loop=True)  # it goes back
    with open_source(config) as source:
        for frame in source:
            assert frame.right is not None and frame.left.shape == frame.right.shape


TARGETS: dict[str, Target] = {
    "requests": Target(requests, answer),
    "messages": Target(lambda _: messages(), read_message),
    "masks": Target(lambda _: messages("left/tissue_mask"), use_mask),
    "thin images": Target(thin_files, lambda data, _: thin.decode("sags/thin", 0.01, data)),
    "poses": Target(poses, read_pose),
    "pictures": Target(pictures, read_picture),
    **{kind: bag(kind) for kind in BAGS},
    "arrays": Target(arrays, read_arrays),
    "sidecars": Target(sidecars, read_dvrk),
    "numbered archive": Target(
        lambda _: [archive_of([f"./frame{number:06d}.json" for number in (0, 2, 1)], lambda _: b"")],
        read_numbered,
    ),
    "launch files": Target(
        lambda _: [f.read_bytes() for f in sorted((ROOT / "launch").glob("*.yaml"))], read_launch
    ),
    "ros calibration": Target(lambda _: [file.read_bytes() for file in RIG], read_ros_rig),
    "calibration archive": Target(
        lambda _: [archive_of([file.name for file in RIG], lambda name: (RIG[0].parent / name).read_bytes())],
        read_archive,
    ),
    "opencv calibration": Target(opencv_rigs, read_opencv_rig),
    **{kind: mesh_files(kind) for kind in MESHES},
    "networks": Target(networks, open_network),
    "videos": Target(films, read_film),
}
IN_MEMORY = {"requests", "messages", "masks", "thin images", "poses", "pictures"}
