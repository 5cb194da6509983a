"""Which device a launch gets, and what is said of a GPU that cannot be used."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import warp as wp
from command_line import refused
from places import ROOT, SESSION

from sags_node.config.schema import LaunchConfig, MappingConfig
from sags_node.engine import device as devices
from sags_node.engine.device import choose_device, find_gpu
from sags_node.engine.gpu import runtime
from sags_node.errors import UsageError
from sags_node.mapping import devices as mapping_devices
from sags_node.mapping.ladder import GPU_RUNGS
from sags_node.tools import doctor


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """A machine with a GPU, as far as can be seen without Warp, and Warp installed."""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(devices, "has_gpu", lambda: True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    find_gpu.cache_clear()
    yield monkeypatch
    find_gpu.cache_clear()


def without_hardware(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(devices, "has_gpu", lambda: False)


def without_driver(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(wp, "is_cuda_available", lambda: False)


def broken(machine: pytest.MonkeyPatch) -> None:
    """A wheel for another machine, or half of one."""

    def fails() -> None:
        raise OSError("warp.so: version `GLIBC_2.34' not found\nand much more")

    machine.setattr(runtime, "start", fails)


def usable(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(wp, "is_cuda_available", lambda: True)
    machine.setattr(wp, "get_cuda_driver_version", lambda: (13, 0))
    machine.setattr(wp, "get_device", lambda name: SimpleNamespace(name="NVIDIA H100"))


UNUSABLE = [
    (without_hardware, "no NVIDIA GPU", "nvidia-smi"),
    (lambda machine: machine.setenv("CUDA_VISIBLE_DEVICES", "-1"), "CUDA_VISIBLE_DEVICES hides", "unset it"),
    (lambda machine: machine.setattr("importlib.util.find_spec", lambda name: None), "Warp is not installed",
     "pip install warp-lang"),
    (without_driver, "finds no GPU that its driver can use", "newer driver"),
    (broken, "Warp cannot be started: warp.so: version `GLIBC_2.34' not found", "--force-reinstall"),
]  # fmt: skip


@pytest.mark.parametrize(("lacks", "reason", "fix"), UNUSABLE)
def test_a_gpu_that_cannot_be_used_is_explained(
    lacks: Callable[[pytest.MonkeyPatch], None], reason: str, fix: str, machine: pytest.MonkeyPatch
) -> None:
    """auto: the CPU, and why; cuda: an error that says how to fix it; doctor: the same."""
    lacks(machine)
    found = choose_device("auto")
    assert found.kind == "cpu" and reason in found.reason
    with pytest.raises(UsageError) as raised:
        choose_device("cuda")
    said = str(raised.value)
    assert reason in said and fix in said and "\n" not in said and "device:=cpu" in said
    check = doctor.check_gpu(LaunchConfig(device="cuda"))
    assert check.level == "error" and reason in check.what and fix in check.fix


def test_doctor_names_the_driver(machine: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also where Warp cannot use it: whether it is too old is the first question."""
    version = tmp_path / "proc/driver/nvidia/version"
    version.parent.mkdir(parents=True)
    version.write_text(
        "NVRM version: NVIDIA UNIX x86_64 Kernel Module  535.183.01  Sun May 12 19:39:15 UTC 2024\n"
    )
    for state in (without_driver, usable):
        state(machine)
        find_gpu.cache_clear()
        assert "driver 535.183.01" in doctor.check_gpu(LaunchConfig(), tmp_path).what


def test_a_missing_gpu_ends_the_command_with_one_message(
    machine: pytest.MonkeyPatch, phantom_session: Path
) -> None:
    without_hardware(machine)
    said = ("\nerror: device: cuda cannot be used: this machine has no NVIDIA GPU",)
    for command in (["run"], ["eval", "--pace", "step"]):
        refused(2, *command, phantom_session, "device:=cuda", said=said)


@pytest.mark.fault("GPU: a Warp that does not start")
def test_a_broken_warp_leaves_the_cpu_and_says_why(tmp_path: Path) -> None:
    package = tmp_path / "warp" / "__init__.py"
    package.parent.mkdir()
    package.write_text("raise ImportError('warp.so is of another machine')")
    card = tmp_path / "nvidia-smi"
    card.write_text("#!/bin/sh")
    card.chmod(0o755)
    environment = os.environ | {
        "PYTHONPATH": f"{tmp_path}:{ROOT}",
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
    }
    code = "from sags_node.engine.device import choose_device; print(choose_device('auto').reason)"
    said = subprocess.check_output([sys.executable, "-c", code], text=True, timeout=300, env=environment)
    assert said == "NVIDIA Warp cannot be started: warp.so is of another machine\n"


def test_a_fit_from_an_online_start_is_refused_on_a_gpu(phantom_session: Path) -> None:
    refused(2, "fit", phantom_session, "device:=cuda", said=("--schedule paper", "device:=cpu"))


def test_a_usable_gpu_is_chosen_and_gets_more_gaussians(machine: pytest.MonkeyPatch) -> None:
    usable(machine)
    assert choose_device("auto").name == choose_device("cuda").name == "NVIDIA H100"
    assert choose_device("cpu").kind == "cpu"
    check = doctor.check_gpu(LaunchConfig())
    assert check.level == "ok" and "H100" in check.what and "CUDA 13.0" in check.what
    for has_cuda in (True, False):
        machine.setattr(torch.cuda, "is_available", lambda found=has_cuda: found)
        check = doctor.check_gpu(LaunchConfig())
        assert f"torch {'finds' if has_cuda else 'does not find'} it" in check.what
        assert check.fix == "" if has_cuda else check.fix.startswith("for sags fit")
    cpu = mapping_devices.affordable(LaunchConfig(device="cpu"), 1280, 1024)
    gpu = mapping_devices.affordable(LaunchConfig(), 1280, 1024)
    assert gpu > cpu and mapping_devices.rungs_of(LaunchConfig()) == GPU_RUNGS
    fixed = LaunchConfig(mapping=MappingConfig(max_gaussians=5000))
    assert mapping_devices.affordable(fixed, 640, 512) == 5000


def test_without_a_gpu_or_with_the_cpu_chosen_nothing_waits_for_torch_or_warp() -> None:
    """`auto` looks for the hardware first, and neither a session nor the frame path needs torch."""
    code = f"""
import sys
from sags_node.engine import device
device.has_gpu = lambda: has_gpu
from sags_node.pipeline.session import open_session
from sags_node.pipeline.warm_up import warm_up
for has_gpu, wanted in ((False, "auto"), (True, "cpu")):
    device.find_gpu.cache_clear()
    warm_up(open_session({str(SESSION)!r}, ["device:=" + wanted]).config)
assert "sags_node.mapping.mapper" in sys.modules
print([name for name in ("torch", "warp", "open3d", "onnxruntime") if name in sys.modules])
"""
    assert subprocess.check_output([sys.executable, "-c", code], text=True, timeout=300) == "[]\n"
