"""Keyframe folders of SCARED: a made-up scene whose depth, poses and images are known is read back."""

import json
import re
import struct
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from command_line import figures_of
from frames import played
from mistakes import frames_until_error, refused_at_opening
from numbered_pictures import write_png, write_video
from packed import pack
from stamped_videos import write

from sags_node.config import schema as cfg
from sags_node.config.launch_file import load_launch
from sags_node.errors import UsageError
from sags_node.geometry import invert, project, unproject
from sags_node.pipeline.session import open_session
from sags_node.sources.source import open_source
from sags_node.types import F32, F64, U8, StereoFrame
from sags_node.vision.rectify import Rectifier

WIDTH, HEIGHT, FRAMES = 160, 128, 6
CALIBRATION, VIDEO, ARCHIVE = "endoscope_calibration.yaml", "data/rgb.mp4", "data/frame_data.tar.gz"
PIXELS = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).astype(np.float64)


class Eye(NamedTuple):
    K: F64
    D: F64


# The eyes differ and look a little past each other, so that nothing agrees by chance.
LEFT = Eye(np.array([[150.0, 0, 74], [0, 151, 66], [0, 0, 1]]), np.array([-0.02, 0.01, 1e-3, -1e-3, 0]))
RIGHT = Eye(np.array([[149.0, 0, 86], [0, 149, 61], [0, 0, 1]]), np.array([-0.01, 0.02, 0, 1e-3, 0]))
R = cv2.Rodrigues(np.array([0.02, -0.03, 0.01]))[0]
T = np.array([-4.2, 0.15, -0.1])  # mm
# The surface: normal . X = distance, in the keyframe's raw left camera, mm.
NORMAL, DISTANCE = np.array([0.25, -0.15, 1.0]), 62.0


def key_to_frame(number: int) -> F64:
    """`camera-pose` of a scope that moves and turns away from the keyframe, which is not frame 0; mm."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.010, -0.015, 0.02]) * (number + 1))[0]
    pose[:3, 3] = np.array([1.0, -0.5, 2.0]) * (number + 1)
    return pose


def seen(eye: Eye, key_to_camera: F64) -> tuple[F64, U8]:
    """Points [H, W, 3] mm of the surface at a camera's pixels, in that camera, and its image (RGB)."""
    plain = cv2.undistortPoints(PIXELS.reshape(-1, 1, 2), eye.K, eye.D).reshape(HEIGHT, WIDTH, 2)
    rays = np.concatenate([plain, np.ones((HEIGHT, WIDTH, 1))], -1)
    camera_to_key = invert(key_to_camera)
    directions, origin = rays @ camera_to_key[:3, :3].T, camera_to_key[:3, 3]
    lengths = (DISTANCE - NORMAL @ origin) / (directions @ NORMAL)
    x, y, _ = np.moveaxis(origin + directions * lengths[..., None], -1, 0)
    waves = np.sin(x / 3) * np.sin(y / 4)
    picture = np.stack([150 + 60 * waves, 90 + 40 * np.sin(x / 5), 80 - 30 * waves], -1)
    return rays * lengths[..., None], picture.astype(np.uint8)


def pictures(number: int) -> tuple[U8, U8]:
    left_to_right = np.eye(4)
    left_to_right[:3, :3], left_to_right[:3, 3] = R, T
    pose = key_to_frame(number)
    return seen(LEFT, pose)[1], seen(RIGHT, left_to_right @ pose)[1]


def scene_points(number: int) -> F32:
    """[2H, W, 3] mm: left above right; a corner was not measured."""
    points = seen(LEFT, key_to_frame(number))[0].astype(np.float32)
    points[:20, :30] = 0
    points[20:40, :30] = np.nan
    return np.concatenate([points, np.full_like(points, 999.0)])


