"""What `sags doctor` says of the machine, for machines made of a few files."""

import os
from pathlib import Path

import pytest

from sags_node.tools import doctor


def made(root: Path, **files: str) -> Path:
    """A machine with these files; `__` stands for `/`."""
    for name, content in files.items():
        file = root / name.replace("__", "/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    return root


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, None),
        ({"proc__self__cgroup": "0::/a/b\n", "sys__fs__cgroup__a__b__cpu.max": "max 100000\n"}, None),
        ({"proc__self__cgroup": "0::/a/b\n", "sys__fs__cgroup__a__b__cpu.max": "150000 100000\n"}, 1.5),
        (  # the least of those above it
            {
                "proc__self__cgroup": "0::/a/b\n",
                "sys__fs__cgroup__a__b__cpu.max": "400000 100000\n",
                "sys__fs__cgroup__a__cpu.max": "300000 100000\n",
            },
            3.0,
        ),
        # in a container, which sees its own group as the root
        ({"proc__self__cgroup": "0::/outside\n", "sys__fs__cgroup__cpu.max": "50000 100000\n"}, 0.5),
        (
            {
                "proc__self__cgroup": "3:memory:/x\n4:cpu,cpuacct:/x\n",
                "sys__fs__cgroup__cpu__x__cpu.cfs_quota_us": "250000\n",
                "sys__fs__cgroup__cpu__x__cpu.cfs_period_us": "100000\n",
            },
            2.5,
        ),
        (
            {
                "proc__self__cgroup": "4:cpu:/x\n",
                "sys__fs__cgroup__cpu__x__cpu.cfs_quota_us": "-1\n",
                "sys__fs__cgroup__cpu__x__cpu.cfs_period_us": "100000\n",
            },
            None,
        ),
    ],
)
def test_the_quota_of_control_groups(files: dict[str, str], cores: float | None, tmp_path: Path) -> None:
    assert doctor.core_quota(made(tmp_path, **files)) == cores


def test_a_quota_below_two_cores_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    files = {"proc__self__cgroup": "0::/\n", "sys__fs__cgroup__cpu.max": "150000 100000\n"}
    found = doctor.check_cores(made(tmp_path, **files))
    assert found.level == "warning" and "CPUQuota" in found.fix
    assert "the machine has 8" in found.what and "time of 1.5" in found.what
    assert doctor.check_cores(made(tmp_path, **{"sys__fs__cgroup__cpu.max": "200000 100000\n"})).level == "ok"
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
    folder = "sys__devices__system__cpu__cpu3__cpufreq__"
    files = {f"{folder}scaling_governor": f"{governor}\n", f"{folder}scaling_driver": f"{driver}\n"}
    found = doctor.check_governor(made(tmp_path, **files))
    assert (found.level, found.what) == (level, said)
    assert bool(found.fix) == (governor != "performance")


OWN = "sys__fs__cgroup__a__memory."
OLD = "sys__fs__cgroup__memory__x__memory."


@pytest.mark.parametrize(
    ("files", "granted"),
    [
        ({"proc__self__cgroup": "0::/a\n", f"{OWN}max": "max\n", f"{OWN}current": "7\n"}, None),
        ({"proc__self__cgroup": "0::/a\n", f"{OWN}max": "512\n", f"{OWN}current": "100\n"}, 412),
        ({"proc__self__cgroup": "0::/a\n", f"{OWN}high": "512\n", f"{OWN}current": "600\n"}, 0),
        (  # the least of those above it; files that were read are no use of it
            {
                "proc__self__cgroup": "0::/a/b\n",
                f"{OWN}max": "900\n",
                f"{OWN}current": "800\n",
                f"{OWN}stat": "anon 500\ninactive_file 300\n",
                "sys__fs__cgroup__a__b__memory.max": "600\n",
                "sys__fs__cgroup__a__b__memory.current": "100\n",
            },
            400,
        ),
        (
            {
                "proc__self__cgroup": "4:memory:/x\n",
                f"{OLD}limit_in_bytes": "700\n",
                f"{OLD}usage_in_bytes": "300\n",
                "sys__fs__cgroup__memory__memory.limit_in_bytes": "9223372036854771712\n",
                "sys__fs__cgroup__memory__memory.usage_in_bytes": "300\n",
            },
            400,
        ),
    ],
)
def test_the_memory_of_control_groups(files: dict[str, str], granted: int | None, tmp_path: Path) -> None:
    assert doctor.memory_quota(made(tmp_path, **files)) == granted


def test_a_container_with_too_little_memory_is_said(tmp_path: Path) -> None:
    files = {
        "proc__meminfo": "MemAvailable: 60000000 kB\n",
        "proc__self__cgroup": "0::/\n",
        "sys__fs__cgroup__memory.max": "536870912\n",
        "sys__fs__cgroup__memory.current": "36870912\n",
    }
    found = doctor.check_memory(made(tmp_path, **files))
    assert found.level == "warning" and "0.5 GB more granted" in found.what and "--memory" in found.fix
    made(tmp_path, **{"sys__fs__cgroup__memory.max": "8000000000\n"})
    assert doctor.check_memory(tmp_path).level == "ok"


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
    found = doctor.check_memory(made(tmp_path, proc__meminfo=f"{lines}HugePages_Total:  0\n"))
    assert found.level == level and said in found.what
    assert bool(found.fix) == (level == "warning")
