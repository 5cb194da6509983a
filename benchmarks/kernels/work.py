"""How much a kernel has to do at least, and so the least time that this machine could need for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from sags_node.kernels.peak import Peak


@dataclass(frozen=True, slots=True)
class Work:
    """A kernel that reached the machine's peak would take the longer of its two times."""

    bytes: float  # of all arrays that it reads or writes, each once
    operations: float = 0.0  # on float32, a multiply-add counted once; 0: not counted, few for each byte
    pairs: int | None = None  # pixel-Gaussian pairs evaluated

    def least_ms(self, peak: Peak) -> float:
        return 1e3 * max(self._memory_s(peak), self._arithmetic_s(peak))

    def bound(self, peak: Peak) -> str:
        """Which of the two it is."""
        return "arithmetic" if self._arithmetic_s(peak) > self._memory_s(peak) else "memory"

    def _memory_s(self, peak: Peak) -> float:
        return self.bytes / peak.bandwidth(self.bytes)

    def _arithmetic_s(self, peak: Peak) -> float:
        return self.operations / peak.operations


def bytes_of(*arrays: NDArray[Any]) -> int:
    return sum(array.nbytes for array in arrays)


def stage_rows(times_ms: Mapping[str, float], work: Mapping[str, Work], peak: Peak) -> list[dict[str, Any]]:
    """One record per stage: its time beside the machine's peak."""
    rows = []
    for stage, ms in times_ms.items():
        todo = work[stage]
        row = {"stage": stage, "ms": ms, "bound": todo.bound(peak), "share_of_peak": todo.least_ms(peak) / ms}
        if todo.pairs is not None:
            row["pairs_per_s"] = todo.pairs / (ms * 1e-3)
        rows.append(row)
    return rows


def share_of_peak(ms: float, work: Mapping[str, Work], peak: Peak) -> float:
    """Of stages one after the other that took `ms` together."""
    return sum(todo.least_ms(peak) for todo in work.values()) / ms
