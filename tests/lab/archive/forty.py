"""Forty recordings as one archive, with and without faults, and what the archive itself costs.

    python tests/lab/archive/forty.py whole FOLDER        # without faults
    python tests/lab/archive/forty.py faults FOLDER       # the same with faults; mounts a disk
    python tests/lab/archive/forty.py efficiency FOLDER
    python tests/lab/archive/forty.py tiny FOLDER         # 2000 recordings that do next to nothing
    python tests/lab/archive/forty.py large FOLDER        # 100,000 that are done

Each takes some minutes of two cores; FOLDER must be new, but for `faults`. benchmarks/archive.md has
what came out.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[3]
HELPERS = ROOT / "tests/helpers"
sys.path.insert(0, str(HELPERS))
from golden import TIMING_KEYS  # noqa: E402
from small_disk import small_disk  # noqa: E402
from tiny_archive import quick_plan, quick_work, write_quick_recordings  # noqa: E402

from sags_lab.archive.cluster import connected  # noqa: E402
from sags_lab.archive.inputs import key_of  # noqa: E402
from sags_lab.archive.manifest import Recording, write_manifest  # noqa: E402
from sags_lab.archive.process import Limits  # noqa: E402
from sags_lab.archive.results import failed, read_results, write_results  # noqa: E402
from sags_lab.archive.run import Tally, about, run  # noqa: E402
from sags_lab.archive.store import RECORDINGS, Store  # noqa: E402
from sags_lab.archive.work import Plan, work  # noqa: E402
from sags_node.evaluation.provenance import revision  # noqa: E402
from sags_node.phantom import PhantomScene, write_session  # noqa: E402

SESSIONS = 12  # that are written
KINDS: tuple[dict[str, Any], ...] = (
    {}, {"smoke": 0.4}, {"noise": 0.05}, {"blur": 1.5}, {"camera_motion": "sway"}, {"blackout": (0.2, 0.3)},
    {"gloss": 10.0},
)  # fmt: skip
REAL = (("d4d_pull", 0.0), ("d4d_pull", 3.0), ("hamlyn_heart", 0.0), ("hamlyn_heart", 2.0))
OVERRIDES = ("mapping.max_gaussians:=2000",)
OPTIONS = ("--iterations", "1", "--hold-out", "2", "--every", "2")
TIMEOUT = 40  # s; what takes longest takes 10
ATTEMPTS = 2
PATIENCE = 240.0  # s


def phantoms(folder: Path, count: int) -> list[Recording]:
    """Of several seeds and kinds, each in several lengths."""
    for number in range(min(count, SESSIONS)):
        source = PhantomScene(seconds=0.8, width=160, height=128, seed=number, **KINDS[number % len(KINDS)])
        write_session(source, folder / f"phantom{number:02d}", rate=10.0)
    said = [(number % SESSIONS, 8 - number // SESSIONS) for number in range(count)]
    return [
        Recording(f"phantom{seed:02d}", str(folder), None, (f"source.frames:={frames}",), frames)
        for seed, frames in said
    ]


def forty(folder: Path) -> list[Recording]:
    """34 phantoms, four real ones, one that is damaged and one that will hang."""
    recordings = phantoms(folder, 34)
    for name, start in REAL:
        said = (f"source.start:={start}", "source.frames:=6")
        recordings.append(Recording(str(ROOT / f"launch/{name}.yaml"), str(folder), None, said, 50.0))
    for name in ("poison", "hangs"):
        shutil.copytree(folder / "phantom00", folder / name)
        recordings.append(Recording(name, str(folder), weight=9.0))
    sorted((folder / "poison/left").iterdir())[1].write_bytes(b"no picture")
    return recordings


def hang(recording: str) -> None:
    """Stop whatever works on a recording, as a disk that no longer answers would; does not return."""
    while True:
        for entry in Path("/proc").glob("[0-9]*"):
            if "archive.child" in (said := name_of(int(entry.name))) and f"eval {recording} " in said:
                with suppress(ProcessLookupError):
                    os.kill(int(entry.name), signal.SIGSTOP)
        time.sleep(0.2)


def command(folder: Path, out: Path) -> list[str]:
    return [
        *(sys.executable, "-m", "sags_node", "archive", "run", str(folder / "forty.csv"), "--job", "eval"),
        *("--out", str(out), "--timeout", str(TIMEOUT), "--attempts", str(ATTEMPTS)),
        *("--options", " ".join(OPTIONS), *OVERRIDES),
    ]


def whole(folder: Path) -> None:
    write_manifest(str(folder / "forty.csv"), forty(folder))
    threading.Thread(target=hang, args=(str(folder / "hangs"),), daemon=True).start()
    began = time.monotonic()
    subprocess.run(command(folder, folder / "whole"), check=False, timeout=2 * PATIENCE)
    say(f"{time.monotonic() - began:.0f} s")


def faults(folder: Path) -> None:
    threading.Thread(target=hang, args=(str(folder / "hangs"),), daemon=True).start()
    whole = folder / "whole"
    size = sum(file.stat().st_size for file in (whole / RECORDINGS).rglob("*") if file.is_file())
    with small_disk(folder / "disk", size * 2 // 3) as disk:
        out = disk / "out"
        driver = subprocess.Popen(command(folder, out), start_new_session=True)
        until(lambda: len(markers(out)) >= 6, driver)
        worker = next(each for each in below(driver.pid) if name_of(each).startswith("ray::work"))
        os.kill(worker, signal.SIGKILL)
        say(f"worker {worker} killed with {len(markers(out))} done")
        until(lambda: len(markers(out)) >= 14, driver)
        ours = below(driver.pid)
        driver.kill()
        driver.wait(PATIENCE)
        until(lambda: not [each for each in ours if alive(each)])
        done = [markers(out)]
        say(f"command killed with {len(done[0])} done; all that it started has ended")
        ended = subprocess.run(
            command(folder, out), check=False, capture_output=True, text=True, timeout=2 * PATIENCE
        )
        done.append(markers(out))
        say(f"disk full with {len(done[1])} done: {ended.stderr.strip().splitlines()[-1]}")
        assert ended.returncode == 1 and "no space left" in ended.stderr
        subprocess.run(["mount", "-o", f"remount,size={4 * size}", str(disk)], check=True, timeout=10)
        subprocess.run(command(folder, out), check=False, timeout=2 * PATIENCE)
        done.append(markers(out))
        assert all(earlier.items() <= later.items() for earlier, later in pairwise(done))
        say(f"done after each: {[len(each) for each in done]}, none twice")
        tables = [[without_times(row) for row in read_results(Store(str(each)))] for each in (whole, out)]
        assert tables[0] == tables[1], "the tables differ"
        states = [row["state"] for row in tables[0]]
        say(f"tables equal in {len(states)} rows, {len(tables[0][0])} columns: {states.count('done')} done")
        quarantined = {record["recording"]: record for record in failed(Store(str(out)))}
        assert quarantined.keys() == {"poison", "hangs"}
        for name, record in quarantined.items():
            say(f"{name}: {[attempt['reason'] for attempt in record['attempts']]}")


def efficiency(folder: Path) -> None:
    recordings = phantoms(folder, 40)
    write_manifest(str(folder / "forty.csv"), recordings)
    limits = Limits()
    plan = Plan("eval", OVERRIDES, OPTIONS, str(folder / "alone"), revision(), limits)
    seconds = [work(recording, plan, "alone").seconds for recording in recordings]
    began = time.monotonic()
    subprocess.run(command(folder, folder / "out"), check=True, timeout=2 * PATIENCE)
    wall, half = time.monotonic() - began, sum(seconds) / 2
    assert len(markers(folder / "out")) == 40
    say(f"one after the other {2 * half:.1f} s; as an archive {wall:.1f} s: {wall / half:.3f} of half of it")


def tiny(folder: Path) -> None:
    os.environ["PYTHONPATH"] = os.pathsep.join((str(HELPERS), str(ROOT)))  # of the workers
    recordings = [replace(each, weight=1.0) for each in write_quick_recordings(folder / "in", 2000)]
    plan = quick_plan(folder / "out")
    alone = [
        quick_work(each, replace(plan, out=str(folder / "alone")), "alone").seconds
        for each in recordings[:20]
    ]
    began = first = time.monotonic()
    memory: list[tuple[int, float, float]] = []

    def tell(tally: Tally, line: str) -> None:
        nonlocal first
        if tally.done == 0:
            first = time.monotonic()
        elif tally.done // 250 > len(memory) - 1:
            workers = [each for each in below(os.getpid()) if name_of(each).startswith("ray::quick_work")]
            memory.append((tally.done, megabytes(os.getpid()), max(map(megabytes, workers), default=0.0)))

    with Store(plan.out).locked():
        tally = run(Store(plan.out), recordings, plan, ATTEMPTS, tell, task=quick_work)
    wall = time.monotonic() - first
    say(f"{tally.done} done; the first after {first - began:.1f} s, the others in {wall:.1f} s")
    each = wall / tally.done * (os.cpu_count() or 1)
    say(f"a core is busy {each:.2f} s with each; alone one takes {sorted(alone)[10]:.2f} s")
    for done, driver, worker in memory:
        say(f"after {done}: driver {driver:.0f} MB, largest worker {worker:.0f} MB")


def large(folder: Path) -> None:
    """A part of a command's work for each of 100,000 recordings, and what Ray takes for 6400 that wait."""
    count, store = 100_000, Store(str(folder / "out"))
    one = phantoms(folder, 1)[0]
    plan = Plan("eval", OVERRIDES, OPTIONS, str(folder / "alone"), revision(), Limits())
    work(one, plan, "key")
    figures = Store(plan.out).read_json(f"done/{one.id}.key.json")
    with timed("a key", 200):
        for _ in range(200):
            key_of(one, about(plan))
    recordings = [replace(one, name=f"case{number}/scope.mcap") for number in range(count)]
    (folder / "out/done").mkdir(parents=True)
    for each in recordings:
        (folder / f"out/done/{each.id}.key.json").write_text(json.dumps(figures | {"id": each.id}))
    with timed("list what is done", count):
        assert len(store.done()) == count
    with timed("results.parquet", count):
        write_results(store, recordings)
    table = (folder / "out/results.parquet").stat().st_size * 1e-6
    say(f"results.parquet has {table:.1f} MB; {megabytes(os.getpid()):.0f} MB of memory")
    with connected(None) as ray:
        waits = ray.remote(lambda: time.sleep(PATIENCE))
        tasks = [waits.remote() for _ in range(6400)]
        with timed("ray.wait among 6400", 100):
            for _ in range(100):
                ray.wait(tasks, num_returns=1, timeout=0)


