"""Disturbances for people: a table, and images to look at."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from rich.table import Table

from benchmarks.quality.disturbances import Shot
from benchmarks.tables import filled, plain_table
from sags_node.quality.gallery import Picture, depth_range, depth_tile, shrunk

_COLUMNS = {
    "PSNR* before": "{psnr_before:.1f}", "during": "{psnr_during:.1f}", "after, dB": "{psnr_after:.1f}",
    "model alone: during": "{model_psnr_during:.1f}", "after ": "{model_psnr_after:.1f}",
    "recovers ": "{model_frames_to_recover}",
    "depth p90, mm": "{confident_depth_p90_mm:.1f}", "median": "{depth_median_mm:.1f}",
    "coverage": "{coverage:.0%}", "borrowed": "{borrowed_share:.0%}",
    "warned, s": "{warned_after_s:.1f}", "cleared": "{cleared_after_s:.1f}",
    "recovers, frames": "{frames_to_recover}", "restarts": "{restarts}",
    "anchors back": "{anchors_back:.0%}", "wrong": "{anchors_wrong:.0%}",
}  # fmt: skip


def table(measured: Mapping[str, Any]) -> Table:
    """Make the table; `measured` as `measure_disturbances` returns it."""
    title = f"from frame {measured['settings']['from']}"
    made = plain_table(measured["session"], *_COLUMNS, title=title)
    return filled(made, measured["rows"], "{name}", *_COLUMNS.values())


def strip(shots: Sequence[Shot]) -> bytes:
    """Draw a PNG with a row each for before, middle and after: the left and right images as they came, what
    is shown, and the depth, which is grey on tissue where none is published."""
    shown = [Picture(shot.view.frame_id, 0.0, shot.left, shot.shown, shot.view.depth, shot.tissue)
             for shot in shots]  # fmt: skip
    near, far = depth_range(shown[::2])  # those that nothing is wrong with
    lines = [
        np.hstack([shrunk(shot.left), shrunk(shot.right), shrunk(each.render), depth_tile(each, near, far)])
        for shot, each in zip(shots, shown, strict=True)
    ]
    return cv2.imencode(".png", np.vstack(lines)[..., ::-1])[1].tobytes()
