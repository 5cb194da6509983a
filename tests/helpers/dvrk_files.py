"""Sessions of dVRK's `record`, in small."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bag_files as files
import cv2
import numpy as np
from bag_files import MS, START, picture


def frame_record(number: int, **realtime: int | None) -> dict[str, Any]:
    """As `dvrk_data:video_sidecar@1.0.0` has it."""
    stamp = START + number * 40 * MS
    seen = {
        "mono_source_ns": None,
        "left_source_ns": stamp,
        "right_source_ns": stamp + 3 * MS,
        "stereo_output_ns": stamp + 9 * MS,
        "overlay_output_ns": None,
        "recorder_reception_ns": stamp + 11 * MS,
        **realtime,
    }
    gst = dict.fromkeys(("dts_ns", "duration_ns", "running_time_ns", "stream_time_ns", "clock_time_ns"))
    return {
        "frame_index": number,
        "gst": {"pts_ns": 500 * MS + number * 40 * MS, **gst},
        "cpu": {"realtime": seen, "monotonic": {"recorder_reception_ns": number}},
    }


def write_session(folder: Path, frames: list[dict[str, Any]], shown: int = 8, order: str = "LR") -> Path:
    """A sidecar of these frames beside a video of `shown` frames at 25 Hz."""
    folder.mkdir()
    sidecar = {
        "type": "dvrk_data:video_sidecar@1.0.0",
        "video_file": "stereo.mp4",
        "stream_name": "stereo",
        "frames": frames,
        "side_by_side": order,
        "estimated_latency_ms": 0,
    }
    (folder / "stereo.json").write_text(json.dumps(sidecar, indent=1, sort_keys=True))  # as jsoncpp writes it
    (folder / "index.json").write_text("{}")
    video = cv2.VideoWriter(
        str(folder / "stereo.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (2 * files.WIDTH, files.HEIGHT)
    )
    for number in range(shown):
        eyes = [picture(number, 0), np.full_like(picture(0, 0), 200)]
        both = np.hstack(eyes if order == "LR" else eyes[::-1])
        video.write(cv2.cvtColor(both, cv2.COLOR_RGB2BGR))
    video.release()
    return folder
