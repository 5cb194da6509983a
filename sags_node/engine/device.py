"""Which processor the model is refined on: the CPU, or a GPU if one can really be used.

torch takes more than a second to import. What tells that there is no GPU costs nothing and is looked at
first.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sags_node.config.schema import DeviceName
from sags_node.engine.failures import UnusableError
from sags_node.errors import UsageError


@dataclass(frozen=True, slots=True)
class Device:
    """What was chosen; of the CPU, why it is not a GPU and how to fix that."""

    kind: Literal["cpu", "cuda"]
    name: str
    reason: str = ""
    fix: str = ""


def choose_device(wanted: DeviceName) -> Device:
    """The device for a launch; the GPU is tried out once in a process, with a small drawing.

    Raises:
        UsageError: a GPU is wanted and none can be used.
    """
    if wanted in ("cpu", "gsplat"):
        return Device("cpu", "the CPU")
    if wanted == "auto" and _interpreted():
        return Device("cpu", "the CPU", "TRITON_INTERPRET is set, for tests of kernels", "unset it")
    found = find_gpu()
    if wanted == "cuda" and found.kind == "cpu":
        raise UsageError(f"device: cuda cannot be used: {found.reason}; {found.fix}, or set device:=cpu")
    return found


@functools.cache
def find_gpu() -> Device:
    """The GPU, or the CPU and why. Under TRITON_INTERPRET=1 the CPU passes for a GPU."""
    try:
        if not _interpreted():
            _look_for_hardware()
        for package in ("torch", "triton"):
            if importlib.util.find_spec(package) is None:
                raise UnusableError(f"{package} is not installed", f"pip install {package}")
        from sags_node.engine.cuda.probe import probe

        return Device("cuda", probe())
    except UnusableError as error:
        return Device("cpu", "the CPU", error.reason, error.fix)


def has_gpu() -> bool:
    """Whether a GPU's driver seems to be here, usable or not."""
    devices = [*Path("/dev").glob("nvidia[0-9]*"), *Path("/dev").glob("dxg")]  # dxg: Windows' own Linux
    return bool(devices) or shutil.which("nvidia-smi") is not None


def _look_for_hardware() -> None:
    if not has_gpu():
        raise UnusableError(
            "this machine has no NVIDIA GPU, or no driver for it", "install its driver: nvidia-smi lists it"
        )
    if os.environ.get("CUDA_VISIBLE_DEVICES") in {"", "-1"}:
        raise UnusableError("CUDA_VISIBLE_DEVICES hides every GPU", "unset it")


def _interpreted() -> bool:
    """Whether Triton's kernels run on the CPU."""
    return os.environ.get("TRITON_INTERPRET") == "1"
