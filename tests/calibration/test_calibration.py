import dataclasses
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from places import ROOT

from sags_node.config.launch_file import load_launch
from sags_node.errors import UsageError
from sags_node.pipeline.session import rig_of
from sags_node.rig import (
    GUESSED_FOV,
    check_rig,
    guessed_rig,
    load_rig,
    read_rig,
    rectified_camera,
    rectify_eyes,
    save_rig,
)
from sags_node.tools.calibration.guess import guess_rig, with_equal_rows
from sags_node.tools.calibration.matches import match_eyes
from sags_node.tools.calibration.rows import rectified_rows
from sags_node.types import F64, U8, StereoRig

CALIB = ROOT / "calib"


SIZE = 640, 480
K = (
    np.array([[552.3, 0, 318.2], [0, 551.1, 243.6], [0, 0, 1]]),
    np.array([[549.8, 0, 323.9], [0, 548.9, 239.4], [0, 0, 1]]),
)
PLUMB_BOB = np.array([-0.18, 0.09, 4e-4, -7e-4, 0.01]), np.array([-0.17, 0.08, -3e-4, 5e-4, 0.02])
R = cv2.Rodrigues(np.array([0.004, -0.011, 0.006]))[0]
T = np.array([-5.2e-3, 4e-5, 6e-5])  # m


def make_rig(distortion: tuple[F64, F64] = PLUMB_BOB) -> StereoRig:
    """A rig with lens distortion and eyes turned against each other."""
    return rectify_eyes("rig", SIZE, K, distortion, R, T)


def edit(folder: Path, side: str, change: dict[str, Any]) -> None:
    """Change a saved file; a value of None removes the key."""
    file = folder / f"{side}.yaml"
    tree = yaml.safe_load(file.read_text())
    for key, value in change.items():
        if value is None:
            del tree[key]
        else:
            tree[key] = value
    file.write_text(yaml.safe_dump(tree))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "rig"
    save_rig(make_rig(), path)
    return path


def refusal(folder: Path) -> str:
    with pytest.raises(UsageError) as caught:
        load_rig(folder)
    return str(caught.value)


def test_baseline_and_pose_come_back_from_the_rectification(folder: Path) -> None:
    rig = load_rig(folder)
    assert rig.baseline == pytest.approx(np.linalg.norm(T))
    np.testing.assert_allclose(rig.T_right_left[:3, :3], R, atol=1e-9)
    np.testing.assert_allclose(rig.T_right_left[:3, 3], T, atol=1e-9)


@pytest.mark.parametrize("name", ["d4d", "hamlyn_heart", "v4l2_example"])
def test_shipped_calibrations_have_no_finding(name: str) -> None:
    assert {finding.level for finding in check_rig(load_rig(CALIB / name))} == {"ok"}


def test_ros_file_without_a_model_and_with_four_coefficients(folder: Path) -> None:
    four = {"rows": 1, "cols": 4, "data": [-0.1, 0.02, 0.0, 0.001]}
    edit(folder, "left", {"distortion_model": None, "distortion_coefficients": four, "binning_x": 0})
    np.testing.assert_array_equal(load_rig(folder).left.distortion, [-0.1, 0.02, 0.0, 0.001, 0.0])


def test_python_style_exponents_are_numbers(folder: Path) -> None:
    """ROS writes 1e-05, which YAML 1.1 reads as a string."""
    file = folder / "left.yaml"
    tree = yaml.safe_load(file.read_text())
    tree["distortion_coefficients"]["data"] = "PLACE"
    file.write_text(yaml.safe_dump(tree).replace("PLACE", "[1e-05, 0.0, 0.0, 0.0, 0.0]"))
    assert load_rig(folder).left.distortion[0] == 1e-5


@pytest.mark.parametrize("text", ["- 1\n- 2\n", "", "a: [1, 2", "%YAML:1.0\n---\nM: 1\n", "\x00"])
def test_not_a_camera_info_file(folder: Path, text: str) -> None:
    (folder / "left.yaml").write_text(text)
    assert str(folder / "left.yaml") in refusal(folder)


