import dataclasses

import cv2
import numpy as np
import pytest

from sags_node import geometry
from sags_node.types import Camera

K = np.array([[410.0, 0, 160.5], [0, 405.0, 118.25], [0, 0, 1]])


def random_pose(rng: np.random.Generator) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rng.normal(size=3))[0]
    T[:3, 3] = rng.normal(size=3)
    return T


def test_invert_undoes_transform() -> None:
    rng = np.random.default_rng(1)
    T = random_pose(rng)
    points = rng.normal(size=(4, 5, 3))
    moved = geometry.transform(T, points)
    homogeneous = np.concatenate([points, np.ones((4, 5, 1))], -1) @ T.T
    np.testing.assert_allclose(moved, homogeneous[..., :3], atol=1e-12)
    np.testing.assert_allclose(geometry.transform(geometry.invert(T), moved), points, atol=1e-12)
    assert geometry.transform(T, points.astype(np.float32)).dtype == np.float32


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, 3.0, np.pi - 1e-9, np.pi])
def test_quaternions_are_w_x_y_z_for_every_axis_and_up_to_half_a_turn(angle: float) -> None:
    rng = np.random.default_rng(2)
    for axis in [*np.eye(3), *-np.eye(3), *rng.normal(size=(20, 3))]:
        turn = axis / np.linalg.norm(axis)
        R = cv2.Rodrigues(turn * angle)[0]
        quat = geometry.matrix_to_quat(R)
        assert quat[0] >= 0
        sign = 1 if quat[1:] @ turn >= 0 else -1  # half a turn is the same both ways
        expected = np.array([sign * np.cos(angle / 2), *sign * np.sin(angle / 2) * turn])
        np.testing.assert_allclose(quat, expected, atol=1e-8)
        for length in (1, 1e-6):  # which does not matter
            np.testing.assert_allclose(geometry.quat_to_matrix(length * quat), R, atol=1e-9)


def test_project_agrees_with_opencv_and_unproject_undoes_it() -> None:
    rng = np.random.default_rng(4)
    camera = Camera(320, 240, K, random_pose(rng))
    local = rng.uniform([-0.03, -0.03, 0.03], [0.03, 0.03, 0.2], size=(50, 3))
    world = geometry.transform(camera.T_world_cam, local)
    pixels, depths = geometry.project(camera, world)
    R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    expected = cv2.projectPoints(world, cv2.Rodrigues(R)[0], t.reshape(3, 1), K, np.zeros(5))[0]
    np.testing.assert_allclose(pixels, expected.reshape(-1, 2), atol=1e-8)
    np.testing.assert_allclose(depths, local[:, 2], atol=1e-12)
    np.testing.assert_allclose(geometry.unproject(camera, pixels, depths), world, atol=1e-12)


def test_points_behind_the_camera_have_no_pixel() -> None:
    camera = Camera(320, 240, K, np.eye(4))
    pixels, depths = geometry.project(camera, np.array([[0.0, 0, 0], [0.01, 0, -0.1], [0, 0, 0.1]]))
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], K[:2, 2])
    np.testing.assert_allclose(depths, [0, -0.1, 0.1])


def test_moving_right_shifts_pixels_by_the_disparity() -> None:
    left = Camera(320, 240, K, random_pose(np.random.default_rng(5)))
    point = geometry.unproject(left, np.array([150.0, 100.0]), np.array(0.08))
    pixel, depth = geometry.project(left.moved_right(0.004), point)
    np.testing.assert_allclose(pixel, [150.0 - K[0, 0] * 0.004 / 0.08, 100.0], atol=1e-9)
    disparity = np.array([150.0 - pixel[0]], np.float32)
    np.testing.assert_allclose(geometry.disparity_to_depth(disparity, K[0, 0], 0.004), depth, rtol=1e-5)


@pytest.mark.parametrize("new_size", [(160, 120), (640, 480), (200, 180)])
def test_scaled_intrinsics_follow_a_resized_picture(new_size: tuple[int, int]) -> None:
    """A blob drawn where a point projects lies, after resizing, where the scaled K projects the point."""
    camera = Camera(320, 240, K, np.eye(4))
    point = np.array([0.013, -0.008, 0.1])
    (u, v), _ = geometry.project(camera, point)
    y, x = np.mgrid[:240, :320]
    blob = np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 6.0**2)).astype(np.float32)
    resized = cv2.resize(blob, new_size, interpolation=cv2.INTER_AREA)
    y, x = np.mgrid[: new_size[1], : new_size[0]]
    centroid = [(x * resized).sum() / resized.sum(), (y * resized).sum() / resized.sum()]
    scaled = Camera(*new_size, geometry.scale_intrinsics(K, (320, 240), new_size), np.eye(4))
    np.testing.assert_allclose(geometry.project(scaled, point)[0], centroid, atol=0.02)
    assert np.array_equal(K, [[410, 0, 160.5], [0, 405, 118.25], [0, 0, 1]]), "the original is left alone"


def test_no_disparity_is_unknown_depth() -> None:
    disparity = np.array([0, -3, np.nan, 20], np.float32)
    depth = geometry.disparity_to_depth(disparity, 500.0, 0.004)
    np.testing.assert_allclose(depth, [0, 0, 0, 0.1], rtol=1e-6)
    assert depth.dtype == np.float32


def test_a_camera_that_was_moved_has_a_view_of_its_own() -> None:
    """The view matrix is kept by the camera, and no copy with another pose takes it over."""
    rng = np.random.default_rng(5)
    first, second = random_pose(rng), random_pose(rng)
    there = Camera(320, 240, K, first)
    np.testing.assert_allclose(there.viewmat @ first, np.eye(4), atol=1e-12)
    moved = dataclasses.replace(there, T_world_cam=second)
    np.testing.assert_allclose(moved.viewmat @ second, np.eye(4), atol=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        there.viewmat[0, 0] = 1
