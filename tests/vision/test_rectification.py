"""Rectified images and masks: where points land, and which rows agree."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from frames import make_frame
from places import ROOT

from sags_node import geometry
from sags_node.errors import SagsError, UsageError
from sags_node.rig import check_rig, load_rig, read_rig
from sags_node.sources.pictures import read_picture
from sags_node.types import U8, Eye, StereoFrame, StereoRig
from sags_node.vision.rectify import Rectifier


def draw_blob(pixel: np.ndarray, width: int, height: int) -> U8:
    y, x = np.mgrid[:height, :width]
    blob = 255 * np.exp(-((x - pixel[0]) ** 2 + (y - pixel[1]) ** 2) / (2 * 4.0**2))
    return np.repeat(np.rint(blob).astype(np.uint8)[..., None], 3, -1)


def centroid(image: U8) -> np.ndarray:
    weights = image[..., 0].astype(np.float64)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(x * weights).sum(), (y * weights).sum()]) / weights.sum()


@pytest.mark.parametrize("size", [(640, 480), (320, 240), (500, 400), (240, 180), (480, 384)])
@pytest.mark.parametrize("point", [(0.004, -0.006, 0.07), (-0.02, 0.02, 0.1)])
def test_a_point_lands_where_the_rectified_cameras_see_it(
    size: tuple[int, int], point: tuple[float, float, float]
) -> None:
    """Raw pixels come from OpenCV's distorting projection, rectified ones from the plain pinhole."""
    rig = load_rig(ROOT / "calib/v4l2_example")
    rectifier = Rectifier(rig, *size)
    raw_left = rig.left.R.T @ np.array(point)  # the rectified point, seen by the raw left camera
    pictures = []
    for eye, T in ((rig.left, np.eye(4)), (rig.right, rig.T_right_left)):
        rotation = cv2.Rodrigues(T[:3, :3])[0]
        pixel = cv2.projectPoints(raw_left, rotation, T[:3, 3:], eye.K, eye.distortion)[0].ravel()
        pictures.append(draw_blob(pixel, eye.width, eye.height))
    pair = rectifier(make_frame(*pictures))
    expected, _ = geometry.project(rectifier.camera, np.array(point))
    np.testing.assert_allclose(centroid(pair.left), expected, atol=0.1)
    expected[0] -= rectifier.camera.K[0, 0] * rig.baseline / point[2]
    np.testing.assert_allclose(centroid(pair.right), expected, atol=0.1)


def test_pictures_that_are_made_ahead_are_the_same_and_of_that_frame_alone() -> None:
    rectifier = Rectifier(load_rig(ROOT / "calib/v4l2_example"), 240, 180)
    rng = np.random.default_rng(2)
    first, second = (make_frame(*rng.integers(0, 256, (2, 480, 640, 3), np.uint8)) for _ in range(2))
    made = rectifier.pictures(first)
    for given, frame in ((made, first), (rectifier.pictures(second), second)):
        ahead, now = rectifier(frame, given), rectifier(frame)
        assert np.array_equal(ahead.left, now.left) and np.array_equal(ahead.right, now.right)
        assert ahead.gray is not None and np.array_equal(ahead.gray[0].full, now.gray[0].full)
    posed = replace(first, T_world_cam=np.full((4, 4), np.nan))
    with pytest.raises(UsageError, match="NaN"):
        rectifier(posed, made)


def test_rows_of_a_real_unrectified_pair_become_equal(data_folder: Path) -> None:
    folder = data_folder / "hamlyn_f7_pair"
    rig = read_rig(folder, (360, 288))
    assert all(finding.level == "ok" for finding in check_rig(rig))
    raw = [read_picture(folder / f"f7_dynamic_deint_{side}_0100.png") for side in "LR"]
    pair = Rectifier(rig, 360, 288)(make_frame(*raw))
    assert abs(np.median(row_errors(*raw))) > 8  # the recording is what the test is for
    errors = row_errors(pair.left, pair.right)
    assert abs(np.median(errors)) < 0.5 and np.median(np.abs(errors)) < 1


def row_errors(left: U8, right: U8) -> np.ndarray:
    sift = cv2.SIFT.create()
    points, descriptors = zip(*(sift.detectAndCompute(image, None) for image in (left, right)), strict=True)
    matches = cv2.BFMatcher(crossCheck=True).match(*descriptors)
    best = sorted(matches, key=lambda match: match.distance)[:80]
    return np.array([points[1][m.trainIdx].pt[1] - points[0][m.queryIdx].pt[1] for m in best])


def test_rectified_pictures_of_the_right_size_pass_untouched_and_the_frames_pose_is_the_cameras() -> None:
    rectifier, T = Rectifier(load_rig(ROOT / "calib/d4d"), 675, 540), np.eye(4)
    T[:3, 3] = [0.01, 0.02, 0.03]
    image = np.random.default_rng(0).integers(0, 256, (540, 675, 3), np.uint8)
    for pose, expected in ((None, np.eye(4)), (T, T)):
        pair = rectifier(StereoFrame(7, 1_000, 2_000, image, image, T_world_cam=pose))
        assert pair.left is image and (pair.frame_id, pair.t_capture_ns) == (7, 1_000)
        assert pair.baseline == pytest.approx(0.00427)
        np.testing.assert_array_equal(pair.camera.T_world_cam, expected)


def test_pictures_of_another_size_are_refused() -> None:
    rectifier = Rectifier(load_rig(ROOT / "calib/d4d"), 640, 512)
    good, bad, twice = (np.zeros((*size, 3), np.uint8) for size in ((540, 675), (480, 640), (1080, 1350)))
    for left, right, words in [
        (good, bad, "the right image is 640x480 px, the left image 675x540"),
        (bad, bad, "have another shape"),
        (twice, twice, f"sags calib convert {ROOT / 'calib/d4d'} -o FOLDER --scale 2$"),
    ]:
        with pytest.raises(SagsError, match=words):
            rectifier(make_frame(left, right))
    with pytest.raises(SagsError, match="mask is 640x480 px, the left image 675x540"):
        rectifier.mask(np.zeros((480, 640), np.bool_))


def test_masks_go_the_way_of_the_pictures() -> None:
    rig = load_rig(ROOT / "calib/v4l2_example")
    rectifier = Rectifier(rig, 320, 240)
    mask = np.zeros((480, 640), np.bool_)
    mask[100:300, 200:500] = True
    image = np.repeat(mask.astype(np.uint8)[..., None] * 255, 3, -1)
    rectified = rectifier(make_frame(image, image)).left[..., 0]
    sure = (rectified == 0) | (rectified == 255)
    assert sure.mean() > 0.95
    found = rectifier.mask(mask)
    np.testing.assert_array_equal(found[sure], rectified[sure] == 255)
    np.testing.assert_allclose(centroid(found[..., None]), centroid(rectified[..., None]), atol=0.1)


def test_outside_the_raw_picture_there_is_no_tissue() -> None:
    plain = load_rig(ROOT / "calib/d4d")
    P = plain.left.P.copy()
    P[0, 2] += 100  # the rectified image looks 100 px past the raw one's left edge
    eye = Eye(675, 540, plain.left.K, plain.left.distortion, plain.left.R, P)
    shifted = Rectifier(StereoRig("shifted", eye, plain.right), 675, 540)
    everything = shifted.mask(np.ones((540, 675), np.bool_))
    assert not everything[:, :99].any() and everything[:, 101:].all()
