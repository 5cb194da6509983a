"""A recording cut into segments: all of them together count each of its frames once."""

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import figures_of, refused, sags
from dvrk_files import frame_record, write_session
from tiny_archive import TINY_FRAMES

from sags_lab.archive.manifest import Recording, read_manifest, write_manifest
from sags_lab.archive.process import Limits
from sags_lab.archive.results import read_results, write_results
from sags_lab.archive.segments import Cut, check_frames, segments
from sags_lab.archive.store import RECORDINGS, Store
from sags_lab.archive.work import Plan, work
from sags_node.config.schema import DvrkSource, FoldersSource
from sags_node.errors import UsageError
from sags_node.kernels.threads import configure_threads
from sags_node.pipeline.session import open_session
from sags_node.sources import replay
from sags_node.sources.bags import BagPairs
from sags_node.sources.pictures import Pairs
from sags_node.sources.replay import Replay
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.provenance import revision
from sags_node.tools.evaluation.session import evaluate
from sags_node.tools.fitting.clip import play

WHOLE = Recording("case1", "/data", weight=100.0)
STEPS = ("engine.threads:=1", "mapping.iterations:=1", "mapping.max_gaussians:=2000")


class Long(BagPairs):
    """The pairs of a recording that nobody has to write."""

    def __init__(self, count: int, rate: float, stamps: Any = None) -> None:
        self.count, self.rate, self.stamps = count, rate, stamps


class LongVideo(Pairs):
    """The same without stamps."""

    def __init__(self, count: int, rate: float) -> None:
        self.count, self.rate = count, rate


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any, FoldersSource], Replay]:
    def open_pairs(pairs: Any, config: FoldersSource) -> Replay:
        monkeypatch.setattr(replay, "open_pairs", lambda config, references: pairs)
        return Replay(config)

    return open_pairs


def said_by(row: Recording) -> dict[str, Any]:
    """A row's overrides as values of a source."""
    said = dict(each.removeprefix("source.").split(":=") for each in row.overrides)
    return {key: float(value) if key == "start" else int(value) for key, value in said.items()}


def stamps_of(rng: random.Random, count: int) -> Any:
    """Of images at about 30 Hz, with gaps, and some that came twice."""
    steps = rng.choices((0, 33_333_333, 33_412_907, 5_000_000_000), (5, 60, 34, 1), k=count - 1)
    left = 1_700_000_000_123_456_789 + np.cumsum([0, *steps])
    return np.stack([left, left], axis=1)


@pytest.mark.parametrize("seed", range(40))
def test_each_frame_counts_once_whatever_the_rate(
    seed: int, opened: Callable[[Any, FoldersSource], Replay]
) -> None:
    rng = random.Random(seed)
    count, rate = rng.randint(2, 4000), rng.choice((25.0, 30.0, 30000 / 1001, 59.94, 7.3))
    pairs: Any = LongVideo(count, rate) if seed % 2 else Long(count, rate, stamps_of(rng, count))
    asked: dict[str, Any] = {"stride": rng.choice((1, 1, 3)), "start": rng.choice((0.0, 0.041))}
    asked["frames"] = rng.choice((None, None, rng.randint(1, 3000)))
    config = FoldersSource(left=Path("l"), right=Path("r"), pace="step", **asked)
    whole = opened(pairs, config)
    frames = range(whole.first, whole.first + (whole.frame_count or 0))
    cut = Cut(rng.choice((0.02, 1.0, 13.7, 60.0)), rng.choice((0.0, 0.5, 2.0)))

    counted, lengths = [], []
    rows = segments(WHOLE, config, whole, cut)
    for row in rows:
        said = said_by(row)
        part, warm_up = opened(pairs, config.model_copy(update=said)), int(said.get("warm_up", 0))
        played = range(part.first, part.first + part.frame_count)
        assert warm_up >= min(round(cut.warm_up * whole.rate), played[warm_up] - frames[0])
        counted += played[warm_up:]
        lengths.append(len(played) - warm_up)
    assert counted == list(frames)
    assert max(lengths) <= max(1, round(cut.seconds * whole.rate)) and max(lengths) - min(lengths) <= 1
    assert len({row.id for row in rows}) == len(rows)
    assert (len(rows) == 1) == (rows == [WHOLE])


def test_what_a_row_says(opened: Callable[[Any, FoldersSource], Replay]) -> None:
    config = FoldersSource(left=Path("l"), right=Path("r"))
    rows = segments(WHOLE, config, opened(LongVideo(2700, 30.0), config), Cut(30.0, 2.0))
    assert [(row.segment, row.overrides, row.weight) for row in rows] == [
        ("0000-0899", ("source.start:=0", "source.warm_up:=0", "source.frames:=900"), 33.33),
        ("0900-1799", ("source.start:=28", "source.warm_up:=60", "source.frames:=960"), 35.56),
        ("1800-end", ("source.start:=58", "source.warm_up:=60"), 35.56),
    ]  # the last one goes on to the end: a file may hold more than it announces
    assert rows[1].id.startswith("case1-0900-1799-")
    assert sorted(row.id for row in rows) == [row.id for row in rows]