@pytest.mark.parametrize(
    ("key", "value"),  # None: the key is missing
    [
        *((key, None) for key in ("camera_matrix", "distortion_coefficients", "projection_matrix")),
        *(("image_width", value) for value in (None, 0, "640", True)),
        ("image_height", 10**9),
        ("distortion_model", "rational_polynomial"),
        ("distortion_model", ["plumb_bob"]),
        ("distortion_model", {"name": "plumb_bob"}),
        ("camera_matrix", {"data": [10**400, 0, 0, 0, 1, 0, 0, 0, 1]}),
        ("distortion_coefficients", {"data": [0.1] * 8}),
        ("camera_matrix", {"data": [1.0] * 8}),
        ("camera_matrix", [1.0] * 9),
        ("rectification_matrix", {"data": ["a"] * 9}),
        ("rectification_matrix", {"data": [True, 0, 0, 0, 1, 0, 0, 0, 1]}),
        ("roi", {"x_offset": False, "y_offset": 0, "width": True, "height": 480}),
        ("binning_x", True),
        ("projection_matrix", {"data": [[1.0, 2.0], 3.0] + [0.0] * 10}),
    ],
)
def test_wrong_value_is_named(folder: Path, key: str, value: Any) -> None:
    edit(folder, "left", {key: value})
    message = refusal(folder)
    assert "left.yaml" in message
    named = {"roi": "x_offset"}.get(key, key)
    assert (f"{key} is missing" if value is None else named) in message


def exchanged(folder: Path) -> None:
    left, right = (folder / "left.yaml").read_text(), (folder / "right.yaml").read_text()
    (folder / "left.yaml").write_text(right)
    (folder / "right.yaml").write_text(left)


def with_P(folder: Path, row: int, column: int, factor: float, more: float = 0.0) -> None:
    P = make_rig().right.P.copy()
    P[row, column] = factor * P[row, column] + more
    edit(folder, "right", {"projection_matrix": {"data": [float(p) for p in P.ravel()]}})


def in_pictures(folder: Path) -> None:
    """K in units of the image's width."""
    K = make_rig().left.K / [[640], [640], [1]]
    edit(folder, "left", {"camera_matrix": {"data": [float(k) for k in K.ravel()]}})


