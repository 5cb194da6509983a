"""Has a kernel become slower? Its time in units of the machine's own peak, against a kept table."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

from sags_node.errors import UsageError

SHORTEST_MS = 0.1  # shorter stages are mostly the start of threads, and are not compared
TRIES = 3
SECTIONS = ("rasterize", "losses", "adam")
# what tells rows of a section apart
SETTINGS = ("n", "of", "columns", "width", "height", "scene", "active_tiles", "sh_degree", "threads")

Table = Mapping[str, Any]
Kernel = tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Compared:
    """One kernel beside the kept table."""

    kernel: str
    ms: float
    kept_ms: float
    ratio: float  # of the times, each multiplied by the peak of its machine; above 1: slower


def read_table(file: Path) -> Table:
    """Read a table that `python -m benchmarks kernels --out` wrote.

    Raises:
        UsageError: it cannot be read or is something else.
    """
    try:
        table = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read {file} as a table of kernel times: {error}") from None
    if not isinstance(table, dict) or "peaks" not in table:
        raise UsageError(f"{file} holds no kernel times; make it with kernels --out {file}")
    return table


def check(measure: Callable[[], Table], kept: Table, tolerance: float) -> list[Compared]:
    """Measure and compare, up to three times: neighbours on the machine disturb a kernel now and then, but a
    slower kernel is slow every time. Each kernel's best ratio counts; the slowest kernel comes first.

    Raises:
        UsageError: the tables have no kernel in common.
    """
    best: dict[str, Compared] = {}
    for _ in range(TRIES):
        for found in compare(measure(), kept):
            best[found.kernel] = min(found, best.get(found.kernel, found), key=attrgetter("ratio"))
        if all(found.ratio <= tolerance for found in best.values()):
            break
    return sorted(best.values(), key=attrgetter("ratio"), reverse=True)


def compare(now: Table, kept: Table) -> list[Compared]:
    """Compare every kernel that both tables hold; return the slowest first.

    Raises:
        UsageError: they have none in common.
    """
    before = dict(_kernels(kept))
    found = []
    for kernel, stage in _kernels(now):
        if kernel in before and before[kernel]["ms"] >= SHORTEST_MS:
            ms, kept_ms, bound = stage["ms"], before[kernel]["ms"], before[kernel]["bound"]
            threads = dict(kernel[1])["threads"]
            ratio = ms * _peak(now, threads, bound) / (kept_ms * _peak(kept, threads, bound))
            found.append(Compared(_name(kernel), ms, kept_ms, ratio))
    if not found:
        raise UsageError("the kept table and this run have no kernel in common; run with the same sizes")
    return sorted(found, key=attrgetter("ratio"), reverse=True)


def _kernels(table: Table) -> Iterator[tuple[Kernel, Mapping[str, Any]]]:
    """Each kernel's section, settings and stage, with its record."""
    for section in SECTIONS:
        for row in table.get(section, []):
            settings = tuple((key, row[key]) for key in SETTINGS if key in row)
            for stage in row["stages"]:
                yield (section, settings, stage["stage"]), stage


def _peak(table: Table, threads: int, bound: str) -> float:
    """The peak rate. For memory, that over few bytes: few kernels leave the caches, and memory is shared."""
    (peak,) = (peak for peak in table["peaks"] if peak["threads"] == threads)
    if bound == "arithmetic":
        return float(peak["operations_per_s"])
    return float(next(iter(peak["bytes_per_s_over"].values())))


def _name(kernel: Kernel) -> str:
    section, settings, stage = kernel
    return f"{section} {stage} (" + ", ".join(f"{key} {value}" for key, value in settings) + ")"
