"""Joining by time: which stamps belong together."""

from __future__ import annotations

import numpy as np

from sags_node.types import I64


def pair(left: I64, right: I64, tolerance: float) -> I64:
    """Rows (index of the left, index of the right picture) [N, 2] of stamps that are each other's nearest.

    Args:
        left, right: capture stamps [L], [R], ns, in any order.
        tolerance: s.
    """
    to_right, to_left = nearest(left, right), nearest(right, left)
    mutual = to_left[to_right] == np.arange(len(left))
    close = np.abs(left - right[to_right]) <= tolerance * 1e9
    chosen = np.flatnonzero(mutual & close)
    chosen = chosen[np.argsort(left[chosen], kind="stable")]
    return np.stack([chosen, to_right[chosen]], axis=1)


def nearest(stamps: I64, others: I64) -> I64:
    """For each of `stamps` [N] the index of the nearest of `others` [M], M > 0."""
    order = np.argsort(others, kind="stable")
    ordered = others[order]
    after = np.searchsorted(ordered, stamps).clip(0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(ordered[before] - stamps) <= np.abs(ordered[after] - stamps)
    found: I64 = order[np.where(closer, before, after)]
    return found
