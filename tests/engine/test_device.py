"""Which device a launch gets, and what is said of a GPU that cannot be used."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import warp as wp
from command_line import refused
from places import SESSION

from sags_node.config.schema import LaunchConfig, MappingConfig
from sags_node.engine import device as devices
from sags_node.engine.device import choose_device, find_gpu
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


def hidden(machine: pytest.MonkeyPatch) -> None:
    machine.setenv("CUDA_VISIBLE_DEVICES", "-1")


def without_warp(machine: pytest.MonkeyPatch) -> None:
    machine.setattr("importlib.util.find_spec", lambda name: None if name == "warp" else name)


def without_driver(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(wp, "is_cuda_available", lambda: False)


def usable(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(wp, "is_cuda_available", lambda: True)
    machine.setattr(wp, "get_cuda_driver_version", lambda: (13, 0))
    machine.setattr(wp, "get_device", lambda name: SimpleNamespace(name="NVIDIA H100"))


UNUSABLE = [
    (without_hardware, "no NVIDIA GPU", "nvidia-smi"),
    (hidden, "CUDA_VISIBLE_DEVICES hides every GPU", "unset it"),
    (without_warp, "Warp is not installed", "pip install warp-lang"),
    (without_driver, "finds no GPU that its driver can use", "newer driver"),
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


def test_a_missing_gpu_ends_the_command_with_one_message(
    machine: pytest.MonkeyPatch, phantom_session: Path
) -> None:
    without_hardware(machine)
    said = ("\nerror: device: cuda cannot be used: this machine has no NVIDIA GPU",)
    for command in (["run"], ["eval", "--pace", "step"]):
        refused(2, *command, phantom_session, "device:=cuda", said=said)


def test_a_fit_from_an_online_start_is_refused_on_a_gpu(phantom_session: Path) -> None:
    refused(2, "fit", phantom_session, "device:=cuda", said=("--schedule paper", "device:=cpu"))


def test_a_usable_gpu_is_chosen_and_gets_more_gaussians(machine: pytest.MonkeyPatch) -> None:
    usable(machine)
    assert choose_device("auto").name == choose_device("cuda").name == "NVIDIA H100"
    assert choose_device("cpu").kind == "cpu"
    check = doctor.check_gpu(LaunchConfig())
    assert check.level == "ok" and "H100" in check.what and "CUDA 13.0" in check.what
    cpu = mapping_devices.affordable(LaunchConfig(device="cpu"), 1280, 1024)
    gpu = mapping_devices.affordable(LaunchConfig(), 1280, 1024)
    assert gpu > cpu and mapping_devices.rungs_of(LaunchConfig()) == GPU_RUNGS
    fixed = LaunchConfig(mapping=MappingConfig(max_gaussians=5000))
    assert mapping_devices.affordable(fixed, 640, 512) == 5000


def test_machines_without_a_gpu_never_wait_for_torch_or_warp() -> None:
    """`auto` looks for the hardware first, and neither a session nor the frame path needs torch."""
    code = f"""
import sys
from sags_node.engine import device
device.has_gpu = lambda: False
from sags_node.config.schema import LaunchConfig
from sags_node.pipeline.session import open_session
from sags_node.pipeline.warm_up import warm_up
open_session({str(SESSION)!r})
warm_up(LaunchConfig())
assert "sags_node.mapping.mapper" in sys.modules
print([name for name in ("torch", "warp") if name in sys.modules])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300
    )
    assert done.stdout == "[]\n"
