"""How work on the device fails."""

from __future__ import annotations

import torch
from triton.errors import TritonError

from sags_node.engine.failures import DeviceMemoryError

SHORTAGES = (DeviceMemoryError, torch.OutOfMemoryError)
FAILURES = (RuntimeError, TritonError)  # torch raises the driver's errors as RuntimeError


def release_memory() -> None:
    """Give what torch keeps for later back to the GPU."""
    torch.cuda.empty_cache()  # does nothing where CUDA was not used
