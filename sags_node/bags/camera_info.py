"""What cameras say of their calibration in ROS (`CameraInfo`, REP 104), now and over a recording."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sags_node.bags.pictures import decode_message
from sags_node.errors import UsageError
from sags_node.messaging.topics import CAMERA_INFO
from sags_node.rig import MODELS, fit_distortion, part_of_sensor
from sags_node.types import I64, Eye

SAME = 1e-4  # of a number: less is rounding


class Said(NamedTuple):
    """A calibration, and since when it holds."""

    since_ns: int
    eye: Eye


def read_eye(data: bytes | memoryview, where: str) -> Eye | None:
    """The calibration in a `CameraInfo`, of pictures as they are sent: of the region that is read out, and
    binned; None: it says that the camera is not calibrated.

    Raises:
        SagsError: the message is damaged.
        UsageError: a distortion model that is not supported, or a region that is none.
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
    """The topic on which a camera says it, beside that of its pictures."""
    return pictures.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"


def changes(said: Sequence[Said]) -> list[Said]:
    """Return what is said, in order of time, without what says the same again."""
    kept: list[Said] = []
    for each in sorted(said, key=lambda one: one.since_ns):
        if not kept or not same(kept[-1].eye, each.eye):
            kept.append(each)
    return kept


def in_force(said: Sequence[Said], stamps: I64) -> I64:
    """Which of the `changes` each picture was taken with, [N]; before the first one, that."""
    since = np.array([each.since_ns for each in said], np.int64)
    return np.maximum(np.searchsorted(since, stamps, "right") - 1, 0)


def same(one: Eye, other: Eye) -> bool:
    """Tell whether two calibrations are equal but for rounding."""
    a, b = (
        np.concatenate([[eye.width, eye.height], *map(np.ravel, (eye.K, eye.R, eye.P, eye.distortion))])
        for eye in (one, other)
    )
    return len(a) == len(b) and np.allclose(a, b, rtol=SAME, atol=0.1 * SAME)
