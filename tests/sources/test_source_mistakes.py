"""Recordings that cannot be played: what users get wrong, and damage that shows late, named with its fix."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numbered_pictures import HEIGHT, WIDTH, numbers, picture, recordings, write_png, write_video

from sags_node.config import schema as cfg
from sags_node.errors import SagsError, UsageError
from sags_node.sources.replay import Recording
from sags_node.sources.source import open_source
from sags_node.types import StereoFrame

HALVES = cfg.GeometryConfig(layout="side_by_side")

# ---- at opening ------------------------------------------------------------------------------------------


def no_left(folder: Path) -> Recording:
    return cfg.FoldersSource(left=folder / "nowhere", right=folder / "r")


def left_is_a_file(folder: Path) -> Recording:
    return cfg.FoldersSource(left=folder / "l/000.png", right=folder / "r")


def empty_folder(folder: Path) -> Recording:
    (folder / "empty").mkdir()
    return cfg.FoldersSource(left=folder / "l", right=folder / "empty")


def fewer_right(folder: Path) -> Recording:
    (folder / "r/003.png").unlink()
    return cfg.FoldersSource(left=folder / "l", right=folder / "r")


def fewer_tools(folder: Path) -> Recording:
    write_png(folder / "tools/000.png", picture(0))
    return cfg.FoldersSource(left=folder / "l", right=folder / "r", tools=folder / "tools")


def eyes_of_two_sizes(folder: Path) -> Recording:
    write_png(folder / "r/000.png", np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    return cfg.FoldersSource(left=folder / "l", right=folder / "r")


def damaged_first(folder: Path) -> Recording:
    (folder / "l/000.png").write_bytes(b"not a picture")
    return cfg.FoldersSource(left=folder / "l", right=folder / "r")


def start_behind_end(folder: Path) -> Recording:
    return cfg.FoldersSource(left=folder / "l", right=folder / "r", start=60)


def no_video(folder: Path) -> Recording:
    return cfg.VideosSource(left=folder / "none.mp4", geometry=HALVES)


def text_as_video(folder: Path) -> Recording:
    (folder / "text.mp4").write_text("hello")
    return cfg.VideosSource(left=folder / "text.mp4", geometry=HALVES)


def odd_width(folder: Path) -> Recording:
    # OpenCV's own writer keeps an odd width, its FFmpeg writer cuts it.
    mjpg = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(folder / "odd.avi"), cv2.CAP_OPENCV_MJPEG, mjpg, 25, (33, 24))
    assert writer.isOpened()
    writer.write(np.zeros((24, 33, 3), np.uint8))
    writer.release()
    return cfg.VideosSource(left=folder / "odd.avi", geometry=HALVES)


def panes(folder: Path, left: cfg.Box, right: cfg.Box, tools: cfg.Box | None = None) -> Recording:
    boxes = cfg.GeometryConfig(layout="panes", crop=left, crop_right=right)
    return cfg.VideosSource(left=folder / "lr.avi", geometry=boxes, tools=tools)


def crop_outside(folder: Path) -> Recording:
    return panes(folder, (0, 0, 32, 24), (40, 0, 32, 24))


def crops_of_two_sizes(folder: Path) -> Recording:
    return panes(folder, (0, 0, 32, 24), (32, 0, 16, 24))


def tools_of_another_size(folder: Path) -> Recording:
    return panes(folder, (0, 0, 32, 24), (32, 0, 32, 24), (0, 0, 16, 24))


def videos_of_two_sizes(folder: Path) -> Recording:
    return cfg.VideosSource(left=folder / "l.avi", right=folder / "lr.avi")


def videos_of_two_rates(folder: Path) -> Recording:
    write_video(folder / "slow.avi", [picture(0)], rate=10)
    return cfg.VideosSource(left=folder / "l.avi", right=folder / "slow.avi")


def no_poses(folder: Path) -> Recording:
    return cfg.FoldersSource(left=folder / "l", right=folder / "r", poses=folder / "poses.npz")


def poses_of_wrong_shape(folder: Path) -> Recording:
    np.savez(folder / "poses.npz", T_world_cam=np.eye(4))
    return no_poses(folder)


def poses_of_other_name(folder: Path) -> Recording:
    np.savez(folder / "poses.npz", poses=np.eye(4)[None])
    return no_poses(folder)


def pickled_poses(folder: Path) -> Recording:
    np.savez(folder / "poses.npz", T_world_cam=np.full((8, 4, 4), {}, dtype=object))
    return no_poses(folder)


def torn_poses(folder: Path) -> Recording:
    np.savez(folder / "poses.npz", T_world_cam=np.tile(np.eye(4), (8, 1, 1)))
    data = (folder / "poses.npz").read_bytes()
    (folder / "poses.npz").write_bytes(data[: len(data) // 2])
    return no_poses(folder)


def depth_without_numbers(folder: Path) -> Recording:
    write_png(folder / "depth/first.png", picture(0))
    truth = cfg.ReferenceConfig(depth=folder / "depth")
    return cfg.FoldersSource(left=folder / "l", right=folder / "r", reference=truth)


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (no_left, "nowhere does not exist; check the path"),
        (left_is_a_file, "000.png is not a folder; check the path"),
        (empty_folder, "empty holds no picture"),
        (fewer_right, "l holds 8 pictures but .*r holds 7; pairing goes by sorted name"),
        (fewer_tools, "l holds 8 pictures but .*tools holds 1; pairing"),
        (
            eyes_of_two_sizes,
            "r/000.png is 33x24 px but .*l/000.png is 32x24; all pictures must have one size",
        ),
        (damaged_first, "l/000.png is damaged or cut off"),
        (start_behind_end, "source.start 60.0 s lies behind the recording's end at 0.27 s"),
        (no_video, "none.mp4 does not exist; check the path"),
        (text_as_video, "text.mp4 cannot be read as a video"),
        (odd_width, "odd.avi is 33 px wide, which is odd"),
        (crop_outside, r"the box \[40, 0, 32, 24\] .* leaves the picture: an eye of .*lr.avi is 64x24 px"),
        (crops_of_two_sizes, "source.geometry.crop is 32x24 px but crop_right 16x24; both eyes need one"),
        (tools_of_another_size, "source.tools is 16x24 px but source.geometry.crop 32x24; all panes need"),
        (videos_of_two_sizes, "l.avi has 32x24 px but .*lr.avi has 64x24; they are not one stereo pair"),
        (videos_of_two_rates, r"l.avi has 25.0 frames/s but .*slow.avi has 10.0;"),
        (no_poses, "poses.npz does not exist; check the path"),
        (poses_of_wrong_shape, r"'T_world_cam' is float64 \[4, 4\], wanted numbers \[any, 4, 4\]"),
        (poses_of_other_name, "poses.npz holds no array 'T_world_cam'"),
        (pickled_poses, "'T_world_cam' is object"),
        (torn_poses, "poses.npz is not a readable npz file"),
        (depth_without_numbers, "first.png: reference depth files are named by frame number"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_mistakes_at_opening(tmp_path: Path, mistake: Callable[[Path], Recording], message: str) -> None:
    recordings(tmp_path)
    with pytest.raises(SagsError, match=message) as caught:
        open_source(mistake(tmp_path))
    assert "\n" not in str(caught.value)
    # Everything but damaged picture data is a mistake of the request.
    assert isinstance(caught.value, UsageError) or mistake in (damaged_first, eyes_of_two_sizes)


def test_impossible_array_size_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    recordings(tmp_path)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**9, 4, 4)}
    )
    with zipfile.ZipFile(tmp_path / "poses.npz", "w") as archive:
        archive.writestr("T_world_cam.npy", header.getvalue() + bytes(128))
    with pytest.raises(UsageError, match="claims an impossible size"):
        open_source(no_poses(tmp_path))


@pytest.mark.fault("file: pictures of both eyes were deleted before it is played")
def test_missing_pictures_on_both_sides_are_noticed(
    folders: cfg.FoldersSource, caplog: pytest.LogCaptureFixture
) -> None:
    (folders.left / "L3.png").unlink()
    (folders.right / "R8.png").unlink()
    with open_source(folders):
        pass
    assert "L4.png is paired with" in caplog.text and "R3.png" in caplog.text


# ---- on the way ------------------------------------------------------------------------------------------


def frames_until_error(config: Recording) -> tuple[list[StereoFrame], str]:
    frames = []
    with open_source(config) as source, pytest.raises(SagsError) as caught:
        for frame in source:
            frames.append(frame)
    return frames, str(caught.value)


@pytest.mark.fault("file: a picture is cut off")
@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_damaged_picture_in_the_middle_is_named(tmp_path: Path, suffix: str) -> None:
    left, right = np.random.default_rng(1).integers(0, 255, (2, HEIGHT, WIDTH, 3), np.uint8)
    for n in range(5):
        write_png(tmp_path / f"l/{n}.{suffix}", left)
        write_png(tmp_path / f"r/{n}.{suffix}", right)
    broken = tmp_path / f"r/3.{suffix}"
    broken.write_bytes(broken.read_bytes()[:-200])
    frames, message = frames_until_error(
        cfg.FoldersSource(left=tmp_path / "l", right=tmp_path / "r", pace="step")
    )
    assert len(frames) == 3
    assert f"picture {broken} is damaged or cut off" in message


@pytest.mark.fault("file: a picture has another size")
def test_picture_of_another_size_in_the_middle_is_named(folders: cfg.FoldersSource) -> None:
    write_png(folders.left / "L7.png", np.zeros((HEIGHT + 2, WIDTH, 3), np.uint8))
    frames, message = frames_until_error(folders)
    assert len(frames) == 7
    assert "L7.png is 32x26 px but" in message


def test_shorter_right_video_says_where_it_ends(tmp_path: Path) -> None:
    left = write_video(tmp_path / "l.avi", [picture(n) for n in range(8)])
    right = write_video(tmp_path / "r.avi", [picture(n, eye=1) for n in range(6)])
    config = cfg.VideosSource(left=left, right=right, pace="step")
    frames, message = frames_until_error(config)
    assert numbers(frames) == list(range(6))
    assert "r.avi ends at frame 6 but" in message and "source.frames" in message
    with open_source(config.model_copy(update={"frames": 6})) as source:  # the way out that the message names
        assert len(list(source)) == 6


def test_too_few_poses_say_for_which_frame(folders: cfg.FoldersSource, tmp_path: Path) -> None:
    np.savez(tmp_path / "poses.npz", T_world_cam=np.tile(np.eye(4), (4, 1, 1)))
    frames, message = frames_until_error(folders.model_copy(update={"poses": tmp_path / "poses.npz"}))
    assert len(frames) == 4
    assert "poses.npz holds 4 poses, none for frame 4" in message
