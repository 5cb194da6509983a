"""What `sags doctor` says of the machine, for machines made of a few files."""

import os
from pathlib import Path

import pytest

from sags_node.tools import doctor


def made(root: Path, files: dict[str, str]) -> Path:
    """A machine with these files."""
    for name, content in files.items():
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{content}\n")
    return root


def grouped(root: Path, process: str, files: dict[str, str]) -> Path:
    """A machine on which this process is in these control groups, with these files of theirs."""
    groups = {f"sys/fs/cgroup/{name}": content for name, content in files.items()}
    return made(root, {"proc/self/cgroup": process} | groups)


OLD_QUOTA, OLD_PERIOD = "cpu/x/cpu.cfs_quota_us", "cpu/x/cpu.cfs_period_us"


@pytest.mark.parametrize(
    ("process", "files", "cores"),
    [
        ("0::/a/b", {"a/b/cpu.max": "max 100000"}, None),
        ("0::/a/b", {"a/b/cpu.max": "150000 100000"}, 1.5),
        ("0::/a/b", {"a/b/cpu.max": "400000 100000", "a/cpu.max": "300000 100000"}, 3.0),  # the least
        ("0::/outside", {"cpu.max": "50000 100000"}, 0.5),  # a container sees its own group as the root
        ("3:memory:/x\n4:cpu,cpuacct:/x", {OLD_QUOTA: "250000", OLD_PERIOD: "100000"}, 2.5),
        ("4:cpu:/x", {OLD_QUOTA: "-1", OLD_PERIOD: "100000"}, None),
    ],
)
def test_the_quota_of_control_groups(
    process: str, files: dict[str, str], cores: float | None, tmp_path: Path
) -> None:
    assert doctor.core_quota(tmp_path) is None
    assert doctor.core_quota(grouped(tmp_path, process, files)) == cores


def test_a_quota_below_two_cores_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    found = doctor.check_cores(grouped(tmp_path, "0::/", {"cpu.max": "150000 100000"}))
    assert found.level == "warning" and "CPUQuota" in found.fix
    assert "the machine has 8" in found.what and "time of 1.5" in found.what
    assert doctor.check_cores(grouped(tmp_path, "0::/", {"cpu.max": "200000 100000"})).level == "ok"
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    assert "cpuset" in doctor.check_cores(tmp_path / "nothing").fix


@pytest.mark.parametrize(
    ("governor", "driver", "level", "said"),
    [
        ("performance", "acpi-cpufreq", "ok", "performance"),
        ("powersave", "acpi-cpufreq", "warning", "powersave"),
        ("powersave", "intel_pstate", "ok", "balanced"),
        ("schedutil", "intel_cpufreq", "ok", "schedutil"),
    ],
)
def test_governors(governor: str, driver: str, level: str, said: str, tmp_path: Path) -> None:
    assert doctor.check_governor(tmp_path).what == "not known"
    folder = "sys/devices/system/cpu/cpu3/cpufreq"
    files = {f"{folder}/scaling_governor": governor, f"{folder}/scaling_driver": driver}
    found = doctor.check_governor(made(tmp_path, files))
    assert (found.level, found.what) == (level, said)
    assert bool(found.fix) == (governor != "performance")


@pytest.mark.parametrize(
    ("process", "files", "granted"),
    [
        ("0::/a", {"a/memory.max": "max", "a/memory.current": "7"}, None),
        ("0::/a", {"a/memory.max": "512", "a/memory.current": "100"}, 412),
        ("0::/a", {"a/memory.high": "512", "a/memory.current": "600"}, 0),
        # The least of those above it; files that were read are no use of it.
        ("0::/a/b", {"a/memory.max": "900", "a/memory.current": "800",
                     "a/memory.stat": "anon 500\ninactive_file 300",
                     "a/b/memory.max": "600", "a/b/memory.current": "100"}, 400),
        ("4:memory:/x", {"memory/x/memory.limit_in_bytes": "700", "memory/x/memory.usage_in_bytes": "300",
                         "memory/memory.limit_in_bytes": "9223372036854771712",
                         "memory/memory.usage_in_bytes": "300"}, 400),
    ],
)  # fmt: skip
def test_the_memory_of_control_groups(
    process: str, files: dict[str, str], granted: int | None, tmp_path: Path
) -> None:
    assert doctor.memory_quota(grouped(tmp_path, process, files)) == granted


def test_a_container_with_too_little_memory_is_said(tmp_path: Path) -> None:
    made(tmp_path, {"proc/meminfo": "MemAvailable: 60000000 kB"})
    grouped(tmp_path, "0::/", {"memory.max": "536870912", "memory.current": "36870912"})
    found = doctor.check_memory(tmp_path)
    assert found.level == "warning" and "0.5 GB more granted" in found.what and "--memory" in found.fix
    assert doctor.check_memory(grouped(tmp_path, "0::/", {"memory.max": "8000000000"})).level == "ok"


@pytest.mark.parametrize(
    ("free", "swap", "unused", "level", "said"),
    [
        (8, 0, 0, "ok", "8.0 GB free, no swap"),
        (8, 4, 3, "ok", "1.0 of 4.0 GB swap used"),
        (1, 4, 4, "warning", "1.0 GB free"),
        (3, 9, 4, "warning", "5.0 of 9.0 GB swap used"),
    ],
)
def test_memory(free: int, swap: int, unused: int, level: str, said: str, tmp_path: Path) -> None:
    amounts = {"MemAvailable": free, "SwapTotal": swap, "SwapFree": unused}
    lines = "".join(f"{name}:  {amount * 10**9 // 1024} kB\n" for name, amount in amounts.items())
    found = doctor.check_memory(made(tmp_path, {"proc/meminfo": f"{lines}HugePages_Total:  0"}))
    assert found.level == level and said in found.what
    assert bool(found.fix) == (level == "warning")
