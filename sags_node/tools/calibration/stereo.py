"""`sags calib stereo`: from images of a board to a checked calibration on disk."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.table import Table

from sags_node.errors import SagsError
from sags_node.rig import check_rig
from sags_node.sources.pictures import FolderPairs
from sags_node.terminal import text
from sags_node.tools.calibration.boards import Board, StereoView, find_in_both
from sags_node.tools.calibration.rows import rectified_rows
from sags_node.tools.calibration.solve import Solution, calibrate
from sags_node.types import F32, F64

GRID = 3  # cells along each side of the image
FEWEST_IN_CELL = 10  # corners, over all views
GOOD_VIEWS = 15
TILT_SPAN = 25.0  # degrees between the extremes: with less, focal length and distance cannot be told apart
DISTANCE_SPAN = 1.25  # farthest distance divided by the nearest
ROW_NAMES, COLUMN_NAMES = ("top", "middle", "bottom"), ("left", "centre", "right")

LOOKED_AT = 5  # images to tell what is seen instead of the board


@dataclass(frozen=True, slots=True)
class Calibrated:
    """A calibration and what is known of its quality."""

    solution: Solution
    size: tuple[int, int]  # px
    pairs: int
    unseen: list[str]  # images in which the eyes do not both see the board
    hints: list[str]


def calibrate_folders(
    left: Path,
    right: Path,
    board: Board,
    name: str,
    coefficients: int = 2,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Calibrated:
    """Calibrate a rig from two folders of images of a board, paired by sorted name.

    Raises:
        UsageError: the folders cannot be read or paired.
        SagsError: the board is seen too rarely, or its views do not fit one rig.
    """
    pictures = FolderPairs(left, right)
    views: list[StereoView] = []
    unseen: list[str] = []
    for index, file in enumerate(pictures.files):
        pair = pictures.read()
        assert pair is not None and pair.right is not None  # there are as many as files, with both eyes
        view = find_in_both(board, file.name, pair.left, pair.right)
        if view is None:
            unseen.append(file.name)
        else:
            views.append(view)
        progress(index + 1, pictures.count)
    if not views:
        raise SagsError(f"the board is seen in none of {pictures.count} pairs: {_instead(board, pictures)}")
    solution = calibrate(name, views, board.points, pictures.size, coefficients)
    hints = coverage_hints(solution.views, solution.board_poses, pictures.size)
    return Calibrated(solution, pictures.size, pictures.count, unseen, hints)


def summarise(calibrated: Calibrated) -> dict[str, Any]:
    """All figures of a calibration, as a dictionary for programs."""
    solution = calibrated.solution
    rig, rows = solution.rig, rectified_rows(solution.rig, solution.matches)
    return {
        "size": list(calibrated.size),
        "views": len(solution.views),
        "pairs": calibrated.pairs,
        "unseen": calibrated.unseen,
        "dropped": {name: round(error, 3) for name, error in solution.dropped.items()},
        "error_px": round(solution.error, 4),
        "row_error_px": {"median": round(rows.median, 4), "p90": round(rows.p90, 4)},
        "baseline_m": round(rig.baseline, 7),
        "focal_px": {side: [float(eye.K[0, 0]), float(eye.K[1, 1])] for side, eye in _eyes(solution)},
        "centre_px": {side: [float(eye.K[0, 2]), float(eye.K[1, 2])] for side, eye in _eyes(solution)},
        "distortion": {side: eye.distortion.tolist() for side, eye in _eyes(solution)},
        "per_view": {
            view.name: {
                "corners": len(view.ids),
                "left_px": round(float(a), 4),
                "right_px": round(float(b), 4),
            }
            for view, (a, b) in zip(solution.views, solution.errors, strict=True)
        },
        "hints": calibrated.hints,
        "findings": [asdict(finding) for finding in check_rig(rig)],
    }


def report_table(summary: dict[str, Any]) -> Table:
    """The summary as a table for people."""
    made = text.table()
    unseen = f", {len(summary['unseen'])} without the board in both eyes" if summary["unseen"] else ""
    made.add_row("views", f"{summary['views']} of {summary['pairs']} pairs{unseen}")
    for name, error in summary["dropped"].items():
        made.add_row("left out", f"{name}: {error:.2f} px from where the others put it")
    rows = summary["row_error_px"]
    made.add_row("error", f"{summary['error_px']:.3f} px (root mean square)")
    made.add_row("rows", f"{rows['median']:.3f} px (median), {rows['p90']:.3f} px (90 %), of the corners")
    for side in ("left", "right"):
        (fx, fy), (cx, cy) = summary["focal_px"][side], summary["centre_px"][side]
        made.add_row(f"{side} eye", f"focal length {fx:.2f} {fy:.2f} px, centre {cx:.2f} {cy:.2f} px")
    made.add_row("baseline", f"{summary['baseline_m'] * 1e3:.3f} mm")
    worst = sorted(summary["per_view"].items(), key=lambda item: -_larger(item[1]))[:3]
    made.add_row("worst views", ", ".join(f"{name} {_larger(view):.2f} px" for name, view in worst))
    for hint in summary["hints"]:
        made.add_row("to improve", hint)
    for finding in summary["findings"]:
        made.add_row(f"check: {finding['level']}", "; ".join(filter(None, (finding["what"], finding["fix"]))))
    return made


def _larger(view: dict[str, float]) -> float:
    return max(view["left_px"], view["right_px"])


def _eyes(solution: Solution) -> Any:
    return (("left", solution.rig.left), ("right", solution.rig.right))


def _instead(board: Board, pictures: FolderPairs) -> str:
    """Return in words what most of the first images show instead of the board."""
    said: Counter[str] = Counter()
    for index in range(min(LOOKED_AT, pictures.count)):
        pair = pictures.at(index)
        assert pair is not None  # it was read before
        said[board.explain(cv2.cvtColor(pair.left, cv2.COLOR_RGB2GRAY))] += 1
    likely = said.most_common(1)[0][0]
    return f"{likely}; check --squares" if likely else "check --board, --squares, light and focus"


def coverage_hints(views: Sequence[StereoView], board_poses: F64, size: tuple[int, int]) -> list[str]:
    """Return what to add for a better calibration; empty where nothing is lacking.

    Args:
        board_poses: [V, 4, 4] m, board to left camera.
        size: width and height of the images, px.
    """
    hints = []
    if len(views) < GOOD_VIEWS:
        hints.append(f"{len(views)} views are few; take {GOOD_VIEWS} to 30")
    for eye, corners in (("left", [view.left for view in views]), ("right", [view.right for view in views])):
        empty = _empty_cells(np.concatenate(corners), size)
        if empty:
            hints.append(
                f"the {eye} image has hardly any corners at {', '.join(empty)}: hold the board there"
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
