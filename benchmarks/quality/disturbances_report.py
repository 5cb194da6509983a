"""Disturbances for people: a table, and pictures to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from rich.table import Table

from benchmarks.kernels.report import new_table
from benchmarks.quality.disturbances import Shot
from sags_node.quality.gallery import Picture, depth_range, depth_tile, shrunk

_COLUMNS = {
    "PSNR* before": "psnr_before", "during": "psnr_during", "after, dB": "psnr_after",
    "depth p90, mm": "confident_depth_p90_mm", "median": "depth_median_mm",
    "coverage": "coverage", "borrowed": "borrowed_share",
    "warned, s": "warned_after_s", "cleared": "cleared_after_s",
    "recovers, frames": "frames_to_recover", "restarts": "restarts",
    "anchors back": "anchors_back", "wrong": "anchors_wrong",
}  # fmt: skip
_SHARES = ("coverage", "borrowed_share", "anchors_back", "anchors_wrong")


def table(measured: Mapping[str, Any]) -> Table:
    """`measured` as `measure_disturbances` returns it."""
    settings = measured["settings"]
    made = new_table(measured["session"], *_COLUMNS, title=f"from frame {settings['from']}")
    for row in measured["rows"]:
        made.add_row(row["name"], *(_cell(key, row[key]) for key in _COLUMNS.values()))
    return made


def _cell(key: str, value: float | None) -> str:
    if value is None:
        return "-"
    if key in _SHARES:
        return f"{value:.0%}"
    return str(value) if isinstance(value, int) else f"{value:.1f}"


def strip(shots: Sequence[Shot]) -> bytes:
    """A PNG: a line each of before, middle and after; what came to the left and the right eye, the model's
    picture, and its depth, grey where none is published on tissue."""
    shown = [Picture(shot.view.frame_id, 0.0, shot.left, shot.view.rgb, shot.view.depth, shot.tissue)
             for shot in shots]  # fmt: skip
    near, far = depth_range(shown[::2])  # those that nothing is wrong with
    lines = [
        np.hstack([shrunk(shot.left), shrunk(shot.right), shrunk(each.render), depth_tile(each, near, far)])
        for shot, each in zip(shots, shown, strict=True)
    ]
    return cv2.imencode(".png", np.vstack(lines)[..., ::-1])[1].tobytes()
