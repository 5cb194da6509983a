"""Pure geometry: SE(3), quaternions, projection, disparity. Conventions are in `sags_node.types`."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sags_node.types import F32, F64, Camera

Array = NDArray[np.floating]
ROTATION_TOLERANCE = 1e-3  # largest error of an element of R R^T


def rigid(R: Array, t: ArrayLike) -> F64:
    """The rigid transform [4, 4] that turns by `R` [3, 3] and then moves by `t` [3]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def invert(T: F64) -> F64:
    """Inverse of a rigid transform [4, 4]."""
    R = T[:3, :3].T
    return rigid(R, -R @ T[:3, 3])


def transform(T: F64, points: Array) -> Array:
    """Apply a rigid transform [4, 4] to points [..., 3]."""
    return points @ T[:3, :3].T.astype(points.dtype) + T[:3, 3].astype(points.dtype)


def is_rotation(matrices: F64) -> NDArray[np.bool_]:
    """Tell which matrices [..., 3, 3] are rotations, to the precision of files written by people."""
    products = matrices @ np.swapaxes(matrices, -1, -2)
    orthogonal = np.abs(products - np.eye(3)).max((-1, -2)) < ROTATION_TOLERANCE
    return np.asarray(orthogonal & (np.linalg.det(matrices) > 0))


def is_rigid(T: F64) -> bool:
    """Tell whether `T` is finite, [4, 4], and a rotation and a translation above a last row 0 0 0 1."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or not is_rotation(T[:3, :3]):
        return False
    return bool(np.abs(T[3] - (0, 0, 0, 1)).max() < 1e-6)  # to the precision of float32


def quat_to_matrix(quats: Array) -> Array:
    """Rotation matrices [..., 3, 3] of quaternions wxyz [..., 4] of any non-zero length."""
    w, x, y, z = np.moveaxis(quats / np.linalg.norm(quats, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def matrix_to_quat(R: F64) -> F64:
    """Unit quaternion wxyz [4] with w >= 0 of a rotation matrix [3, 3] (Shepperd's method)."""
    trace = np.trace(R)
    squares = np.array([trace, R[0, 0], R[1, 1], R[2, 2]])
    largest = int(np.argmax(squares))
    if largest == 0:
        q = np.array([1 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.zeros(4)
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = 1 + R[i, i] - R[j, j] - R[k, k]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + k] = R[k, i] + R[i, k]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0 else -q


def project(camera: Camera, points: Array) -> tuple[Array, Array]:
    """Pixels [..., 2] and depths [...] (m, camera z) of world points [..., 3].

    Points at or behind the camera plane get pixel NaN.
    """
    local = transform(camera.viewmat, points)
    z = local[..., 2]
    safe = np.where(z > 0, z, np.nan)
    K = camera.K
    u = K[0, 0] * local[..., 0] / safe + K[0, 2]
    v = K[1, 1] * local[..., 1] / safe + K[1, 2]
    return np.stack([u, v], -1), z


def unproject(camera: Camera, pixels: Array, depths: Array) -> Array:
    """World points [..., 3] (m) of pixels [..., 2] at depths [...] (m, camera z)."""
    K = camera.K
    x = (pixels[..., 0] - K[0, 2]) / K[0, 0] * depths
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1] * depths
    return transform(camera.T_world_cam, np.stack([x, y, depths], -1))


def scale_intrinsics(K: F64, size: tuple[int, int], new_size: tuple[int, int]) -> F64:
    """`K` [3, 3] for an image resized from `size` to `new_size` (width, height). Pixel centres are integers,
    so the point that stays in place is the corner (-0.5, -0.5), not (0, 0)."""
    sx, sy = new_size[0] / size[0], new_size[1] / size[1]
    scaled = K.copy()
    scaled[0] *= sx
    scaled[1] *= sy
    scaled[0, 2] += 0.5 * sx - 0.5
    scaled[1, 2] += 0.5 * sy - 0.5
    return scaled


def resized_camera(camera: Camera, width: int, height: int) -> Camera:
    """The camera whose image is resized to `width` x `height` px."""
    K = scale_intrinsics(camera.K, (camera.width, camera.height), (width, height))
    return Camera(width, height, K, camera.T_world_cam)


def scale_pixels(pixels: Array, size: tuple[int, int], new_size: tuple[int, int]) -> Array:
    """Convert pixels [..., 2] of an image of `size` (width, height) to that resized to `new_size`."""
    factors = np.array(new_size, np.float64) / size
    return (pixels + 0.5) * factors - 0.5


def disparity_to_depth(disparity: F32, focal_px: float, baseline: float) -> F32:
    """Depth (m) of a disparity image (px); where disparity <= 0 the depth is 0, unknown."""
    return np.divide(
        np.float32(focal_px * baseline), disparity, out=np.zeros_like(disparity), where=disparity > 0
    )
