"""What processes cost, and which this one has started."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

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


def descriptors(process: int) -> int:
    """How many files, sockets and pipes it holds open.

    Raises:
        OSError: it has ended, or is another user's.
    """
    return len(os.listdir(f"/proc/{process}/fd"))


def threads(process: int) -> int:
    """How many threads it has.

    Raises:
        OSError: it has ended.
    """
    return len(os.listdir(f"/proc/{process}/task"))