@contextmanager
def timed(what: str, count: int) -> Iterator[None]:
    began = time.monotonic()
    yield
    seconds = time.monotonic() - began
    say(f"{what}: {seconds:.1f} s, {seconds / count * 1e3:.2f} ms each")


def without_times(row: dict[str, Any]) -> dict[str, Any]:
    """A row without what differs from run to run, and the version."""
    return {
        key: value
        for key, value in row.items()
        if key.partition(".")[0] not in TIMING_KEYS | {"seconds", "finished", "version"}
    }


def markers(out: Path) -> dict[str, int]:
    """What is done, and when it was."""
    return {file.name: file.stat().st_mtime_ns for file in (out / "done").glob("[!.]*")}


def below(process: int) -> list[int]:
    """All processes that it started, and those started."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(entry.parent.name)] = int(entry.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue  # it has ended
    found = [process]
    for each in found:  # grows
        found += [child for child, parent in parents.items() if parent == each]
    return found[1:]


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def name_of(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""


def megabytes(process: int) -> float:
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


def until(there: Callable[[], Any], driver: subprocess.Popen[bytes] | None = None) -> None:
    deadline = time.monotonic() + PATIENCE
    while not there():
        assert time.monotonic() < deadline, "it did not happen"
        assert driver is None or driver.poll() is None, "the command has ended"
        time.sleep(0.1)


def say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    what, place = sys.argv[1], Path(sys.argv[2]).resolve()
    place.mkdir(parents=True, exist_ok=what == "faults")
    {"whole": whole, "faults": faults, "efficiency": efficiency, "tiny": tiny, "large": large}[what](place)
