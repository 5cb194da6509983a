"""Replay of recordings: pairing, order, stamps, pace, truth, and the mistakes users make with paths."""

from __future__ import annotations

import io
import os
import threading
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from sags_node import config as cfg
from sags_node.errors import SagsError, UsageError
from sags_node.launch_file import DEFAULT_DATA
from sags_node.sources.replay import Recording, Replay
from sags_node.sources.source import open_source
from sags_node.types import U8, StereoFrame

ROOT = Path(__file__).parent.parent
DATA = Path(os.environ.get("SAGS_DATA", ROOT / DEFAULT_DATA))
D4D = DATA / "d4d_pull"
D4D_VIDEO = D4D / "2025_03_06-16_49_40_combined_2x2.mp4"
needs_d4d = pytest.mark.skipif(not D4D_VIDEO.exists(), reason=f"no D4D recording in {DATA}; set SAGS_DATA")

WIDTH, HEIGHT = 32, 24


def picture(number: int, eye: int = 0) -> U8:
    """An RGB picture that tells its frame number (red) and its eye (blue)."""
    return np.full((HEIGHT, WIDTH, 3), (10 * number, 100, 200 * eye), np.uint8)


def number_of(rgb: U8) -> int:
    return round(float(rgb[..., 0].mean()) / 10)


def eye_of(rgb: U8) -> int:
    return int(rgb[..., 2].mean() > 100)


def write_png(file: Path, rgb: U8) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), rgb[..., ::-1])


def write_video(file: Path, pictures: list[U8], rate: float = 25.0) -> Path:
    """Lossy MJPG, as capture boxes write it."""
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), rate, (width, height))
    assert writer.isOpened()
    for rgb in pictures:
        writer.write(np.ascontiguousarray(rgb[..., ::-1]))
    writer.release()
    return file


@pytest.fixture
def folders(tmp_path: Path) -> cfg.FoldersSource:
    """Twelve pairs whose numbers are not padded: plain text order would play 1, 10, 11, 2."""
    for number in range(12):
        write_png(tmp_path / f"left/L{number}.png", picture(number))
        write_png(tmp_path / f"right/R{number}.png", picture(number, eye=1))
    return cfg.FoldersSource(left=tmp_path / "left", right=tmp_path / "right", pace="step", rate=20)


