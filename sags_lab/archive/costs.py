"""What a job costs for an hour of video: measured on two lengths of a recording, extrapolated by frames."""

import multiprocessing
import resource
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sags_lab.archive.manifest import Recording
from sags_lab.archive.process import Limits
from sags_lab.archive.store import RECORDINGS
from sags_lab.archive.work import Outcome, Plan, work
from sags_node.errors import SagsError
from sags_node.tools.evaluation.provenance import revision

SHORT = 4  # the longer run has so many times the frames of the shorter one
HOUR = 3600.0  # s
IN_CLIPS = frozenset({"fit"})  # held in memory as a whole: its hour is made of clips of the longer length


@dataclass(frozen=True, slots=True)
class Cost:
    """What one run costs."""

    cpu_s: float
    wall_s: float
    peak_mb: float  # of its largest process
    bytes: float  # of the files that it leaves


def job_costs(
    launch: str,
    overrides: Sequence[str],
    jobs: Sequence[str],
    frames: int,
    rate: float,
    tell: Callable[[int, str], None] = lambda done, what: None,
) -> list[dict[str, Any]]:
    """Measure jobs, one after the other, on one core unless `engine.threads` says another number.

    Args:
        launch: a launch file or session.
        frames: of the longer run.
        rate: of the recording, frames per second.
        tell: called with how many jobs are done, and which one is next.

    Raises:
        SagsError: a job fails.
    """
    rows = []
    for done, job in enumerate(jobs):
        tell(done, job)
        long = _cost(launch, overrides, job, frames)
        short = long if job in IN_CLIPS else _cost(launch, overrides, job, max(1, frames // SHORT))
        rows.append(
            {
                "job": job,
                "frames": frames,
                "seconds_of_video": round(frames / rate, 2),
                "wall_s": round(long.wall_s, 1),
                "cpu_s": round(long.cpu_s, 1),
                "peak_mb": round(long.peak_mb),
                "bytes": round(long.bytes),
                "of_an_hour": of_an_hour(job, short, long, frames, rate),
            }
        )
    return rows


def of_an_hour(job: str, short: Cost, long: Cost, frames: int, rate: float) -> dict[str, int]:
    """Return CPU seconds, wall seconds and bytes of an hour of video. A start costs once; what each further
    frame costs follows from the two runs."""
    count, fewer = HOUR * rate, max(1, frames // SHORT)

    def scaled(less: float, more: float) -> int:
        if job in IN_CLIPS:
            return round(more * count / frames)
        further = max(0.0, more - less) / (frames - fewer)  # a report may be smaller for more frames
        return round(more + further * (count - frames))

    return {
        "cpu_s": scaled(short.cpu_s, long.cpu_s),
        "wall_s": scaled(short.wall_s, long.wall_s),
        "bytes": scaled(short.bytes, long.bytes),
    }


def _cost(launch: str, overrides: Sequence[str], job: str, frames: int) -> Cost:
    recording = Recording(launch, "", overrides=(*overrides, f"source.frames:={frames}"))
    with tempfile.TemporaryDirectory(prefix="sags-costs-") as out:
        plan = Plan(job, (), (), out, revision(), Limits())
        # A new process for each: all that its children used was used by this job.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as alone:
            outcome, cpu_s, peak_mb = alone.submit(_measured, recording, plan).result()
        if outcome.state != "done":
            raise SagsError(f"{job}: {outcome.reason}")
        left = sum(file.stat().st_size for file in (Path(out) / RECORDINGS).rglob("*") if file.is_file())
    return Cost(cpu_s, outcome.seconds, peak_mb, left)


def _measured(recording: Recording, plan: Plan) -> tuple[Outcome, float, float]:
    outcome = work(recording, plan, "cost")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return outcome, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024e-6  # KiB
