"""The calibration that cameras publish in ROS (`CameraInfo`, REP 104), also as it changes over time."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sags_node.bags.pictures import decode_message
from sags_node.errors import UsageError
from sags_node.messaging.topics import CAMERA_INFO
from sags_node.rig import MODELS, fit_distortion, part_of_sensor
from sags_node.types import I64, Eye

SAME = 1e-4  # relative: smaller differences are rounding


class Said(NamedTuple):
    """A calibration and the time from which it holds."""

    since_ns: int
    eye: Eye


def read_eye(data: bytes | memoryview, where: str) -> Eye | None:
    """Read the calibration in a `CameraInfo`, for images as they are sent: with its region of interest and
    binning. None: the message says that the camera is not calibrated.

    Raises:
        SagsError: the message is damaged.
        UsageError: the distortion model is not supported, or the region is invalid.
    """
    message = decode_message(data, CAMERA_INFO, where)
    if message.k[0] == 0:
        return None
    if message.distortion_model not in ("", *MODELS):
        raise UsageError(
            f"{where}: distortion model {message.distortion_model!r} is not supported; calibrate with "
            "'plumb_bob' or 'rational_polynomial', or set rig"
        )
    eye = Eye(
        width=message.width,
        height=message.height,
        K=np.array(message.k, np.float64).reshape(3, 3),
        distortion=fit_distortion(np.asarray(message.d, np.float64), where),
        R=np.array(message.r, np.float64).reshape(3, 3),
        P=np.array(message.p, np.float64).reshape(3, 4),
    )
    roi = message.roi
    part = roi.x_offset, roi.y_offset, roi.width, roi.height
    return part_of_sensor(eye, part, (message.binning_x, message.binning_y), where)


def topic_of(pictures: str) -> str:
    """Return the camera_info topic that belongs to a topic of images."""
    return pictures.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"


def changes(said: Sequence[Said]) -> list[Said]:
    """Return the calibrations in order of time, without those that equal the one before."""
    kept: list[Said] = []
    for each in sorted(said, key=lambda one: one.since_ns):
        if not kept or not same(kept[-1].eye, each.eye):
            kept.append(each)
    return kept


def in_force(said: Sequence[Said], stamps: I64) -> I64:
    """Return for each image the index in `changes` of its calibration [N]; before the first, 0."""
    since = np.array([each.since_ns for each in said], np.int64)
    return np.maximum(np.searchsorted(since, stamps, "right") - 1, 0)


def same(one: Eye, other: Eye) -> bool:
    """Tell whether two calibrations are equal up to rounding."""
    a, b = (
        np.concatenate([[eye.width, eye.height], *map(np.ravel, (eye.K, eye.R, eye.P, eye.distortion))])
        for eye in (one, other)
    )
    return len(a) == len(b) and np.allclose(a, b, rtol=SAME, atol=0.1 * SAME)
