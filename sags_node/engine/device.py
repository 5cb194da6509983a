"""Which processor the model is refined on: the CPU, or a GPU if gsplat can draw there.

torch takes more than a second to import. What tells that there is no GPU costs nothing and is looked at
first.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sags_node.config.schema import DeviceName
from sags_node.errors import UsageError


@dataclass(frozen=True, slots=True)
class Device:
    """What was chosen; of the CPU, why it is not a GPU and how to fix that."""

    kind: Literal["cpu", "cuda"]
    name: str
    reason: str = ""
    fix: str = ""


def choose_device(wanted: DeviceName) -> Device:
    """The device for a launch.

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
    """The GPU, or the CPU and why. gsplat builds its kernels when they are looked for first: minutes."""
    missing = _missing_hardware() or _missing_software()
    if missing is not None:
        return Device("cpu", "the CPU", *missing)
    import torch

    return Device("cuda", torch.cuda.get_device_name())


def has_gpu() -> bool:
    """Whether a GPU's driver seems to be here, usable or not."""
    devices = [*Path("/dev").glob("nvidia[0-9]*"), *Path("/dev").glob("dxg")]  # dxg: Windows' own Linux
    return bool(devices) or shutil.which("nvidia-smi") is not None


def _missing_hardware() -> tuple[str, str] | None:
    """The reason and its remedy."""
    if not has_gpu():
        return (
            "this machine has no NVIDIA GPU, or no driver for it",
            "install its driver: nvidia-smi lists it",
        )
    if os.environ.get("CUDA_VISIBLE_DEVICES") in {"", "-1"}:
        return "CUDA_VISIBLE_DEVICES hides every GPU", "unset it"
    return None


def _missing_software() -> tuple[str, str] | None:
    """The reason and its remedy."""
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed", "pip install 'sags-node[gsplat]'"
    import torch

    if torch.version.cuda is None:
        return (
            f"torch {torch.__version__} is a build without CUDA",
            "install one with CUDA: pip install --force-reinstall torch",
        )
    if not torch.cuda.is_available():
        return (
            f"torch (CUDA {torch.version.cuda}) finds no GPU that its driver can use",
            "look at nvidia-smi and install a newer driver",
        )
    try:
        with redirect_stdout(sys.stderr):  # it reports its progress; our results are alone on stdout
            from gsplat.cuda import _backend  # nothing public says whether the kernels are there
    except Exception as error:  # CUDA's compiler and the one that it calls fail in many ways
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        return f"gsplat's kernels could not be built: {first}", "see gsplat's installation"
    if _backend._C is None:
        return (
            "gsplat has no kernels and found no CUDA compiler to build them",
            f"install the CUDA toolkit {torch.version.cuda} (nvcc)",
        )
    return None
