"""Sessions of dVRK's `record`, in small."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from bag_files import MS, START, picture
from numbered_pictures import write_video


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
    eyes = [[picture(number, 0), np.full_like(picture(0, 0), 200)] for number in range(shown)]
    both = [np.hstack(pair if order == "LR" else pair[::-1]) for pair in eyes]
    write_video(folder / "stereo.mp4", both, codec="mp4v")
    return folder
