"""What an archive itself costs.

    python tests/lab/archive/archive_costs.py efficiency FOLDER
    python tests/lab/archive/archive_costs.py tiny FOLDER         # 2000 recordings that do next to nothing
    python tests/lab/archive/archive_costs.py large FOLDER        # 100,000 that are done

Each takes some minutes of two cores; FOLDER must be new. benchmarks/archive.md has what came out.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[3]
HELPERS = ROOT / "tests/helpers"
sys.path.insert(0, str(HELPERS))
from tiny_archive import quick_plan, quick_work, write_quick_recordings  # noqa: E402

from sags_lab.archive.cluster import connected  # noqa: E402
from sags_lab.archive.inputs import key_of  # noqa: E402
from sags_lab.archive.manifest import Recording, write_manifest  # noqa: E402
from sags_lab.archive.process import Limits  # noqa: E402
from sags_lab.archive.results import write_results  # noqa: E402
from sags_lab.archive.run import Tally, about, run  # noqa: E402
from sags_lab.archive.store import Store  # noqa: E402
from sags_lab.archive.work import Plan, work  # noqa: E402
from sags_node.phantom import PhantomScene, write_session  # noqa: E402
from sags_node.processes import resident_mb  # noqa: E402
from sags_node.tools.evaluation.provenance import revision  # noqa: E402

SESSIONS = 12  # that are written
KINDS: tuple[dict[str, Any], ...] = (
    {}, {"smoke": 0.4}, {"noise": 0.05}, {"blur": 1.5}, {"camera_motion": "sway"}, {"blackout": (0.2, 0.3)},
    {"gloss": 10.0},
)  # fmt: skip
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


def command(folder: Path, out: Path) -> list[str]:
    return [
        *(sys.executable, "-m", "sags_node", "archive", "run", str(folder / "forty.csv"), "--job", "eval"),
        *("--out", str(out), "--timeout", str(TIMEOUT), "--attempts", str(ATTEMPTS)),
        *("--options", " ".join(OPTIONS), *OVERRIDES),
    ]


def efficiency(folder: Path) -> None:
    recordings = phantoms(folder, 40)
    write_manifest(str(folder / "forty.csv"), recordings)
    limits = Limits()
    plan = Plan("eval", OVERRIDES, OPTIONS, str(folder / "alone"), revision(), limits)
    seconds = [work(recording, plan, "alone").seconds for recording in recordings]
    began = time.monotonic()
    subprocess.run(command(folder, folder / "out"), check=True, timeout=2 * PATIENCE)
    wall, half = time.monotonic() - began, sum(seconds) / 2
    assert len([*(folder / "out/done").glob("[!.]*")]) == 40
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
            memory.append((tally.done, resident_mb(), max(map(resident_mb, workers), default=0.0)))

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
    say(f"results.parquet has {table:.1f} MB; {resident_mb():.0f} MB of memory")
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


def name_of(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""


def say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    what, place = sys.argv[1], Path(sys.argv[2]).resolve()
    place.mkdir(parents=True)
    {"efficiency": efficiency, "tiny": tiny, "large": large}[what](place)
