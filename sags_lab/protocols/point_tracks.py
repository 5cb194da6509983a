"""How followed points are judged, as the field does it: shares within thresholds and average Jaccard, from
TAP-Vid (Doersch et al., NeurIPS 2022); and how often what is said with some confidence is right."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sags_node.types import F64, AnchorStates, Bool

THRESHOLDS_PX = (2, 4, 8, 16, 32)
SURE = 0.5  # least confidence, and least visibility, of a point that counts as seen
BINS = (0.0, 0.02, 0.1, 0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # of confidence


def shares_within(distances: F64, thresholds: Sequence[float] = THRESHOLDS_PX) -> dict[str, float]:
    """Return the share of distances up to each threshold, and their mean (delta_avg of TAP-Vid)."""
    shares = {f"within_{threshold:g}": float(np.mean(distances <= threshold)) for threshold in thresholds}
    return {**shares, "average": float(np.mean(list(shares.values())))}


def average_jaccard(
    distances: F64, visible: Bool, said: Bool, thresholds: Sequence[float] = THRESHOLDS_PX
) -> float:
    """Return TAP-Vid's figure of where points are and whether they are seen, over all points and frames [N].

    A point is right if it is seen, is said to be, and lies within the threshold. A Jaccard index is right
    points / (seen points + points wrongly said to be seen there); the average is over the thresholds.
    """
    found = []
    for threshold in thresholds:
        right = said & visible & (distances < threshold)
        wrong = said & ~right
        found.append(right.sum() / max(1, visible.sum() + wrong.sum()))
    return float(np.mean(found))


def surely_seen(states: AnchorStates) -> Bool:
    """Tell which anchors [A] are sure and visible, by `SURE`."""
    return (states.confidence >= SURE) & (states.visibility >= SURE)


@dataclass(frozen=True, slots=True)
class Bin:
    """One bin of a reliability diagram: what was said with about the same confidence."""

    least: float
    most: float
    count: int
    said: float  # mean confidence
    right: float  # share that was right


def reliability(confidence: F64, right: Bool) -> list[Bin]:
    """Return the reliability diagram of a confidence [N] and what was right [N], without empty bins."""
    places = np.clip(np.searchsorted(BINS, confidence, side="right") - 1, 0, len(BINS) - 2)
    return [
        Bin(
            BINS[k],
            BINS[k + 1],
            int(np.count_nonzero(places == k)),
            float(np.mean(confidence[places == k])),
            float(np.mean(right[places == k])),
        )
        for k in np.unique(places)
    ]


def calibration_error(bins: Sequence[Bin]) -> float:
    """Return the mean distance between confidence and share that was right, over all that was said (expected
    calibration error; Guo et al., ICML 2017)."""
    counts = np.array([each.count for each in bins])
    return float(np.average([abs(each.said - each.right) for each in bins], weights=counts))