def test_frames_that_have_one_stamp_stay_apart(tmp_path: Path) -> None:
    """A dVRK video of which two frames never came: they have the stamps of others."""
    folder = write_session(tmp_path / "case", [frame_record(number) for number in (0, 1, 2, 5, 6, 7)])
    config = DvrkSource(path=folder, pace="step")
    counted = []
    with Replay(config) as whole:
        rows = segments(WHOLE, config, whole, Cut(0.08, 0.04))
    for row in rows:
        with Replay(config.model_copy(update=said_by(row))) as source:
            counted.append([frame.frame_id for frame in source if not frame.warm_up])
    assert counted == [[0, 1], [2, 3], [4, 5], [6, 7]]


def test_the_warm_up_is_played_and_not_counted(tiny_session: Path, tmp_path: Path) -> None:
    """What comes after it is what a run of the whole shows of these frames."""
    try:
        whole, part = (
            evaluate(tiny_session, [*STEPS, f"source.warm_up:={frames}"], MeasureOptions(0, 2), "step")
            for frames in (0, 2)
        )
    finally:
        configure_threads(None)
    assert [row.frame_id for row in part.rows] == [2, 3, 4, 5]
    assert part.summary["frames"] == part.summary["processed"] == TINY_FRAMES - 2
    assert {picture.frame_id for picture in part.pictures} <= {2, 3, 4, 5}
    shown = [[row.figures["online"]["psnr"] for row in run.rows[-4:]] for run in (whole, part)]
    assert shown[0] == shown[1]
    asked = ("--pace", "step", "--warm-up", 2, "--hold-out", 0, "--json")
    assert figures_of("eval", tiny_session, *STEPS, *asked)["online"] == part.summary["online"]
    cold = evaluate(tiny_session, [*STEPS, "source.start:=0.2"], MeasureOptions(0, 2), "step")
    configure_threads(None)
    assert cold.rows[0].frame_id == 2
    assert cold.rows[0].figures["online"]["psnr"] != shown[1][0]  # a model that begins there


def test_exports_leave_the_warm_up_out(tiny_session: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="the extra archive is not installed")
    said = ("source.start:=0.1", "source.warm_up:=2", "source.frames:=4", *STEPS)
    made = figures_of(
        *("export", tiny_session, *said, "--depth", tmp_path / "depth", "--tracks", tmp_path / "t.npz"),
        *("--render", tmp_path / "m.mp4", "--lerobot", tmp_path / "lerobot", "--json"),
    )
    configure_threads(None)
    holds = {row["kind"]: row["holds"] for row in made}
    assert (holds["depth"], holds["render"], holds["lerobot"]) == (2, 2, 2)
    assert sorted(file.name for file in (tmp_path / "depth").iterdir()) == ["00003.png", "00004.png"]
    assert cv2.VideoCapture(str(tmp_path / "m.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 2
    with np.load(tmp_path / "t.npz") as tracks:
        assert tracks["frames"].tolist() == [3, 4]
        assert np.isfinite(tracks["points"][0]).all(-1).mean() > 0.5  # pinned in the first one that counts
    session = open_session(tiny_session, ["source.pace:=step", *said])
    # What sags fit learns from.
    assert [frame.frame_id for frame in play(session, references=False)] == [3, 4]


def test_an_archive_of_segments(tiny_session: Path, tmp_path: Path) -> None:
    """One real run: maps of depth of all segments together are those of the recording."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in/case").symlink_to(tiny_session)
    manifest = tmp_path / "m.csv"
    cut = ("--segment", "0.3", "--warm-up", "0.1")
    result = sags("archive", "scan", tmp_path / "in", "--out", manifest, *cut)
    assert "1 recordings in 2 rows" in result.stderr
    rows = read_manifest(str(manifest))
    assert [row.segment for row in rows] == ["0-2", "3-end"]
    plan = Plan("depth", STEPS, (), str(tmp_path / "out"), revision(), Limits())
    assert [work(row, plan, "key").reason for row in rows] == ["", ""]
    files = [
        {file.name for file in (tmp_path / "out" / RECORDINGS / row.id / "depth").iterdir()} for row in rows
    ]
    assert not files[0] & files[1]
    assert files[0] | files[1] == {f"{number:05d}.png" for number in range(TINY_FRAMES)}
    store = Store(plan.out)
    assert write_results(store, rows) == 2
    assert [(row["segment"], row["depth.holds"]) for row in read_results(store)] == [("0-2", 3), ("3-end", 3)]


def test_what_would_move_the_borders_is_refused(tmp_path: Path) -> None:
    part = Recording("a", str(tmp_path), overrides=("source.frames:=4",), segment="0-3")
    check_frames([part], ["mapping.rung:=2"])
    check_frames([Recording("a", str(tmp_path))], ["source.stride:=2"])
    with pytest.raises(UsageError, match=r"source\.stride:=2.*scan again"):
        check_frames([part], ["source.stride:=2"])
    write_manifest(str(tmp_path / "m.csv"), [part])
    run = ("archive", "run", tmp_path / "m.csv", "--job", "depth", "--out", tmp_path / "out")
    refused(2, *run, "source.rate:=10", said=("source.rate:=10", "segments"))
    (tmp_path / "m.csv").write_text("recording,segment\na,../b\n")
    refused(2, *run, said=("row 1: segment '../b'",))