TRANSPOSED = {"camera_matrix": {"data": make_rig().left.K.T.ravel().tolist()}}  # as MATLAB writes it
MIRROR = {"rectification_matrix": {"data": [1.0, 0, 0, 0, 1.0, 0, 0, 0, -1.0]}}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (exchanged, "exchanged"),
        (lambda folder: with_P(folder, 0, 3, -1), r"must be -fx \* baseline"),
        (lambda folder: with_P(folder, 0, 3, 0), "no baseline"),
        (lambda folder: with_P(folder, 0, 3, 1000), "looks like millimetres.*divide"),
        (lambda folder: with_P(folder, 0, 3, 1 / make_rig().right.P[0, 0]), "too small.*by fx"),
        (lambda folder: with_P(folder, 1, 1, 1, 2), "rectified fy differs"),
        (lambda folder: with_P(folder, 1, 2, 1, 2), "rectified cy differs"),
        (lambda folder: with_P(folder, 0, 0, 1, 2), "rectified fx differs"),
        (lambda folder: edit(folder, "right", {"image_width": 720}), "same image size"),
        (lambda folder: edit(folder, "left", MIRROR), "not a rotation"),
        (in_pictures, "not plausible"),
        (
            lambda folder: edit(folder, "left", {"projection_matrix": {"data": [0.0] * 12}}),
            "all zeros.*one by",
        ),
        (lambda folder: edit(folder, "left", TRANSPOSED), "camera_matrix is transposed"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_eyes_that_cannot_be(folder: Path, change: Callable[[Path], None], said: str) -> None:
    change(folder)
    assert re.search(said, refusal(folder))
    levels = [finding.level for finding in check_rig(read_rig(folder))]
    assert "error" in levels  # it can be read, to be reported on


def test_unusual_baseline_is_only_a_warning(folder: Path) -> None:
    with_P(folder, 0, 3, 10)
    findings = check_rig(load_rig(folder))
    assert [finding.what for finding in findings if finding.level == "warning"] == [
        "a baseline of 52 mm is unusual for a stereo endoscope (3 to 10 mm)"
    ]


@pytest.mark.parametrize("planted", [float("nan"), float("inf")])
@pytest.mark.parametrize("field", ["K", "distortion", "R", "P"])
def test_numbers_that_are_not_finite(field: str, planted: float) -> None:
    rig = make_rig()
    values = getattr(rig.left, field).copy()
    values.flat[0] = planted
    bad = dataclasses.replace(rig, left=dataclasses.replace(rig.left, **{field: values}))
    assert [finding.level for finding in check_rig(bad)] == ["error"]


def test_rectified_camera_at_the_working_size() -> None:
    rig = make_rig()
    camera = rectified_camera(rig, 320, 240)
    assert (camera.width, camera.height) == (320, 240)
    assert camera.K[0, 0] == pytest.approx(rig.left.P[0, 0] / 2)
    assert camera.K[0, 2] == pytest.approx((rig.left.P[0, 2] + 0.5) / 2 - 0.5)
    np.testing.assert_array_equal(camera.T_world_cam, np.eye(4))


# ---- A rig for eyes that nobody has calibrated. ----


SHOWN = (480, 384)


def seen(height_px: float, roll_deg: float, zoom: float) -> tuple[U8, U8]:
    """Spots at several depths, and the same 12 to 20 px farther left in an eye that is turned and zoomed."""
    rng = np.random.default_rng(3)
    spots = cv2.resize(rng.integers(30, 230, (96, 120, 3), np.uint8), SHOWN, interpolation=cv2.INTER_CUBIC)
    x, y = np.meshgrid(np.arange(SHOWN[0], dtype=np.float32), np.arange(SHOWN[1], dtype=np.float32))
    shifted = cv2.remap(spots, x + 16 + 4 * np.sin(y / 60), y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    turn = cv2.getRotationMatrix2D((0.5 * (SHOWN[0] - 1), 0.5 * (SHOWN[1] - 1)), roll_deg, zoom)
    turn[1, 2] += height_px
    return spots, cv2.warpAffine(shifted, turn, SHOWN, flags=cv2.INTER_CUBIC)


@pytest.mark.parametrize(("height", "roll", "zoom"), [(0, 0, 1), (9, 0, 1), (-5, 1.5, 1), (4, -1, 1.02)])
def test_rows_of_pictures_agree_in_it(height: float, roll: float, zoom: float) -> None:
    """To the pixel that rows may differ by in stereo, however the right eye is turned."""
    pair = seen(height, roll, zoom)
    rig = with_equal_rows(guessed_rig(*SHOWN), [pair])
    assert rectified_rows(rig, match_eyes(*pair)).median < 1.0
    assert not rig.metric
    before = rectified_rows(guessed_rig(*SHOWN), match_eyes(*pair)).median
    assert before > 3.0 or not height


def test_it_has_the_size_of_the_pictures_and_the_field_of_view_that_is_said(phantom_session: Path) -> None:
    source = load_launch(phantom_session).source
    rig, true = guess_rig(source), rig_of(load_launch(phantom_session))
    assert (rig.left.width, rig.left.height) == (true.left.width, true.left.height)
    half = np.arctan(0.5 * rig.left.width / rig.left.K[0, 0])
    assert np.degrees(2 * half) == pytest.approx(GUESSED_FOV)
    assert true.metric and not rig.metric
    assert not replace(rig, name="copied").metric


def test_where_nothing_matches_the_rows_are_as_they_are() -> None:
    black = np.zeros((SHOWN[1], SHOWN[0], 3), np.uint8)
    rig = guessed_rig(*SHOWN)
    assert with_equal_rows(rig, [(black, black)]) is rig and with_equal_rows(rig, []) is rig
