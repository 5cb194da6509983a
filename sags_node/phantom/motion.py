"""The clock of the phantom: periodic movements over the session's phase, 0 to 1."""

import cv2
import numpy as np

from sags_node.config.schema import CameraMotion
from sags_node.types import F64

_ACTION = 4.0  # s, about one grasp
BREATH = 4.0  # s
_HEARTBEAT = 0.8  # s
_SCOPE = 7.0  # s: no multiple of a breath, so that all places are seen in all states of the tissue
_ZOOM = 0.015  # m, in and out
CENTRE = np.array([0.0, 0.0, 0.078])  # m: what the scope looks at when it stands still
_ORBIT = 0.20, 0.15  # rad, sideways and upwards: arcs of 16 and 12 mm


class Clock:
    """Turns the phase of a session of `seconds` into those of its movements, which all make whole cycles."""

    def __init__(self, seconds: float) -> None:
        self._cycles = {p: max(1, round(seconds / p)) for p in (_ACTION, BREATH, _HEARTBEAT, _SCOPE)}

    def action(self, phase: float) -> float:
        """Return the phase 0..1 of the instruments' work."""
        return (phase * self._cycles[_ACTION]) % 1.0

    def breath(self, phase: float) -> float:
        """Return the phase angle of the breath, radians."""
        return 2 * np.pi * phase * self._cycles[BREATH]

    def heartbeat(self, phase: float) -> float:
        """Return the outward push, about -1..1: a quick stroke and a slow return."""
        angle = 2 * np.pi * phase * self._cycles[_HEARTBEAT]
        return float(0.75 * np.sin(angle) + 0.35 * np.sin(2 * angle))

    def scope(self, phase: float) -> float:
        """Return the phase 0..1 of the scope's round."""
        return (phase * self._cycles[_SCOPE]) % 1.0


def keyed(phase: float, keys: tuple[tuple[float, float], ...]) -> float:
    """Interpolate (phase, value) keys smoothly, at rest at every key; the first and last value must agree."""
    at, values = zip(*keys, strict=True)
    k = int(np.clip(np.searchsorted(at, phase, side="right") - 1, 0, len(keys) - 2))
    t = np.clip((phase - at[k]) / (at[k + 1] - at[k]), 0, 1)
    return float(values[k] + (values[k + 1] - values[k]) * t * t * (3 - 2 * t))


def scope_pose(phase: float, motion: CameraMotion) -> F64:
    """Return `T_world_cam` [4, 4] of the left rectified camera at a phase 0..1 of a round. A round starts and
    ends at identity."""
    pose = np.eye(4)
    once, twice = 2 * np.pi * phase, 4 * np.pi * phase
    if motion == "sway":
        pose[:3, :3] = _turned(0.020 * np.sin(twice), 0.030 * np.sin(once), 0.015 * np.sin(once))
        pose[:3, 3] = [0.0030 * np.sin(once), 0.0018 * np.sin(twice), 0.0020 * (1 - np.cos(once))]
    elif motion == "zoom":
        pose[2, 3] = _ZOOM * np.sin(once)
    elif motion == "orbit":
        sideways, upwards = _ORBIT
        pose[:3, :3] = _turned(0.5 * upwards * (1 - np.cos(once)), sideways * np.sin(once), 0.0)
        pose[:3, 3] = CENTRE - pose[:3, :3] @ CENTRE
    return pose


def _turned(x: float, y: float, z: float) -> F64:
    """Rotation [3, 3] by a vector, rad."""
    return np.asarray(cv2.Rodrigues(np.array([x, y, z]))[0], np.float64)
