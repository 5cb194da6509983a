"""A stereo rig from views of a board: both cameras first (Zhang, PAMI 2000), then all together."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.errors import SagsError
from sags_node.rig.rig import fit_distortion, rectify_eyes
from sags_node.tools.calibration.boards import StereoView
from sags_node.types import F32, F64, StereoRig

FEWEST_VIEWS = 6
OUTLIER = 3.0  # times the median error of all views
OUTLIER_PX = 0.3  # px above it: where all views are very good, none is an outlier
ROUNDS = 5
LARGEST_ERROR = 2.0  # px, of all views together: beyond it the board is another one
FLAGS = {2: cv2.CALIB_FIX_K3, 3: 0, 6: cv2.CALIB_RATIONAL_MODEL}  # by the number of radial coefficients
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9)


@dataclass(frozen=True, slots=True)
class Solution:
    """A rig and how well each view fits it."""

    rig: StereoRig
    views: list[StereoView]  # used
    errors: F64  # [V, 2] px, root mean square per view and eye
    dropped: dict[str, float]  # view -> its larger error, px, when it was left out
    board_poses: F64  # [V, 4, 4] m, board to left camera

    @property
    def error(self) -> float:
        """The root mean square error over all views, px."""
        return float(np.sqrt(np.mean(np.square(self.errors))))

    @property
    def matches(self) -> F64:
        """The corners of all views, [M, 4], as `match_eyes` gives points."""
        return np.concatenate([np.hstack([view.left, view.right]) for view in self.views]).astype(np.float64)


def calibrate(
    name: str, views: Sequence[StereoView], points: F32, size: tuple[int, int], coefficients: int = 2
) -> Solution:
    """Calibrate and rectify a rig; views that fit far worse than the rest are left out.

    Args:
        views: of one board.
        points: [N, 3] m, the board's corners by id.
        size: width and height of the images, px.
        coefficients: of radial distortion: 2, 3 or 6 (rational_polynomial).

    Raises:
        SagsError: there are too few views, or they do not fit one rig.
    """
    used, dropped = list(views), dict[str, float]()
    for _ in range(ROUNDS):
        if len(used) < FEWEST_VIEWS:
            lost = f" ({len(dropped)} more did not fit)" if dropped else ""
            raise SagsError(
                f"{len(used)} usable views of the board{lost}; {FEWEST_VIEWS} are needed, 20 are good: take "
                "more images, with the whole image covered and the board tilted"
            )
        solution = _solve(name, used, points, size, coefficients, dropped)
        worst = solution.errors.max(1)
        limit = max(OUTLIER * np.median(worst), np.median(worst) + OUTLIER_PX)
        outliers = worst > limit
        if not outliers.any():
            break
        dropped |= {
            view.name: float(error) for view, error, out in zip(used, worst, outliers, strict=True) if out
        }
        used = [view for view, out in zip(used, outliers, strict=True) if not out]
    if solution.error > LARGEST_ERROR:
        raise SagsError(
            f"the views fit one rig only to {solution.error:.1f} px: check --squares, that the board is "
            "flat, and that left and right images of a pair were taken at the same moment"
        )
    return solution


def _solve(
    name: str,
    views: list[StereoView],
    points: F32,
    size: tuple[int, int],
    coefficients: int,
    dropped: dict[str, float],
) -> Solution:
    boards = [points[view.ids] for view in views]
    left, right = [view.left for view in views], [view.right for view in views]
    flags = FLAGS[coefficients]
    try:
        (K_left, d_left), (K_right, d_right) = (
            cv2.calibrateCamera(boards, corners, size, None, None, flags=flags, criteria=CRITERIA)[1:3]
            for corners in (left, right)
        )
        _, K_left, d_left, K_right, d_right, R, T, _, _, rvecs, tvecs, errors = cv2.stereoCalibrateExtended(
            *(boards, left, right, K_left, d_left, K_right, d_right, size, None, None),
            flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
            criteria=CRITERIA,
        )
    except cv2.error as error:
        raise SagsError(
            f"no camera explains these views ({' '.join(error.err.split())}); check --squares, and that the "
            "board is seen from several directions"
        ) from None
    fitted = [fit_distortion(d.ravel(), name) for d in (d_left, d_right)]
    rig = rectify_eyes(name, size, (K_left, K_right), (fitted[0], fitted[1]), R, T.ravel())
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    poses[:, :3, :3] = [cv2.Rodrigues(rvec)[0] for rvec in rvecs]
    poses[:, :3, 3] = np.reshape(tvecs, (-1, 3))
    return Solution(rig, views, errors, dict(dropped), poses)
