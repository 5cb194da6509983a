"""Files that are deleted, cut off, replaced or still being written while they are played."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_files import ROS1, ROS2, stereo_rows, write_rosbag1, write_rosbag2
from numbered_pictures import numbers, picture, recordings, write_png, write_video
from places import SESSION

from sags_node.config import schema as cfg
from sags_node.errors import SagsError
from sags_node.pipeline.session import open_session
from sags_node.sources.replay import Recording
from sags_node.sources.source import open_source
from sags_node.types import StereoFrame

AT = 3  # frames are taken before the file changes
COUNT = 150  # frames of a recording that is too long to be in a buffer


def played(config: Recording, change: Callable[[], object]) -> tuple[list[StereoFrame], str]:
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


@pytest.mark.fault("file: a picture is deleted while it is played")
def test_a_picture_that_is_deleted_is_named(tmp_path: Path) -> None:
    config = recordings(tmp_path)["folders"]
    frames, error = played(config, (tmp_path / "r/006.png").unlink)
    assert numbers(frames) == list(range(len(frames))) and AT <= len(frames) <= 6
    assert "r/006.png" in error


@pytest.mark.fault("file: a folder of pictures grows while it is played")
def test_pictures_that_come_later_are_not_played(tmp_path: Path) -> None:
    config = recordings(tmp_path)["folders"]

    def grow() -> None:
        for eye, name in enumerate(("l", "r")):
            write_png(tmp_path / f"{name}/008.png", picture(8, eye))

    frames, error = played(config, grow)
    assert numbers(frames) == list(range(8)) and error == ""


@pytest.mark.fault("file: a video is deleted while it is played")
def test_a_video_that_is_deleted_is_played_to_its_end(tmp_path: Path) -> None:
    config = recordings(tmp_path)["videos"]
    frames, error = played(config, (tmp_path / "r.avi").unlink)
    assert numbers(frames) == list(range(8)) and error == ""


@pytest.mark.fault("file: a video is cut off while it is played")
def test_a_video_that_is_cut_off_is_named(tmp_path: Path) -> None:
    """Two megabytes of noise: more than a reader reads ahead."""
    rng = np.random.default_rng(0)
    eyes = [[rng.integers(0, 255, (128, 160, 3), np.uint8) for _ in range(COUNT)] for _ in range(2)]
    left, right = (
        write_video(tmp_path / f"{name}.avi", shown) for name, shown in zip("lr", eyes, strict=True)
    )
    config = cfg.VideosSource(left=left, right=right, pace="step")
    whole, _ = played(config, lambda: None)
    frames, error = played(config, lambda: cut(right))
    assert AT <= len(frames) < len(whole) == COUNT and f"r.avi ends at frame {len(frames)}" in error
    for frame, true in zip(frames[:-1], whole, strict=False):
        assert np.array_equal(frame.right, true.right)


@pytest.mark.fault("file: a ROS bag is cut off while it is played")
@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_a_bag_that_is_cut_off_is_named(kind: str, tmp_path: Path) -> None:
    """Four megabytes: more than a chunk, which is read at once."""
    if kind == "mcap":
        path = write_rosbag2(tmp_path / "bag", stereo_rows(ROS2, COUNT)) / "bag.mcap"
    else:
        path = write_rosbag1(tmp_path / "a.bag", stereo_rows(ROS1, COUNT))
    config = cfg.BagSource(path=path, pace="step")
    whole, _ = played(config, lambda: None)
    frames, error = played(config, lambda: cut(path))
    assert AT <= len(frames) < len(whole) == COUNT and f"{path.name} is damaged" in error
    for frame, true in zip(frames, whole, strict=False):
        assert np.array_equal(frame.left, true.left) and np.array_equal(frame.right, true.right)


def cut(file: Path) -> None:
    """To nothing: what a reader has in its buffer is at most what it has read ahead."""
    with file.open("r+b") as opened:
        opened.truncate(0)


@pytest.mark.fault("calibration: deleted or overwritten while it is used")
@pytest.mark.fault("launch file: broken while it is used")
def test_what_was_read_at_the_start_may_change(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    shutil.copytree(SESSION, folder)
    overrides = ["source.pace:=step", "source.frames:=6"]
    with open_session(SESSION, overrides).source as source:
        true = list(source)
    session = open_session(folder, overrides)
    rig, config = session.rig, session.config.model_copy(deep=True)
    frames = []
    with session.source as source:
        for frame in source:
            frames.append(frame)
            if len(frames) == AT:
                (folder / "launch.yaml").write_text("source: [")
                (folder / "calib/left.yaml").write_bytes(b"\xff")
                (folder / "calib/right.yaml").unlink()
    assert len(frames) == 6 and (session.rig, session.config) == (rig, config)
    for frame, one in zip(frames, true, strict=True):
        assert np.array_equal(frame.left, one.left) and np.array_equal(frame.right, one.right)
    with pytest.raises(SagsError, match=r"launch\.yaml"):
        open_session(folder)
    shutil.copy(SESSION / "launch.yaml", folder)
    with pytest.raises(SagsError, match=r"left\.yaml"):
        open_session(folder)
