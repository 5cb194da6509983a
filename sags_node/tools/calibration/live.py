"""Taking images of a board from a running source: only views that add something, held still."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from sags_node.config.schema import LaunchConfig
from sags_node.errors import SagsError, UsageError
from sags_node.files import whole, writing
from sags_node.sources.source import open_source
from sags_node.tools.calibration.boards import Board, StereoView, find_in_both
from sags_node.types import F32, U8

NEW_AT = 0.06  # of the diagonal: how far common corners must have moved from every view taken before
STILL_AT = 0.004  # of the diagonal: how far they may have moved since the frame before
TO_BOTH = "show the board to both eyes, a chessboard whole"


def grab_views(
    config: LaunchConfig,
    board: Board,
    folder: Path,
    count: int,
    tell: Callable[[int, str], None] = lambda taken, what: None,
) -> tuple[Path, Path]:
    """Take views of the board until there are `count`, the source ends or Ctrl-C.

    Args:
        folder: new or empty; gets `left/` and `right/` with a PNG for each view.
        tell: called for each frame with the number of views and what to do.

    Returns:
        Both image folders.

    Raises:
        UsageError: the folder holds something, or the source has no right eye.
        SagsError: no view was taken, or the source fails.
    """
    sides = folder / "left", folder / "right"
    if any(file.is_file() for file in folder.rglob("*")):  # empty folders of an earlier attempt may stay
        raise UsageError(f"{folder} is not empty; name a new folder, or calibrate from the images in it")
    with writing(folder):
        for side in sides:
            side.mkdir(parents=True, exist_ok=True)
    taken: list[StereoView] = []
    before: StereoView | None = None
    try:
        with open_source(config.source, references=False) as source:
            for frame in source:
                if frame.right is None:
                    raise UsageError("the session has no right eye; a stereo calibration needs both")
                view = find_in_both(board, f"{len(taken):04d}.png", frame.left, frame.right)
                advice = _advice(view, before, taken, float(np.hypot(*frame.left.shape[:2])))
                before = view
                if view is not None and not advice:
                    _write(sides, view.name, (frame.left, frame.right))
                    taken.append(view)
                tell(len(taken), advice or "taken")
                if len(taken) >= count:
                    break
    except KeyboardInterrupt:
        tell(len(taken), "stopped")
    if not taken:
        raise SagsError(f"no view was taken: {TO_BOTH}, and hold it still")
    return sides


def _advice(
    view: StereoView | None, before: StereoView | None, taken: list[StereoView], diagonal: float
) -> str:
    """Return what to do so that the frame becomes a new view; empty: it is one."""
    if view is None:
        return TO_BOTH
    if before is None or _moved(view, before) > STILL_AT * diagonal:
        return "hold it still"
    if any(_moved(view, old) < NEW_AT * diagonal for old in taken):
        return "move or tilt it"
    return ""


def _moved(view: StereoView, other: StereoView) -> float:
    """Root mean square motion of the corners that both show, px; infinite where there are none."""
    _, here, there = np.intersect1d(view.ids, other.ids, return_indices=True)
    if not len(here):
        return np.inf
    motion: F32 = view.left[here] - other.left[there]
    return float(np.sqrt(np.mean(np.sum(np.square(motion), -1))))


def _write(sides: tuple[Path, Path], name: str, pair: tuple[U8, U8]) -> None:
    for side, picture in zip(sides, pair, strict=True):
        with whole(side / name) as partial:
            partial.write_bytes(cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
