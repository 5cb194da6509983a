"""End other processes, with a limit on every wait, and read the memory of a process."""

import os
import subprocess
from pathlib import Path
from typing import Any

PAGE = os.sysconf("SC_PAGE_SIZE")
KILL_SECONDS = 5.0  # longest wait after a kill: a process that waits for a disk ends only when that answers


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


def resident_mb(process: int | str = "self") -> float:
    """The resident memory of a process, MB.

    Raises:
        OSError: it has ended.
    """
    pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    return pages * PAGE / 1e6
