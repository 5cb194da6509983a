"""What `sags export` writes of every frame: read again by others, and compared with the phantom's truth."""

import json
import shutil
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d
import pytest
from command_line import pure_json, refused, sags
from engine_scenes import round_gaussians
from synthetic import plane_result
from tiny_archive import TINY_FRAMES, write_tiny_session
from user_files import write_video

from sags_lab.lerobot.dataset import LeRobot, merge
from sags_lab.lerobot.form import COARSE, DEPTH, LEFT, POINTS, POSE, RIGHT, TASK, TISSUE, VISIBILITY, Version
from sags_lab.lerobot.stats import Sums, merged
from sags_node.config.schema import ReferenceConfig
from sags_node.errors import SagsError, UsageError
from sags_node.model.ply import write_ply
from sags_node.pipeline.session import open_session
from sags_node.rig import read_rig, save_rig
from sags_node.sources.source import open_source
from sags_node.tools.export import sequence
from sags_node.tools.export.played import DEPTH_UNIT, TRACKS
from sags_node.tools.export.scene import Scene, from_session
from sags_node.types import Camera, FrameResult, Gaussians, RectifiedPair
from sags_node.vision.rectify import Rectifier

pq = pytest.importorskip("pyarrow.parquet", reason="the extra archive is not installed")
av = pytest.importorskip("av", reason="a second reader of videos")

SESSIONS = 3
DARK_FROM = 3  # frame
CHUNKS = ("chunk_index", "file_index")
CODING = 6  # of 255: a video's error; another frame of these sessions differs by 10 and more


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders session0, session1, session2, and what was exported of each: depth, tracks, render, lerobot."""
    folder = tmp_path_factory.mktemp("played")
    for number in range(SESSIONS):
        session, out = folder / f"session{number}", folder / str(number)
        write_tiny_session(session, seed=number)
        out.mkdir()
        rows = pure_json(
            sags(
                *("export", session, "mapping.iterations:=1", "mapping.max_gaussians:=4000"),
                *("--depth", out / "depth", "--tracks", out / "tracks.npz"),
                *("--render", out / "model.mp4", "--lerobot", out / "lerobot", "--json"),
                *("--lerobot-version", "v2.1" if number == 1 else "v3.0"),
            ).stdout
        )
        assert [row["kind"] for row in rows] == ["depth", "tracks", "render", "lerobot"]
        assert all(row["bytes"] > 0 for row in rows)
    return folder


def rectified(folder: Path) -> list[RectifiedPair]:
    session = open_session(folder, ["source.pace:=step"])
    rectifier = Rectifier(session.rig, *session.working_size)
    with session.source as source:
        return [rectifier(frame) for frame in source]


def test_depth_is_that_of_the_phantom(exported: Path) -> None:
    rig = read_rig(exported / "session0/calib")
    half_a_pixel = 0.5 / (rig.left.P[0, 0] * rig.baseline)  # of disparity, in inverse depth, 1/m
    for number in range(TINY_FRAMES):
        said = cv2.imread(str(exported / f"0/depth/{number:05d}.png"), cv2.IMREAD_UNCHANGED)
        truth = cv2.imread(str(exported / f"session0/depth/{number:04d}.png"), cv2.IMREAD_UNCHANGED)
        depth, known = said * DEPTH_UNIT, (said > 0) & (truth > 0)
        assert known.mean() > 0.5
        error = np.abs(1 / depth[known] - 1 / (truth[known] * 2.5e-6))
        assert np.median(error) < half_a_pixel


def test_points_stay_on_the_surface_and_sags_eval_reads_them(exported: Path) -> None:
    with np.load(exported / "0/tracks.npz") as tracks:
        points, visible = tracks["points"], tracks["visible"]
        assert tracks["frames"].tolist() == list(range(TINY_FRAMES))
    assert points.shape == (TINY_FRAMES, TRACKS, 3) and visible.shape == (TINY_FRAMES, TRACKS)
    pinned = np.isfinite(points[0, :, 0])
    assert pinned.mean() > 0.5 and not visible[:, ~pinned].any()
    K = read_rig(exported / "session0/calib").left.P[:, :3]
    pixels = points[0, pinned] @ K.T
    u, v = (pixels[:, :2] / pixels[:, 2:]).T
    side = round(TRACKS**0.5)
    for value, length in ((u, 160), (v, 128)):  # on the grid, where each was pinned
        place = value * side / length - 0.5
        assert np.abs(place - np.round(place)).max() < 0.1

    said = pure_json(
        sags(
            *("eval", exported / "session0", f"source.reference.tracks:={exported}/0/tracks.npz"),
            *("--pace", "step", "--iterations", "1", "--hold-out", "0", "--json"),
        ).stdout
    )
    assert said["track"]["median_px"] < 2  # both follow the same tissue


def test_what_is_exported_of_some_frames_is_read_back_for_the_same(exported: Path, tmp_path: Path) -> None:
    """Files and rows are numbered by the recording's own frames, whichever of them are played."""
    playing = ("source.stride:=2", "source.start:=0.2")
    into = ("--depth", tmp_path / "depth", "--tracks", tmp_path / "tracks.npz")
    assert sags("export", exported / "session0", *playing, "mapping.iterations:=1", *into).exit_code == 0
    assert sorted(file.stem for file in (tmp_path / "depth").iterdir()) == ["00002", "00004"]
    config = open_session(exported / "session0", ["source.pace:=step"]).config.source
    reference = ReferenceConfig(depth=tmp_path / "depth", tracks=tmp_path / "tracks.npz")
    with open_source(config.model_copy(update={"reference": reference})) as source:
        found = {frame.frame_id: frame.reference for frame in source if frame.reference is not None}
    assert list(found) == [2, 4]
    with np.load(tmp_path / "tracks.npz") as tracks:
        assert tracks["frames"].tolist() == [2, 4]
        for row, (number, each) in enumerate(found.items()):
            counts = cv2.imread(str(tmp_path / f"depth/{number:05d}.png"), cv2.IMREAD_UNCHANGED)
            assert each.depth is not None and np.allclose(each.depth, counts * DEPTH_UNIT)
            assert np.array_equal(each.points, tracks["points"][row], equal_nan=True)


