"""Where tissue is expected after a frame, by the motion of the control nodes."""

from dataclasses import replace

import numpy as np

from sags_node.model.deformation import nearest_nodes, skinned
from sags_node.types import F32, F64, Forecast, Gaussians, Snapshot


def reached(snapshot: Snapshot, seconds: float) -> float:
    """The time, s, that a snapshot can be moved ahead when `seconds` are wanted: no more than the forecast
    has skill for; 0: no prediction."""
    forecast = snapshot.forecast
    return 0.0 if forecast is None else float(min(max(seconds, 0.0), forecast.state.reach))


def gaussians_ahead(snapshot: Snapshot, seconds: float) -> Gaussians:
    """The Gaussians of a snapshot with a forecast, `seconds` later; colours and rotations stay."""
    forecast, gaussians = snapshot.forecast, snapshot.gaussians
    assert forecast is not None
    moves = _moves(forecast, seconds)
    return replace(
        gaussians, means=skinned(moves, forecast.node_index, forecast.node_weight, gaussians.means)
    )


def points_ahead(forecast: Forecast, points: F32 | F64, seconds: float) -> F32:
    """The points [A, 3] m of the tissue, world, `seconds` later; NaN stays NaN."""
    moved = np.array(points, np.float32)
    known = np.isfinite(moved).all(1)
    index, weight, _ = nearest_nodes(moved[known], forecast.nodes)
    moved[known] = skinned(_moves(forecast, seconds), index, weight, moved[known])
    return moved


def _moves(forecast: Forecast, seconds: float) -> F32:
    """Motion [M, 3] m of the nodes after a time: linear between frames, extrapolated from the last two."""
    moves = np.concatenate([np.zeros_like(forecast.moves[:1]), forecast.moves])
    frames = seconds / forecast.frame_s
    before = min(max(int(frames), 0), len(moves) - 2)
    between: F32 = moves[before] + np.float32(frames - before) * (moves[before + 1] - moves[before])
    return between
