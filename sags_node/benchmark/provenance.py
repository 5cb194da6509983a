"""Where figures come from: without it nobody can tell later what they are worth."""

from __future__ import annotations

import shlex
import subprocess
import sys
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sags_node.evaluation.machine import machine_name

ROOT = Path(__file__).parent.parent.parent
WHAT_COUNTS = ("sags_node", "launch", "calib", "replay")  # a change there may change a figure
GIT_SECONDS = 10.0


def provenance() -> dict[str, Any]:
    """`revision` of the sources, `date` (UTC), `machine`, its `peak` at this moment (see
    `benchmark.kernels.peak`; once a process), and `command`: with the defaults of that revision it says all
    settings."""
    name = Path(sys.argv[0]).name
    return {
        "revision": revision(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine_name(),
        "peak": _peak(),
        "command": shlex.join(["sags" if name == "__main__.py" else name, *sys.argv[1:]]),
    }


@cache
def revision(root: Path = ROOT) -> str:
    """The commit of the checkout, with `-changed` where its files are not those of the commit; the package's
    version where there is no checkout."""
    commit = _git(root, "rev-parse", "--short=12", "HEAD")
    if not commit:
        return version("sags-node")
    return commit + ("-changed" if _git(root, "status", "--porcelain", "--", *WHAT_COUNTS) else "")


@cache
def _peak() -> dict[str, Any]:
    from sags_node.benchmark.kernels.peak import measure_peak, peak_row
    from sags_node.kernels.threads import configure_threads

    return peak_row(measure_peak(configure_threads(None)))


def _git(root: Path, *arguments: str) -> str:
    """What git says; nothing where it has nothing to say."""
    try:
        found = subprocess.run(
            ["git", *arguments], cwd=root, capture_output=True, text=True, check=False, timeout=GIT_SECONDS
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return found.stdout.strip() if found.returncode == 0 else ""
