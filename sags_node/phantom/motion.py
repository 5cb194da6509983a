"""The clock of the phantom: periodic movements over the session's phase, 0 to 1."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.types import F64

_ACTION = 4.0  # s, about one grasp
_BREATH = 4.0  # s
_HEARTBEAT = 0.8  # s


class Clock:
    """Turns the phase of a session of `seconds` into the phases of its movements; all close at the end."""

    def __init__(self, seconds: float) -> None:
        self._cycles = {p: max(1, round(seconds / p)) for p in (_ACTION, _BREATH, _HEARTBEAT)}

    def action(self, phase: float) -> float:
        """Phase 0..1 of the instruments' work."""
        return (phase * self._cycles[_ACTION]) % 1.0

    def breath(self, phase: float) -> float:
        """Angle of breathing, radians."""
        return 2 * np.pi * phase * self._cycles[_BREATH]

    def heartbeat(self, phase: float) -> float:
        """Outward push -1..1: a quick stroke and a slow return."""
        angle = 2 * np.pi * phase * self._cycles[_HEARTBEAT]
        return float(0.75 * np.sin(angle) + 0.35 * np.sin(2 * angle))


def keyed(phase: float, keys: tuple[tuple[float, float], ...]) -> float:
    """Value at `phase` between (phase, value) keys, at rest at every key; the first and last must agree."""
    at, values = zip(*keys, strict=True)
    k = int(np.clip(np.searchsorted(at, phase, side="right") - 1, 0, len(keys) - 2))
    t = np.clip((phase - at[k]) / (at[k + 1] - at[k]), 0, 1)
    return float(values[k] + (values[k + 1] - values[k]) * t * t * (3 - 2 * t))


def scope_pose(phase: float, moving: bool) -> F64:
    """`T_world_cam` [4, 4] of the left rectified camera: a slow sway that starts and ends at identity."""
    pose = np.eye(4)
    if moving:
        once, twice = 2 * np.pi * phase, 4 * np.pi * phase
        pose[:3, :3] = cv2.Rodrigues(
            np.array([0.020 * np.sin(twice), 0.030 * np.sin(once), 0.015 * np.sin(once)])
        )[0]
        pose[:3, 3] = [0.0030 * np.sin(once), 0.0018 * np.sin(twice), 0.0020 * (1 - np.cos(once))]
    return pose
