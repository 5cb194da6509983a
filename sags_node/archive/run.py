"""Goes through an archive: what is not done yet is given to Ray, one task for each recording."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain
from typing import Any

from sags_node.archive.cluster import connected
from sags_node.archive.inputs import key_of
from sags_node.archive.manifest import Recording
from sags_node.archive.store import ABOUT, DONE, FAILED, MANIFEST, Store
from sags_node.archive.work import Outcome, Plan, repeating, resources, work
from sags_node.errors import SagsError
from sags_node.terminal.console import on_stop_signals

Task = Callable[[Recording, Plan, str], Outcome]

AHEAD = 2  # tasks handed to Ray for each that runs: so many wait where they will run
LOOK_PERIOD = 0.5  # s
STOP_SECONDS = 15.0  # for the tasks to end what they started
SLOTS_PERIOD = 10.0  # s until a cluster is asked again how large it is


@dataclass(slots=True)
class Tally:
    """How far it is.

    Attributes:
        kept: done before this run.
        frames: of those done in this run.
        hosts: recordings done, by machine.
        stopping: set by Ctrl-C: what runs is ended, and may be done again later.
    """

    of: int
    kept: int = 0
    done: int = 0
    quarantined: int = 0
    running: int = 0
    retried: int = 0
    frames: int = 0
    work_seconds: float = 0.0
    hosts: Counter[str] = field(default_factory=Counter)
    stopping: threading.Event = field(default_factory=threading.Event)


@dataclass(frozen=True, slots=True)
class Todo:
    recording: Recording
    key: str


def run(
    store: Store,
    recordings: Sequence[Recording],
    plan: Plan,
    attempts: int,
    tell: Callable[[Tally, str], None] = lambda tally, line: None,
    retry_failed: bool = False,
    address: str | None = None,
    task: Task = work,
) -> Tally:
    """Do what is missing, until all is done or Ctrl-C. The store must be locked.

    Args:
        attempts: a recording is tried so often, in this and earlier runs; then it is quarantined.
        tell: called with how far it is, and a line where something failed.
        retry_failed: quarantined recordings have all their attempts anew.
        address: of a Ray cluster; None: this machine alone.
        task: what is done with each.

    Raises:
        UsageError: Ray is not installed.
        SagsError: Ray does not start, the output is full, or no machine has what a task needs.
    """
    tally = Tally(len(recordings))
    failed = {name.removesuffix(".json") for name in store.names(FAILED) if name.endswith(".json")}
    todo = _missing(store, recordings, plan, failed, retry_failed, tally)
    first = next(todo, None)
    if first is None:
        return tally
    tell(tally, "")
    with connected(address) as ray:
        _check_fit(ray, plan)
        on_stop_signals(tally.stopping.set)  # after Ray, which has a handler of its own
        _work_through(ray, store, chain([first], todo), plan, attempts, tell, failed, tally, task)
    return tally


def _work_through(
    ray: Any,
    store: Store,
    todo: Iterator[Todo],
    plan: Plan,
    attempts: int,
    tell: Callable[[Tally, str], None],
    failed: set[str],
    tally: Tally,
    task: Task,
) -> None:
    cores, gpus = resources(plan.overrides)
    memory = {} if plan.limits.memory_gb is None else {"memory": int(plan.limits.memory_gb * 1e9)}
    remote = ray.remote(task).options(num_cpus=cores, num_gpus=gpus, max_retries=0, **memory)
    again: deque[Todo] = deque()
    running: dict[Any, Todo] = {}
    full: str | None = None
    most, asked = 0, -SLOTS_PERIOD
    while not tally.stopping.is_set() and full is None:
        if time.monotonic() - asked > SLOTS_PERIOD:
            most, asked = AHEAD * _slots(ray, cores, gpus), time.monotonic()
        while len(running) < most and (new := next(todo, None) or (again.popleft() if again else None)):
            running[remote.remote(new.recording, plan, new.key)] = new
        tally.running = len(running)
        tell(tally, "")
        if not running:
            break
        ready, _ = ray.wait(list(running), num_returns=1, timeout=LOOK_PERIOD)
        for reference in ready:
            ended = running.pop(reference)
            outcome = _outcome(ray, reference, ended.recording)
            if outcome.state == "no space":
                full = outcome.reason
            elif outcome.state == "done":
                _count(tally, outcome)
                if outcome.id in failed:
                    forget(store, outcome.id)
            else:
                failed.add(outcome.id)
                if _note(store, ended, plan, outcome, attempts):
                    tally.quarantined += 1
                else:
                    tally.retried += 1
                    again.append(ended)
                tell(tally, f"{outcome.id}: {outcome.reason}")
    _end(ray, running)
    if full is not None:
        raise SagsError(f"no space left on {store.url} ({full}); make room, then give the same command again")


def about(plan: Plan) -> dict[str, Any]:
    """What decides what comes out, beside a recording itself."""
    return {
        "job": plan.job,
        "overrides": list(plan.overrides),
        "options": list(plan.options),
        "version": plan.version,
    }


def describe(store: Store, recordings: Sequence[Recording], plan: Plan, manifest: bytes) -> None:
    """Keep what is being run, for `sags archive status`."""
    store.write(MANIFEST, manifest)
    store.write_json(ABOUT, {**about(plan), "folder": recordings[0].folder, "limits": asdict(plan.limits)})


def forget(store: Store, id: str) -> None:
    """Of a recording's failures."""
    for suffix in ("json", "log"):
        store.remove(f"{FAILED}/{id}.{suffix}")


