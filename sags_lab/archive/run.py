"""Goes through an archive: what is not done yet is given to Ray, one task for each recording."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain
from typing import Any

from sags_lab.archive.cluster import connected
from sags_lab.archive.inputs import key_of
from sags_lab.archive.manifest import Recording
from sags_lab.archive.store import ABOUT, DONE, FAILED, MANIFEST, Store
from sags_lab.archive.work import Needs, Outcome, Plan, needs, repeating, work
from sags_node.errors import SagsError
from sags_node.terminal.console import on_stop_signals

Task = Callable[[Recording, Plan, str], Outcome]

AHEAD = 2  # tasks handed to Ray for each that can run, so that the next ones wait on their machine
LOOK_PERIOD = 0.5  # s
STOP_SECONDS = 15.0  # for the tasks to end what they started
SLOTS_PERIOD = 10.0  # s until a cluster is asked again how large it is


@dataclass(slots=True)
class Tally:
    """How far a run is.

    Attributes:
        kept: done before this run.
        frames: of the recordings done in this run.
        hosts: recordings done, by machine.
        waits: says what waiting recordings need that no machine has; empty: none wait for that.
        stopping: set by Ctrl-C: running tasks are ended; a later run does them again.
    """

    of: int
    kept: int = 0
    done: int = 0
    quarantined: int = 0
    running: int = 0
    retried: int = 0
    frames: int = 0
    hosts: Counter[str] = field(default_factory=Counter)
    waits: str = ""
    stopping: threading.Event = field(default_factory=threading.Event)


@dataclass(frozen=True, slots=True)
class Todo:
    recording: Recording
    key: str
    needs: Needs


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
        attempts: after so many, in this and earlier runs, a recording is quarantined.
        tell: called with how far it is, and a line where something failed or waits; else "".
        retry_failed: forget all failed attempts, also of quarantined recordings.
        address: of a Ray cluster; None: this machine alone.
        task: what is done with each recording.

    Raises:
        UsageError: Ray is not installed, or `engine.threads` of a recording is no number of cores.
        SagsError: Ray does not start, or the output is full.
    """
    tally = Tally(len(recordings))
    failed = {name.removesuffix(".json") for name in store.names(FAILED) if name.endswith(".json")}
    alike: dict[Needs, list[Recording]] = {}
    for recording in sorted(recordings, key=lambda each: -each.weight):
        alike.setdefault(needs(plan, recording), []).append(recording)
    todo = {}
    for what, those in alike.items():
        missing = _missing(store, those, what, plan, failed, retry_failed, tally)
        if (first := next(missing, None)) is not None:
            todo[what] = chain([first], missing)
    if not todo:
        return tally
    tell(tally, "")
    with connected(address) as ray:
        on_stop_signals(tally.stopping.set)  # after Ray, which has a handler of its own
        _work_through(ray, store, todo, plan, attempts, tell, failed, tally, task)
    return tally


def _work_through(
    ray: Any,
    store: Store,
    todo: Mapping[Needs, Iterator[Todo]],
    plan: Plan,
    attempts: int,
    tell: Callable[[Tally, str], None],
    failed: set[str],
    tally: Tally,
    task: Task,
) -> None:
    remote = {what: _remote(ray, task, what) for what in todo}
    again: dict[Needs, deque[Todo]] = {what: deque() for what in todo}
    running: dict[Any, Todo] = {}
    full: str | None = None
    slots: dict[Needs, int] = {}
    asked = -SLOTS_PERIOD
    while not tally.stopping.is_set() and full is None:
        if time.monotonic() - asked > SLOTS_PERIOD:
            nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
            slots, asked = {what: _slots(nodes, what) for what in todo}, time.monotonic()
            before, tally.waits = tally.waits, _unmet(nodes, [what for what in todo if not slots[what]])
            if tally.waits != before:
                tell(tally, tally.waits)
        handed = Counter(each.needs for each in running.values())
        for what, those in todo.items():
            while handed[what] < AHEAD * slots[what] and (
                new := next(those, None) or (again[what].popleft() if again[what] else None)
            ):
                running[remote[what].remote(new.recording, plan, new.key)] = new
                handed[what] += 1
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
                    again[ended.needs].append(ended)
                tell(tally, f"{outcome.id}: {outcome.reason}")
    _end(ray, running)
    if full is not None:
        raise SagsError(f"no space left on {store.url} ({full}); make room, then give the same command again")