class Clock:
    """A clock that moves only when somebody sleeps or works."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds

    def wall_ns(self) -> int:
        return round(self.now * 1e9) + 7_000_000_000_000


def replay(config: Recording, clock: Clock) -> Replay:
    return Replay(config, clock=clock, wall_ns=clock.wall_ns, sleep=clock.sleep)


def numbers(frames: list[StereoFrame]) -> list[int]:
    """Frame numbers as the pictures show them; both eyes must show the same one."""
    for frame in frames:
        assert (eye_of(frame.left), eye_of(frame.right)) == (0, 1)
        assert number_of(frame.left) == number_of(frame.right)
    return [number_of(frame.left) for frame in frames]


def recordings(tmp_path: Path) -> dict[str, Recording]:
    """The same eight frames in every kind of file."""
    pairs = [(picture(n), picture(n, eye=1)) for n in range(8)]
    green = np.zeros_like(pairs[0][0])
    for n, (left, right) in enumerate(pairs):
        write_png(tmp_path / f"l/{n:03d}.png", left)
        write_png(tmp_path / f"r/{n:03d}.png", right)
    left_file = write_video(tmp_path / "l.avi", [pair[0] for pair in pairs])
    right_file = write_video(tmp_path / "r.avi", [pair[1] for pair in pairs])
    lr = write_video(tmp_path / "lr.avi", [np.hstack(pair) for pair in pairs])
    rl = write_video(tmp_path / "rl.avi", [np.hstack(pair[::-1]) for pair in pairs])
    panes = write_video(
        tmp_path / "panes.avi", [np.vstack([np.hstack(p), np.hstack([green] * 2)]) for p in pairs]
    )
    return {
        "folders": cfg.FoldersSource(left=tmp_path / "l", right=tmp_path / "r", pace="step", rate=25),
        "videos": cfg.VideosSource(left=left_file, right=right_file, pace="step"),
        "LR": cfg.SideBySideSource(video=lr, pace="step"),
        "RL": cfg.SideBySideSource(video=rl, order="RL", pace="step"),
        "panes": cfg.PanesSource(
            video=panes, left=(0, 0, WIDTH, HEIGHT), right=(WIDTH, 0, WIDTH, HEIGHT), pace="step"
        ),
    }


@pytest.mark.parametrize("kind", ["folders", "videos", "LR", "RL", "panes"])
def test_every_kind_plays_the_same_frames(tmp_path: Path, kind: str) -> None:
    config = recordings(tmp_path)[kind]
    with open_source(config) as source:
        frames = list(source)
        assert source.rate == 25
        assert source.frame_count == 8
        assert source.dropped == 0
    assert numbers(frames) == list(range(8))
    assert [frame.frame_id for frame in frames] == list(range(8))
    assert [frame.t_capture_ns for frame in frames] == [n * 40_000_000 for n in range(8)]
    assert {frame.t_capture_right_ns - frame.t_capture_ns for frame in frames} == {0}
    assert frames[0].left.shape == frames[0].right.shape == (HEIGHT, WIDTH, 3)
    assert frames[0].tissue is None and frames[0].reference is None and frames[0].T_world_cam is None


@pytest.mark.parametrize("kind", ["folders", "videos", "LR", "panes"])
def test_start_frames_and_loop(tmp_path: Path, kind: str) -> None:
    config = recordings(tmp_path)[kind]
    config = config.model_copy(update={"start": 5 / 25, "frames": 8, "loop": True})
    with open_source(config) as source:
        frames = list(source)
        assert source.frame_count == 8
    assert numbers(frames) == [5, 6, 7, 5, 6, 7, 5, 6]
    assert [frame.epoch for frame in frames] == [0, 0, 0, 1, 1, 1, 2, 2]
    assert [frame.frame_id for frame in frames] == list(range(5, 13))
    stamps = [frame.t_capture_ns for frame in frames]
    assert stamps == [frame.frame_id * 40_000_000 for frame in frames]


def test_endless_loop_has_no_frame_count(folders: cfg.FoldersSource) -> None:
    with open_source(folders.model_copy(update={"loop": True})) as source:
        assert source.frame_count is None
        seen = []
        for frame in source:
            seen.append(frame)
            if len(seen) == 30:
                source.stop()
    assert numbers(seen) == [n % 12 for n in range(30)]
    assert len({frame.frame_id for frame in seen}) == 30


def test_step_pace_is_reproducible(folders: cfg.FoldersSource) -> None:
    def play() -> list[tuple[int, int, bytes]]:
        with open_source(folders) as source:
            return [(f.frame_id, f.t_capture_ns, f.left.tobytes()) for f in source]

    assert play() == play()


def test_realtime_waits_and_stamps_the_due_moment(folders: cfg.FoldersSource) -> None:
    clock = Clock()
    released = []
    with replay(folders.model_copy(update={"pace": "realtime"}), clock) as source:
        for frame in source:
            released.append(clock.now)
            clock.now += 0.03  # work shorter than the period of 0.05 s
            assert frame.t_capture_ns == 7_100_000_000_000 + 50_000_000 * frame.frame_id
    assert np.allclose(released, 100 + 0.05 * np.arange(12))
    assert source.dropped == 0


def test_realtime_leaves_out_what_comes_too_late(folders: cfg.FoldersSource) -> None:
    clock = Clock()
    seen = []
    with replay(folders.model_copy(update={"pace": "realtime"}), clock) as source:
        for frame in source:
            seen.append(frame)
            # Frame 3 is due 0.05 s after frame 2; work of 0.22 s makes 3, 4 and 5 more than one period late.
            clock.now += 0.22 if frame.frame_id == 2 else 0.001
    assert [frame.frame_id for frame in seen] == numbers(seen) == [0, 1, 2, 6, 7, 8, 9, 10, 11]
    assert source.dropped == 3
    stamps = np.array([frame.t_capture_ns for frame in seen])
    assert (np.diff(stamps) == 50_000_000 * np.diff([frame.frame_id for frame in seen])).all()


def test_realtime_never_starves(folders: cfg.FoldersSource) -> None:
    """When even skipping is too slow, one frame a second of the recording still comes through."""
    clock = Clock()
    config = folders.model_copy(update={"pace": "realtime", "loop": True, "frames": 100})
    with replay(config, clock) as source:
        seen = []
        for frame in source:
            seen.append(frame.frame_id)
            clock.now += 1000.0
    assert seen == [0, 21, 42, 63, 84]
    assert source.dropped == 95


def test_fast_pace_stamps_at_release_and_loses_nothing(folders: cfg.FoldersSource) -> None:
    clock = Clock()
    stamps = []
    with replay(folders.model_copy(update={"pace": "fast"}), clock) as source:
        for frame in source:
            stamps.append(frame.t_capture_ns)
            assert frame.t_capture_ns == clock.wall_ns()
            clock.now += 0.5
    assert len(stamps) == 12 and source.dropped == 0


def test_stop_ends_a_wait(folders: cfg.FoldersSource) -> None:
    """At one frame in 1000 s only the stop can end this test."""
    with open_source(folders.model_copy(update={"pace": "realtime", "rate": 0.001})) as source:
        frames: Iterator[StereoFrame] = iter(source)
        next(frames)
        rest: list[StereoFrame] = []
        thread = threading.Thread(target=lambda: rest.extend(frames))
        thread.start()
        source.stop()
        thread.join(5)
        assert not thread.is_alive()
    assert rest == []


def test_truth_follows_the_recording_through_a_loop(folders: cfg.FoldersSource, tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 0, 3] = np.arange(12) * 1e-3
    np.savez(tmp_path / "poses.npz", T_world_cam=poses)
    points = np.random.default_rng(0).normal(size=(12, 5, 3))
    visible = np.arange(60).reshape(12, 5) % 3 > 0
    np.savez(tmp_path / "tracks.npz", points=points, visible=visible)
    depth = np.full((HEIGHT, WIDTH), 12345, np.uint16)
    depth[0, 0] = 0
    write_depth = tmp_path / "depth"
    write_depth.mkdir()
    cv2.imwrite(str(write_depth / "0010.png"), depth)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    for n in range(12):
        mask[:, n] = 255  # one more column of instrument in every frame
        (tmp_path / "tools").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / f"tools/T{n}.png"), mask)
    truth = cfg.ReferenceConfig(depth=write_depth, depth_kind="ct", tracks=tmp_path / "tracks.npz")
    update = {
        "tools": tmp_path / "tools",
        "poses": tmp_path / "poses.npz",
        "reference": truth,
        "start": 9 / 20,
        "loop": True,
        "frames": 5,
    }
    with open_source(folders.model_copy(update=update)) as source:
        frames = list(source)
    for frame, index in zip(frames, [9, 10, 11, 9, 10], strict=True):
        assert frame.T_world_cam is not None and frame.T_world_cam[0, 3] == poses[index, 0, 3]
        assert frame.tissue is not None and (frame.tissue == (np.arange(WIDTH) > index)).all()
        assert frame.reference is not None and frame.reference.points is not None
        assert (frame.reference.points == points[index]).all()
        assert (frame.reference.points_visible == visible[index]).all()
        assert (frame.reference.depth is not None) == (index == 10)
        assert frame.reference.depth_kind == "ct"
    measured = frames[1].reference
    assert measured is not None and measured.depth is not None and measured.depth.dtype == np.float32
    assert measured.depth[0, 0] == 0
    assert measured.depth[1, 1] == pytest.approx(0.12345)

    with open_source(folders.model_copy(update=update), references=False) as source:
        frame = next(iter(source))
    assert frame.reference is None and frame.T_world_cam is not None and frame.tissue is not None


def test_phantom_session_is_played_as_this_launch_file_asks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    config = cfg.PhantomSource(seconds=0.1, width=64, height=64, pace="step", rate=10, loop=True, frames=4)
    with open_source(config) as source:
        frames = list(source)
    assert [frame.t_capture_ns for frame in frames] == [0, 100_000_000, 200_000_000, 300_000_000]
    assert [frame.epoch for frame in frames] == [0, 0, 0, 1]
    assert (frames[0].left == frames[3].left).all() and (frames[0].left != frames[1].left).any()
    for frame in frames:
        assert frame.left.shape == (64, 64, 3)
        assert frame.tissue is not None and frame.T_world_cam is not None
        assert frame.reference is not None and frame.reference.depth_kind == "exact"
        assert frame.reference.depth is not None and frame.reference.points is not None


# ---- mistakes --------------------------------------------------------------------------------------------


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
    return cfg.SideBySideSource(video=folder / "none.mp4")


def text_as_video(folder: Path) -> Recording:
    (folder / "text.mp4").write_text("hello")
    return cfg.SideBySideSource(video=folder / "text.mp4")


def odd_width(folder: Path) -> Recording:
    # OpenCV's own writer keeps an odd width, its FFmpeg writer cuts it.
    mjpg = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(folder / "odd.avi"), cv2.CAP_OPENCV_MJPEG, mjpg, 25, (33, 24))
    assert writer.isOpened()
    writer.write(np.zeros((24, 33, 3), np.uint8))
    writer.release()
    return cfg.SideBySideSource(video=folder / "odd.avi")


def crop_outside(folder: Path) -> Recording:
    return cfg.PanesSource(video=folder / "lr.avi", left=(0, 0, 32, 24), right=(40, 0, 32, 24))


def crops_of_two_sizes(folder: Path) -> Recording:
    return cfg.PanesSource(video=folder / "lr.avi", left=(0, 0, 32, 24), right=(32, 0, 16, 24))


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
        (empty_folder, "empty holds no .jpg or .png file"),
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
        (crop_outside, r"pane 'right' \(40, 0, 32, 24\) .* leaves the picture: .*lr.avi is 64x24 px"),
        (crops_of_two_sizes, "pane 'right' is 16x24 px but the left pane is 32x24"),
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


def frames_until_error(config: Recording) -> tuple[list[StereoFrame], str]:
    frames = []
    with open_source(config) as source, pytest.raises(SagsError) as caught:
        for frame in source:
            frames.append(frame)
    return frames, str(caught.value)


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_damaged_picture_in_the_middle_is_named(tmp_path: Path, suffix: str) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    for n in range(5):
        write_png(tmp_path / f"l/{n}.{suffix}", noise)
        write_png(tmp_path / f"r/{n}.{suffix}", noise)
    broken = tmp_path / f"r/3.{suffix}"
    broken.write_bytes(broken.read_bytes()[:-200])
    frames, message = frames_until_error(
        cfg.FoldersSource(left=tmp_path / "l", right=tmp_path / "r", pace="step")
    )
    assert len(frames) == 3
    assert f"picture {broken} is damaged or cut off" in message


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


def test_missing_pictures_on_both_sides_are_noticed(
    folders: cfg.FoldersSource, caplog: pytest.LogCaptureFixture
) -> None:
    (folders.left / "L3.png").unlink()
    (folders.right / "R8.png").unlink()
    with open_source(folders):
        pass
    assert "L4.png is paired with" in caplog.text and "R3.png" in caplog.text


# ---- the real recording ----------------------------------------------------------------------------------


def d4d(**playing: object) -> cfg.PanesSource:
    return cfg.PanesSource(
        video=D4D_VIDEO,
        left=(0, 0, 675, 540),
        right=(675, 0, 675, 540),
        tools=(675, 540, 675, 540),
        pace="step",
        reference=cfg.ReferenceConfig(depth=D4D / "depth_mm_x100", depth_kind="stereo_network"),
    ).model_copy(update=playing)


@needs_d4d
def test_d4d_clip() -> None:
    overlaps = []
    with open_source(d4d()) as source:
        assert source.rate == 30 and source.frame_count == 179
        for index, frame in enumerate(source):
            assert frame.frame_id == index
            assert frame.left.shape == frame.right.shape == (540, 675, 3)
            assert frame.left[..., 0].mean() > frame.left[..., 1].mean()  # tissue is red: RGB, not BGR
            assert frame.tissue is not None
            assert (frame.reference is not None) == (index % 10 == 0)
            if frame.reference is None:
                continue
            assert frame.reference.depth is not None and frame.reference.depth_kind == "stereo_network"
            known = frame.reference.depth[frame.reference.depth > 0]
            assert 0.03 < float(np.median(known)) < 0.15  # metres
            mask = cv2.imread(str(D4D / f"toolmask/{index:04d}.png"), cv2.IMREAD_GRAYSCALE)
            assert mask is not None
            tools, found = mask > 127, ~frame.tissue
            overlaps.append((tools & found).sum() / (tools | found).sum())
    assert index == 178
    assert len(overlaps) == 18
    assert np.median(overlaps) >= 0.95 and min(overlaps) >= 0.9


@needs_d4d
def test_d4d_seeks_to_the_exact_frame() -> None:
    with open_source(d4d(frames=92), references=False) as source:
        last = list(source)[-1]
    with open_source(d4d(start=91 / 30, frames=1), references=False) as source:
        sought = next(iter(source))
    assert last.frame_id == sought.frame_id == 91
    assert (last.left == sought.left).all()
