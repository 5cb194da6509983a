"""What the views of a board leave open: where in the picture, how tilted and how far it was never held."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sags_node.tools.calibration.boards import StereoView
from sags_node.types import F32, F64

GRID = 3  # cells along each side of the picture
FEWEST_IN_CELL = 10  # corners, over all views
GOOD_VIEWS = 15
TILT_SPAN = 25.0  # degrees between the extremes: with less, focal length and distance cannot be told apart
DISTANCE_SPAN = 1.25  # farthest by nearest
ROW_NAMES, COLUMN_NAMES = ("top", "middle", "bottom"), ("left", "centre", "right")


def coverage_hints(views: Sequence[StereoView], board_poses: F64, size: tuple[int, int]) -> list[str]:
    """Return what to add for a better calibration; empty where nothing is lacking.

    Args:
        board_poses: [V, 4, 4] m, board to left camera.
        size: width and height of the pictures, px.
    """
    hints = []
    if len(views) < GOOD_VIEWS:
        hints.append(f"{len(views)} views are few; take {GOOD_VIEWS} to 30")
    for eye, corners in (
        ("left", [view.left for view in views]),
        ("right", [view.right for view in views]),
    ):
        empty = _empty_cells(np.concatenate(corners), size)
        if empty:
            hints.append(
                f"the {eye} picture has hardly any corners at {', '.join(empty)}: hold the board there"
            )
    normals = board_poses[:, :3, 2] * np.sign(board_poses[:, 2:3, 2])
    for axis, how in ((0, "left and right"), (1, "up and down")):
        span = float(np.ptp(np.degrees(np.arctan2(normals[:, axis], normals[:, 2]))))
        if span < TILT_SPAN:
            hints.append(f"the board is tilted {how} by {span:.0f} degrees in all: tilt it 20 both ways")
    distances = board_poses[:, 2, 3]
    if distances.max() < DISTANCE_SPAN * distances.min():
        hints.append("all views are from the same distance: hold the board nearer and farther")
    return hints


def _empty_cells(corners: F32, size: tuple[int, int]) -> list[str]:
    edges = [np.linspace(-0.5, side - 0.5, GRID + 1) for side in size]
    counts = np.histogram2d(corners[:, 1], corners[:, 0], bins=(edges[1], edges[0]))[0]
    return [
        f"{ROW_NAMES[row]} {COLUMN_NAMES[column]}" for row, column in np.argwhere(counts < FEWEST_IN_CELL)
    ]
