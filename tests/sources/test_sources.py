"""Replay of recordings: pairing, order, stamps, pace and truth."""

import json
import re
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_files import MS, START, picture
from dvrk_files import frame_record, write_session
from frames import played
from numbered_pictures import HEIGHT, WIDTH, numbers, recordings, write_png
from places import ROOT, SESSION
from waiting import beside

from sags_node.cli.launching import split
from sags_node.config import schema as cfg
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import DvrkSource
from sags_node.errors import UsageError
from sags_node.sources.pictures import read_picture
from sags_node.sources.replay import Recording, Replay
from sags_node.sources.source import open_source
from sags_node.types import StereoFrame
from sags_node.wall_clock import WallClock


class Clock:
    """A clock that moves only when somebody sleeps or works."""

    def __init__(self) -> None:
        self.now = 100.0
        self.set_by = 7000  # s

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds

    def wall_ns(self) -> int:
        return round(self.now * 1e9) + self.set_by * 10**9


def replay(config: Recording, clock: Clock) -> Replay:
    return Replay(config, clock=clock, wall_ns=clock.wall_ns, sleep=clock.sleep)


def realtime(folders: cfg.FoldersSource, **said: Any) -> cfg.FoldersSource:
    return folders.model_copy(update={"pace": "realtime", **said})


def taken(
    config: Recording, clock: Clock, work: Callable[[StereoFrame], float]
) -> tuple[list[StereoFrame], list[float], int]:
    """Frames, when each was released, and how many were left out, of one who works so long on each, s."""
    frames, released = [], []
    with replay(config, clock) as source:
        for frame in source:
            frames.append(frame)
            released.append(clock.now)
            clock.now += work(frame)
    return frames, released, source.dropped


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Recording]:
    return recordings(tmp_path_factory.mktemp("kinds"))


@pytest.mark.parametrize(
    "kind", ["folders", "videos", "LR", "RL", "over under", "in turn", "cropped", "panes"]
)
def test_every_kind_plays_the_same_frames_once_and_in_a_loop(kind: str, kinds: dict[str, Recording]) -> None:
    config = kinds[kind]
    with open_source(config) as source:
        frames = list(source)
        assert (source.rate, source.frame_count, source.dropped) == (25, 8, 0)
    assert numbers(frames) == [frame.frame_id for frame in frames] == list(range(8))
    assert [frame.t_capture_ns for frame in frames] == [n * 40_000_000 for n in range(8)]
    later = 20_000_000 if kind == "in turn" else 0
    assert {frame.t_capture_right_ns - frame.t_capture_ns for frame in frames} == {later}
    assert frames[0].left.shape == frames[0].right.shape == (HEIGHT, WIDTH, 3)
    assert frames[0].tissue is None and frames[0].reference is None and frames[0].T_world_cam is None

    with open_source(config.model_copy(update={"start": 5 / 25, "frames": 8, "loop": True})) as source:
        frames = list(source)
        assert source.frame_count == 8
    places = [5, 6, 7, 5, 6, 7, 5, 6]
    assert numbers(frames) == places
    assert [frame.epoch for frame in frames] == [0, 0, 0, 1, 1, 1, 2, 2]
    assert [frame.recorded_s for frame in frames] == pytest.approx([place / 25 for place in places])
    assert [frame.frame_id for frame in frames] == list(range(5, 13))
    assert [frame.t_capture_ns for frame in frames] == [frame.frame_id * 40_000_000 for frame in frames]


def test_endless_loop_has_no_frame_count(folders: cfg.FoldersSource) -> None:
    with open_source(folders.model_copy(update={"loop": True})) as source:
        assert source.frame_count is None
        frames = list(islice(source, 30))
    assert numbers(frames) == [n % 12 for n in range(30)]
    assert len({frame.frame_id for frame in frames}) == 30


