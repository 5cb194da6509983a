"""A list of named points that a peer keeps, mirrored as anchors: each is pinned where it has come to rest."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sags_node.types import F64

REST = 0.5  # s that a point must lie still: one that is dragged is sent again and again
STILL = 0.1  # mm; a point that moves less has not moved
MOST = 64  # points of a list


class Pin(NamedTuple):
    """A point that is to be pinned."""

    name: str
    place: F64  # [3] mm, as the peer said it
    number: int = 1  # among those of that name: names need not differ


@dataclass(slots=True)
class _Point:
    place: F64
    since: float  # monotonic s; when it was put there
    asked: bool = False  # whether an anchor at that place was asked for
    anchor: int | None = None


class Pins:
    """Compares the list that came with what is pinned; used from one thread."""

    def __init__(self) -> None:
        self._points: dict[tuple[str, int], _Point] = {}  # by name, and number of that name

    def hear(self, points: Iterable[tuple[str, F64]], now: float) -> list[int]:
        """Take in the current list; return the anchors to give back, as their points have gone or moved."""
        listed: dict[tuple[str, int], F64] = {}
        named: Counter[str] = Counter()
        for name, place in list(points)[:MOST]:
            named[name] += 1
            listed[name, named[name]] = place
        released: list[int] = []
        for key in list(self._points):
            point = self._points[key]
            if key not in listed or float(np.abs(listed[key] - point.place).max()) > STILL:
                if point.anchor is not None:
                    released.append(point.anchor)
                del self._points[key]
        for key, place in listed.items():
            self._points.setdefault(key, _Point(place, now))
        return released

    def due(self, now: float) -> list[Pin]:
        """Return the points that have come to rest, each of them once."""
        resting = [
            (key, point)
            for key, point in self._points.items()
            if not point.asked and now - point.since >= REST
        ]
        for _, point in resting:
            point.asked = True
        return [Pin(name, point.place, number) for (name, number), point in resting]

    def pinned(self, pin: Pin, anchor: int) -> list[int]:
        """Note a point's anchor; return it, to be given back, if the point has gone or moved meanwhile."""
        point = self._points.get((pin.name, pin.number))
        if point is None or point.place is not pin.place:
            return [anchor]
        point.anchor = anchor
        return []

    def forget(self) -> bool:
        """Forget all anchors without giving them back: by now, another node may use their numbers.

        Returns:
            whether there were any. Their points are pinned again once they move: the world may be another.
        """
        pinned = [point for point in self._points.values() if point.anchor is not None]
        for point in pinned:
            point.anchor = None
        return bool(pinned)
