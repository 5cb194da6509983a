"""How far estimated camera poses are from known ones."""

import cv2
import numpy as np

from sags_node.geometry import invert, rigid, unproject
from sags_node.types import F32, F64, U8, Bool, Camera

CORNERS = 500
CORNER_QUALITY = 0.005
CORNER_DISTANCE = 8  # px
REPROJECTION = 2.0  # px, of an inlier in RANSAC
LEAST_POINTS = 12


def trajectory_errors(estimated: F64, known: F64) -> dict[str, float]:
    """Compare estimated with known poses `T_world_cam` [T, 4, 4].

    The worlds are aligned at the first frame, without scale. ATE is the root mean square distance of the
    camera's places; RPE that of the motions from one frame to the next, in mm and in degrees.
    """
    ours = np.linalg.inv(estimated[0]) @ estimated
    true = np.linalg.inv(known[0]) @ known
    distances = np.linalg.norm(ours[:, :3, 3] - true[:, :3, 3], axis=1) * 1e3
    errors = np.linalg.inv(_steps(true)) @ _steps(ours)
    turns = [np.linalg.norm(cv2.Rodrigues(error[:3, :3])[0]) for error in errors]
    return {
        "ate_mm": _rms(distances),
        "max_mm": float(distances.max()),
        "rpe_mm": _rms(np.linalg.norm(errors[:, :3, 3], axis=1) * 1e3),
        "rpe_deg": _rms(np.degrees(turns)),
    }


def _steps(poses: F64) -> F64:
    return np.asarray(np.linalg.inv(poses[:-1]) @ poses[1:])


def _rms(values: F64) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


class RigidOdometry:
    """The baseline: corners followed from frame to frame (Lucas-Kanade), their depths, and the pose that
    most of them agree with (PnP with RANSAC). It has no model and nothing to return to."""

    def __init__(self) -> None:
        self._pose = np.eye(4)
        self._before: tuple[U8, F32, Bool] | None = None

    def __call__(self, image: U8, depth: F32, tissue: Bool, camera: Camera) -> F64:
        """`T_world_cam` [4, 4] of the next frame; where it finds no motion, that of the frame before.

        Args:
            image: [H, W, 3] RGB.
            depth: [H, W] m, 0 unknown.
            tissue: [H, W].
            camera: its `K` is used.
        """
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if self._before is not None:
            self._pose = self._pose @ _motion(*self._before, gray, tissue, camera.K)
        self._before = gray, depth, tissue
        return self._pose


def _motion(before: U8, depth: F32, tissue: Bool, after: U8, tissue_after: Bool, K: F64) -> F64:
    """Pose [4, 4] of the later camera in the earlier one's axes."""
    where = (tissue & (depth > 0)).view(np.uint8)
    corners = cv2.goodFeaturesToTrack(before, CORNERS, CORNER_QUALITY, CORNER_DISTANCE, mask=where)
    if corners is None:
        return np.eye(4)
    found, status, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)
    height, width = before.shape
    places = np.rint(found[:, 0]).astype(np.intp)
    good = (status[:, 0] > 0) & (places >= 0).all(1) & (places < [width, height]).all(1)
    good[good] = tissue_after[places[good, 1], places[good, 0]]
    if np.count_nonzero(good) < LEAST_POINTS:
        return np.eye(4)
    pixels = corners[good, 0].astype(np.float64)
    columns, rows = np.rint(pixels).astype(np.intp).T
    points = unproject(Camera(width, height, K, np.eye(4)), pixels, depth[rows, columns].astype(np.float64))
    solved, rotation, translation, inliers = cv2.solvePnPRansac(
        points, found[good, 0].astype(np.float64), K, None, reprojectionError=REPROJECTION
    )
    if not solved or inliers is None or len(inliers) < LEAST_POINTS:
        return np.eye(4)
    return invert(rigid(cv2.Rodrigues(rotation)[0], translation[:, 0]))
