"""Whatever happens on the way, what comes out is the same: workers, machines and the driver are killed, the
disk is full, recordings are broken or hang. `quick_job` stands in for the work itself."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from places import HELPERS
from small_disk import small_disk
from tiny_archive import quick_plan, quick_work, table, write_quick_recordings
from waiting import until

from sags_lab.archive.cluster import connected
from sags_lab.archive.manifest import Recording, as_csv
from sags_lab.archive.results import failed, status, write_results
from sags_lab.archive.run import Tally, describe, run
from sags_lab.archive.store import Store
from sags_lab.archive.work import Plan
from sags_node.errors import SagsError, UsageError

PATIENCE = 60.0  # s


@pytest.fixture(scope="module", autouse=True)
def connection(cluster: Any) -> Iterator[None]:
    """One for all runs of this file, so that its workers are started once. The driver that is killed has its
    own."""
    with connected(cluster.address):
        yield


def gone_through(
    out: Path,
    recordings: list[Recording],
    cluster: Any,
    attempts: int = 2,
    plan: Plan | None = None,
    **more: Any,
) -> tuple[Store, Tally]:
    """A run as the command does it, and its table."""
    store, plan = Store(str(out)), plan or quick_plan(out)
    with store.locked():
        describe(store, recordings, plan, as_csv(recordings))
        tally = run(store, recordings, plan, attempts, address=cluster.address, task=quick_work, **more)
        write_results(store, recordings)
    return store, tally


def change(recording: Recording, **said: Any) -> None:
    file = Path(recording.place)
    file.write_text(json.dumps(json.loads(file.read_text()) | said))


def begun(signs: Path, recording: Recording) -> int:
    """The process that works on a recording, once it does."""
    name = Path(recording.name).stem
    return int(until(lambda: sorted(signs.glob(f"{name}.*")))[-1].suffix[1:])


def state_and_parent(process: int) -> list[str]:
    return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[:2]


def is_alive(process: int) -> bool:
    try:
        return state_and_parent(process)[0] != "Z"
    except OSError:
        return False


def test_broken_recordings_are_quarantined_and_fixed_ones_done(cluster: Any, tmp_path: Path) -> None:
    recordings = write_quick_recordings(tmp_path / "in", 8)
    _, whole = gone_through(tmp_path / "whole", recordings, cluster)
    assert (whole.done, whole.quarantined) == (8, 0)

    broken = {
        1: ({"fails": "frame 7 is damaged"}, 2, "frame 7 is damaged (exit code 1)"),
        2: ({"fails": "no such key", "code": 2}, 1, "no such key (exit code 2)"),
        3: ({"signal": "SIGSEGV"}, 2, "ended by SIGSEGV"),
        4: ({"takes_memory": 300}, 2, "GB of memory"),
    }
    for number, (said, _, _) in broken.items():
        change(recordings[number], **said)
    plan = quick_plan(tmp_path / "out", memory_gb=0.2)
    store, tally = gone_through(tmp_path / "out", recordings, cluster, plan=plan)
    assert (tally.done, tally.quarantined) == (4, 4)
    records = {record["id"]: record for record in failed(store)}
    for number, (_, attempts, reason) in broken.items():
        record = records[recordings[number].id]
        assert record["quarantined"] and len(record["attempts"]) == attempts
        assert all(reason in each["reason"] for each in record["attempts"])
        assert record["command"].startswith(f"sags eval {recordings[number].place} ")
    assert {row["state"] for row in table(store)} == {"done", "quarantined"}

    again = gone_through(tmp_path / "out", recordings, cluster, plan=plan)[1]
    assert (again.kept, again.done, again.quarantined) == (4, 0, 4)  # nothing is tried for a third time
    for number, (said, _, _) in broken.items():
        change(recordings[number], **dict.fromkeys(said))
    fixed = gone_through(tmp_path / "out", recordings, cluster, plan=plan)[1]
    assert (fixed.kept, fixed.done, fixed.quarantined) == (4, 4, 0)
    assert table(store) == table(Store(str(tmp_path / "whole")))
    assert status(store)["failed"] == []


def test_what_hangs_is_ended_and_retry_failed_tries_it_again(cluster: Any, tmp_path: Path) -> None:
    marker = tmp_path / "there"
    recordings = write_quick_recordings(tmp_path / "in", 2, waits_for=str(marker))
    plan = quick_plan(tmp_path / "out", seconds=0.5)
    store, tally = gone_through(tmp_path / "out", recordings, cluster, 1, plan)
    assert tally.quarantined == 2
    said = {attempt["reason"] for record in failed(store) for attempt in record["attempts"]}
    assert said == {"it took more than 0.5 s (--timeout)"}
    marker.touch()
    assert gone_through(tmp_path / "out", recordings, cluster, 1, plan)[1].quarantined == 2
    slow = replace(plan, limits=replace(plan.limits, seconds=600.0))
    assert gone_through(tmp_path / "out", recordings, cluster, 1, slow, retry_failed=True)[1].done == 2


def written(folder: Path) -> dict[str, int]:
    """Its files, and when they were written."""
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


DRIVER = """
import sys
from pathlib import Path
sys.path.insert(0, {helpers!r})
from tiny_archive import quick_plan, quick_work
from sags_lab.archive.manifest import Recording
from sags_lab.archive.run import run
from sags_lab.archive.store import Store
out = Path({out!r})
recordings = [Recording(f"r{{number:03d}}.json", {folder!r}, weight=10 - number) for number in range(5)]
store = Store(str(out))
with store.locked():
    tally = run(store, recordings, quick_plan(out), 2, address={address!r}, task=quick_work)
