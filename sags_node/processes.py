"""Ends other processes, with a limit on every wait."""

from __future__ import annotations

import subprocess
from typing import Any

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
