"""Processes: what they cost, which this one has started, and how to run work in another."""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

STOPPING = 5.0  # s for a process to end
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
        process.join(STOPPING)
        process.kill()
