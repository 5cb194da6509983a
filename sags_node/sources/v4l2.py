"""Live stereo from V4L2: two cameras paired by their stamps, or one whose pictures show both eyes."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial

from sags_node.config.schema import V4l2Source
from sags_node.errors import UsageError
from sags_node.sources.device import Device
from sags_node.sources.live import CaptureDevice, Input, LiveStereo
from sags_node.sources.live_pairs import LivePairs
from sags_node.types import Side


def open_cameras(
    config: V4l2Source,
    size: tuple[int, int] | None = None,
    open_device: Callable[[str, V4l2Source], CaptureDevice] = Device,
) -> LiveStereo:
    """Open the cameras of a launch file.

    Args:
        config: devices, size, rate, and how far apart the stamps of a pair may be.
        size: width and height that an eye's pictures must have, px.
        open_device: opens one camera.

    Raises:
        UsageError: the devices named cannot make a stereo pair, or not of this size.
        SagsError: a device is missing, cannot be opened, or gives another size.
    """
    sides: dict[str, Side | None] = {config.left: None}
    if config.geometry.layout == "separate":
        sides = {config.left: "left", _right_path(config): "right"}
    inputs = [
        Input(path, side, partial(open_device, path, config), config.deadline) for path, side in sides.items()
    ]
    pairs = LivePairs(config.pair_tolerance_ms, config.latency_ms)
    return LiveStereo(inputs, config.geometry, pairs, size)


def _right_path(config: V4l2Source) -> str:
    if config.right is None:
        raise UsageError("source.right names no camera; name one, or set source.geometry.layout")
    if os.path.realpath(config.left) == os.path.realpath(config.right):
        raise UsageError(f"source.left and source.right are the same camera, {config.right}")
    return config.right
