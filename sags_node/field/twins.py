"""The choice between two implementations of a formula: a Numba kernel, or torch."""

import torch
from torch import Tensor


def by_kernels(table: Tensor) -> bool:
    """Tell whether kernels can take a table: float32, in the memory of the host."""
    return table.dtype == torch.float32 and table.device.type == "cpu"
