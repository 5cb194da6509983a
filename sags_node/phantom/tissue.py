"""The deforming tissue: where every material point is at every phase of the session."""

import numpy as np

from sags_node.phantom.motion import Clock, keyed
from sags_node.phantom.relief import Relief
from sags_node.phantom.vectors import normalized
from sags_node.types import F32, F64, I64

LIFT = np.array([-0.0015, 0.0020, -0.0125])  # m, how far the grip is pulled up, and aside
LIFT_KEYS = ((0.0, 0.0), (0.20, 0.0), (0.45, 1.0), (0.58, 1.0), (0.80, 0.0), (1.0, 0.0))
BREATH_LIFT = 0.0012  # m
HEART_PUSH = 0.0008  # m


class Tissue:
    """A triangle mesh over the relief's grid; its vertices move, its material coordinates do not."""

    def __init__(self, relief: Relief, clock: Clock) -> None:
        self.relief = relief
        self._clock = clock
        rest = relief.positions
        rows, cols = rest.shape[:2]
        corner = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).ravel()
        upper = np.stack([corner, corner + 1, corner + cols], -1)
        lower = np.stack([corner + cols + 1, corner + cols, corner + 1], -1)
        # Even faces are the upper-left half of a cell, odd ones the lower-right half.
        self.faces = np.stack([upper, lower], 1).reshape(-1, 3).astype(np.uint32)

        x, y = rest[..., 0], rest[..., 1]
        grip_row, grip_col = relief.grip
        from_grip = rest[..., :2] - rest[grip_row, grip_col, :2]
        along = from_grip @ relief.grip_axis.astype(np.float32)
        across_axis = np.array([-relief.grip_axis[1], relief.grip_axis[0]], np.float32)
        across = from_grip @ across_axis
        wide = np.exp(-0.5 * ((along / 0.017) ** 2 + (across / 0.012) ** 2))
        sharp = np.exp(-0.5 * ((along / 0.0065) ** 2 + (across / 0.0045) ** 2))
        pinched = np.exp(-0.5 * ((along / 0.008) ** 2 + (across / 0.006) ** 2))
        lifted = (0.55 * wide + 0.45 * sharp)[..., None] * LIFT.astype(np.float32)
        lifted[..., :2] -= (0.60 * pinched * across)[..., None] * across_axis
        self._lifted = lifted

        self._breath_delay = 14.0 * y + 6.0 * x  # radians: the wave comes from the diaphragm, far side first
        self._breath_gain = 1.0 + 6.0 * x
        heart_x, heart_y = float(0.35 * relief.x[-1]), float(0.45 * relief.y[0])
        near_heart = np.exp(-0.5 * ((x - heart_x) ** 2 + (y - heart_y) ** 2) / 0.014**2)
        self._heart_push = near_heart[..., None] * np.array([0.0002, 0.0003, -1.0 * HEART_PUSH], np.float32)

    def vertices(self, phase: float) -> F32:
        """Return the positions [rows, cols, 3] (m, world) at a phase 0..1 of the session."""
        breath = self._breath_gain * np.sin(self._clock.breath(phase) - self._breath_delay)
        positions = self.relief.positions + np.float32(self.lift(phase)) * self._lifted
        positions += np.float32(self._clock.heartbeat(phase)) * self._heart_push
        positions[..., 1] += (0.4 * BREATH_LIFT) * breath
        positions[..., 2] -= BREATH_LIFT * breath
        return np.asarray(positions, np.float32)

    def lift(self, phase: float) -> float:
        """Return how far the grip is pulled, 0..1."""
        return keyed(self._clock.action(phase), LIFT_KEYS)

    def grip(self, vertices: F32) -> F64:
        """Return the gripped point [3] (m, world)."""
        return np.asarray(vertices[self.relief.grip], np.float64)

    def track_indices(self, rng: np.random.Generator, half_view: tuple[float, float], count: int) -> I64:
        """Choose the tracked surface points: flat indices [count] of vertices spread over the view."""
        rest = self.relief.positions
        inside = np.abs(rest[..., :2] / rest[..., 2:]) < 0.92 * np.array(half_view)
        candidates = np.flatnonzero(inside.all(-1))
        return np.sort(rng.choice(candidates, count, replace=False))


def vertex_normals(vertices: F32) -> F32:
    """Return the unit normals [rows, cols, 3] of a grid surface, towards the camera (negative z)."""
    along_row = np.empty_like(vertices)
    along_row[:, 1:-1] = vertices[:, 2:] - vertices[:, :-2]
    along_row[:, 0], along_row[:, -1] = along_row[:, 1], along_row[:, -2]
    down = np.empty_like(vertices)
    down[1:-1] = vertices[2:] - vertices[:-2]
    down[0], down[-1] = down[1], down[-2]
    return normalized(np.cross(down, along_row))