def _missing(
    store: Store,
    recordings: Sequence[Recording],
    plan: Plan,
    failed: set[str],
    retry_failed: bool,
    tally: Tally,
) -> Iterator[Todo]:
    """Recordings that are not done as they are now, the dearest first. Files are looked at one recording
    ahead of the work, not all at once."""
    done = store.done()
    for recording in sorted(recordings, key=lambda each: -each.weight):
        key = key_of(recording, about(plan))
        before = done.get(recording.id)
        if before == key:
            tally.kept += 1
            continue
        if before is not None:
            store.remove(f"{DONE}/{recording.id}.{before}.json")  # first: its results are about to go
        if recording.id in failed:
            record = store.read_json(f"{FAILED}/{recording.id}.json")
            if retry_failed or record["key"] != key:
                forget(store, recording.id)
            elif record["quarantined"]:
                tally.quarantined += 1
                continue
        yield Todo(recording, key)


def _check_fit(ray: Any, plan: Plan) -> None:
    cores, gpus = resources(plan.overrides)
    wanted = {"CPU": cores, "GPU": gpus, "memory": (plan.limits.memory_gb or 0) * 1e9}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(all(node.get(what, 0) >= count for what, count in wanted.items()) for node in nodes):
        most = max(nodes, key=lambda node: float(node.get("CPU", 0)))
        raise SagsError(
            f"no machine has what a recording needs: {cores} cores, {gpus} GPUs, "
            f"{plan.limits.memory_gb or 0:g} GB of memory. The largest has {most.get('CPU', 0):g} cores, "
            f"{most.get('GPU', 0):g} GPUs, {most.get('memory', 0) * 1e-9:.1f} GB; lower engine.threads or "
            "--memory"
        )


def _slots(ray: Any, cores: int, gpus: int) -> int:
    """How many tasks can run at once."""
    there = ray.cluster_resources()
    by_cores = int(there.get("CPU", 0) // cores)
    return max(1, min(by_cores, int(there.get("GPU", 0) // gpus)) if gpus else by_cores)


def _outcome(ray: Any, reference: Any, recording: Recording) -> Outcome:
    try:
        outcome: Outcome = ray.get(reference)
    except ray.exceptions.RayError as error:  # the worker or its machine was lost
        said = str(error).strip().splitlines()
        reason = f"{type(error).__name__}: {said[0] if said else 'no reason is known'}"
        return Outcome(recording.id, "failed", reason, 0.0, 0, "?")
    return outcome


def _count(tally: Tally, outcome: Outcome) -> None:
    tally.done += 1
    tally.frames += outcome.frames
    tally.work_seconds += outcome.seconds
    tally.hosts[outcome.host] += 1


def _note(store: Store, todo: Todo, plan: Plan, outcome: Outcome, attempts: int) -> bool:
    """Keep why an attempt failed; whether the recording is quarantined now."""
    name = f"{FAILED}/{outcome.id}.json"
    before = store.read_json(name)
    tried = [*(before["attempts"] if before is not None and before["key"] == todo.key else [])]
    tried.append({"reason": outcome.reason, "seconds": round(outcome.seconds, 3), "host": outcome.host})
    quarantined = outcome.state == "refused" or len(tried) >= attempts
    store.write_json(
        name,
        {
            "id": outcome.id,
            "recording": todo.recording.name,
            "key": todo.key,
            "quarantined": quarantined,
            "attempts": tried,
            "command": repeating(todo.recording, plan),
        },
    )
    return quarantined


def _end(ray: Any, running: dict[Any, Todo]) -> None:
    """End what runs: each task ends its own process."""
    for reference in running:
        ray.cancel(reference, force=False)
    if running:
        ray.wait(list(running), num_returns=len(running), timeout=STOP_SECONDS)
