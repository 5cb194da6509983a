"""The times at which codes were shown and seen again, on the monotonic clock.

Messages are stamped by the wall clock. The difference of the two clocks converts these stamps.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

CLOCK_SET = 2_000_000  # ns; if the clocks' difference changes by more while a code is on its way, one was set
MOST_READS = 10  # attempts to read both clocks at the same moment
PERCENTILES = (50, 95, 99, 99.9)


class Moment(NamedTuple):
    """The same moment on both clocks, ns."""

    monotonic: int
    wall: int

    @classmethod
    def now(cls) -> Moment:
        for _ in range(MOST_READS):
            before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            if after - before < CLOCK_SET // 20:  # else another thread ran between the readings
                break
        return cls(after, wall)

    def later(self, seconds: float) -> Moment:
        return Moment(*(clock + round(1e9 * seconds) for clock in self))


class Ledger:
    """Codes that were shown, and images in which they were looked for.

    Args:
        first: name of the moment at which a code is shown.
    """

    def __init__(self, first: str) -> None:
        self._first = first
        self._shown: dict[int, list[Moment]] = defaultdict(list)
        self._seen: list[tuple[int | None, dict[str, int], Moment]] = []

    def shown(self, number: int, at: Moment) -> None:
        """Note that a code is shown from this moment on; moments come in the order of time."""
        self._shown[number].append(at)

    def seen(self, number: int | None, stamps: Mapping[str, int], at: Moment) -> None:
        """Note an image in which a code was looked for.

        Args:
            number: of the code that was read in it; None: no code could be read.
            stamps: when it passed each stage, in order: wall clock ns, by the stage's name.
        """
        self._seen.append((number, dict(stamps), at))

    def figures(self, since: Moment, until: Moment) -> dict[str, Any]:
        """Return the latencies of codes shown between two moments, each to the first image that shows it.

        Returns:
            codes, read, lost (codes in no image), unreadable (images without a code), unknown (images
            with a code that was not shown before), clock_set (codes that count in total_ms only, as the wall
            clock was set meanwhile), total_ms, and parts_ms by the name of the stage that ends each part.
        """
        total: dict[Moment, float] = {}
        parts: dict[str, list[float]] = defaultdict(list)
        counts = dict.fromkeys(("unreadable", "unknown", "clock_set"), 0)
        for number, stamps, at in self._seen:
            before = [] if number is None else self._shown.get(number, [])
            place = bisect_right(before, at)
            if not place:
                counts["unreadable" if number is None else "unknown"] += since <= at <= until
                continue
            begun = before[place - 1]
            if begun in total or not since <= begun <= until:
                continue
            total[begun] = 1e-6 * (at.monotonic - begun.monotonic)
            ahead, last = at.wall - at.monotonic, begun.monotonic
            if abs(ahead - (begun.wall - begun.monotonic)) > CLOCK_SET:
                counts["clock_set"] += 1
                continue
            for name, stamp in {**stamps, "shown": at.wall}.items():
                parts[name].append(1e-6 * (stamp - ahead - last))
                last = stamp - ahead
        codes = sum(since <= at <= until for moments in self._shown.values() for at in moments)
        return {
            "from": self._first,
            "codes": codes,
            "read": len(total),
            "lost": codes - len(total),
            **counts,
            "total_ms": _spread(list(total.values())),
            "parts_ms": {name: _spread(values) for name, values in parts.items()},
        }


def _spread(ms: list[float]) -> dict[str, float]:
    said = zip(PERCENTILES, np.percentile(ms, PERCENTILES), strict=True) if ms else ()
    return {f"p{q:g}": round(float(v), 2) + 0.0 for q, v in said} | ({"max": round(max(ms), 2)} if ms else {})
