"""What the online mapper saw of a recording: the way of each Gaussian."""

from __future__ import annotations

from dataclasses import dataclass

from sags_node.types import F32, I64, Bool


@dataclass(frozen=True, slots=True)
class Paths:
    """How the online mapper saw each Gaussian at some times."""

    times_ns: I64  # [K]
    states: F32  # [K, N, 14], see `columns`
    known: Bool  # [K, N]
