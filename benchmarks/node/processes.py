"""What processes cost, which this one has started, and work in one that ends with us."""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

STOPPING = 5.0  # s for a process to end
TICKS = os.sysconf("SC_CLK_TCK")  # of CPU time in a second


def children(named: str = "") -> list[int]:
    """The processes that this one has started, and whose command holds `named`."""
    found = []
    for task in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # a thread or a process that ends meanwhile
            for child in (task / "children").read_text(encoding="ascii").split():
                if named.encode() in Path(f"/proc/{child}/cmdline").read_bytes():
                    found.append(int(child))
    return found


def cpu_seconds(process: int) -> float:
    """Of a process and its threads.

    Raises:
        OSError: it has ended.
    """
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def listed(process: int, what: Literal["fd", "task"]) -> int:
    """How many files, sockets and pipes it holds open, or how many threads it has.

    Raises:
        OSError: it has ended, or is another user's.
    """
    return len(os.listdir(f"/proc/{process}/{what}"))


def parent_lives() -> bool:
    """Whether the process that started this one with `program` still runs."""
    parent = multiprocessing.parent_process()
    return parent is not None and parent.is_alive()


@contextmanager
def own_run_dir() -> Iterator[Path]:
    """An empty run directory; a process whose XDG_RUNTIME_DIR is its parent looks there."""
    with TemporaryDirectory(prefix="sags-benchmarks-") as folder:
        run_dir = Path(folder) / "sags"
        run_dir.mkdir(mode=0o700)
        yield run_dir


@contextmanager
def program(work: Callable[..., None], *arguments: Any) -> Iterator[None]:
    """Work in another process, which ends when this is left, and with us."""
    process = multiprocessing.get_context("spawn").Process(target=work, args=arguments, daemon=True)
    process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join(STOPPING)
        process.kill()