sys.exit(130 if tally.stopping.is_set() else 0)
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_driver_and_ctrl_c(cluster: Any, tmp_path: Path, how: signal.Signals) -> None:
    """It takes the work with it. What was done stays done, and the rest is done by the next run."""
    signs, marker = tmp_path / "signs", tmp_path / "go on"
    signs.mkdir()
    recordings = write_quick_recordings(tmp_path / "in", 5, signs=str(signs))
    change(recordings[3], waits_for=str(marker))
    recordings = [replace(each, weight=10.0 - number) for number, each in enumerate(recordings)]
    out, folder = str(tmp_path / "out"), str(tmp_path / "in")
    code = DRIVER.format(helpers=str(HELPERS), out=out, folder=folder, address=cluster.address)
    driver = subprocess.Popen([sys.executable, "-c", code], start_new_session=True)
    try:
        stuck = begun(signs, recordings[3])
        until(lambda: len(Store(str(tmp_path / "out")).done()) >= 3)
        with pytest.raises(UsageError, match="another sags archive run"):
            gone_through(tmp_path / "out", recordings, cluster)
        driver.send_signal(how)
        code = driver.wait(PATIENCE)
    finally:
        driver.kill()
    assert code == (130 if how == signal.SIGINT else -signal.SIGKILL)
    until(lambda: not is_alive(stuck))
    before = written(tmp_path / "out/done")
    assert not any(name.startswith(recordings[3].id) for name in before)

    marker.touch()
    store, tally = gone_through(tmp_path / "out", recordings, cluster)
    assert (tally.kept, tally.done) == (len(before), 5 - len(before))
    assert before.items() <= written(tmp_path / "out/done").items()
    _, _ = gone_through(tmp_path / "whole", recordings, cluster)
    assert table(store) == table(Store(str(tmp_path / "whole")))


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 12 << 20) as folder:
        yield folder


def test_a_full_disk_stops_the_run_and_blames_no_recording(cluster: Any, tmp_path: Path, disk: Path) -> None:
    recordings = write_quick_recordings(tmp_path / "in", 6, writes=3)
    with pytest.raises(SagsError, match="no space left"):
        gone_through(disk / "out", recordings, cluster)
    store = Store(str(disk / "out"))
    before = store.done()
    assert 1 <= len(before) <= 4 and failed(store) == []
    assert all((disk / "out/recordings" / id / "report/large").stat().st_size == 3 << 20 for id in before)

    subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True, timeout=10)
    tally = gone_through(disk / "out", recordings, cluster)[1]
    assert (tally.kept, tally.done) == (len(before), 6 - len(before))
    assert [(row["state"], row["online.psnr"]) for row in table(store)] == [
        ("done", 30 + number / 8) for number in range(6)
    ]


def test_what_no_machine_has_is_waited_for_by_those_that_need_it(cluster: Any, tmp_path: Path) -> None:
    """The others are done. A GPU for the test is one that Ray is told of; nobody computes on it."""
    recordings = write_quick_recordings(tmp_path / "in", 3)
    recordings[0] = replace(recordings[0], overrides=("device:=cuda",))
    recordings[1] = replace(recordings[1], overrides=("engine.threads:=64",))
    store, tally = gone_through(tmp_path / "out", recordings, cluster)
    assert tally.done == 1 and store.done().keys() == {recordings[2].id}
    assert "wait for 1 cores, 1 GPUs, 0 GB of memory; 64 cores, 0 GPUs" in tally.waits
    assert status(store)["missing"] == 2 and failed(store) == []

    more = cluster.add_node(num_cpus=1, num_gpus=1)
    try:
        store, tally = gone_through(tmp_path / "out", recordings, cluster)
    finally:
        cluster.remove_node(more)
    assert (tally.kept, tally.done) == (1, 1) and "wait for 64 cores" in tally.waits
    rows = {row["id"]: row for row in table(store)}
    assert rows[recordings[0].id]["gpu"] == "0"  # the first of that machine's
    assert rows[recordings[2].id]["gpu"] is None