def tiff(array: F32) -> bytes:
    """An uncompressed float TIFF [H, W, 3], written by hand: the order of its channels is beyond doubt."""
    height, width, _ = array.shape
    data = array.astype("<f4").tobytes()
    long, short = 4, 3
    entries = [
        (256, long, 1, width), (257, long, 1, height), (258, short, 3, 8 + len(data)), (259, short, 1, 1),
        (262, short, 1, 2), (273, long, 1, 8), (277, short, 1, 3), (278, long, 1, height),
        (279, long, 1, len(data)), (284, short, 1, 1), (339, short, 3, 8 + len(data) + 6),
    ]  # fmt: skip
    directory = struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", *entry) for entry in entries)
    counts = struct.pack("<6H", 32, 32, 32, 3, 3, 3)
    header = struct.pack("<2sHI", b"II", 42, 8 + len(data) + len(counts))
    return header + data + counts + directory + bytes(4)


def frame_json(number: int) -> bytes:
    calibration = {"KL": LEFT.K, "DL": LEFT.D[None], "KR": RIGHT.K, "DR": RIGHT.D[None], "R": R, "T": T[None]}
    numbers = {key: value.tolist() for key, value in calibration.items()}
    pose = key_to_frame(number).tolist()
    return json.dumps({"camera-calibration": numbers, "camera-pose": pose, "timestamp": number}).encode()


def write_calibration(file: Path, **changed: Any) -> None:
    """As OpenCV 3 wrote it: with a header that is not YAML 1.1."""
    values = {"M1": LEFT.K, "D1": LEFT.D, "M2": RIGHT.K, "D2": RIGHT.D, "R": R, "T": T[:, None]} | changed
    lines = ["%YAML:1.0", "---"]
    for key, value in values.items():
        if value is not None:
            matrix = np.atleast_2d(value)
            data = ", ".join(repr(float(number)) for number in matrix.ravel())
            lines.append(f"{key}: !!opencv-matrix\n   rows: {matrix.shape[0]}\n   cols: {matrix.shape[1]}")
            lines.append(f"   dt: d\n   data: [ {data} ]")
    file.write_text("\n".join(lines) + "\n")


@pytest.fixture
def keyframe(tmp_path: Path) -> Path:
    """As it is downloaded: a video of stacked images and packed data."""
    folder = tmp_path / "dataset_1/keyframe_2"
    (folder / "data").mkdir(parents=True)
    write_calibration(folder / "endoscope_calibration.yaml")
    shown = [np.vstack(pictures(number)) for number in range(FRAMES)]
    write_video(folder / "data/rgb.mp4", shown, codec="mp4v")
    # In the order of a file system, with what a Mac leaves behind.
    order = [0, 2, 1, 5, 3, 4]
    poses = {f"./frame_data{number:06d}.json": frame_json(number) for number in order}
    pack(folder / "data/frame_data.tar.gz", {"./._frame_data000000.json": b"Mac"} | poses)
    points = {f"scene_points{number:06d}.tiff": tiff(scene_points(number)) for number in order}
    pack(folder / "data/scene_points.tar.gz", points)
    return folder


def unpack(keyframe: Path) -> None:
    for packed in (keyframe / "data").glob("*.tar.gz"):
        with tarfile.open(packed) as archive:
            archive.extractall(keyframe / "data" / packed.name.removesuffix(".tar.gz"), filter="data")
        packed.unlink()


def play(keyframe: Path, **options: Any) -> list[StereoFrame]:
    return played(cfg.ScaredSource(folder=keyframe, pace="step", **options))


# ---- what is read ----------------------------------------------------------------------------------------


def same(one: StereoFrame, other: StereoFrame) -> bool:
    """Pose and reference are."""
    assert np.array_equal(one.reference.depth, other.reference.depth)
    return np.array_equal(one.T_world_cam, other.T_world_cam)


