"""Recordings that cannot be played: what users get wrong, and damage that shows late, named with its fix."""

import io
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_files import ROS1, ROS2, stereo_rows, write_rosbag1, write_rosbag2
from mistakes import refused_at_opening
from numbered_pictures import HEIGHT, WIDTH, numbers, picture, recordings, write_png, write_video
from places import SESSION

from sags_node.config import schema as cfg
from sags_node.errors import SagsError, UsageError
from sags_node.pipeline.session import open_session
from sags_node.sources.replay import Recording
from sags_node.sources.source import open_source
from sags_node.types import F64, StereoFrame

# ---- at opening ------------------------------------------------------------------------------------------


def folders_of(folder: Path, left: str = "l", right: str = "r", **said: Any) -> Recording:
    return cfg.FoldersSource(left=folder / left, right=folder / right, **said)


def posed(folder: Path, poses: np.ndarray, name: str = "T_world_cam", **said: Any) -> Recording:
    np.savez(folder / "poses.npz", **{name: poses})
    return folders_of(folder, poses=folder / "poses.npz", **said)


def moving_by(step: float, count: int = 8) -> F64:
    """Poses of a scope along x."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = step * np.arange(count)
    return poses


def measured(folder: Path) -> Recording:
    return folders_of(folder, reference=cfg.ReferenceConfig(depth=folder / "depth"))


def write_depth(file: Path, width: int = WIDTH, height: int = HEIGHT, counts: int = 5000) -> None:
    write_png(file, np.full((height, width), counts, np.uint16))


def tracked(folder: Path, frames: list[float], away: float = 0.0) -> Recording:
    points = np.full((3, 5, 3), [0.0, 0.0, away])
    np.savez(folder / "tracks.npz", points=points, visible=np.ones((3, 5)), frames=frames)
    return folders_of(folder, reference=cfg.ReferenceConfig(tracks=folder / "tracks.npz"))


def torn_poses(folder: Path) -> Recording:
    config = posed(folder, moving_by(0.0))
    cut(folder / "poses.npz", -1000)
    return config


def vast_poses(folder: Path) -> Recording:
    """They are refused before memory is taken for them."""
    header = io.BytesIO()
    claimed = {"descr": "<f8", "fortran_order": False, "shape": (10**9, 4, 4)}
    np.lib.format.write_array_header_1_0(header, claimed)
    with zipfile.ZipFile(folder / "poses.npz", "w") as archive:
        archive.writestr("T_world_cam.npy", header.getvalue() + bytes(128))
    return folders_of(folder, poses=folder / "poses.npz")


def beyond(folder: Path) -> Recording:
    boxes = cfg.GeometryConfig(layout="panes", crop=(0, 0, 32, 24), crop_right=(40, 0, 32, 24))
    return cfg.VideosSource(left=folder / "lr.avi", geometry=boxes)


# What is wrong, made in a folder of `recordings`; what is said.
MISTAKES: list[tuple[Callable[[Path], Recording], str]] = [
    (lambda at: folders_of(at, "nowhere"), "nowhere does not exist; check the path"),
    (lambda at: cfg.VideosSource(left=at / "l", right=at / "r"), "l is a folder; of images: source.kind"),
    (lambda at: folders_of(at, "l/000.png"), "000.png is not a folder; check the path"),
    (lambda at: (at / "empty").mkdir() or folders_of(at, right="empty"), "empty holds no image"),
    (lambda at: [(at / f"r/00{n}.png").unlink() for n in range(4)] and folders_of(at),
     "l holds 8 images but .*r holds 4; pairing goes by sorted name"),
    (lambda at: write_png(at / "tools/000.png", picture(0)) or folders_of(at, tools=at / "tools"),
     "l holds 8 images but .*tools holds 1; pairing"),
    (lambda at: folders_of(at, start=60), "source.start 60.0 s lies behind the recording's end at 0.27 s"),
    (beyond, r"the box \[40, 0, 32, 24\] .* leaves the image: an eye of .*lr.avi is 64x24 px"),
    (lambda at: folders_of(at, poses=at / "poses.npz"), "poses.npz does not exist; check the path"),
    (lambda at: posed(at, np.eye(4)), r"'T_world_cam' is float64 \[4, 4\], wanted numbers \[any, 4, 4\]"),
    (lambda at: posed(at, np.eye(4)[None], "poses"), "poses.npz holds no array 'T_world_cam'"),
    (lambda at: posed(at, np.full((8, 4, 4), {}, dtype=object)), "'T_world_cam' is object"),
    (torn_poses, "poses.npz is not a readable npz file"),
    (vast_poses, "claims an impossible size"),
    *((lambda at, count=count, stride=stride: posed(at, moving_by(0.0, count), stride=stride),
       f"poses.npz holds {count} poses, the recording 8 images of the left")
      for count, stride in ((3, 1), (32, 1), (7, 1), (9, 1), (4, 2))),
    (lambda at: posed(at, moving_by(1e-3).swapaxes(1, 2)),
     "of frame 1 is no rotation and translation; is it transposed"),
    (lambda at: posed(at, moving_by(1e-3) * [2, 2, 2, 1]), "of frame 0 is no rotation and translation"),
    (lambda at: posed(at, moving_by(2.0)), "the camera by 14 m.*of millimetres divide them by 1000"),
    (lambda at: write_png(at / "depth/first.png", picture(0)) or measured(at),
     "first.png: reference depth files are named by frame number"),
    (lambda at: [write_depth(at / f"depth/{n:03d}.png") for n in range(1, 9)] and measured(at),
     "depth knows frame 8, but the recording's 8 frames are numbered from 0 to 7; number the"),
    (lambda at: write_depth(at / "depth/000.png", counts=100) or measured(at),
     r"000.png: the median depth would be 0.001 m.*set source.reference.depth_unit .*0.001 makes 100 mm"),
    (lambda at: tracked(at, [0, 1, 2], 70.0), "points are 70 m away .*of millimetres divide them by 1000"),
    (lambda at: tracked(at, [1, 4, 8]), "tracks.npz knows frame 8, but the recording's 8 frames"),
    (lambda at: tracked(at, [0, 1, 1]), "'frames' must hold the frame number of each row, from 0"),
    (lambda at: tracked(at, [0.0, 0.5, 1.0]), "'frames' must hold the frame number of each row"),
    (lambda at: tracked(at, [-1, 0, 1]), "'frames' must hold the frame number of each row"),
    (lambda at: tracked(at, [0, 1]), r"'frames' is int64 \[2\], wanted numbers \[3\]"),
]  # fmt: skip
DAMAGED: list[tuple[Callable[[Path], Recording], str]] = [
    (lambda at: write_png(at / "r/000.png", np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8)) or folders_of(at),
     "r/000.png is 33x24 px but .*l/000.png is 32x24; all images must have one size"),
    (lambda at: (at / "l/000.png").write_bytes(b"not a picture") and folders_of(at),
     "l/000.png is damaged or cut off"),
]  # fmt: skip


@pytest.mark.parametrize(("mistake", "message"), MISTAKES + DAMAGED)
def test_mistakes_at_opening(tmp_path: Path, mistake: Callable[[Path], Recording], message: str) -> None:
    """All but damaged image data are mistakes of the request."""
    recordings(tmp_path)
    error = refused_at_opening(lambda: mistake(tmp_path), message)
    assert isinstance(error, UsageError) or (mistake, message) in DAMAGED


@pytest.mark.fault("file: depth that is known to be true has another unit")
def test_depth_beyond_an_endoscopes_view_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recordings(tmp_path)
    for counts, is_told in ((30_000, False), (31_000, True)):  # 0.3 m is the farthest
        write_depth(tmp_path / "depth/000.png", counts=counts)
        open_source(measured(tmp_path))
        assert ("depth: 310 mm (median) with 1e-05 m per count" in caplog.text) == is_told


def test_depth_named_by_the_next_frame_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Every third frame, counted from 1, has numbers that are all there."""
    recordings(tmp_path)
    for number in range(8, 0, -1):
        for eye in "lr":
            (tmp_path / f"{eye}/{number - 1:03d}.png").rename(tmp_path / f"{eye}/{number:03d}.png")
    for number in (3, 6):
        write_depth(tmp_path / f"depth/{number:03d}.png")
    open_source(measured(tmp_path))
    assert "003.png is taken for the depth of 004.png: frame numbers begin at 0" in caplog.text


