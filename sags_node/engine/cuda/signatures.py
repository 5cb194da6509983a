"""What kernels are compiled for: every module with kernels lists them in a constant `SIGNATURES`, so that a
test can compile them all on a machine that has no GPU."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Compiled:
    """One variant of a Triton kernel."""

    kernel: Any  # what `triton.jit` returned
    signature: Mapping[str, str]  # run-time argument -> its type: "*fp32", "*i64", "i32", "fp32"
    constexprs: Mapping[str, Any] = field(default_factory=dict)  # compile-time argument -> its value
    num_warps: int = 4  # as it is launched