def pictures_of(file: Path) -> list[np.ndarray]:
    """Of a video, RGB."""
    with av.open(str(file)) as video:
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]


def test_the_video_has_every_frame(exported: Path) -> None:
    pictures = pictures_of(exported / "0/model.mp4")
    assert len(pictures) == TINY_FRAMES
    shown = rectified(exported / "session0")[3].left
    known = pictures[3].max(-1) > 0
    assert known.mean() > 0.5
    assert np.abs(pictures[3].astype(float) - shown)[known].mean() < 16  # of 255: the same scene


def test_the_video_has_the_detail_that_the_model_alone_has_not(exported: Path, tmp_path: Path) -> None:
    session, frames = exported / "session0", rectified(exported / "session0")
    options = ("mapping.iterations:=1", "mapping.max_gaussians:=4000", "publish.detail:=false")
    into = ("--render", tmp_path / "model.mp4", "--depth", tmp_path / "depth")
    assert sags("export", session, *options, *into).exit_code == 0
    pairs = zip(pictures_of(exported / "0/model.mp4"), pictures_of(tmp_path / "model.mp4"), strict=True)
    for frame, (shown, model) in zip(frames, pairs, strict=True):
        known = (shown.max(-1) > 0) & (model.max(-1) > 0)
        near, far = (np.abs(each.astype(float) - frame.left)[known].mean() for each in (shown, model))
        assert near < far
    for file in (tmp_path / "depth").iterdir():  # which is the model's in both
        assert file.read_bytes() == (exported / "0/depth" / file.name).read_bytes()


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_three_sessions_are_one_data_set(exported: Path, tmp_path: Path, version: Version) -> None:
    """In the form of lerobot 0.4.4 and 0.3.3, `datasets/utils.py`; Parquet and MP4 are read by others."""
    out = tmp_path / "all"
    frames = merge([exported / f"{number}/lerobot" for number in range(SESSIONS)], out, version)
    info = json.loads((out / "meta/info.json").read_text())
    assert frames == info["total_frames"] == SESSIONS * TINY_FRAMES
    assert (info["codebase_version"], info["total_episodes"], info["fps"]) == (version, SESSIONS, 10)

    index = 0
    for number, places in enumerate(places_v30(out) if version == "v3.0" else places_v21(out)):
        rows = pq.read_table(out / info["data_path"].format(**places["data"])).to_pylist()
        assert len(rows) == TINY_FRAMES
        for frame, row in enumerate(rows):
            assert (row["index"], row["frame_index"], row["episode_index"]) == (index, frame, number)
            assert row["timestamp"] == pytest.approx(frame / 10)
            for name, feature in info["features"].items():
                if feature["dtype"] != "video" and feature["shape"] != [1]:
                    assert list(np.shape(row[name])) == feature["shape"], name
            index += 1
        counts = cv2.imread(str(exported / f"{number}/depth/00002.png"), cv2.IMREAD_UNCHANGED)
        assert np.allclose(rows[2][DEPTH], counts[::COARSE, ::COARSE] * DEPTH_UNIT, atol=DEPTH_UNIT)
        assert np.array_equal(rows[0][POSE], np.eye(4)) and np.mean(rows[0][TISSUE]) > 0.5
        with np.load(exported / f"{number}/tracks.npz") as tracks:
            assert np.array_equal(np.float32(rows[4][POINTS]), tracks["points"][4], equal_nan=True)
        for eye, side in ((LEFT, "left"), (RIGHT, "right")):
            with av.open(str(out / info["video_path"].format(**places[eye]))) as video:
                stream = video.streams.video[0]
                read = [(float(each.pts * stream.time_base), each) for each in video.decode(video=0)]
            assert [at for at, _ in read] == pytest.approx([frame / 10 for frame in range(TINY_FRAMES)])
            given = getattr(rectified(exported / f"session{number}")[5], side)
            assert np.abs(read[5][1].to_ndarray(format="rgb24").astype(float) - given).mean() < CODING
    assert index == frames


