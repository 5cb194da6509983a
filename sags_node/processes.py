"""Other processes: which there are, what they cost, and how they end, with a limit on every wait."""

from __future__ import annotations

import os
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

TICKS = os.sysconf("SC_CLK_TCK")  # of CPU time in a second
PAGE = os.sysconf("SC_PAGE_SIZE")
KILL_SECONDS = 5.0  # a killed process that waits for a disk ends when the disk answers


def end(process: subprocess.Popen[Any], grace: float) -> bool:
    """Ask a process to end, and kill it after `grace` seconds; False where not even that ends it."""
    if grace > 0:
        process.terminate()
        if _ends(process, grace):
            return True
    process.kill()
    return _ends(process, KILL_SECONDS)


def _ends(process: subprocess.Popen[Any], seconds: float) -> bool:
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return False
    return True


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


def resident_mb(process: int | str = "self") -> float:
    """Resident memory, MB.

    Raises:
        OSError: it has ended.
    """
    pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    return pages * PAGE / 1e6


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
