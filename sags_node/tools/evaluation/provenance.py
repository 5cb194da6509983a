"""Where figures come from: without it nobody can tell later what they are worth."""

import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[3]
# A change there may change a figure.
WHAT_COUNTS = ("sags_node", "sags_lab", ":(glob)benchmarks/**/*.py", "launch", "calib", "replay")
GIT_SECONDS = 10.0
PROGRAMS = {"sags_node": "sags", "benchmarks": "python -m benchmarks"}  # by the folder of `__main__.py`


def provenance() -> dict[str, Any]:
    """The `revision` of the sources, `date` (UTC), `machine`, its `peak` at this moment (see
    `sags_node.kernels.peak`; once a process), and `command`: with the defaults of that revision it says all
    settings."""
    program = Path(sys.argv[0])
    name = PROGRAMS.get(program.parent.name, program.name) if program.stem == "__main__" else program.name
    return {
        "revision": revision(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine_name(),
        "peak": _peak(),
        "command": " ".join([name, *map(shlex.quote, sys.argv[1:])]),
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
    from sags_node.kernels.peak import measure_peak, peak_row
    from sags_node.kernels.threads import configure_threads

    return peak_row(measure_peak(configure_threads(None)))


def machine_name() -> str:
    """Processor, cores this process may use, memory, system: without the name of the host."""
    cores = len(os.sched_getaffinity(0))
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    return f"{_processor()}, {cores} cores, {memory:.0f} GiB, {platform.system()} {platform.machine()}"


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        key, _, value = line.partition(":")
        if key.strip() == "model name":
            return value.strip()
    return platform.machine()


def _git(root: Path, *arguments: str) -> str:
    """Return what git says; nothing where it has nothing to say."""
    try:
        found = subprocess.run(
            ["git", *arguments], cwd=root, capture_output=True, text=True, check=False, timeout=GIT_SECONDS
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return found.stdout.strip() if found.returncode == 0 else ""
