"""What a snapshot says of a moment that the mapper never saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sags_node.model.forecast import gaussians_ahead, reached
from sags_node.types import Gaussians, Snapshot

VELOCITY_SHARE = 0.8  # tissue slows down: less than the last velocity predicts best (0.3 to 0.7 dB over none)
ROUNDING = 1e-3  # s, of stamps


def extrapolated(snapshot: Snapshot, seconds: float) -> Gaussians:
    """The Gaussians `seconds` after the snapshot: by the motion field where motion comes again and that has
    skill so far ahead, else by 0.8 times their last observed velocity."""
    comes_again = snapshot.forecast is not None and snapshot.forecast.state.period is not None
    if comes_again and 0 < seconds <= reached(snapshot, seconds) + ROUNDING:
        return gaussians_ahead(snapshot, seconds)
    means = snapshot.gaussians.means + snapshot.velocities * np.float32(VELOCITY_SHARE * seconds)
    return replace(snapshot.gaussians, means=means)


def between(before: Gaussians, after: Gaussians, share: float) -> Gaussians:
    """The Gaussians of a moment that was not mapped, once the next one was: places and colours lie on the
    line between the two, `share` of the way from the earlier to the later, 0..1. What the earlier one has
    not yet is as in the later one."""
    order = np.argsort(before.ids)
    places = order[np.minimum(np.searchsorted(before.ids[order], after.ids), len(order) - 1)]
    shared = before.ids[places] == after.ids
    left = np.where(shared, np.float32(1 - share), np.float32(0))[:, None]
    return replace(
        after,
        means=after.means + left * (before.means[places] - after.means),
        colors=after.colors + left * (before.colors[places] - after.colors),
    )
