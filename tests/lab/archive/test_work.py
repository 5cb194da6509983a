"""One recording on the machine that does it: limits, threads, URLs, and what is left behind."""

import fcntl
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fsspec.core import url_to_fs
from tiny_archive import quick_plan, quick_work, write_quick_recordings

from sags_lab.archive import results
from sags_lab.archive.inputs import fetched, key_of, scratch
from sags_lab.archive.jobs import FIGURES, JOBS, LOG, command
from sags_lab.archive.manifest import Recording, as_csv
from sags_lab.archive.process import Limits
from sags_lab.archive.results import of_one, read_results, status, write_results
from sags_lab.archive.run import about, describe
from sags_lab.archive.store import Store
from sags_lab.archive.work import Needs, needs, work
from sags_node.errors import SagsError, UsageError


@pytest.fixture
def in_memory() -> Iterator[str]:
    """A place that is no folder, and renames nothing."""
    url = "memory://archive"
    yield url
    fs, path = url_to_fs(url)
    fs.rm(path, recursive=True)


@pytest.fixture(autouse=True)
def own_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))


def test_results_appear_whole_and_are_not_done_twice(tmp_path: Path) -> None:
    recording = write_quick_recordings(tmp_path / "in", 1)[0]
    plan = quick_plan(tmp_path / "out", "engine.threads:=3")
    outcome = quick_work(recording, plan, "key")
    assert (outcome.state, outcome.frames) == ("done", 3)
    store = Store(plan.out)
    assert store.done() == {recording.id: "key"}
    row = store.read_json(f"done/{recording.id}.key.json")
    assert row["online.psnr"] == 30.0 and row["threads"] == "3" and row["version"] == plan.version
    left = sorted(path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.*"))
    assert left == [
        f"done/{recording.id}.key.json",
        f"recordings/{recording.id}/figures.json",
        f"recordings/{recording.id}/log.txt",
    ]
    first = (tmp_path / "out/recordings" / recording.id / "figures.json").stat()
    assert quick_work(recording, plan, "key").state == "done"  # one that was taken for lost comes back
    assert (tmp_path / "out/recordings" / recording.id / "figures.json").stat() == first


def test_a_rows_own_cores_count(tmp_path: Path) -> None:
    recording = write_quick_recordings(tmp_path / "in", 1)[0]
    plan = quick_plan(tmp_path / "out", "engine.threads:=3")
    assert needs(plan) == Needs(3, 0, 0)
    own = replace(recording, overrides=("engine.threads:=2", "device:=cuda"))
    assert needs(replace(plan, limits=Limits(memory_gb=1.5)), own) == Needs(2, 1, 1_500_000_000)
    assert quick_work(own, plan, "key").state == "done"
    assert Store(plan.out).read_json(f"done/{own.id}.key.json")["threads"] == "2"
    with pytest.raises(UsageError, match=r"r000.*engine\.threads:=0"):
        needs(plan, replace(recording, overrides=("engine.threads:=0",)))


@pytest.mark.parametrize("job", JOBS)
def test_a_job_writes_beside_its_figures(job: str, tmp_path: Path) -> None:
    """`figures.json` and `log.txt` are its stdout and stderr: a file of its own must not be one."""
    said = command(job, ["recording"], (), tmp_path)
    written = [Path(each).relative_to(tmp_path) for each in said if each.startswith(str(tmp_path))]
    assert written and all(each.name and each.name not in (FIGURES, LOG) for each in written)


def test_a_store_that_is_no_folder(tmp_path: Path, in_memory: str) -> None:
    recordings = write_quick_recordings(tmp_path / "in", 2)
    plan = replace(quick_plan(tmp_path), out=in_memory)
    assert quick_work(recordings[0], plan, "key").state == "done"
    store = Store(in_memory)
    assert store.done() == {recordings[0].id: "key"}
    assert store.read(f"recordings/{recordings[0].id}/report/content") == b"r000"
    assert list((tmp_path / "tmp").iterdir()) == []
    assert store.read_many(["archive.json"]) == [None]
    assert write_results(store, recordings) == 1
    assert [(row["state"], row["online.psnr"]) for row in read_results(store)] == [
        ("done", 30.0),
        ("missing", None),
    ]


def test_a_url_is_fetched_and_removed(tmp_path: Path) -> None:
    there = write_quick_recordings(tmp_path / "in", 1)[0]
    recording = Recording(f"file://{there.place}", "")
    plan = quick_plan(tmp_path / "out")
    assert quick_work(recording, plan, "key").state == "done"
    said = Store(plan.out).read_json(f"done/{recording.id}.key.json")["played"]
    assert said.startswith(str(tmp_path / "tmp")) and list((tmp_path / "tmp").iterdir()) == []

    small = quick_plan(tmp_path / "out", staged_gb=1e-9)
    outcome = quick_work(recording, small, "key")
    assert outcome.state == "refused" and "--stage-limit" in outcome.reason
    gone = quick_work(Recording(f"{recording.name}.gone", ""), plan, "key")
    assert gone.state == "failed" and "gone" in gone.reason


def test_both_eyes_videos_are_fetched_together(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for eye in ("left", "right"):
        (tmp_path / f"in/scope_{eye}.mp4").write_bytes(eye.encode())
    (tmp_path / "in/calib").mkdir()
    (tmp_path / "in/calib/left.yaml").write_text("left")
    recording = Recording("scope_left.mp4", f"file://{tmp_path}/in", "calib", ("source.kind:=videos",))
    with scratch() as folder:
        place, rig = fetched(recording, folder, 1.0)
        assert place.read_text() == "left" and place.with_name("scope_right.mp4").read_text() == "right"
        assert rig is not None and (rig / "left.yaml").read_text() == "left"


def test_another_version_does_no_work(tmp_path: Path) -> None:
    recording = write_quick_recordings(tmp_path / "in", 1)[0]
    plan = replace(quick_plan(tmp_path / "out"), version="0.0.1")
    outcome = work(recording, plan, "key")
    assert outcome.state == "failed" and "not 0.0.1; install that" in outcome.reason


def test_the_key_changes_with_all_that_decides_the_result(tiny_session: Path, tmp_path: Path) -> None:
    recording = Recording(str(tiny_session), "")
    plan = quick_plan(tmp_path)
    key = key_of(recording, about(plan))
    assert key == key_of(recording, about(replace(plan, out="elsewhere")))
    others = [
        key_of(recording, about(replace(plan, overrides=("mapping.rung:=1",)))),
        key_of(recording, about(replace(plan, version="2"))),
        key_of(replace(recording, overrides=("source.frames:=2",)), about(plan)),
    ]
    launch = tmp_path / "launch.yaml"
    launch.write_text(f"source: {{kind: folders, left: {tiny_session}/left, right: {tiny_session}/right}}\n")
    named = Recording(str(launch), "")
    before = key_of(named, about(plan))
    picture = next((tiny_session / "left").iterdir())  # which only the launch file names
    picture.touch()
    assert len({key, before, key_of(named, about(plan)), *others}) == 6
    assert key_of(recording, about(plan)) != key


def test_what_was_done_with_other_settings_is_missing_until_it_is_done_again(tmp_path: Path) -> None:
    """As after a run with changed settings that was stopped."""
    recordings = write_quick_recordings(tmp_path / "in", 2)
    before, now = (quick_plan(tmp_path / "out", f"mapping.rung:={rung}") for rung in (0, 1))
    store = Store(now.out)
    for recording in recordings:
        quick_work(recording, before, key_of(recording, about(before)))
    describe(store, recordings, now, as_csv(recordings))
    assert status(store)["missing"] == 2
    quick_work(recordings[0], now, key_of(recordings[0], about(now)))
    assert write_results(store, recordings) == 1 and status(store)["done"] == 1
    assert [of_one(store, each.id)["state"] for each in recordings] == ["done", "missing"]
    describe(store, recordings, before, as_csv(recordings))  # what was not begun is not lost
    assert of_one(store, recordings[1].id)["state"] == "done"


@pytest.mark.parametrize("name", ["done/{}.key.json", "failed/{}.json", "archive.json"])
def test_what_is_damaged_is_named(name: str, tmp_path: Path) -> None:
    recordings, plan = write_quick_recordings(tmp_path / "in", 1), quick_plan(tmp_path / "out")
    store = Store(plan.out)
    for each in ("done/{}.key.json", name):
        store.write(each.format(recordings[0].id), b'{"id": ')
    with pytest.raises(SagsError, match=rf"{name.format(recordings[0].id)} is damaged; remove it"):
        write_results(store, recordings)


def test_a_figure_of_several_kinds_is_text_in_large_archives_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results, "BATCH", 1)
    recordings = write_quick_recordings(tmp_path / "in", 3)
    store = Store(str(tmp_path / "out"))
    for recording, value in zip(recordings, (1.5, "auto", None), strict=True):
        store.write_json(f"done/{recording.id}.key.json", {"id": recording.id, "said": value, "n": 1})
    assert write_results(store, recordings) == 3
    assert [(row["said"], row["n"]) for row in read_results(store)] == [("1.5", 1), ("auto", 1), (None, 1)]


def test_what_killed_workers_left_is_removed(tmp_path: Path) -> None:
    with scratch() as mine:
        orphan = tmp_path / "tmp/sags-archive-orphan"
        orphan.mkdir()
        (orphan / ".lock").touch()
        (orphan / "video.mp4").write_bytes(b"x")
        with scratch() as other:
            assert mine.is_dir() and other.is_dir() and not orphan.exists()


def test_no_other_worker_removes_a_folder_before_it_is_locked(monkeypatch: pytest.MonkeyPatch) -> None:
    lock = fcntl.flock

    def another_comes_first(*asked: Any) -> None:
        monkeypatch.setattr(fcntl, "flock", lock)
        with scratch():
            lock(*asked)

    monkeypatch.setattr(fcntl, "flock", another_comes_first)
    with scratch() as folder:
        assert folder.is_dir()


def test_a_log_says_the_reason(tmp_path: Path) -> None:
    recording = write_quick_recordings(tmp_path / "in", 1, fails="no calibration", code=2)[0]
    plan = quick_plan(tmp_path / "out")
    outcome = quick_work(recording, plan, "key")
    assert (outcome.state, outcome.reason) == ("refused", "no calibration (exit code 2)")
    assert Store(plan.out).read(f"failed/{recording.id}.log") == b"error: no calibration\n"
    assert Store(plan.out).done() == {}
    assert list((tmp_path / "out/partial").iterdir()) == []
