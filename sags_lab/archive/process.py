"""One command in a process of its own, within limits of time and memory. It is killed with its parent."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

LOOK_PERIOD = 0.05  # s until the process is looked at again
MEMORY_PERIOD = 0.5  # s between two looks at its memory
PROGRAM = ("sags_node",)  # a module, or a file of Python
PAGE = os.sysconf("SC_PAGE_SIZE")
THREADS = (
    "OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Limits:
    """What one recording may take.

    Attributes:
        memory_gb: resident, of the process and its children; None: no limit.
        seconds: of wall time; None: no limit.
        staged_gb: size of what is fetched for it; 10^9 bytes.
    """

    memory_gb: float | None = None
    seconds: float | None = None
    staged_gb: float = 50.0


@dataclass(frozen=True, slots=True)
class Ended:
    """How a command ended: its exit code, negative for a signal, and the limit that ended it, if one did."""

    code: int
    limit: str | None = None


def run_limited(command: Sequence[str], cores: int, limits: Limits, stdout: Path, stderr: Path) -> Ended:
    """Run a command, and all that it starts. It is killed with this process.

    Args:
        cores: number of threads of each library.

    Raises:
        OSError: it cannot be started.
    """
    environment = os.environ | dict.fromkeys(THREADS, str(cores))
    with stdout.open("wb") as out, stderr.open("wb") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", "sags_lab.archive.child", str(os.getpid()), *command],
            stdin=subprocess.DEVNULL, stdout=out, stderr=err, env=environment,
            start_new_session=True,
        )  # fmt: skip
    try:
        limit = _wait(process, limits)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return Ended(process.returncode, limit)


def _wait(process: subprocess.Popen[bytes], limits: Limits) -> str | None:
    """Wait until the process ends or exceeds a limit; says which limit, or None."""
    began = looked = time.monotonic()
    while process.poll() is None:
        time.sleep(LOOK_PERIOD)
        now = time.monotonic()
        if limits.seconds is not None and now - began > limits.seconds:
            return f"it took more than {limits.seconds:g} s (--timeout)"
        if limits.memory_gb is not None and now - looked > MEMORY_PERIOD:
            looked = now
            used = resident_bytes(process.pid) * 1e-9
            if used > limits.memory_gb:
                return f"it took {used:.2f} GB of memory, {limits.memory_gb:g} are allowed (--memory)"
    return None


def resident_bytes(session: int) -> int:
    """Return the resident memory of all processes of a session, bytes."""
    total = 0
    for entry in os.scandir("/proc"):
        if not entry.name.isdigit():
            continue
        with suppress(OSError):  # it has ended meanwhile
            fields = Path(entry.path, "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == session:
                total += int(fields[21]) * PAGE
    return total
