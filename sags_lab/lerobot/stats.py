"""The statistics that a LeRobot data set has of each feature: min, max, mean, std and count."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sags_node.types import F64

Stats = dict[str, list[Any]]  # of one feature: statistic -> its values


class Sums:
    """Running sums for min, max, mean and std of numbers [N, C], for each of C; NaN is left out."""

    def __init__(self) -> None:
        self._count: F64 | float = 0.0
        self._sum: F64 | float = 0.0
        self._squares: F64 | float = 0.0
        self._least: F64 | float = np.inf
        self._most: F64 | float = -np.inf

    def add(self, values: F64) -> None:
        known = np.isfinite(values)
        self._count = self._count + known.sum(0)
        self._sum = self._sum + np.where(known, values, 0).sum(0)
        self._squares = self._squares + np.where(known, values**2, 0).sum(0)
        self._least = np.minimum(self._least, np.where(known, values, np.inf).min(0))
        self._most = np.maximum(self._most, np.where(known, values, -np.inf).max(0))

    def stats(self, shape: Sequence[int]) -> Stats:
        """Return the statistics, reshaped from C numbers to `shape`; 0 where nothing is known."""
        count = np.maximum(self._count, 1)
        mean = self._sum / count
        std = np.sqrt(np.maximum(self._squares / count - mean**2, 0))
        found = {"min": self._least, "max": self._most, "mean": mean, "std": std}
        plain = {
            name: np.where(np.isfinite(value), value, 0).reshape(shape).tolist()
            for name, value in found.items()
        }
        return plain | {"count": [int(np.max(self._count))]}


def merged(stats: Sequence[Stats]) -> Stats:
    """Merge statistics of episodes, weighted by their counts. Those without a known value are ignored."""
    stats = [each for each in stats if each["count"] != [0]] or stats[:1]
    values = {name: np.array([each[name] for each in stats], np.float64) for name in stats[0]}
    counts = values["count"].reshape(-1, *[1] * (values["mean"].ndim - 1))
    share = counts / max(1.0, float(counts.sum()))
    mean = (share * values["mean"]).sum(0)
    spread = (share * (values["std"] ** 2 + (values["mean"] - mean) ** 2)).sum(0)
    return {
        "min": values["min"].min(0).tolist(),
        "max": values["max"].max(0).tolist(),
        "mean": mean.tolist(),
        "std": np.sqrt(spread).tolist(),
        "count": [int(counts.sum())],
    }