def places_v30(out: Path) -> list[dict[str, dict[str, Any]]]:
    """Of each episode: what the paths of its data and of each video are made of."""
    found = []
    for number, episode in enumerate(pq.read_table(out / "meta/episodes").to_pylist()):
        span = episode["dataset_from_index"], episode["dataset_to_index"], episode["episode_index"]
        assert span == (number * TINY_FRAMES, (number + 1) * TINY_FRAMES, number)
        assert episode[f"stats/{DEPTH}/mean"] != [0.0]
        kinds = {"data": "data", LEFT: f"videos/{LEFT}", RIGHT: f"videos/{RIGHT}"}
        found.append(
            {
                kind: {"video_key": kind, **{key: episode[f"{column}/{key}"] for key in CHUNKS}}
                for kind, column in kinds.items()
            }
        )
    tasks = pq.read_table(out / "meta/tasks.parquet").to_pylist()
    assert tasks == [{"task_index": 0, "__index_level_0__": TASK}]
    return found


def places_v21(out: Path) -> list[dict[str, dict[str, Any]]]:
    def lines(name: str) -> list[Any]:
        return [json.loads(line) for line in (out / f"meta/{name}.jsonl").read_text().splitlines()]

    assert lines("tasks") == [{"task_index": 0, "task": TASK}]
    assert [each["stats"][DEPTH]["mean"] != [0.0] for each in lines("episodes_stats")] == [True] * SESSIONS
    found = []
    for number, episode in enumerate(lines("episodes")):
        assert episode == {"episode_index": number, "tasks": [TASK], "length": TINY_FRAMES}
        place = {"episode_chunk": 0, "episode_index": number}
        found.append({kind: place | {"video_key": kind} for kind in ("data", LEFT, RIGHT)})
    return found