def about(plan: Plan) -> dict[str, Any]:
    """Return what results depend on, beside the recording itself."""
    return {
        "job": plan.job,
        "overrides": list(plan.overrides),
        "options": list(plan.options),
        "version": plan.version,
    }


def describe(store: Store, recordings: Sequence[Recording], plan: Plan, manifest: bytes) -> None:
    """Write what is being run into the store, for `sags archive status`."""
    store.write(MANIFEST, manifest)
    store.write_json(ABOUT, {**about(plan), "folder": recordings[0].folder, "limits": asdict(plan.limits)})


def forget(store: Store, id: str) -> None:
    """Remove the record of a recording's failures."""
    for suffix in ("json", "log"):
        store.remove(f"{FAILED}/{id}.{suffix}")


def _missing(
    store: Store,
    recordings: Sequence[Recording],
    what: Needs,
    plan: Plan,
    failed: set[str],
    retry_failed: bool,
    tally: Tally,
) -> Iterator[Todo]:
    """Recordings without up-to-date results, in this order. Their files are looked at one recording ahead of
    the work, not all at once."""
    done = store.done()
    for recording in recordings:
        key = key_of(recording, about(plan))
        before = done.get(recording.id)
        if before == key:
            tally.kept += 1
            continue
        if before is not None:
            store.remove(f"{DONE}/{recording.id}.{before}.json")  # before its results are replaced
        if recording.id in failed:
            record = store.read_json(f"{FAILED}/{recording.id}.json")
            if retry_failed or record is None or record["key"] != key:
                forget(store, recording.id)
            elif record["quarantined"]:
                tally.quarantined += 1
                continue
        yield Todo(recording, key, what)


def _remote(ray: Any, task: Task, what: Needs) -> Any:
    """The task as a Ray function that asks for these resources."""
    memory = {"memory": what.memory} if what.memory else {}
    return ray.remote(task).options(num_cpus=what.cores, num_gpus=what.gpus, max_retries=0, **memory)


def _slots(nodes: Sequence[Mapping[str, float]], what: Needs) -> int:
    """How many tasks that need this can run at once; 0: no machine has it."""
    wanted = {"CPU": what.cores, "GPU": what.gpus, "memory": what.memory}
    return sum(
        min(int(node.get(name, 0) // count) for name, count in wanted.items() if count) for node in nodes
    )


def _unmet(nodes: Sequence[Mapping[str, float]], those: Sequence[Needs]) -> str:
    """A line that says what recordings need and no machine has; empty where `those` is."""
    if not those:
        return ""
    most = {name: max((node.get(name, 0) for node in nodes), default=0) for name in ("CPU", "GPU", "memory")}
    there = f"{most['CPU']:g} cores, {most['GPU']:g} GPUs, {most['memory'] * 1e-9:.1f} GB"
    return (
        f"recordings wait for {'; '.join(map(str, those))}, which no machine has. The most that one has is "
        f"{there}; lower engine.threads or --memory, leave out device:=cuda, or give the same command again "
        "where a machine has it (--ray)"
    )


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
    tally.hosts[outcome.host] += 1


def _note(store: Store, todo: Todo, plan: Plan, outcome: Outcome, attempts: int) -> bool:
    """Write why an attempt failed; return whether the recording is quarantined now."""
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
    """Cancel the running tasks: each ends its own process."""
    for reference in running:
        ray.cancel(reference, force=False)
    if running:
        ray.wait(list(running), num_returns=len(running), timeout=STOP_SECONDS)
