"""Choice of the processor that refines the model: the CPU, or a GPU if Warp can use it.

Warp takes most of a second to start, so the cheap signs that there is no GPU are checked first.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sags_node.config.schema import DeviceName
from sags_node.errors import UsageError, first_line

if TYPE_CHECKING:
    import warp as wp

TORCH_WITH_CUDA = "pip install --force-reinstall torch"


@dataclass(frozen=True, slots=True)
class Device:
    """The chosen processor. Where the CPU stands in for a GPU: the reason, and how to fix it."""

    kind: Literal["cpu", "cuda"]
    name: str
    reason: str = ""
    fix: str = ""


def choose_device(wanted: DeviceName) -> Device:
    """Return the device for a launch.

    Raises:
        UsageError: a GPU is wanted and none can be used.
    """
    if wanted == "cpu":
        return Device("cpu", "the CPU")
    found = find_gpu()
    if wanted == "cuda" and found.kind == "cpu":
        raise UsageError(f"device: cuda cannot be used: {found.reason}; {found.fix}, or set device:=cpu")
    return found


@functools.cache
def find_gpu() -> Device:
    """Return the GPU, or the CPU with the reason why no GPU can be used."""
    missing = _missing_hardware() or _missing_software()
    if missing is not None:
        return Device("cpu", "the CPU", *missing)
    import warp as wp

    return Device("cuda", wp.get_device("cuda").name)


def gpu() -> wp.Device:
    """Return Warp's device of the GPU.

    Raises:
        UsageError: no GPU can be used.
    """
    choose_device("cuda")
    from sags_node.engine.gpu import runtime

    return runtime.device_named("cuda")


def is_of_warp(error: Exception) -> bool:
    """Tell whether torch or Warp says that the GPU failed. Warp raises a plain `Exception` where a kernel
    cannot be compiled or loaded."""
    return isinstance(error, RuntimeError) or type(error) is Exception


def has_gpu() -> bool:
    """Tell whether a GPU's driver seems to be here, usable or not."""
    devices = [*Path("/dev").glob("nvidia[0-9]*"), *Path("/dev").glob("dxg")]  # dxg: WSL
    return bool(devices) or shutil.which("nvidia-smi") is not None


def _missing_hardware() -> tuple[str, str] | None:
    """Why the hardware cannot be used, and the remedy; None if it can."""
    if not has_gpu():
        return (
            "this machine has no NVIDIA GPU, or no driver for it",
            "install its driver: nvidia-smi lists it",
        )
    if os.environ.get("CUDA_VISIBLE_DEVICES") in {"", "-1"}:
        return "CUDA_VISIBLE_DEVICES hides every GPU", "unset it"
    return None


def _missing_software() -> tuple[str, str] | None:
    """Why Warp cannot use the GPU, and the remedy; None if it can."""
    if importlib.util.find_spec("warp") is None:
        return "NVIDIA Warp is not installed", "pip install warp-lang"
    from sags_node.engine.gpu import runtime

    try:
        runtime.start()
    except Exception as error:  # whatever a package that is broken, or for another machine, raises
        reinstall = "pip install --force-reinstall warp-lang"
        return f"NVIDIA Warp cannot be started: {first_line(error)}", reinstall
    import warp as wp

    if not wp.is_cuda_available():
        return (
            f"Warp {wp.config.version} finds no GPU that its driver can use",
            "install a newer driver (nvidia-smi names yours; since 1.18 it must be R580), or an older Warp: "
            "pip install warp-lang==1.17.0",
        )
    return None
