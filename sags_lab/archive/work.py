"""One recording of an archive, on the worker: fetch it, run the job, store the results, report."""

import errno
import json
import os
import shlex
import shutil
import signal
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from sags_lab.archive.inputs import fetched, scratch
from sags_lab.archive.jobs import FIGURES, LOG, command, row_of
from sags_lab.archive.launching import arguments, split
from sags_lab.archive.manifest import Recording
from sags_lab.archive.process import PROGRAM, Ended, Limits, run_limited
from sags_lab.archive.store import FAILED, RECORDINGS, Store
from sags_node.errors import SagsError, UsageError
from sags_node.tools.evaluation.provenance import machine_name, revision

State = Literal["done", "failed", "refused", "no space"]
NO_SPACE = os.strerror(errno.ENOSPC)
WRONG_REQUEST = UsageError.exit_code  # exit code where a further attempt would fail, too
LEAST_FREE = 1 << 20  # bytes; a file system with less counts as full
TAIL = 20_000  # bytes of a log that are looked at
LONGEST_REASON = 500  # characters


@dataclass(frozen=True, slots=True)
class Plan:
    """What is done with every recording.

    Attributes:
        overrides: `key:=value` for all; a recording's own come after them.
        options: further options of the job's command.
        out: path or URL of the store.
        version: of this package; another one on a worker is an error.
    """

    job: str
    overrides: tuple[str, ...]
    options: tuple[str, ...]
    out: str
    version: str
    limits: Limits


@dataclass(frozen=True, slots=True)
class Needs:
    """What a recording takes of a machine while it runs; memory in bytes."""

    cores: int
    gpus: int
    memory: int

    def __str__(self) -> str:
        return f"{self.cores} cores, {self.gpus} GPUs, {self.memory * 1e-9:g} GB of memory"


def needs(plan: Plan, recording: Recording | None = None) -> Needs:
    """Return what the overrides ask for with `engine.threads` and `device:=cuda`; the recording's own win.

    Raises:
        UsageError: `engine.threads` is no number of cores.
    """
    own = () if recording is None else recording.overrides
    said = dict(each.split(":=", 1) for each in (*plan.overrides, *own))
    cores = said.get("engine.threads", "1")
    if not cores.isdecimal() or int(cores) < 1:
        where = "" if recording is None else f"{recording.id}: "
        raise UsageError(f"{where}engine.threads:={cores}: a recording needs a number of cores, 1 or more")
    return Needs(int(cores), int(said.get("device") == "cuda"), int((plan.limits.memory_gb or 0) * 1e9))


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one attempt.

    Attributes:
        state: `refused`: another attempt would fail, too; `no space`: the output is full.
        reason: why it is not done, in a line.
        host: name of the machine that did it.
    """

    id: str
    state: State
    reason: str
    seconds: float
    frames: int
    host: str


def work(
    recording: Recording, plan: Plan, key: str, program: Sequence[str] = PROGRAM, here: str | None = None
) -> Outcome:
    """Do the job for one recording. What is wrong with it is in the outcome, and not raised.

    Args:
        program: what the job's arguments are given to.
        here: the revision of `program` on this machine; default: that of this package.
    """
    began, frames = time.monotonic(), 0
    state: State = "done"
    reason = ""
    try:
        frames = _work(recording, plan, key, program, here or revision())
    except _FailedError as error:
        state, reason = error.state, str(error)
    except UsageError as error:
        state, reason = "refused", str(error)
    except (SagsError, OSError, ValueError) as error:
        full = isinstance(error, OSError) and error.errno == errno.ENOSPC
        state, reason = "no space" if full else "failed", f"{type(error).__name__}: {error}"
    return Outcome(recording.id, state, reason, time.monotonic() - began, frames, socket.gethostname())


class _FailedError(Exception):
    """The command failed."""

    def __init__(self, state: State, reason: str) -> None:
        super().__init__(reason)
        self.state = state


def _work(recording: Recording, plan: Plan, key: str, program: Sequence[str], here: str) -> int:
    """Do as `work`; returns the number of frames, 0 where the job does not count them."""
    if here != plan.version:
        raise SagsError(f"this machine has sags-node {here}, not {plan.version}; install that")
    began, store = time.monotonic(), Store(plan.out)
    with scratch() as stage, store.partial(recording.id) as out:
        place, rig = fetched(recording, stage, plan.limits.staged_gb)
        said = command(plan.job, _said(place, rig, recording, plan), plan.options, out)
        cores = needs(plan, recording).cores
        figures_file, log = stage / FIGURES, stage / LOG  # not in `out`, which may become full
        ended = run_limited([*program, *said], cores, plan.limits, figures_file, log)
        is_full = shutil.disk_usage(out).free < LEAST_FREE  # not all writers of images report it
        if is_full or NO_SPACE in _tail(log):
            raise _FailedError("no space", NO_SPACE)
        if ended != Ended(0):
            store.write(f"{FAILED}/{recording.id}.log", _tail(log).encode())
            raise _FailedError("refused" if ended.code == WRONG_REQUEST else "failed", _reason(ended, log))
        final = f"{plan.out.rstrip('/')}/{RECORDINGS}/{recording.id}"
        for file in (figures_file, log):  # they name the folder of the results
            (out / file.name).write_bytes(file.read_bytes().replace(os.fsencode(out), final.encode()))
        figures = row_of(json.loads(figures_file.read_bytes()))
        store.finish(recording.id, key, out, _row(recording, figures, plan, time.monotonic() - began))
    return int(figures.get("frames") or 0)


def _said(place: Path, rig: Path | None, recording: Recording, plan: Plan) -> list[str]:
    """What is launched; then overrides for resources, for all recordings and its own: later ones win."""
    cores = needs(plan, recording).cores
    threads = [f"engine.threads:={cores}", f"vision.onnx.threads:={cores}"]
    launch, own = split(arguments(place, rig, recording.overrides))
    return [*([] if launch is None else [launch]), *threads, "device:=cpu", *plan.overrides, *own]


def repeating(recording: Recording, plan: Plan) -> str:
    """Return the command that does the same by hand."""
    rig = None if recording.rig is None else Path(recording.rig)
    try:
        said = _said(Path(recording.place), rig, recording, plan)
    except UsageError:
        said = [recording.place, *recording.overrides]
    return shlex.join(["sags", *command(plan.job, said, plan.options, Path("out") / recording.id)])


def _row(recording: Recording, figures: dict[str, Any], plan: Plan, seconds: float) -> dict[str, Any]:
    return {
        "id": recording.id,
        "recording": recording.name,
        "segment": recording.segment,
        "job": plan.job,
        **figures,
        "seconds": round(seconds, 3),
        "machine": machine_name(),
        "version": plan.version,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _reason(ended: Ended, log: Path) -> str:
    """Why a command failed, in a line: the limit, the signal, or the last thing that it printed."""
    if ended.limit is not None:
        return ended.limit
    if ended.code < 0:
        return f"ended by {signal.Signals(-ended.code).name}"
    lines = [line.strip() for line in _tail(log).splitlines() if line.strip()]
    said = [line.partition("error:")[2].strip() for line in lines if line.startswith("error:")]
    last = said[-1:] or lines[-1:] or ["it said nothing"]
    return f"{last[0][:LONGEST_REASON]} (exit code {ended.code})"


def _tail(log: Path) -> str:
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - TAIL))
        return file.read().decode("utf-8", errors="replace")
