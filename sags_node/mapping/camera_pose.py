"""The camera's pose from points of the model that were found again in an image: robust least squares."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.geometry import disparity_to_depth, invert, rigid
from sags_node.kernels.jit import inlined, kernel
from sags_node.types import F32, F64, Camera, Observation

ROUNDS = 8
SPREADS = 2.0  # standard deviations of the residuals beyond which a point counts less than a quarter
SMALLEST_SCALE = 0.3  # px: optical flow is no more exact
FIRST_SCALE = 8.0  # px: so that the start may be that far off
INLIER = 0.25  # weight: the residual is below the scale
DAMPING = 1e-6  # of the largest diagonal element: directions that no residual constrains stay at rest
CONVERGED = 1e-6  # m and rad
NEAREST = 1e-3  # m: nearer points have no weight
LARGEST = 1e12  # px^2: no honest residual comes near


@dataclass(frozen=True, slots=True)
class PoseFit:
    """A camera pose, and how well the points agree with it."""

    T_world_cam: F64  # [4, 4]
    weights: F32  # [M] 0..1: how far each point is believed
    scale: float  # px: residuals beyond it count less than a quarter

    @property
    def inliers(self) -> int:
        return int(np.count_nonzero(self.weights > INLIER))


def fit_pose(points: F32, pixels: F32, disparities: F32, camera: Camera, baseline: float) -> PoseFit:
    """The pose from which most of the points are seen where they were found.

    Gauss-Newton on SE(3), on residuals in px: of the place, and of the disparity where it was measured, as
    ORB-SLAM2 does (R. Mur-Artal and J. D. Tardos, T-RO 2017). The robust weights are Geman and McClure's;
    their scale starts wide and follows the median (graduated non-convexity), so that a large minority that
    moves otherwise is given up.

    Args:
        points: [M, 3] m, world.
        pixels: [M, 2] where they were found.
        disparities: [M] px, 0: not measured.
        camera: the pose to start from.
        baseline: m.
    """
    view = camera.viewmat.copy()
    focal = float(camera.K[0, 0])
    intrinsics = np.array([focal, camera.K[1, 1], camera.K[0, 2], camera.K[1, 2], focal * baseline])
    weights, squares = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    scale = FIRST_SCALE
    for _ in range(ROUNDS):
        normal, gradient = _normal_equations(
            view, intrinsics, points, pixels, disparities, scale * scale, weights, squares
        )
        normal.flat[::7] += DAMPING * normal.max() + 1e-12  # the diagonal
        twist = np.asarray(-np.linalg.solve(normal, gradient), np.float64)
        view = exponential(twist) @ view
        spread = SPREADS * 1.4826 * float(np.sqrt(np.median(squares) / 2)) if len(squares) else 0.0
        widest, scale = scale, min(max(scale / 2, spread, SMALLEST_SCALE), FIRST_SCALE)
        if scale >= 0.9 * widest and np.abs(twist).max() < CONVERGED:
            break
    view[:3, :3] = cv2.Rodrigues(cv2.Rodrigues(view[:3, :3])[0])[0]  # orthonormal again: poses are chained
    return PoseFit(invert(view), weights, scale)


def at_pixels(picture: NDArray[Any], pixels: F32) -> NDArray[Any]:
    """Values [N] of an image [H, W] at pixels [N, 2] in it."""
    columns, rows = (pixels + np.float32(0.5)).astype(np.intp).T
    return np.asarray(picture[rows, columns])


def disparities_at(observation: Observation, pixels: F32) -> F32:
    """Disparities [N] px that were measured at pixels [N, 2]; 0: none was."""
    depths, focal = at_pixels(observation.depth, pixels), float(observation.camera.K[0, 0])
    return disparity_to_depth(depths, focal, observation.baseline)  # the formula is its own inverse


def exponential(twist: F64) -> F64:
    """Rigid transform [4, 4] of a small motion [6]: translation (m), then rotation vector (rad)."""
    return rigid(cv2.Rodrigues(twist[3:])[0], twist[:3])


def towards(start: F64, end: F64, share: float) -> F64:
    """The pose [4, 4] at a share of the way from `start` to `end`, which lie near each other."""
    motion = invert(start) @ end
    twist = np.concatenate([motion[:3, 3], cv2.Rodrigues(motion[:3, :3])[0][:, 0]])
    pose: F64 = start @ exponential(share * twist)
    pose[:3, :3] = cv2.Rodrigues(cv2.Rodrigues(pose[:3, :3])[0])[0]  # orthonormal again: poses are chained
    return pose


@kernel
def _normal_equations(
    view: F64, intrinsics: F64, points: F32, pixels: F32, disparities: F32,
    scale2: float, weights: F32, squares: F32,
) -> tuple[F64, F64]:  # fmt: skip
    """J^T W J [6, 6] and J^T W r [6] for a twist on the left of the view matrix; writes each point's weight
    and squared residual (px^2). What lies behind the camera or is not finite has no weight."""
    normal, gradient = np.zeros((6, 6)), np.zeros(6)
    jacobian, residual, p = np.zeros((3, 6)), np.zeros(3), np.zeros(3)
    fx, fy, cx, cy, focal_baseline = intrinsics
    for i in range(len(points)):
        for k in range(3):
            p[k] = view[k, 3]
            for a in range(3):
                p[k] += view[k, a] * points[i, a]
        weights[i], squares[i] = 0, np.inf
        if not p[2] > NEAREST:
            continue
        rows = 3 if disparities[i] > 0 else 2
        x, y, per_z = p[0] / p[2], p[1] / p[2], 1 / p[2]
        residual[0] = fx * x + cx - pixels[i, 0]
        residual[1] = fy * y + cy - pixels[i, 1]
        residual[2] = focal_baseline * per_z - disparities[i]
        square = residual[0] ** 2 + residual[1] ** 2
        if rows == 3:
            square += residual[2] ** 2
        if not square < LARGEST:
            continue
        _chain(jacobian[0], p, fx * per_z, 0.0, -fx * x * per_z)
        _chain(jacobian[1], p, 0.0, fy * per_z, -fy * y * per_z)
        _chain(jacobian[2], p, 0.0, 0.0, -focal_baseline * per_z * per_z)
        weight = (scale2 / (scale2 + square)) ** 2
        weights[i], squares[i] = weight, square
        for r in range(rows):
            for a in range(6):
                gradient[a] += weight * jacobian[r, a] * residual[r]
                for b in range(a + 1):
                    normal[a, b] += weight * jacobian[r, a] * jacobian[r, b]
    for a in range(6):
        for b in range(a):
            normal[b, a] = normal[a, b]
    return normal, gradient


@inlined
def _chain(row: F64, p: F64, gx: float, gy: float, gz: float) -> None:
    """Chain rule: the derivative [6] by a twist of the view, given the gradient g by a point p (camera axes):
    g . (t + w x p) = t . g + w . (p x g)."""
    row[0], row[1], row[2] = gx, gy, gz
    row[3], row[4], row[5] = p[1] * gz - p[2] * gy, p[2] * gx - p[0] * gz, p[0] * gy - p[1] * gx
