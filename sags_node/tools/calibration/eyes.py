"""What a source gives for each eye, as one image: is it split, cropped and turned as it should be?"""

import threading
import time
from typing import Any

import cv2
import numpy as np

from sags_node.config.schema import LaunchConfig
from sags_node.errors import SagsError
from sags_node.sources.source import open_source
from sags_node.types import U8, StereoFrame

WIDEST = 960  # px of an eye in the image
LINES = 8  # drawn across both eyes: the same tissue must lie near the same line
SILENT_S = 20.0  # a source may give no frame for so long
LINE, TEXT, SHADE = (255, 220, 0), (255, 255, 255), (0, 0, 0)  # RGB


def look(config: LaunchConfig, seconds: float) -> tuple[U8, dict[str, Any]]:
    """Watch a source for some seconds.

    Returns:
        The last pair side by side [h, w, 3] RGB, and what was found: `width`, `height` (px), `frames_per_s`,
        `skew_ms` (stamp of the right eye minus the left one's), `age_ms` (from capture until the frame was
        here) and `dropped` (images without a partner).

    Raises:
        SagsError: the source fails, or gives no frame.
    """
    count, first, last, came_ns = 0, None, None, 0
    with open_source(config.source, references=False) as source:
        timer = threading.Timer(seconds + SILENT_S, source.stop)
        timer.daemon = True
        timer.start()
        began = time.monotonic()
        for frame in source:
            count, first, last, came_ns = count + 1, first or frame, frame, time.time_ns()
            if time.monotonic() - began > seconds:
                break
        timer.cancel()
        dropped = source.dropped
    if first is None or last is None:
        raise SagsError(f"no pair of images came within {seconds + SILENT_S:g} s")
    took_ns = last.t_capture_ns - first.t_capture_ns
    return _side_by_side(last), {
        "width": last.left.shape[1],
        "height": last.left.shape[0],
        "frames_per_s": round((count - 1) * 1e9 / took_ns, 1) if took_ns > 0 else None,
        "skew_ms": round((last.t_capture_right_ns - last.t_capture_ns) * 1e-6, 2),
        "age_ms": round((came_ns - last.t_capture_ns) * 1e-6, 1),
        "dropped": dropped,
    }


def _side_by_side(frame: StereoFrame) -> U8:
    named = [(frame.left, "LEFT"), (frame.right, "RIGHT")]
    return np.hstack([_labelled(picture, name) for picture, name in named if picture is not None])


def _labelled(picture: U8, name: str) -> U8:
    height, width = picture.shape[:2]
    scale = min(1.0, WIDEST / width)
    shown = cv2.resize(picture, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    for line in range(1, LINES):
        y = line * shown.shape[0] // LINES
        shown[y] = LINE
    for color, thickness in ((SHADE, 5), (TEXT, 2)):
        cv2.putText(shown, name, (12, 34), cv2.FONT_HERSHEY_SIMPLEX, 1.0, color, thickness, cv2.LINE_AA)
    return np.asarray(shown, np.uint8)
