"""Replay of recordings: pairing, order, stamps, pace and truth."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numbered_pictures import HEIGHT, WIDTH, numbers, recordings

from sags_node.config import schema as cfg
from sags_node.sources.replay import Recording, Replay
from sags_node.sources.source import open_source
from sags_node.types import StereoFrame


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
        thread.join(30)
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
