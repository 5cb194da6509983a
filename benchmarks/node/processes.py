"""Processes: what they cost, which this one has started, and how to run work in another."""

import json
import multiprocessing
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import DEVNULL, Popen
from tempfile import TemporaryDirectory
from typing import Any, Literal

from sags_node.errors import SagsError
from sags_node.processes import end

STARTING, STOPPING = 60.0, 30.0  # s for a process to be ready, and to end
TICKS = os.sysconf("SC_CLK_TCK")  # clock ticks per second of CPU time


def children(named: str = "") -> list[int]:
    """Return the processes that this one has started and whose command line contains `named`."""
    found = []
    for task in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # a thread or a process that ends meanwhile
            for child in (task / "children").read_text(encoding="ascii").split():
                if named.encode() in Path(f"/proc/{child}/cmdline").read_bytes():
                    found.append(int(child))
    return found


def cpu_seconds(process: int) -> float:
    """Return the CPU time (s) of a process and its threads.

    Raises:
        OSError: it has ended.
    """
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def listed(process: int, what: Literal["fd", "task"]) -> int:
    """Count the files, sockets and pipes that a process has open ("fd"), or its threads ("task").

    Raises:
        OSError: it has ended, or is another user's.
    """
    return len(os.listdir(f"/proc/{process}/{what}"))


def parent_lives() -> bool:
    """Tell whether the process that started this one with `program` still runs."""
    parent = multiprocessing.parent_process()
    return parent is not None and parent.is_alive()


@contextmanager
def own_run_dir() -> Iterator[Path]:
    """Make an empty run directory; a process whose XDG_RUNTIME_DIR is its parent folder uses it."""
    with TemporaryDirectory(prefix="sags-benchmarks-") as folder:
        run_dir = Path(folder) / "sags"
        run_dir.mkdir(mode=0o700)
        yield run_dir


@contextmanager
def program(work: Callable[..., None], *arguments: Any) -> Iterator[None]:
    """Run `work` in another process, which ends when the block ends or this process does."""
    process = multiprocessing.get_context("spawn").Process(target=work, args=arguments, daemon=True)
    process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join(5.0)
        process.kill()


@contextmanager
def sags(*arguments: str, lasts: bool = False, **more: Any) -> Iterator[Popen[str]]:
    """Run a command of sags in another process until the block ends.

    Raises:
        SagsError: it has ended before, though it `lasts`: its figures would say that it costs nothing.
    """
    command = [sys.executable, "-m", "sags_node", *arguments]
    process = Popen(command, text=True, **{"stdout": DEVNULL, "stderr": DEVNULL, **more})
    try:
        yield process
        if lasts and process.poll() is not None:
            raise SagsError(f"sags {arguments[0]} ended before its time, exit code {process.returncode}")
    finally:
        end(process, grace=STOPPING)


def first_said(process: Popen[str], failed: str) -> dict[str, Any]:
    """Return the JSON that a process prints when it is ready.

    Raises:
        SagsError: `failed`; it ends, or prints nothing in time.
    """
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], STARTING)
    said = process.stdout.readline() if ready else ""  # one line at once, or the process has ended
    if not said:
        raise SagsError(failed)
    found: dict[str, Any] = json.loads(said)
    return found


def wait_until(ready: Callable[[], object], process: Popen[str], failed: str) -> None:
    """Wait for what a process should do.

    Raises:
        SagsError: `failed`; it ends, or does not do it in time.
    """
    deadline = time.monotonic() + STARTING
    while not ready():
        if process.poll() is not None or time.monotonic() > deadline:
            raise SagsError(failed)
        time.sleep(0.05)
