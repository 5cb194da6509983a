"""Where a robot says that a tool's tip is, and what the image corrects of that.

A robot knows well how a tip moves, and badly where it is: joints, base frames and hand-eye are off by some
millimetres and degrees. In the camera's frame all of that is one small rigid motion that changes slowly
(the lumped error of Richter, Lu, Orosco and Yip, 2021, "Robotic tool tracking under partially visible
kinematic chain"). A Kalman filter learns it from the tips that both eyes see. How a tool points is not taken
from the image: the turn is learnt from how the tips are off in several places.
"""

import cv2
import numpy as np

from sags_node.geometry import project
from sags_node.instruments.outlines import Outline
from sags_node.types import F64, Camera

NINE_OF_TEN = 1.645  # standard deviations
TURN = np.radians(4.0)  # rad, about each axis: standard deviation of the error before any correction
DRIFT = np.array([*3 * [np.radians(0.2)], *3 * [5e-4]]) ** 2  # rad^2/s, m^2/s: process noise
ALIKE_NS = 1_000_000_000  # tips seen within this time share their error: together they count as one
ACROSS = 0.5  # error of a seen tip across the ray, over that along the ray
WRONG = 11.3  # chi-squared of three numbers that 1 of 100 exceeds: a seen tip that is farther off is ignored
SEEN = np.arange(0, 0.06, 5e-4)  # m from the tip, of the part of a tool that is looked for in the image
BESIDE = 0.005  # m, plus the tip's error: how far an outline may lie beside a tool
NEAREST = 0.01  # m: a tool that is nearer to the camera is not looked for


class Arm:
    """One tool, told by its robot; lengths and directions are in the left camera.

    Args:
        number: of its instrument.
        error: m, nine of ten of its tips are nearer than this to where the robot says.

    Attributes:
        is_corrected: the image has corrected it.
    """

    def __init__(self, number: int, error: float) -> None:
        self.number, self.error = number, error
        self.is_corrected = False
        self._off = np.zeros(6)  # rad about the pivot, then m
        self._spread = np.diag([*3 * [TURN], *3 * [error / (NINE_OF_TEN * np.sqrt(3))]]) ** 2
        self._most = np.diag(self._spread).copy()
        self._pivot = np.full(3, np.nan)
        self._told_ns = self._learnt_ns = 0

    def move(self, T_cam_tool: F64, t_ns: int) -> None:
        """Take the pose [4, 4] that the robot tells now: that of the tip, out of which z points."""
        self._tip, self._axis = T_cam_tool[:3, 3], T_cam_tool[:3, 2]
        if np.isnan(self._pivot[0]):
            self._pivot, self._told_ns = self._tip, t_ns
        older = max(0, t_ns - self._told_ns) * 1e-9
        grown = np.diag(self._spread) + older * DRIFT
        self._spread[np.diag_indices(6)] = np.maximum(np.diag(self._spread), np.minimum(grown, self._most))
        self._told_ns = t_ns
        self._learnt_ns = min(self._learnt_ns, t_ns)  # of a clock that was set back

    @property
    def tip(self) -> F64:
        """The corrected tip [3], m."""
        return np.asarray(self._pivot + self._turn @ (self._tip - self._pivot) + self._off[3:], np.float64)

    @property
    def axis(self) -> F64:
        """The corrected unit vector [3] from the shaft to the tip."""
        return np.asarray(self._turn @ self._axis, np.float64)

    @property
    def tip_error(self) -> float:
        """The error (m) that nine of ten tips are expected to stay below."""
        ways = self._ways()
        return NINE_OF_TEN * float(np.sqrt(np.trace(ways @ self._spread @ ways.T)))

    @property
    def axis_error(self) -> float:
        """The error (rad) that nine of ten axes are expected to stay below."""
        return NINE_OF_TEN * float(np.sqrt(np.linalg.eigvalsh(self._spread[:3, :3])[1:].sum()))

    def learn(self, tip: F64, error: float) -> None:
        """Correct it by a tip [3] that the eyes saw, with its error (m). A tip too far off is ignored."""
        share = min(1.0, (self._told_ns - self._learnt_ns) / ALIKE_NS) if self.is_corrected else 1.0
        if share <= 0:
            return
        ray, ways = tip / np.linalg.norm(tip), self._ways()
        seen = (error / NINE_OF_TEN) ** 2 * (ACROSS**2 * np.eye(3) + (1 - ACROSS**2) * np.outer(ray, ray))
        among = ways @ self._spread @ ways.T + seen / share
        off = tip - self.tip
        if off @ np.linalg.solve(among, off) > WRONG:
            return
        gain = np.linalg.solve(among, ways @ self._spread).T
        self._off = self._off + gain @ off
        self._spread = self._spread - gain @ ways @ self._spread
        self._spread = 0.5 * (self._spread + self._spread.T)
        self.is_corrected, self._learnt_ns = True, self._told_ns

    @property
    def _turn(self) -> F64:
        return np.asarray(cv2.Rodrigues(self._off[:3])[0], np.float64)

    def _ways(self) -> F64:
        """The Jacobian [3, 6] of the tip with respect to the correction (turn, shift)."""
        x, y, z = self.tip - self._pivot - self._off[3:]
        return np.hstack([np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]]), np.eye(3)])


def seen_as(arms: list[Arm], outlines: list[Outline], camera: Camera) -> dict[int, int]:
    """Return the outline of each arm that has one: both lie along one line in the image. Closest first."""
    here = Camera(camera.width, camera.height, camera.K, np.eye(4))
    pairs = []
    for number, arm in enumerate(arms):
        pixels, depths = project(here, arm.tip - SEEN[:, None] * arm.axis)
        if depths[0] < NEAREST:
            continue
        line = pixels[depths >= NEAREST]
        for row, outline in enumerate(outlines):
            ends = np.stack([outline.far, outline.back])
            aside = np.linalg.norm(ends[:, None] - line, axis=2).min(1).max()
            off = float(aside * depths[0] / camera.K[0, 0])
            if off <= arm.tip_error + BESIDE:
                pairs.append((off, number, row))
    found: dict[int, int] = {}
    for _, number, row in sorted(pairs):
        if number not in found and row not in found.values():
            found[number] = row
    return found
