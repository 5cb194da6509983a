"""Recordings that are played in no time."""

import json
from pathlib import Path
from typing import Any

from sags_lab.archive.manifest import Recording
from sags_lab.archive.process import Limits
from sags_lab.archive.store import RESULTS, Store
from sags_lab.archive.work import Outcome, Plan, work
from sags_node.config.schema import PhantomSource
from sags_node.phantom import write_session

TINY_FRAMES = 6
QUICK = "quick"  # a revision: that of the checkout may change meanwhile


def write_tiny_session(folder: Path, seed: int) -> None:
    """Six small frames of a phantom, with their truth."""
    write_session(
        PhantomSource(seconds=TINY_FRAMES / 10, width=160, height=128, seed=seed), folder, rate=10.0
    )


def quick_work(recording: Recording, plan: Plan, key: str) -> Outcome:
    """`work` with `quick_job` in place of `sags`."""
    return work(recording, plan, key, (str(Path(__file__).with_name("quick_job.py")),), QUICK)


def write_quick_recordings(folder: Path, count: int, **said: Any) -> list[Recording]:
    """Files of `quick_job`, one for each recording; what is said is of all."""
    folder.mkdir()
    recordings = [
        Recording(f"r{number:03d}.json", str(folder), weight=count - number) for number in range(count)
    ]
    for number, recording in enumerate(recordings):
        (folder / recording.name).write_text(json.dumps({"psnr": 30 + number / 8, **said}))
    return recordings


def quick_plan(out: Path, *overrides: str, **limits: Any) -> Plan:
    return Plan("eval", overrides, (), str(out), QUICK, Limits(**limits))


def table(store: Store) -> list[dict[str, Any]]:
    """The rows of results.parquet without what differs from run to run."""
    import pyarrow.parquet as pq

    rows = pq.read_table(Path(store.url) / RESULTS).to_pylist()
    for row in rows:
        for key in ("seconds", "finished"):
            row.pop(key, None)
    return rows