def test_the_pictures_come_from_the_two_halves_of_the_video(keyframe: Path) -> None:
    """Going back in a packed archive unpacks it again; the numbers must still belong together."""
    plain = play(keyframe)
    assert [frame.t_capture_ns for frame in plain] == [number * 40_000_000 for number in range(FRAMES)]
    for frame in plain:
        for shown, drawn in zip((frame.left, frame.right), pictures(frame.frame_id), strict=True):
            assert shown is not None and shown.shape == (HEIGHT, WIDTH, 3)
            assert np.abs(shown.astype(float) - drawn).mean() < 6  # lossy video, halved colour resolution
        assert frame.tissue is None and frame.depth is None
    frames = play(keyframe, stride=2, loop=True, frames=5)
    assert [frame.frame_id for frame in frames] == [0, 1, 2, 3, 4]
    for frame, number in zip(frames, [0, 2, 4, 0, 2], strict=True):
        assert same(frame, plain[number]) and np.array_equal(frame.left, plain[number].left)


def test_the_rectified_eyes_agree_with_each_other(keyframe: Path) -> None:
    """Depth, pose, baseline and rectification together: a point has one colour in both eyes."""
    rig = open_session(keyframe).rig
    assert rig.baseline == pytest.approx(np.linalg.norm(T) * 1e-3)
    assert rig.name == "dataset_1_keyframe_2"
    rectifier = Rectifier(rig, WIDTH, HEIGHT)
    frame = play(keyframe)[2]
    pair = rectifier(frame)
    depth = frame.reference.depth
    points = unproject(pair.camera, PIXELS, depth.astype(np.float64))
    in_right, _ = project(pair.camera.moved_right(rig.baseline), points)
    assert np.allclose(in_right[depth > 0][:, 1], PIXELS[depth > 0][:, 1], atol=1e-6)
    warped = cv2.remap(pair.right, in_right.astype(np.float32), None, cv2.INTER_LINEAR)
    inner = (depth > 0) & (in_right[..., 0] > 5) & (in_right[..., 0] < WIDTH - 5)
    inner[:8] = inner[-8:] = False
    right_place = np.abs(warped[inner].astype(float) - pair.left[inner]).mean()
    wrong_place = np.abs(pair.right[inner].astype(float) - pair.left[inner]).mean()
    assert inner.mean() > 0.5 and right_place < 6 < wrong_place / 3


@pytest.mark.parametrize("packed", [True, False])
def test_poses_and_structured_light_depth_are_of_the_rectified_camera(keyframe: Path, packed: bool) -> None:
    """The camera moves by centimetres; the world is the rectified camera of frame 0."""
    if not packed:
        unpack(keyframe)
    rig = open_session(keyframe).rig
    K, raw_to_rectified = rig.left.P[:, :3], np.eye(4)
    raw_to_rectified[:3, :3] = R1 = rig.left.R
    for frame in play(keyframe):
        frame_to_key = invert(key_to_frame(frame.frame_id))
        pose = raw_to_rectified @ key_to_frame(0) @ frame_to_key @ invert(raw_to_rectified)
        pose[:3, 3] *= 1e-3
        assert frame.T_world_cam is not None and np.allclose(frame.T_world_cam, pose, atol=1e-9)
        assert frame.reference is not None and frame.reference.depth_kind == "structured_light"
        depth = frame.reference.depth
        assert depth is not None and depth.shape == (HEIGHT, WIDTH) and depth.dtype == np.float32
        assert np.isfinite(depth).all() and (depth >= 0).all()
        # The plane in the rectified camera of this frame: n . z K^-1 p = d.
        normal = R1 @ frame_to_key[:3, :3].T @ NORMAL
        distance = DISTANCE - NORMAL @ frame_to_key[:3, 3]
        rays = np.concatenate([PIXELS, np.ones((HEIGHT, WIDTH, 1))], -1) @ np.linalg.inv(K).T
        exact = 1e-3 * distance / (rays @ normal)
        known = depth > 0
        assert known.mean() > 0.8
        unmeasured = np.array([[[20.0, 10.0]], [[20.0, 30.0]]])  # raw pixels that hold 0 and NaN
        columns, rows = cv2.undistortPoints(unmeasured, LEFT.K, LEFT.D, R=R1, P=K)[:, 0].round().astype(int).T
        assert not known[rows, columns].any()
        errors = depth[known] - exact[known]
        assert np.abs(errors).max() < 1.5e-4  # the nearest raw pixel is up to 0.7 px away
        assert abs(errors.mean()) < 5e-6  # and to no side in particular