def test_realtime_waits_and_stamps_the_due_moment(folders: cfg.FoldersSource) -> None:
    """The work is shorter than the period of 0.05 s."""
    frames, released, dropped = taken(realtime(folders), Clock(), lambda frame: 0.03)
    assert [frame.t_capture_ns for frame in frames] == [7_100_000_000_000 + 50_000_000 * n for n in range(12)]
    assert np.allclose(released, 100 + 0.05 * np.arange(12)) and dropped == 0


@pytest.mark.fault("clock: set, or the machine slept, while a recording is played")
@pytest.mark.parametrize("jump", [60, -60])
def test_realtime_stamps_by_the_wall_clock_of_now(jump: int, folders: cfg.FoldersSource) -> None:
    clock = Clock()

    def work(frame: StereoFrame) -> float:
        assert frame.t_capture_ns == clock.wall_ns()
        clock.set_by += jump * (frame.frame_id == 4)
        return 0.01

    seen, _, _ = taken(realtime(folders, loop=True, frames=30), clock, work)
    steps = np.diff([frame.t_capture_ns for frame in seen])
    assert np.flatnonzero(steps != 50_000_000).tolist() == [4] and steps[4] == jump * 10**9 + 50_000_000
    back = [jump < 0 and number > 4 for number in range(30)]
    assert [frame.epoch for frame in seen] == [number // 12 + back[number] for number in range(30)]


def test_a_clock_that_was_read_slowly_is_read_again() -> None:
    """Another process comes between for 5 ms: an hour that is 2.5 ms off would later be set back."""
    times = iter([1.0, 1.005, 2.0, 2.0])
    wall = WallClock()
    assert wall.at(0.0, times.__next__, lambda: 9_000_000_000) == 7_000_000_000


def test_realtime_leaves_out_what_comes_too_late(folders: cfg.FoldersSource) -> None:
    """Frame 3 is due 0.05 s after frame 2; work of 0.22 s makes 3, 4 and 5 more than one period late."""
    config = realtime(folders)
    seen, _, dropped = taken(config, Clock(), lambda frame: 0.22 if frame.frame_id == 2 else 0.001)
    assert [frame.frame_id for frame in seen] == numbers(seen) == [0, 1, 2, 6, 7, 8, 9, 10, 11]
    assert dropped == 3
    stamps = np.array([frame.t_capture_ns for frame in seen])
    assert (np.diff(stamps) == 50_000_000 * np.diff([frame.frame_id for frame in seen])).all()


def test_realtime_never_starves(folders: cfg.FoldersSource) -> None:
    """When even skipping is too slow, one frame a second of the recording still comes through."""
    seen, _, dropped = taken(realtime(folders, loop=True, frames=100), Clock(), lambda frame: 1000.0)
    assert [frame.frame_id for frame in seen] == [0, 21, 42, 63, 84] and dropped == 95


def test_fast_pace_stamps_at_release_and_loses_nothing(folders: cfg.FoldersSource) -> None:
    frames, released, dropped = taken(realtime(folders, pace="fast"), Clock(), lambda frame: 0.5)
    assert [frame.t_capture_ns for frame in frames] == [round((7000 + at) * 1e9) for at in released]
    assert len(frames) == 12 and dropped == 0


def test_stop_ends_a_wait(folders: cfg.FoldersSource) -> None:
    """At one frame in 1000 s only the stop can end this test."""
    rest: list[StereoFrame] = []
    with open_source(realtime(folders, rate=0.001)) as source:
        frames = iter(source)
        next(frames)
        with beside(lambda: rest.extend(frames)):
            source.stop()
    assert rest == []


def test_truth_follows_the_recording_through_a_loop(folders: cfg.FoldersSource, tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 0, 3] = np.arange(12) * 1e-3
    np.savez(tmp_path / "poses.npz", T_world_cam=poses)
    points = np.random.default_rng(0).normal(size=(12, 5, 3))
    visible = np.arange(60).reshape(12, 5) % 3 > 0
    np.savez(tmp_path / "tracks.npz", points=points, visible=visible)
    depth, mask = np.full((HEIGHT, WIDTH), 12345, np.uint16), np.zeros((HEIGHT, WIDTH), np.uint8)
    depth[0, 0] = 0
    write_png(tmp_path / "depth/0010.png", depth)
    for n in range(12):
        mask[:, n] = 255  # one more column of instrument in every frame
        write_png(tmp_path / f"tools/T{n}.png", mask)
    truth = cfg.ReferenceConfig(depth=tmp_path / "depth", depth_kind="ct", tracks=tmp_path / "tracks.npz")
    given = {"tools": tmp_path / "tools", "poses": tmp_path / "poses.npz", "reference": truth}
    config = folders.model_copy(update={**given, "start": 9 / 20, "loop": True, "frames": 5})
    frames = played(config)
    for frame, index in zip(frames, [9, 10, 11, 9, 10], strict=True):
        assert frame.T_world_cam is not None and frame.T_world_cam[0, 3] == poses[index, 0, 3]
        assert frame.tissue is not None and (frame.tissue == (np.arange(WIDTH) > index)).all()
        reference = frame.reference
        assert reference is not None and reference.depth_kind == "ct"
        assert np.array_equal(reference.points, points[index])
        assert np.array_equal(reference.points_visible, visible[index])
        assert (reference.depth is not None) == (index == 10)
    measured = frames[1].reference
    assert measured is not None and measured.depth is not None and measured.depth.dtype == np.float32
    assert measured.depth[0, 0] == 0 and measured.depth[1, 1] == pytest.approx(0.12345)

    with open_source(config, references=False) as source:
        frame = next(iter(source))
    assert frame.reference is None and frame.T_world_cam is not None and frame.tissue is not None


def test_tracks_of_some_frames_go_by_their_numbers(folders: cfg.FoldersSource, tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(3, 5, 3))
    np.savez(tmp_path / "t.npz", points=points, visible=np.ones((3, 5), bool), frames=[9, 3, 6])
    update = {"reference": cfg.ReferenceConfig(tracks=tmp_path / "t.npz"), "stride": 3}
    first, *others = (frame.reference for frame in played(folders.model_copy(update=update)))
    assert first is None
    np.testing.assert_array_equal([other.points for other in others if other is not None], points[[1, 2, 0]])


def test_phantom_session_is_played_as_this_launch_file_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of forty frames that was rendered before."""
    monkeypatch.setattr("sags_node.phantom.cached_session", lambda config, progress: SESSION)
    with open_source(cfg.PhantomSource(pace="step", rate=5, loop=True, start=6.4, frames=9)) as source:
        frames = list(source)
    assert [frame.t_capture_ns for frame in frames] == [number * 200_000_000 for number in range(32, 41)]
    assert [frame.epoch for frame in frames] == [0] * 8 + [1]
    assert (frames[0].left == frames[8].left).all() and (frames[0].left != frames[1].left).any()
    for frame in (frames[0], frames[8]):
        assert frame.tissue is not None and frame.T_world_cam is not None
        assert frame.reference is not None and frame.reference.depth_kind == "exact"
        assert frame.reference.depth is not None and frame.reference.points is not None


def test_a_real_clip_with_panes_masks_and_depth(data_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SAGS_DATA", str(data_folder))
    config = load_launch(ROOT / "launch/d4d_pull.yaml", ["source.pace:=step", "source.stride:=5"]).source
    overlaps = []
    for number, frame in zip(range(0, 179, 5), played(config), strict=True):
        assert frame.left.shape == frame.right.shape == (540, 675, 3) and frame.tissue is not None
        assert frame.left[..., 0].mean() > frame.left[..., 1].mean()  # tissue is red: RGB, not BGR
        assert (frame.reference is not None) == (number % 10 == 0)
        if frame.reference is None:
            continue
        assert frame.reference.depth is not None and frame.reference.depth_kind == "stereo_network"
        assert 0.03 < float(np.median(frame.reference.depth[frame.reference.depth > 0])) < 0.15  # metres
        tools = read_picture(data_folder / f"d4d_pull/toolmask/{number:04d}.png")[..., 0] > 127
        overlaps.append((tools & ~frame.tissue).sum() / (tools | ~frame.tissue).sum())
    assert np.median(overlaps) >= 0.95 and min(overlaps) >= 0.9


# ---- dVRK sessions as sources: stamps of the sidecar for the images of its video ---------------------


def stamps_ms(frames: list[StereoFrame]) -> list[tuple[int, int]]:
    return [((f.t_capture_ns - START) // MS, (f.t_capture_right_ns - START) // MS) for f in frames]


@pytest.mark.parametrize("order", ["LR", "RL"])
def test_a_dvrk_session(order: str, tmp_path: Path) -> None:
    frames = [frame_record(number) for number in range(8)]
    frames[3] = frame_record(3, left_source_ns=None)
    frames[5] = frame_record(5, left_source_ns=None, right_source_ns=None)
    folder = write_session(tmp_path / "session", frames, order=order)
    for given in (folder, folder / "stereo.json"):
        source = load_launch(*split([str(given), "source.side_by_side:=RL"])).source
        assert isinstance(source, DvrkSource) and source.side_by_side == "RL"
    with Replay(DvrkSource(path=folder, pace="step")) as source:
        frames = list(source)
        assert source.rate == pytest.approx(25, rel=0.1)
    other = [(123, 123), (160, 163), (209, 209)]
    assert stamps_ms(frames) == [(0, 3), (40, 43), (80, 83), *other, (240, 243), (280, 283)]
    for frame in frames:
        assert frame.right is not None and abs(float(frame.right.mean()) - 200) < 8
    assert np.abs(frames[6].left.astype(int) - picture(6, 0)).mean() < 15


@pytest.mark.parametrize(
    ("listed", "said"),
    [
        ((0, 1, 2, 5, 6, 7), []),  # the encoder made 25 Hz of frames of which two never came
        (range(10), [r"stereo\.mp4 is 80 ms shorter than .*\.json, .* stamps are early by as much"]),
        (range(6), [r"stereo\.json is 80 ms shorter than .*\.mp4, .* stamps are late by as much"]),
    ],
    ids=["frames are missing", "shorter", "longer"],
)
def test_a_dvrk_video_of_other_frames(listed: Sequence[int], said: list[str], tmp_path: Path) -> None:
    folder = write_session(tmp_path / "session", [frame_record(number) for number in listed])
    with Replay(DvrkSource(path=folder, pace="step")) as source:
        lefts = [left for left, _ in stamps_ms(list(source))]
        found = [finding.what for finding in source.pairs.findings]
    assert len(found) == len(said) and all(map(re.search, said, found))
    assert said or lefts == [0, 40, 80, 80, 200, 200, 240, 280]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"type": "dvrk_data:sidecar@1.0.0"}, "is of type 'dvrk_data:sidecar@1.0.0'"),
        ({"frames": []}, "lists no frames"),
        ({"frames": [{"cpu": 3}]}, r"not a dvrk_data:video_sidecar@1\.0\.0 file: .*cpu"),
        ({"frames": [frame_record(0), frame_record(0, left_source_ns=-5)]}, "not a dvrk_data"),
        ({"frames": [frame_record(n) for n in (0, 1, 2, 4, 3, 5, 6, 7)]}, "frame 4 lies before"),
        ({"side_by_side": "undefined"}, "set source.side_by_side to LR or RL"),
        ({"video_file": "../../other.mp4"}, "other.mp4 does not exist"),
    ],
)
def test_a_wrong_sidecar(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    folder = write_session(tmp_path / "session", [frame_record(number) for number in range(8)])
    file = folder / "stereo.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    with pytest.raises(UsageError, match=said):
        Replay(DvrkSource(path=file))
    with pytest.raises(UsageError, match="one sidecar of a stereo video is needed, there are: none"):
        Replay(DvrkSource(path=tmp_path))
