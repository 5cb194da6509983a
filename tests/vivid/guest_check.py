"""Runs inside the guest, as root, with two vivid cameras: prints one line `RESULT {json}` on the console.

tests/sources/test_v4l2_vivid.py holds what must be true of it.
"""

import json
import logging
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

from sags_node.config.schema import GeometryConfig, V4l2Source
from sags_node.errors import SagsError
from sags_node.sources.source import open_source
from sags_node.types import StereoFrame

DRIVER = Path("/sys/bus/platform/drivers/vivid")
TWO = V4l2Source(left="/dev/video0", right="/dev/video1", width=320, height=180, rate=30, deadline=0.5)
HALVES = GeometryConfig(layout="side_by_side")
ONE = V4l2Source(left="/dev/video0", right=None, geometry=HALVES, width=640, height=360, rate=15)


def facts(frames: list[StereoFrame]) -> dict[str, Any]:
    left = [frame.t_capture_ns for frame in frames]
    right = [frame.t_capture_right_ns for frame in frames]
    return {
        "frames": len(frames),
        "sizes": sorted({frame.left.shape for frame in frames} | {frame.right.shape for frame in frames}),
        "left_advances": all(b > a for a, b in pairwise(left)),
        "right_advances": all(b > a for a, b in pairwise(right)),
        "largest_skew_ms": max(abs(a - b) for a, b in zip(left, right, strict=True)) / 1e6,
        "ids_advance": all(b.frame_id > a.frame_id for a, b in pairwise(frames)),
        "age_ms": (time.time_ns() - left[-1]) / 1e6,
        "contrast": float(frames[-1].left.std()),
        "pictures_differ": bool((frames[0].left != frames[-1].left).any()),
    }


def take(config: V4l2Source, count: int) -> dict[str, Any]:
    frames = []
    with open_source(config) as source:
        for frame in source:
            frames.append(frame)
            if len(frames) == count:
                source.stop()
        return {**facts(frames), "rate": source.rate, "dropped": source.dropped}


def unplug_and_replug() -> dict[str, Any]:
    """Unbinding the driver makes both device files vanish under the open cameras, as pulling a plug does."""
    frames: list[StereoFrame] = []
    with open_source(TWO) as source:

        def keep_frames() -> None:
            for frame in source:
                frames.append(frame)

        taking = threading.Thread(target=keep_frames)
        taking.start()
        wait_for(lambda: len(frames) >= 3)
        (DRIVER / "unbind").write_text("vivid.0")
        vanished = not Path("/dev/video0").exists()
        time.sleep(0.5)
        before = len(frames)
        (DRIVER / "bind").write_text("vivid.0")
        wait_for(lambda: len(frames) >= before + 3)
        source.stop()
        taking.join(10)
    return {"vanished": vanished, "before": before, "after": len(frames), "ended": not taking.is_alive()}


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)


def message_of(config: V4l2Source) -> str:
    try:
        open_source(config)
    except SagsError as error:
        return str(error)
    return "no error"


def main() -> None:
    logging.basicConfig()
    result = {
        "two": take(TWO, 12),
        "side_by_side": take(ONE, 6),
        "wrong_size": message_of(TWO.model_copy(update={"width": 333, "height": 217})),
        "missing": message_of(TWO.model_copy(update={"right": "/dev/video7"})),
        "replug": unplug_and_replug(),
    }
    print("RESULT", json.dumps(result), flush=True)


main()