# ---- on the way ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(WIDTH, WIDTH), (HEIGHT, WIDTH), (WIDTH + 2, HEIGHT)])
def test_reference_depth_of_another_shape_is_refused(tmp_path: Path, width: int, height: int) -> None:
    recordings(tmp_path)
    write_depth(tmp_path / "depth/000.png", WIDTH // 2, HEIGHT // 2)  # smaller: the same view
    write_depth(tmp_path / "depth/001.png", width, height)
    (frame,), said = played(measured(tmp_path))
    assert frame.reference is not None and frame.reference.depth is not None
    assert re.search(f"001.png is {width}x{height} px, of another shape .*32x24", said)


def test_reference_depth_of_65535_counts_is_not_known(tmp_path: Path) -> None:
    recordings(tmp_path)
    counts = np.full((HEIGHT, WIDTH), 6000, np.uint16)
    counts[:2], counts[2:4] = 65535, 0
    write_png(tmp_path / "depth/000.png", counts)
    reference = played(measured(tmp_path))[0][0].reference
    assert reference.depth.dtype == np.float32 and not reference.depth[:4].any()
    np.testing.assert_allclose(reference.depth[4:], 0.06, rtol=1e-6)


@pytest.mark.parametrize("step", [1e-3, 0.14])
def test_poses_that_a_scope_can_have_are_played(step: float, tmp_path: Path) -> None:
    """Up to 0.98 m: as far as from one end of a patient to the other."""
    recordings(tmp_path)
    frames, _ = played(posed(tmp_path, moving_by(step)))
    np.testing.assert_array_equal([frame.T_world_cam for frame in frames], moving_by(step))


# ---- files that are deleted, cut off, replaced or still being written while they are played ------------


AT = 3  # frames are taken before the file changes
COUNT = 150  # frames of a recording that is too long to be in a buffer
TALLER = np.zeros((HEIGHT + 2, WIDTH, 3), np.uint8)


def played(config: Recording, change: Callable[[], object] = lambda: None) -> tuple[list[StereoFrame], str]:
    """The frames of a recording that changes while it is played, and the error that ends it, if one does."""
    frames = []
    with open_source(config) as source:
        try:
            for frame in source:
                frames.append(frame)
                if len(frames) == AT:
                    change()
        except SagsError as error:
            assert "\n" not in str(error)
            return frames, str(error)
    return frames, ""


def cut(file: Path, behind: int = 0) -> None:
    """To nothing, unless told: what a reader has in its buffer is at most what it has read ahead."""
    file.write_bytes(file.read_bytes()[:behind])


def add_a_pair(folder: Path) -> None:
    for eye, name in enumerate("lr"):
        write_png(folder / f"{name}/008.png", picture(8, eye))


@pytest.mark.fault("file: an image is cut off")
@pytest.mark.fault("file: an image has another size")
@pytest.mark.fault("file: an image is deleted while it is played")
@pytest.mark.fault("file: a folder of images grows while it is played")
@pytest.mark.fault("file: a video is deleted while it is played")
@pytest.mark.parametrize(
    ("kind", "change", "count", "said"),
    [
        ("folders", lambda folder: cut(folder / "l/007.png", -20), 7, "l/007.png is damaged or cut off"),
        ("folders", lambda folder: write_png(folder / "r/007.png", TALLER), 7, "r/007.png is 32x26 px but"),
        ("folders", lambda folder: (folder / "r/006.png").unlink(), 6, "r/006.png"),
        ("folders", add_a_pair, 8, ""),
        ("videos", lambda folder: (folder / "r.avi").unlink(), 8, ""),
    ],
    ids=["cut off", "another size", "an image is deleted", "images come", "a video is deleted"],
)
def test_what_is_there_is_played_and_what_is_gone_is_named(
    kind: str, change: Callable[[Path], object], count: int, said: str, tmp_path: Path
) -> None:
    frames, error = played(recordings(tmp_path)[kind], lambda: change(tmp_path))
    assert numbers(frames) == list(range(count)) and said in error and bool(said) == bool(error)


def noise_videos(folder: Path) -> tuple[Recording, Path]:
    """Two megabytes: more than a reader reads ahead."""
    rng = np.random.default_rng(0)
    left, right = (
        write_video(folder / f"{name}.avi", [*rng.integers(0, 255, (COUNT, 128, 160, 3), np.uint8)])
        for name in "lr"
    )
    return cfg.VideosSource(left=left, right=right, pace="step"), right


def long_bag(path: Path) -> tuple[Recording, Path]:
    """Four megabytes: more than a chunk, which is read at once."""
    return cfg.BagSource(path=path, pace="step"), path


@pytest.mark.fault("file: a video is cut off while it is played")
@pytest.mark.fault("file: a ROS bag is cut off while it is played")
@pytest.mark.parametrize(
    ("write", "said", "parts"),  # how many frames at the end may be there in part
    [
        (noise_videos, r"r\.avi ends at frame {}", 1),
        (lambda at: long_bag(write_rosbag2(at / "a", stereo_rows(ROS2, COUNT)) / "a.mcap"), "mcap is dam", 0),
        (lambda at: long_bag(write_rosbag1(at / "a.bag", stereo_rows(ROS1, COUNT))), r"a\.bag is damaged", 0),
    ],
    ids=["video", "mcap", "ros1"],
)
def test_a_file_that_is_cut_off_is_named(
    write: Callable[[Path], tuple[Recording, Path]], said: str, parts: int, tmp_path: Path
) -> None:
    config, file = write(tmp_path)
    whole, _ = played(config)
    frames, error = played(config, lambda: cut(file))
    assert AT <= len(frames) < len(whole) == COUNT and re.search(said.format(len(frames)), error)
    for frame, true in zip(frames[: len(frames) - parts], whole, strict=False):
        assert np.array_equal(frame.left, true.left) and np.array_equal(frame.right, true.right)


@pytest.mark.fault("calibration: deleted or overwritten while it is used")
@pytest.mark.fault("launch file: broken while it is used")
def test_what_was_read_at_the_start_may_change(tmp_path: Path) -> None:
    folder, overrides = tmp_path / "session", ["source.pace:=step", "source.frames:=6"]
    shutil.copytree(SESSION, folder)

    def break_all() -> None:
        (folder / "launch.yaml").write_text("source: [")
        (folder / "calib/left.yaml").write_bytes(b"\xff")
        (folder / "calib/right.yaml").unlink()

    session = open_session(folder, overrides)
    rig, config = session.rig, session.config.model_copy(deep=True)
    true, _ = played(session.config.source)
    frames, _ = played(session.config.source, break_all)
    assert len(frames) == 6 and (session.rig, session.config) == (rig, config)
    for frame, one in zip(frames, true, strict=True):
        assert np.array_equal(frame.left, one.left) and np.array_equal(frame.right, one.right)
    with pytest.raises(SagsError, match=r"launch\.yaml"):
        open_session(folder)
    shutil.copy(SESSION / "launch.yaml", folder)
    with pytest.raises(SagsError, match=r"left\.yaml"):
        open_session(folder)
