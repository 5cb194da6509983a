"""What Linux gives this process: share of the processors, how they are clocked, memory.

Each function reads small files below `root`, which is another folder in tests.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

ROOT = Path("/")


def core_quota(root: Path = ROOT) -> float | None:
    """The cores whose time control groups grant, of this one and those above it; None: no limit is known.

    Versions 2 and 1 (https://docs.kernel.org/admin-guide/cgroup-v2.html).
    """
    granted = []
    for line in _read(root / "proc/self/cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        mount = root / "sys/fs/cgroup" / ("cpu" if controllers else "")
        if controllers and "cpu" not in controllers.split(","):
            continue
        # A container may see its own group as the root, whatever it is called outside.
        for group in (mount / path.lstrip("/"), *(mount / path.lstrip("/")).parents):
            said = _read(group / "cpu.max").split()
            if controllers:
                said = [_read(group / "cpu.cfs_quota_us").strip(), _read(group / "cpu.cfs_period_us").strip()]
            with suppress(ValueError, ZeroDivisionError):  # "max", -1 and nothing: no limit
                if float(said[0] if said else "") > 0:
                    granted.append(float(said[0]) / float(said[1]))
            if group == mount:
                break
    return min(granted, default=None)


def governors(root: Path = ROOT) -> set[str]:
    """Return what decides the clock rates of the cores; empty where the machine does not tell, as in most
    guests.

    `powersave` of a processor that chooses its rate itself (`intel_pstate`, `amd-pstate-epp`) is not the
    lowest rate, and is called `balanced` here.
    """
    found = set()
    for file in (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"):
        name = _read(file).strip()
        chooses_itself = _read(file.with_name("scaling_driver")).strip() in ("intel_pstate", "amd-pstate-epp")
        found.add("balanced" if chooses_itself and name == "powersave" else name)
    return found - {""}


def memory(root: Path = ROOT) -> dict[str, int]:
    """`MemAvailable`, `SwapTotal`, `SwapFree` and the others of /proc/meminfo, bytes."""
    found = {}
    for line in _read(root / "proc/meminfo").splitlines():
        name, _, said = line.partition(":")
        number, _, unit = said.strip().partition(" ")
        found[name] = int(number) * (1024 if unit == "kB" else 1)
    return found


def _read(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:
        return ""
