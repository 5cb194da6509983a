"""`sags calib hand-eye`: from a recording of a board and the robot's poses to `hand_eye.yaml`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from rich.table import Table

from sags_node.config.schema import BagRobot, LaunchConfig, RecordedSource
from sags_node.errors import SagsError, UsageError
from sags_node.sources.robot import open_robot
from sags_node.sources.source import open_source
from sags_node.terminal import text
from sags_node.tools.calibration.boards import Board, Chessboard, StereoView, find_in_both, turned_like
from sags_node.tools.calibration.hand_eye_solve import HandEyeSolution, solve_hand_eye
from sags_node.tools.calibration.pictures import spread
from sags_node.types import StereoRig

Progress = Callable[[int, int], None]


def calibrate_hand_eye(
    config: LaunchConfig,
    rig: StereoRig,
    board: Board,
    count: int,
    progress: Progress = lambda done, total: None,
) -> HandEyeSolution:
    """Calibrate from `count` views, spread over a recording in which the board lies still.

    Raises:
        UsageError: the source is live, or the poses are not in the recording.
        SagsError: the board is seen too rarely, or the motion does not tell where the camera sits.
    """
    source = config.source
    if not isinstance(source, RecordedSource) or not isinstance(config.robot, BagRobot):
        raise UsageError(
            "a hand-eye calibration needs a recording with images and poses: record both topics (ros2 bag "
            "record), then set source.kind:=bag and robot.kind:=bag"
        )
    playing = spread(source, count)
    track = open_robot(config).track
    views: list[StereoView] = []
    stamps: list[int] = []
    with open_source(playing, references=False) as opened:
        for number, frame in enumerate(opened):
            if frame.right is None:
                raise UsageError("the session has no right eye; hand-eye calibration uses both")
            view = find_in_both(board, str(frame.frame_id), frame.left, frame.right)
            if view is not None:
                if views and isinstance(board, Chessboard):
                    left = turned_like(view.left, views[0].left)
                    view = replace(view, left=left, right=turned_like(view.right, left))
                views.append(view)
                stamps.append(frame.t_device_ns)
            progress(number + 1, opened.frame_count or number + 1)
    if not views:
        raise SagsError("the board is seen in no frame; check --board, --squares, light and focus")
    return solve_hand_eye(views, stamps, board.points, rig, track.at)


def summarise_hand_eye(solution: HandEyeSolution) -> dict[str, Any]:
    """All figures of a solution, as a dictionary for programs."""
    T = solution.hand_eye.T_hand_cam
    worst = np.argsort(-solution.errors)[:3]
    return {
        "views": len(solution.errors),
        "error_px": round(float(np.sqrt(np.mean(solution.errors**2))), 4),
        "worst_views": {solution.names[i]: round(float(solution.errors[i]), 3) for i in worst},
        "place_mm": [round(float(part) * 1e3, 4) for part in T[:3, 3]],
        "place_sure_to_mm": round(solution.position_error * 1e3, 4),
        "turn_sure_to_degrees": round(float(np.degrees(solution.rotation_error)), 5),
        "offset_ms": round(solution.hand_eye.offset_ns * 1e-6, 3),
        "offset_sure_to_ms": round(solution.offset_error_ns * 1e-6, 3),
    }


def hand_eye_table(summary: dict[str, Any]) -> Table:
    """The summary as a table for people."""
    made = text.table()
    made.add_row("views", f"{summary['views']} of the board with a pose of the robot")
    made.add_row("error", f"{summary['error_px']:.3f} px (root mean square, both eyes)")
    worst = (f"frame {name} {error:.2f} px" for name, error in summary["worst_views"].items())
    made.add_row("worst views", ", ".join(worst))
    place = " ".join(f"{part:.2f}" for part in summary["place_mm"])
    sure = f"sure to {summary['place_sure_to_mm']:.2f} mm, {summary['turn_sure_to_degrees']:.3f} degrees"
    made.add_row("camera on the hand", f"{place} mm; {sure}")
    made.add_row(
        "clocks",
        f"robot - images {summary['offset_ms']:.1f} ms, sure to {summary['offset_sure_to_ms']:.1f} ms",
    )
    return made