def test_rectified_pictures_take_the_place_of_the_video(keyframe: Path) -> None:
    rectifier = Rectifier(open_session(keyframe).rig, WIDTH, HEIGHT)
    raw = play(keyframe)
    for frame in raw:
        pair = rectifier(frame)
        for side, picture in (("left", pair.left), ("right", pair.right)):
            write_png(keyframe / f"{side}_rectified/{frame.frame_id:06d}.png", picture)
    (keyframe / "data/rgb.mp4").unlink()
    rig = open_session(keyframe).rig
    assert rig.baseline == pytest.approx(np.linalg.norm(T) * 1e-3)
    again = Rectifier(rig, WIDTH, HEIGHT)
    for before, frame in zip(raw, play(keyframe), strict=True):
        assert same(frame, before) and np.array_equal(again(frame).left, rectifier(before).left)
    for side in ("left", "right"):
        (keyframe / f"{side}_rectified/000003.png").unlink()
    with pytest.raises(UsageError, match="from 000000 without gaps, not 000000 to 000005"):
        play(keyframe)


def test_pictures_that_were_resized_are_told_of(keyframe: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The files do not say their size: of half of it all depth would be twice as far."""
    open_session(keyframe)
    assert "principal points" not in caplog.text
    halves = [cv2.resize(np.vstack(pictures(number)), None, fx=0.5, fy=0.5) for number in range(FRAMES)]
    write_video(keyframe / "data/rgb.mp4", halves, codec="mp4v")
    open_session(keyframe)
    assert "endoscope_calibration.yaml: both principal points lie at 2 of the middle" in caplog.text


def test_points_are_read_for_measuring_only(keyframe: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A test keyframe has neither points nor poses."""
    points = keyframe / "data/scene_points.tar.gz"
    points.write_bytes(b"not packed at all")
    with open_session(keyframe, ["source.pace:=step"]).source as source:
        assert [frame.reference for frame in source] == [None] * FRAMES
    points.unlink()
    (keyframe / ARCHIVE).unlink()
    frames = play(keyframe)
    assert [(frame.T_world_cam, frame.reference) for frame in frames] == [(None, None)] * FRAMES
    assert "has no data/frame_data: the camera is taken to stand still" in caplog.text


def test_what_has_no_pose_is_left_out(keyframe: Path, caplog: pytest.LogCaptureFixture) -> None:
    """What has no points has no reference."""
    unpack(keyframe)
    (keyframe / "data/frame_data/frame_data000005.json").unlink()
    (keyframe / "data/scene_points/scene_points000003.tiff").unlink()
    with open_source(cfg.ScaredSource(folder=keyframe)) as source:
        assert source.frame_count == 5
    frames = play(keyframe, loop=True, frames=7)
    assert [frame.frame_id for frame in frames] == list(range(7))
    assert [frame.reference is None for frame in frames] == [number == 3 for number in range(7)]
    assert "has poses for 5 of 6 frames; the rest is left out" in caplog.text


def test_a_video_is_played_by_its_stamps(keyframe: Path, caplog: pytest.LogCaptureFixture) -> None:
    """It has fewer images than there are poses."""
    seconds = [0.0, 0.04, 2.0, 2.04]
    write(keyframe / "data/rgb.mp4", [np.vstack(pictures(n)) for n in range(4)], seconds, rate=25)
    assert [frame.t_capture_ns * 1e-9 for frame in play(keyframe)] == pytest.approx(seconds)
    assert "has poses of more than its 4 images" in caplog.text


def test_a_folder_is_known_by_its_files(keyframe: Path) -> None:
    config = load_launch(keyframe, ["source.stride:=2"])
    assert isinstance(config.source, cfg.ScaredSource)
    assert config.source.folder == keyframe and config.source.stride == 2
    assert config.vision.tissue.method == "none"
    with pytest.raises(UsageError, match="the recording brings its own"):
        open_session(keyframe, [f"rig:={keyframe}"])


def test_a_keyframe_is_measured_by_its_own_protocol(keyframe: Path) -> None:
    arguments = ["eval", "--protocol", "scared", str(keyframe), "--iterations", "2", "--json"]
    found = figures_of(*arguments)
    assert found["measured"]["frames"] == found["model"]["frames"] == 6
    assert found["measured"]["mae_mm"] < 2 and found["model"]["mae_mm"] < 3  # one pixel: 6 mm
    assert 0.5 < found["measured"]["given"] <= 1


# ---- mistakes --------------------------------------------------------------------------------------------


def calibration(**changed: Any) -> Callable[[Path], None]:
    return lambda keyframe: write_calibration(keyframe / "endoscope_calibration.yaml", **changed)


def written(name: str, content: bytes | None) -> Callable[[Path], None]:
    """That file, in what was unpacked where it lies there; None: there is none."""

    def change(keyframe: Path) -> None:
        if not (keyframe / name).exists():
            unpack(keyframe)
        (keyframe / name).unlink()
        if content is not None:
            (keyframe / name).write_bytes(content)

    return change


POSE = "data/frame_data/frame_data000001.json"
SHEARED = np.eye(4) + np.eye(4, k=1)


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (written(CALIBRATION, None), r"cannot read calibration .*endoscope_calibration\.yaml: No such file"),
        (calibration(T=T / 1000), r"T puts the eyes 0\.0042 mm apart, possible are 1 to 50; the unit is mil"),
        (calibration(T=-T), "the eyes are exchanged"),
        (calibration(M1=np.diag([9e4, 151, 1.0])), "M1: fx = 90000 px is not plausible"),
        (written(VIDEO, None), "holds neither data/rgb.mp4 nor left_rectified/ and right_rectified/"),
        (lambda keyframe: (keyframe / ARCHIVE).write_bytes((keyframe / ARCHIVE).read_bytes()[:-300]),
         r"frame_data\.tar\.gz is cut off or damaged .*download it again"),
        (written(ARCHIVE, b"hello"),
         r"frame_data\.tar\.gz is not a readable tar\.gz: .*; unpack or download it again"),
        (lambda keyframe: pack(keyframe / ARCHIVE, {}),
         "data/frame_data holds no frame_data000000.json; unpack it again"),
        (written(POSE, b"{"), "data/frame_data 1: no JSON with a camera-pose of numbers"),
        (written(POSE, b'{"camera-pose": "here"}'), "data/frame_data 1: no JSON with a camera-pose"),
        (written(POSE, b'{"camera-pose": [1%s]}' % (400 * b"0")), "data/frame_data 1: no JSON with a cam"),
        (written(POSE, b'{"camera-pose": [[1, 0], [0, 1]]}'), "data/frame_data 1: camera-pose is not a rot"),
        (written(POSE, json.dumps({"camera-pose": SHEARED.tolist()}).encode()),
         "data/frame_data 1: camera-pose is not a rotation and a translation"),
        (written(POSE, bytes(2**20 + 1)), r"frame_data000001\.json: it has 1048577 bytes, 1048576 at most"),
    ],
)  # fmt: skip
def test_mistakes_are_named(keyframe: Path, mistake: Callable[[Path], None], message: str) -> None:
    mistake(keyframe)
    refused_at_opening(lambda: load_launch(keyframe).source, message)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"hello", "is no JPEG, PNG, TIFF"),
        (tiff(scene_points(2))[:5000], "or is damaged"),
        (tiff(scene_points(2)[:HEIGHT]), "is no whole float TIFF of 160x256 px"),
    ],
    ids=["text", "torn", "half"],
)
def test_damaged_points_in_the_middle_are_named(keyframe: Path, data: bytes, said: str) -> None:
    unpack(keyframe)
    (keyframe / "data/scene_points/scene_points000002.tiff").write_bytes(data)
    frames, message = frames_until_error(cfg.ScaredSource(folder=keyframe, pace="step"))
    assert len(frames) == 2 and re.search(f"scene_points of frame 2 .*{said}", message)