def test_statistics_of_several_episodes_are_those_of_all_their_numbers() -> None:
    random = np.random.default_rng(5)
    parts = [random.normal(100 + number, 1 + number, (20 + 10 * number, 3)) for number in range(3)]
    parts[1][4] = np.nan  # a lost point
    parts.append(np.full((9, 3), np.nan))  # nothing known in a whole episode
    stats = []
    for part in parts:
        sums = Sums()
        sums.add(part[:7])
        sums.add(part[7:])
        stats.append(sums.stats((3,)))
    found, together = merged(stats), np.concatenate(parts)
    for name, of in {"min": np.nanmin, "max": np.nanmax, "mean": np.nanmean, "std": np.nanstd}.items():
        assert found[name] == pytest.approx(of(together, axis=0)), name
    assert found["count"] == [89]


@pytest.fixture(scope="module")
def darkened(exported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose light is switched off: frames from `DARK_FROM` on, of both eyes, are black."""
    folder = shutil.copytree(exported / "session0", tmp_path_factory.mktemp("dark") / "session")
    for eye in ("left", "right"):
        for file in sorted((folder / eye).iterdir())[DARK_FROM:]:
            cv2.imwrite(str(file), np.zeros_like(cv2.imread(str(file))))
    return folder


@pytest.mark.fault("image: black to the end of a recording that is exported")
def test_frames_that_were_not_taken_in_have_no_points(darkened: Path, tmp_path: Path) -> None:
    into = ("--depth", tmp_path / "depth", "--tracks", tmp_path / "t.npz", "--lerobot", tmp_path / "lerobot")
    assert sags("export", darkened, "mapping.iterations:=1", *into).exit_code == 0
    with np.load(tmp_path / "t.npz") as tracks:
        points, visible = tracks["points"], tracks["visible"]
    (table,) = (tmp_path / "lerobot/data").rglob("*.parquet")
    rows = pq.read_table(table).to_pylist()
    for number in range(TINY_FRAMES):
        dark = number >= DARK_FROM
        depth = cv2.imread(str(tmp_path / f"depth/{number:05d}.png"), cv2.IMREAD_UNCHANGED)
        assert np.all(depth == 0) == dark
        assert np.isnan(points[number]).all() == dark and visible[number].any() != dark
        assert np.isnan(rows[number][POINTS]).all() == dark and np.any(rows[number][VISIBILITY]) != dark
        assert np.array_equal(rows[number][POSE], np.eye(4))  # this camera stands still


def data_set(out: Path, *results: FrameResult) -> Path:
    """These frames in the form of lerobot."""
    episode = LeRobot(out, 10.0, "v3.0")
    for number, result in enumerate(results):
        episode.add(number, result, result.anchors)
    assert episode.finish() == len(results)
    return out


def test_a_pose_that_the_robot_does_not_tell_is_not_the_last_one(tmp_path: Path) -> None:
    told = plane_result(stamp_ns=0)
    unknown = replace(told, held="no pose came", skipped={"pose": "no pose came"})
    (table,) = (data_set(tmp_path / "out", told, unknown) / "data").rglob("*.parquet")
    first, second = pq.read_table(table)[POSE].to_pylist()
    assert np.array_equal(first, np.float32(told.pair.camera.T_world_cam)) and np.isnan(second).all()


def test_a_data_set_says_what_its_videos_are(tmp_path: Path) -> None:
    """Also of images whose sides are odd."""
    told = plane_result(stamp_ns=0)
    camera = replace(told.pair.camera, width=told.pair.camera.width - 1, height=told.pair.camera.height - 1)
    pair = replace(told.pair, camera=camera, left=told.pair.left[:-1, :-1], right=None)
    out = data_set(tmp_path / "out", replace(told, pair=pair))
    info = json.loads((out / "meta/info.json").read_text())["features"][LEFT]
    (video,) = (out / "videos").rglob("*.mp4")
    with av.open(str(video)) as opened:
        stream = opened.streams.video[0]
        assert info["shape"] == [stream.height, stream.width, 3]
        assert info["info"]["video.codec"] == stream.codec_context.name
        assert info["info"]["video.pix_fmt"] == stream.pix_fmt


def test_no_dark_frame_is_exported(darkened: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    command = ("export", darkened, "mapping.iterations:=1")
    last = (DARK_FROM - 1) / 10  # s
    mistake = (f"at {last + 0.2:.2f} s was not taken in", "black", f"--at {last:g}")
    refused(2, *command, "--at", last + 0.2, "--splats", tmp_path / "dark.ply", said=mistake)
    files = [tmp_path / "at.ply", tmp_path / "end.ply"]
    assert sags(*command, "--at", last, "--splats", files[0]).exit_code == 0
    assert sags(*command, "--splats", files[1]).exit_code == 0
    assert "was not taken in" in caplog.text and f"at {last:g} s" in caplog.text
    assert files[0].read_bytes() == files[1].read_bytes()
    assert sags(*command, "--sequence", tmp_path / "all").exit_code == 0
    assert f"{TINY_FRAMES - DARK_FROM} frames are left out" in caplog.text
    kept = sorted(file.name for file in (tmp_path / "all").glob("frame_*.ply"))
    assert kept == [f"frame_{number:05d}.ply" for number in range(DARK_FROM)]


STAMPS = (0, 0.1, 0.2, 5.2, 5.3, 5.4)  # s; the recording paused


@pytest.mark.fault("stamp: a recording that paused is exported as a video")
def test_videos_have_the_recordings_own_stamps(exported: Path, tmp_path: Path) -> None:
    for part in ("left", "right", "calib"):
        shutil.copytree(exported / "session0" / part, tmp_path / "session" / part)
    for eye in ("left", "right"):
        for file, at in zip(sorted((tmp_path / "session" / eye).iterdir()), STAMPS, strict=True):
            file.rename(file.with_name(f"{1_700_000_000_000_000_000 + round(at * 1e9)}{file.suffix}"))
    command = ("export", tmp_path / "session", "mapping.iterations:=1")
    assert sags(*command, "--render", tmp_path / "model.mp4").exit_code == 0
    assert times_of(tmp_path / "model.mp4") == pytest.approx(STAMPS, abs=1e-3)
    assert sags(*command, "--sequence", tmp_path / "all").exit_code == 0
    back = [2 * STAMPS[-1] - at for at in STAMPS[-2:0:-1]]
    assert times_of(tmp_path / "all/loop.mp4") == pytest.approx([*STAMPS, *back], abs=1e-3)


def times_of(video: Path) -> list[float]:
    """When each image is shown, s."""
    with av.open(str(video)) as opened:
        return [float(frame.time) for frame in opened.decode(video=0)]


@pytest.mark.parametrize(
    ("rate", "fits"), [(30.0, True), (29.97, True), (1000 / 33, True), (12.5, False), (0.5, False)]
)
def test_lerobot_takes_whole_rates(tmp_path: Path, rate: float, fits: bool) -> None:
    said = f"{rate:g} frames a second are recorded; set source.rate"
    with nullcontext() if fits else pytest.raises(UsageError, match=said):
        LeRobot(tmp_path / "out", rate, "v3.0")


@pytest.mark.parametrize("paused", [False, True])
def test_gaps_in_time_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture, paused: bool) -> None:
    stamps = STAMPS if paused else np.arange(6) * 0.11
    data_set(tmp_path / "out", *(plane_result(stamp_ns=round(at * 1e9)) for at in stamps))
    assert ("1 of 5 steps" in caplog.text and "5.0 s" in caplog.text) if paused else not caplog.text


def test_what_does_not_go_together_is_refused(exported: Path, tmp_path: Path) -> None:
    session = exported / "session0"
    refused(2, "export", "--depth", tmp_path / "d", said=("--depth exports all frames",))
    refused(2, "export", session, "--at", "0.1", "--tracks", tmp_path / "t.npz", said=("--tracks",))
    refused(2, "export", session, "--depth", exported / "0/depth", said=("is not empty",))
    for eye in ("left", "right"):
        write_video(tmp_path / f"{eye}.mp4", [getattr(pair, eye) for pair in rectified(session)])
    save_rig(open_session(session).rig, tmp_path / "calib")
    launch = tmp_path / "mine.yaml"
    launch.write_text("source: {kind: videos, left: left.mp4, right: right.mp4}\nrig: calib\n")
    for option, file in (("--render", "left.mp4"), ("--orbit", "right.mp4")):
        into = (option, tmp_path / file, "--force")
        refused(2, "export", launch, *into, said=(f"{file} is read by this command",))


# ---- `sags export --sequence`: whole splat files, one a frame, that an interrupted export goes on with. ----


CAMERA = Camera(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), np.eye(4))
FRAMES = 6


def scenes(count: int = FRAMES) -> Iterator[Scene]:
    """A patch that moves to the right, frame by frame; the first shows nothing yet."""
    rng = np.random.default_rng(0)
    places = np.concatenate([rng.uniform(-0.01, 0.01, (400, 2)), np.full((400, 1), 0.06)], 1)
    for frame in range(count):
        size = 0 if frame == 0 else 400
        moved = (places[:size] + np.array([0.004 * frame, 0, 0])).astype(np.float32)
        yield Scene(round_gaussians(moved, 6e-4, 0.9), CAMERA, frame * 33_000_000)


def written(folder: Path, count: int = FRAMES) -> list[dict[str, Any]]:
    sequence.check_sequence(folder, {"session": "a"}, force=False)
    return sequence.write_sequence(folder, scenes(count), 30.0, count, lambda *said: None)


def test_every_frame_that_shows_something_is_a_file_and_the_video_comes_back(tmp_path: Path) -> None:
    frames, loop = written(tmp_path / "out")
    assert frames["holds"] == FRAMES - 1 and loop["holds"] == 2 * (FRAMES - 1) - 2
    for frame in range(1, FRAMES):
        cloud = open3d.io.read_point_cloud(tmp_path / f"out/frame_{frame:05d}.ply")
        assert np.asarray(cloud.points)[:, 0].mean() == pytest.approx(0.004 * frame, abs=1e-3)
    pictures = pictures_of(tmp_path / "out/loop.mp4")
    middles = [np.argwhere(picture[..., 2] > 128)[:, 1].mean() for picture in pictures]
    assert len(middles) == loop["holds"]
    steps = np.diff([*middles, middles[0]])
    assert (steps[: FRAMES - 2] > 0).all() and (steps[FRAMES - 2 :] < 0).all()  # there, and back to the first


@pytest.mark.fault("disk: full while frames are exported")
def test_an_export_that_a_full_disk_ended_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = iter(range(3))

    def full(path: Path, gaussians: Gaussians) -> None:
        if next(room, None) is None:
            raise SagsError(f"cannot write {path}: No space left on device")
        write_ply(path, gaussians)

    said = r"No space left on device.*3 frames are there; the same command goes on"
    with monkeypatch.context() as patched, pytest.raises(SagsError, match=said):
        patched.setattr(sequence, "write_ply", full)
        written(tmp_path)
    done = sorted(file.name for file in tmp_path.iterdir())
    assert done == [*(f"frame_{n:05d}.ply" for n in (1, 2, 3)), "sequence.json"]  # nothing half written
    stamps = {name: (tmp_path / name).stat().st_mtime_ns for name in done[:3]}
    assert written(tmp_path)[0]["holds"] == FRAMES - 1
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in stamps} == stamps


def test_a_recording_of_the_same_name_is_another_one(exported: Path, tmp_path: Path) -> None:
    first, second = (
        shutil.copytree(exported / f"session{number}", tmp_path / patient / "clip")
        for number, patient in enumerate(("anna", "bert"))
    )
    into = ("source.frames:=2", "--sequence", tmp_path / "out")
    assert sags("export", first, *into).exit_code == 0
    refused(2, "export", second, *into, said=("holds another sequence", "--force"))


@pytest.mark.parametrize("changed", ["launch.yaml", "calib/left.yaml"])
def test_what_the_frames_are_made_from_is_another_when_a_file_was_changed(
    exported: Path, tmp_path: Path, changed: str, caplog: pytest.LogCaptureFixture
) -> None:
    recording = shutil.copytree(exported / "session0", tmp_path / "clip")
    command = ("export", recording, "source.frames:=2", "--sequence", tmp_path / "out")
    first = tmp_path / "out/frame_00000.ply"
    assert sags(*command).exit_code == 0
    before = first.stat().st_mtime_ns, first.read_bytes()
    assert sags(*command).exit_code == 0  # the same again goes on
    assert "2 of 2 frames were there and stayed; --force makes all anew" in caplog.text
    assert (first.stat().st_mtime_ns, first.read_bytes()) == before
    file = recording / changed
    if changed == "launch.yaml":
        file.write_text(file.read_text() + "mapping: {max_gaussians: 500}\n")
    else:
        rig = read_rig(recording / "calib")
        file.write_text(file.read_text().replace(f"{rig.left.P[0, 2]}", f"{rig.left.P[0, 2] + 8}"))
    refused(2, *command, said=("another launch file, calibration, fit or version", "--force"))
    assert sags(*command, "--force").exit_code == 0
    assert first.read_bytes() != before[1]


def test_states_tell_fits_apart(exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = open_session(exported / "session0", ["source.pace:=step"])
    with pytest.raises(UsageError, match=r"there is no .*checkpoint\.npz"):
        sequence.state_of(session, tmp_path)
    states = []
    for name in ("checkpoint.npz", "figures.json"):
        (tmp_path / name).write_text("first")
    for said in ("first", "first", "second"):
        (tmp_path / "checkpoint.npz").write_text(said)
        states.append(sequence.state_of(session, tmp_path))
    assert states[0] == states[1] != states[2]
    monkeypatch.setattr(sequence, "__version__", "0.0.1")
    assert sequence.state_of(session, tmp_path) != states[2]
    session.source.stop()


def test_a_time_of_whole_milliseconds_is_that_of_its_frame(exported: Path) -> None:
    """0.067 s are 67000000.00000001 ns: the frame of that stamp lay before them."""
    session = open_session(exported / "session0", ["source.pace:=step", f"source.rate:={1000 / 67}"])
    assert from_session(session, 0.067, lambda *said: None).t_capture_ns == 67_000_000


def test_files_of_something_else_stay_unless_forced(tmp_path: Path) -> None:
    written(tmp_path / "ours")
    with pytest.raises(UsageError, match="another sequence"):
        sequence.check_sequence(tmp_path / "ours", {"session": "b"}, force=False)
    for state in ("b", "a"):  # of the same state, too
        assert (tmp_path / "ours/frame_00001.ply").exists()
        sequence.check_sequence(tmp_path / "ours", {"session": state}, force=True)
        assert not (tmp_path / "ours/frame_00001.ply").exists()
        sequence.check_sequence(tmp_path / "ours", {"session": "a"}, force=True)
        written(tmp_path / "ours")
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(UsageError, match="not empty"):
        sequence.check_sequence(tmp_path, {"session": "a"}, force=False)


def test_a_recording_that_shows_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SagsError, match="no frame shows anything"):
        written(tmp_path, count=1)
