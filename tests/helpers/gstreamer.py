"""GStreamer on this machine: is it there, and files that it can play to the pixel."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from waiting import until

from benchmarks.node.processes import children
from sags_node.errors import SagsError
from sags_node.sources.gst_process import installed

NEEDED = ("appsink", "videoconvert", "videotestsrc", "deinterlace")
BALL = (
    "videotestsrc is-live=true pattern=ball animation-mode=wall-time motion=sweep"  # goes round in a second
)


def need_gstreamer(*more: str) -> None:
    """Skip where packages of the Makefile's DEBIAN_TESTS are missing; `more`: elements beyond the usual."""
    try:
        version, missing = installed()
    except SagsError as error:
        pytest.skip(str(error))
    absent = {missing[name]: name for name in (*NEEDED, *more) if name in missing}
    if absent:
        pytest.skip(f"{version} has no {', '.join(absent.values())}; install {' '.join(absent)}")


def ball_moment(picture: np.ndarray) -> float:
    """The fraction of the wall clock's second at which `BALL` was drawn: one frame before its stamp."""
    rows, columns = np.nonzero(picture[..., 0] > 100)
    height, width = picture.shape[:2]
    turn = np.arctan2(rows.mean() - (height - 1) / 2, columns.mean() - (width - 1) / 2)
    return float((turn / (2 * np.pi) + 0.25) % 1)


def apart(one: float, other: float) -> float:
    """How long between two fractions of a second, the shorter way, s."""
    return abs((one - other + 0.5) % 1 - 0.5)


def raw_file(file: Path, pictures: np.ndarray, rate: int, interlaced: bool = False) -> str:
    """Write images [T, H, W, 3] (or gray [T, H, W] uint16) and return the launch string that plays them."""
    height, width = pictures.shape[1:3]
    rows = np.ascontiguousarray(pictures).view(np.uint8).reshape(len(pictures), height, -1)
    padding = -rows.shape[2] % 4  # GStreamer's rows end at multiples of 4 bytes
    file.write_bytes(np.pad(rows, ((0, 0), (0, 0), (0, padding))).tobytes())
    kind = "gray16-le" if pictures.dtype == np.uint16 else "rgb"
    fields = "interlaced=true top-field-first=true" if interlaced else ""
    return (
        f"filesrc location={file} ! rawvideoparse format={kind} width={width} height={height} "
        f"framerate={rate}/1 {fields}"
    )


def pipelines() -> list[int]:
    """Process ids of the pipelines that this process runs."""
    return children("gst_child")


def kill_pipelines() -> None:
    """Wait for one, since it may have been started this moment, and kill all."""
    until(pipelines)
    for process in pipelines():
        os.kill(process, signal.SIGKILL)
