"""Replay of recordings: pairing, order, stamps, pace and truth."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bag_files import MS, START, picture
from dvrk_files import frame_record, write_session
from numbered_pictures import HEIGHT, WIDTH, numbers, recordings
from places import SESSION
from waiting import beside

from sags_node.cli.launching import split
from sags_node.config import schema as cfg
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import DvrkSource, LaunchConfig
from sags_node.errors import UsageError
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


@pytest.mark.parametrize(
    "kind", ["folders", "videos", "LR", "RL", "over under", "in turn", "cropped", "panes"]
)
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
    later = 20_000_000 if kind == "in turn" else 0
    assert {frame.t_capture_right_ns - frame.t_capture_ns for frame in frames} == {later}
    assert frames[0].left.shape == frames[0].right.shape == (HEIGHT, WIDTH, 3)
    assert frames[0].tissue is None and frames[0].reference is None and frames[0].T_world_cam is None


@pytest.mark.parametrize("kind", ["folders", "videos", "LR", "in turn", "panes"])
def test_start_frames_and_loop(tmp_path: Path, kind: str) -> None:
    config = recordings(tmp_path)[kind]
    config = config.model_copy(update={"start": 5 / 25, "frames": 8, "loop": True})
    with open_source(config) as source:
        frames = list(source)
        assert source.frame_count == 8
    assert numbers(frames) == [5, 6, 7, 5, 6, 7, 5, 6]
    assert [frame.epoch for frame in frames] == [0, 0, 0, 1, 1, 1, 2, 2]
    places = [5 / 25, 6 / 25, 7 / 25]
    assert [frame.recorded_s for frame in frames] == pytest.approx([*places, *places, *places[:2]])
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


@pytest.mark.fault("clock: set, or the machine slept, while a recording is played")
@pytest.mark.parametrize("jump", [60, -60])
def test_realtime_stamps_by_the_wall_clock_of_now(jump: int, folders: cfg.FoldersSource) -> None:
    clock = Clock()
    seen = []
    with replay(folders.model_copy(update={"pace": "realtime", "loop": True, "frames": 30}), clock) as source:
        for frame in source:
            seen.append(frame)
            assert frame.t_capture_ns == clock.wall_ns()
            clock.set_by += jump * (frame.frame_id == 4)
            clock.now += 0.01
    steps = np.diff([frame.t_capture_ns for frame in seen])
    assert np.flatnonzero(steps != 50_000_000).tolist() == [4] and steps[4] == jump * 10**9 + 50_000_000
    loops = [frame.frame_id // 12 for frame in seen]
    back = [int(jump < 0 and frame.frame_id > 4) for frame in seen]
    assert [frame.epoch for frame in seen] == [sum(both) for both in zip(loops, back, strict=True)]


def test_a_clock_that_was_read_slowly_is_read_again() -> None:
    """Another process comes between for 5 ms: an hour that is 2.5 ms off would later be set back."""
    times = iter([1.0, 1.005, 2.0, 2.0])
    wall = WallClock()
    assert wall.at(0.0, times.__next__, lambda: 9_000_000_000) == 7_000_000_000


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


def test_tracks_of_some_frames_go_by_their_numbers(folders: cfg.FoldersSource, tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(3, 5, 3))
    rows = {9: 0, 3: 1, 6: 2}
    np.savez(tmp_path / "t.npz", points=points, visible=np.ones((3, 5), bool), frames=list(rows))
    update = {"reference": cfg.ReferenceConfig(tracks=tmp_path / "t.npz"), "stride": 3}
    with open_source(folders.model_copy(update=update)) as source:
        for frame, number in zip(source, (0, 3, 6, 9), strict=True):
            if number == 0:
                assert frame.reference is None
                continue
            assert frame.reference is not None
            assert np.array_equal(frame.reference.points, points[rows[number]])


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


# ---- the real recording d4d_pull: colours, depth, instrument masks -------------------------------------


@pytest.fixture(scope="module")
def folder(data_folder: Path) -> Path:
    folder = data_folder / "d4d_pull"
    if not folder.is_dir():
        pytest.skip(f"recording d4d_pull is not under SAGS_DATA ({data_folder})")
    return folder


def d4d(folder: Path, **playing: object) -> cfg.VideosSource:
    return cfg.VideosSource(
        left=folder / "2025_03_06-16_49_40_combined_2x2.mp4",
        geometry=cfg.GeometryConfig(layout="panes", crop=(0, 0, 675, 540), crop_right=(675, 0, 675, 540)),
        tools=(675, 540, 675, 540),
        pace="step",
        reference=cfg.ReferenceConfig(depth=folder / "depth_mm_x100", depth_kind="stereo_network"),
    ).model_copy(update=playing)


def test_d4d_clip(folder: Path) -> None:
    overlaps = []
    with open_source(d4d(folder)) as source:
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
            mask = cv2.imread(str(folder / f"toolmask/{index:04d}.png"), cv2.IMREAD_GRAYSCALE)
            assert mask is not None
            tools, found = mask > 127, ~frame.tissue
            overlaps.append((tools & found).sum() / (tools | found).sum())
    assert index == 178
    assert len(overlaps) == 18
    assert np.median(overlaps) >= 0.95 and min(overlaps) >= 0.9


# ---- dVRK sessions as sources: stamps of the sidecar for the images of its video ---------------------


@pytest.mark.parametrize("order", ["LR", "RL"])
def test_a_dvrk_session(order: str, tmp_path: Path) -> None:
    frames = [frame_record(number) for number in range(8)]
    frames[3] = frame_record(3, left_source_ns=None)
    frames[5] = frame_record(5, left_source_ns=None, right_source_ns=None)
    folder = write_session(tmp_path / "session", frames, order=order)
    for given in (folder, folder / "stereo.json"):
        assert isinstance(load_launch(given).source, DvrkSource)
    with Replay(DvrkSource(path=folder, pace="step")) as source:
        played = list(source)
        assert source.rate == pytest.approx(25, rel=0.1)
    stamps = [((f.t_capture_ns - START) // MS, (f.t_capture_right_ns - START) // MS) for f in played]
    assert stamps == [(0, 3), (40, 43), (80, 83), (123, 123), (160, 163), (209, 209), (240, 243), (280, 283)]
    for frame in played:
        assert frame.right is not None and abs(float(frame.right.mean()) - 200) < 8
    assert np.abs(played[6].left.astype(int) - picture(6, 0)).mean() < 15


def test_a_dvrk_video_with_other_frames_than_its_sidecar(tmp_path: Path) -> None:
    """The encoder made 25 Hz of frames of which two never came."""
    frames = [frame_record(number) for number in (0, 1, 2, 5, 6, 7)]
    folder = write_session(tmp_path / "session", frames)
    with Replay(DvrkSource(path=folder, pace="step")) as source:
        stamps = [(frame.t_capture_ns - START) // MS for frame in source]
        assert not source.pairs.oddities
    assert stamps == [0, 40, 80, 80, 200, 200, 240, 280]


@pytest.mark.parametrize(
    ("listed", "said"),
    [
        (10, r"stereo\.mp4 is 80 ms shorter than .*\.json, .* stamps are early by as much"),
        (6, r"stereo\.json is 80 ms shorter than .*\.mp4, .* stamps are late by as much"),
    ],
)
def test_a_dvrk_video_that_lacks_its_beginning_or_end_is_told_of(
    listed: int, said: str, tmp_path: Path
) -> None:
    folder = write_session(tmp_path / "session", [frame_record(number) for number in range(listed)])
    with Replay(DvrkSource(path=folder, pace="step")) as source:
        assert re.search(said, source.pairs.findings[0].what)


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


def test_a_session_as_users_give_it(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "session", [frame_record(number) for number in range(8)])
    path, overrides = split([str(folder), "source.side_by_side:=RL"])
    config = load_launch(path, overrides)
    assert isinstance(config, LaunchConfig) and isinstance(config.source, DvrkSource)
    assert config.source.side_by_side == "RL"
    with pytest.raises(UsageError, match="one sidecar of a stereo video is needed, there are: none"):
        Replay(DvrkSource(path=tmp_path))
