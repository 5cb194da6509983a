"""Planted errors, and images that tell them."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import ran
from places import ROOT

from sags_node.checks import Finding
from sags_node.config.launch_file import load_launch
from sags_node.config.units import UNITS
from sags_node.errors import SagsError
from sags_node.geometry import invert
from sags_node.rig import check_rig, load_rig, read_rig, rectified_rig, rectify_eyes, save_rig
from sags_node.rig.check import size_made_for
from sags_node.sources.pictures import read_picture
from sags_node.tools.calibration.check import check_pictures, judge
from sags_node.tools.calibration.matches import match_eyes
from sags_node.tools.calibration.pictures import pairs_of_files, pairs_of_session
from sags_node.tools.calibration.principal_points import judge_known_depths
from sags_node.tools.calibration.rows import judge_scale, rectified_rows
from sags_node.types import F64, U8, StereoFrame, StereoRig
from sags_node.vision.rectify import Rectifier

Pairs = list[tuple[U8, U8]]
F7 = "hamlyn_f7_pair"
F7_SIZE = 360, 288
BENT = 0.06  # of a scale: what the phantom's lens adds to it, since other rays are looked up


@pytest.fixture(scope="module")
def phantom(phantom_session: Path) -> tuple[StereoRig, Pairs]:
    names = [f"{index:04d}.jpg" for index in (0, 15, 30)]
    pairs = [
        (read_picture(phantom_session / "left" / name), read_picture(phantom_session / "right" / name))
        for name in names
    ]
    return load_rig(phantom_session / "calib"), pairs


@pytest.fixture(scope="module")
def f7(data_folder: Path) -> tuple[StereoRig, Pairs]:
    folder = data_folder / F7
    if not folder.is_dir():
        pytest.skip(f"recording {F7} is not under SAGS_DATA ({data_folder})")
    left, right = (read_picture(folder / f"f7_dynamic_deint_{side}_0100.png") for side in "LR")
    return read_rig(folder, F7_SIZE), [(left, right)]


def exchanged(pairs: Pairs) -> Pairs:
    return [(right, left) for left, right in pairs]


def exchanged_files(rig: StereoRig) -> StereoRig:
    return StereoRig(rig.name, rig.right, rig.left)


def with_T_negated(rig: StereoRig) -> StereoRig:
    """As files with the wrong sign are rectified."""
    return from_matrices(rig, -1.0)


def in_unit(unit: str) -> Callable[[StereoRig], StereoRig]:
    return lambda rig: from_matrices(rig, 1 / UNITS[unit])


def with_R_transposed(rig: StereoRig) -> StereoRig:
    """As what MATLAB says is copied."""
    return rectify_anew(rig, rig.T_right_left[:3, :3].T, rig.T_right_left[:3, 3])


def from_right_to_left(rig: StereoRig) -> StereoRig:
    T = invert(rig.T_right_left)
    return rectify_anew(rig, T[:3, :3], T[:3, 3])


def from_matrices(rig: StereoRig, factor: float) -> StereoRig:
    return rectify_anew(rig, rig.T_right_left[:3, :3], factor * rig.T_right_left[:3, 3])


def rectify_anew(rig: StereoRig, R: F64, T: F64) -> StereoRig:
    left, right = rig.left, rig.right
    size, K, distortion = (left.width, left.height), (left.K, right.K), (left.distortion, right.distortion)
    return rectify_eyes(rig.name, size, K, distortion, R, T)


def half_size(rig: StereoRig) -> StereoRig:
    """Calibrated with images of half the size; only the size in the files was edited."""
    half = np.diag([0.5, 0.5, 1])
    left, right = (replace(eye, K=half @ eye.K) for eye in (rig.left, rig.right))
    return from_matrices(StereoRig(rig.name, left, right), 1.0)


def with_right_turned(rig: StereoRig, degrees: tuple[float, float, float]) -> StereoRig:
    turn = cv2.Rodrigues(np.radians(degrees))[0]
    return StereoRig(rig.name, rig.left, replace(rig.right, R=turn @ rig.right.R))


@pytest.fixture
def subject(request: pytest.FixtureRequest) -> tuple[StereoRig, Pairs]:
    rig_and_pairs: tuple[StereoRig, Pairs] = request.getfixturevalue(request.param)
    return rig_and_pairs


every_subject = pytest.mark.parametrize("subject", ["phantom", "f7"], indirect=True)


def worst(findings: list[Finding]) -> Finding:
    return max(findings, key=lambda finding: ("ok", "warning", "error").index(finding.level))


# ---- what is right stays right ---------------------------------------------------------------------------


@every_subject
def test_a_right_calibration_passes(subject: tuple[StereoRig, Pairs]) -> None:
    findings = check_rig(subject[0]) + check_pictures(*subject)
    assert {finding.level for finding in findings} == {"ok"}, findings


def test_rows_of_a_real_unrectified_pair(f7: tuple[StereoRig, Pairs]) -> None:
    """This rig's rows are off by 1.5 px at the top of the image, and agree in its middle. Features, found
    without the dense search, say so too: to half a pixel, since there are few of them at the edges."""
    rig, pairs = f7
    front, rows = check_pictures(rig, pairs)
    features = rectified_rows(rig, match_eyes(*pairs[0]))
    assert rows.figures["row_median_px"] == pytest.approx(features.median, abs=0.5)
    assert rows.figures["row_p90_px"] == pytest.approx(features.p90, abs=0.5)
    assert rows.figures["matched"] > 0.4
    assert front.figures["row_error_median_px"] < 0.5
    assert 0.05 < front.figures["depth_median_m"] < 0.09


def test_rows_of_the_phantom_are_exact(phantom: tuple[StereoRig, Pairs]) -> None:
    _, rows = check_pictures(*phantom)
    assert rows.figures["row_median_px"] < 0.1


# ---- planted errors --------------------------------------------------------------------------------------


def unchanged(given: Any) -> Any:
    return given


NOTHING = "", ""
# What is done to the rig and to the images; what images tell of it and its fix; what numbers alone tell.
PLANTED: dict[str, tuple[Any, Any, tuple[str, str], tuple[str, str]]] = {
    "exchanged images": (
        unchanged, exchanged, ("the images are exchanged", "calibration is in order"), NOTHING
    ),
    "exchanged files": (
        exchanged_files, unchanged, ("exchanged in the calibration", "images are in order"), NOTHING
    ),
    "wrong sign": (
        with_T_negated, unchanged, ("has the wrong sign", "images are in order"), ("", "must be -fx")
    ),
    "both ends exchanged": (exchanged_files, exchanged, ("images and calibration agree", ""), NOTHING),
    "millimetres": (in_unit("mm"), unchanged, ("", "--unit mm"), ("looks like millimetres", "--unit mm")),
    "centimetres": (in_unit("cm"), unchanged, ("", "--unit cm"), ("looks like centimetres", "--unit cm")),
    "inches": (in_unit("inch"), unchanged, ("", "--unit inch"), ("unusual", "--unit inch")),
    "micrometres": (in_unit("um"), unchanged, ("", "--unit um"), ("looks like micrometres", "--unit um")),
    "half size": (half_size, unchanged, ("0.5 times the size", ""), ("camera_matrix is of", "by 2")),
}  # fmt: skip


@every_subject
@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_error_is_found_and_named(subject: tuple[StereoRig, Pairs], name: str) -> None:
    of_rig, of_pairs, said, said_of_numbers = PLANTED[name]
    rig = of_rig(subject[0])
    finding, numbers = worst(check_pictures(rig, of_pairs(subject[1]))), worst(check_rig(rig))
    assert finding.level == "error" and said[0] in finding.what and said[1] in finding.fix
    assert said_of_numbers[0] in numbers.what and said_of_numbers[1] in numbers.fix


@pytest.mark.parametrize(
    ("change", "what", "fix"),
    [
        (with_R_transposed, "R, from left to right camera, is transposed", "its transpose"),
        (from_right_to_left, "R and T go from the right to the left camera", "minus that transpose times T"),
    ],
)
def test_directions_of_turned_eyes_are_told_apart(
    phantom: tuple[StereoRig, Pairs], change: Callable[[StereoRig], StereoRig], what: str, fix: str
) -> None:
    """What is said to do undoes it, since it is its own inverse."""
    rig, pairs = phantom
    finding = worst(check_pictures(change(rig), pairs))
    assert finding.level == "error" and what in finding.what and fix in finding.fix
    again = change(change(rig))
    np.testing.assert_allclose(again.right.R, rectify_anew(rig, *of_eyes(rig)).right.R, atol=1e-9)
    assert worst(judge(again, pairs)).level == "ok"


def of_eyes(rig: StereoRig) -> tuple[F64, F64]:
    return rig.T_right_left[:3, :3], rig.T_right_left[:3, 3]


def test_without_a_baseline_nothing_is_said_of_its_sign(phantom: tuple[StereoRig, Pairs]) -> None:
    rig, pairs = phantom
    P = rig.right.P * [1, 1, 1, 0]
    found = judge(StereoRig("two mono", rig.left, replace(rig.right, P=P)), pairs)
    assert [finding.what for finding in found if finding.level != "ok"] == [
        "projection_matrix[3] is 0 in left.yaml and 0 in right.yaml: there is no baseline"
    ]


@every_subject
def test_another_picture_size(subject: tuple[StereoRig, Pairs]) -> None:
    rig, pairs = subject
    double = [
        (cv2.resize(left, None, fx=2, fy=2), cv2.resize(right, None, fx=2, fy=2)) for left, right in pairs
    ]
    (finding,) = check_pictures(rig, double)
    assert finding.level == "error" and "2 times as large" in finding.what
    assert f"{rig.path} -o FOLDER --scale 2" in finding.fix
    (finding,) = check_pictures(rig, [(left[:-20], right[:-20]) for left, right in pairs])
    assert "cropped" in finding.fix


@pytest.mark.parametrize(
    ("turned", "figure"), [((0.3, 0.0, 0.0), "pitch_deg"), ((0.0, 0.0, 0.6), "roll_deg")]
)
def test_a_turned_eye_is_a_warning_with_its_angle(
    phantom: tuple[StereoRig, Pairs], turned: tuple[float, float, float], figure: str
) -> None:
    rig, pairs = phantom
    finding = worst(check_pictures(with_right_turned(rig, turned), pairs))
    assert finding.level == "warning" and "one eye were turned" in finding.what
    assert abs(finding.figures[figure]) == pytest.approx(max(turned), abs=0.05)
    other = "roll_deg" if figure == "pitch_deg" else "pitch_deg"
    assert abs(finding.figures[other]) < 0.1


def test_a_principal_point_that_lies_lower_is_said_in_px(phantom: tuple[StereoRig, Pairs]) -> None:
    rig, pairs = phantom
    finding = worst(check_pictures(with_principal_point_moved(rig, 0.0, -1.5), pairs))
    assert finding.level == "warning" and "px lower" in finding.what
    assert finding.figures["row_offset_px"] == pytest.approx(1.5, abs=0.1)


def with_principal_point_moved(rig: StereoRig, x: float, y: float) -> StereoRig:
    K = rig.right.K + np.array([[0, 0, x], [0, 0, y], [0, 0, 0]])
    return StereoRig(rig.name, rig.left, replace(rig.right, K=K))


@pytest.mark.parametrize("scale", [0.01, -0.01])
def test_an_eye_of_another_scale_is_said_with_its_fix(phantom: tuple[StereoRig, Pairs], scale: float) -> None:
    """The right image is so much larger than the calibration says. What is said to set fixes it, and depth
    leans by what follows from disparity = f B / Z."""
    rig, pairs = phantom
    assert not [finding for finding in check_pictures(rig, pairs) if "scale" in finding.figures]
    finding = worst(check_pictures(with_right_focal(rig, 1 / (1 + scale)), pairs)[-1:])
    assert finding.level == "warning" and ("larger" if scale > 0 else "smaller") in finding.what
    assert finding.figures["scale"] == pytest.approx(scale, rel=BENT)
    assert ("far on the right" if scale > 0 else "near on the right") in finding.what
    depth = check_pictures(rig, pairs)[0].figures["depth_median_m"]
    per_pixel = depth**2 / (rig.left.P[0, 0] * rig.baseline) * 1e3  # mm
    assert abs(finding.figures["leans_mm_per_100_px"]) == pytest.approx(per_pixel, rel=2 * BENT)
    fx, fy = (float(number) for number in re.findall(r"to ([\d.]+)", finding.fix))
    assert (fx, fy) == pytest.approx((rig.right.K[0, 0], rig.right.K[1, 1]), rel=0.0005)


def with_right_focal(rig: StereoRig, factor: float) -> StereoRig:
    K = rig.right.K * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
    return StereoRig(rig.name, rig.left, replace(rig.right, K=K))


@pytest.mark.parametrize("bent", [0.0, 3.0])
def test_a_scale_is_named_only_where_it_fixes_the_rows(bent: float) -> None:
    """By arithmetic: rows 1 % too large, and bent by so many px to either side."""
    rig = rectified_rig("plane", 640, 512, np.array([[600.0, 0, 319.5], [0, 600, 255.5], [0, 0, 1]]), 0.004)
    rng = np.random.default_rng(0)
    columns, lines = rng.uniform(40, 630, 500), rng.uniform(10, 500, 500)
    right = 255.5 + 1.01 * (lines - 255.5) + bent * np.cos(columns / 50) + rng.normal(0, 0.2, 500)
    rows = rectified_rows(rig, np.column_stack([columns, lines, columns - 30, right]))
    (finding,) = judge_scale(rig, rows)
    assert finding.figures["scale"] == pytest.approx(0.01, abs=4 * rows.scale_error)
    assert rows.left_over == pytest.approx(np.hypot(0.2, bent / np.sqrt(2)), rel=0.15)
    assert ("set fx to" in finding.fix) == (bent == 0)
    assert ("distortion is wrong" in finding.what) == (bent > 0)


def test_a_scale_too_large_for_stereo_is_said_with_the_rows(phantom: tuple[StereoRig, Pairs]) -> None:
    rig, pairs = phantom
    (finding,) = check_pictures(with_right_focal(rig, 1 / 1.1), pairs)
    assert finding.level == "error" and "rows differ" in finding.what
    assert "larger than the calibration says" in finding.what
    assert finding.figures["scale"] == pytest.approx(0.1, rel=BENT)


def test_known_depths_show_what_matches_cannot(
    phantom_session: Path, phantom: tuple[StereoRig, Pairs]
) -> None:
    """The right principal point moved sideways by half a pixel: rows stay as they are, depths do not."""
    pairs, depths = pairs_of_session(load_launch(phantom_session))
    moved = with_principal_point_moved(phantom[0], 0.5, 0.0)
    matches = [match_eyes(*pair) for pair in pairs]
    rows = [rectified_rows(rig, np.concatenate(matches)).errors for rig in (phantom[0], moved)]
    assert np.abs(rows[1] - rows[0]).max() < 0.05
    right, wrong = (judge_known_depths(rig, matches, depths)[0] for rig in (phantom[0], moved))
    assert right.level == "ok" and abs(right.figures["offset_px"]) < 0.1
    assert wrong.level == "warning" and "too near" in wrong.what
    shift = wrong.figures["offset_px"] - right.figures["offset_px"]
    assert shift == pytest.approx(0.5, abs=0.02)  # exact but for the lens distortion
    fixed = float(re.findall(r"right.yaml to ([\d.]+)", wrong.fix)[0])
    assert fixed == pytest.approx(moved.right.K[0, 2] - wrong.figures["offset_px"], abs=0.01)


@pytest.mark.parametrize(("nearest", "farthest"), [(0.05, 0.12), (0.1, 0.101)])
def test_an_offset_is_told_from_a_longer_baseline_where_depths_differ(
    nearest: float, farthest: float
) -> None:
    """By arithmetic: disparity = f B / Z + 0.3 px, with noise of 0.2 px, on a leaning plane."""
    rig = rectified_rig("plane", 640, 512, np.array([[600.0, 0, 319.5], [0, 600, 255.5], [0, 0, 1]]), 0.004)
    depth = np.tile(1 / np.linspace(1 / nearest, 1 / farthest, 640), (512, 1)).astype(np.float32)
    rng = np.random.default_rng(0)
    columns, lines = rng.integers(10, 630, 4000), rng.integers(10, 500, 4000)
    disparity = 2.4 / depth[lines, columns] + 0.3 + rng.normal(0, 0.2, 4000)
    matches = np.column_stack([columns, lines, columns - disparity, lines])
    (finding,) = judge_known_depths(rig, [matches], [depth])
    assert finding.figures["offset_px"] == pytest.approx(0.3, abs=0.02)
    assert ("longer" in finding.what) == (farthest - nearest < 0.01)
    depth[:, 1::2] = 0
    assert judge_known_depths(rig, [matches], [depth]) == []  # every point lies beside an unknown one


def test_the_calibration_of_another_scope(phantom: tuple[StereoRig, Pairs]) -> None:
    rig, pairs = phantom
    finding = worst(check_pictures(with_right_turned(rig, (3.0, 0.0, 1.0)), pairs))
    assert finding.level == "error" and "not of these images" in finding.fix


def test_rectified_pictures_exchanged(data_folder: Path) -> None:
    """Rows tell nothing here; on which side the points lie does."""
    left, right = (
        sorted((data_folder / "hamlyn_invivo_001_100" / side).iterdir())[:1] for side in ("left", "right")
    )
    pairs = [(read_picture(left[0]), read_picture(right[0]))]
    rig = load_rig(ROOT / "calib/hamlyn_heart")
    assert worst(check_pictures(rig, pairs)).level == "ok"
    assert "the images are exchanged" in worst(check_pictures(rig, exchanged(pairs))).what


def test_principal_points_far_apart_are_not_taken_for_an_exchange(phantom: tuple[StereoRig, Pairs]) -> None:
    """Rectified images whose right one is cut out farther to the right than the calibration says: points
    seem to lie behind the eyes, as in exchanged ones. Only whoever covers a lens can tell which it is."""
    rig, pairs = phantom
    rectifier = Rectifier(rig, rig.left.width, rig.left.height)
    left, right = rectified(rectifier, pairs[0])
    shift = rig.left.width * 97 // 640
    moved = np.zeros_like(right)
    moved[:, shift:] = right[:, :-shift]
    said = worst(check_pictures(plain_rig(rectifier, 0.0), [(left, moved)]))
    assert said.level == "error" and "or their principal points differ by at least" in said.what
    least = int(re.findall(r"at least (\d+) px", said.what)[0])
    assert 0 < least < shift and "cover the left eye's lens" in said.fix
    # A calibration that says so is in order.
    assert worst(check_pictures(plain_rig(rectifier, shift), [(left, moved)])).level == "ok"


def plain_rig(rectifier: Rectifier, shift: float) -> StereoRig:
    """Of rectified images; the right eye's principal point lies `shift` px farther to the right."""
    camera = rectifier.camera
    rig = rectified_rig("plain", camera.width, camera.height, camera.K, rectifier.baseline)
    return with_principal_point_moved(rig, shift, 0.0)


def rectified(rectifier: Rectifier, pair: tuple[U8, U8]) -> tuple[U8, U8]:
    made = rectifier(StereoFrame(0, 0, 0, *pair))
    assert made.right is not None
    return made.left, made.right


def test_highlights_are_no_points_of_the_tissue(phantom: tuple[StereoRig, Pairs]) -> None:
    """They are the sharpest thing in both images, and lie on the epipolar lines, but at another depth."""
    _, pairs = phantom
    left, right = (eye.copy() for eye in pairs[0])
    clean = match_eyes(left, right)
    down = round(float(np.median(clean[:, 3] - clean[:, 1])))  # raw images: rows differ
    rng = np.random.default_rng(3)
    shining = rng.uniform((60, 20), (290, 230), (25, 2)).astype(int)
    for x, y in np.repeat(shining, 4, axis=0) + rng.integers(-5, 6, (100, 2)):  # in clusters
        shape = tuple(int(side) for side in rng.integers(1, 5, 2)), int(rng.integers(0, 180))
        for eye, (dx, dy) in ((left, (0, 0)), (right, (-14, down))):
            cv2.ellipse(eye, (int(x + dx), int(y + dy)), *shape, 0, 360, (255, 255, 255), -1)
    matches = match_eyes(left, right)
    assert len(matches) > 200
    distances = np.linalg.norm(matches[:, None, :2] - shining, axis=-1)
    assert distances.min() > 4


def test_pictures_that_show_nothing(phantom: tuple[StereoRig, Pairs]) -> None:
    rig, _ = phantom
    grey = np.full((rig.left.height, rig.left.width, 3), 90, np.uint8)
    (finding,) = check_pictures(rig, [(grey, grey)])
    assert finding.level == "warning" and "too few to judge" in finding.what


# ---- numbers alone ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0])
def test_size_made_for(phantom: tuple[StereoRig, Pairs], factor: float) -> None:
    rig, _ = phantom
    assert size_made_for(rig) is None
    scale = np.diag([factor, factor, 1])
    left, right = (replace(eye, K=scale @ eye.K) for eye in (rig.left, rig.right))
    assert size_made_for(StereoRig("scaled", left, right)) == factor
    assert size_made_for(StereoRig("one eye", left, rig.right)) is None


def test_distortion_that_turns_back(phantom: tuple[StereoRig, Pairs]) -> None:
    rig, _ = phantom
    folded = replace(rig.left, distortion=np.array([-0.089, 0.94, 0, 0, -14.8]))
    findings = check_rig(StereoRig("folded", folded, rig.right))
    (warned,) = [finding for finding in findings if finding.level == "warning"]
    radius = np.linspace(0, 1, 100_000)  # where the model's radius stops growing, by brute force
    grown = radius * (1 - 0.089 * radius**2 + 0.94 * radius**4 - 14.8 * radius**6)
    reached = grown.max() * rig.left.K[0, 0]
    assert f"left.yaml: the distortion turns back {reached:.0f} px" in warned.what


# ---- the command -----------------------------------------------------------------------------------------


sags = partial(ran, "calib", "check")


def test_check_of_a_session_against_itself(phantom_session: Path) -> None:
    code, out, _ = sags(phantom_session, "--json")
    findings = json.loads(out)
    points, rows, principal_points = (finding["figures"] for finding in findings[-3:])
    assert code == 0 and rows["row_median_px"] < 0.2
    assert points["matches"] > 300 and abs(principal_points["offset_px"]) < 0.1


def test_check_against_a_session_with_another_key(phantom_session: Path) -> None:
    sides = ("left", "right"), ("right", "left")
    exchanged_source = [f"source.{eye}:={phantom_session / other}" for eye, other in sides]
    code, out, err = sags(phantom_session / "calib", "--session", phantom_session, *exchanged_source)
    assert code == 1 and "the images are exchanged" in out and "cannot be used" in err


def test_a_broken_calibration_is_checked_against_a_session(phantom_session: Path, tmp_path: Path) -> None:
    """A session does not open with it, but this command must."""
    rig = load_rig(phantom_session / "calib")
    save_rig(with_T_negated(rig), tmp_path / "wrong")
    code, out, _ = sags(tmp_path / "wrong", "--session", phantom_session)
    assert code == 1 and "must be -fx * baseline" in out and "has the wrong sign" in out


def test_check_with_files_and_folders(phantom_session: Path) -> None:
    first = phantom_session / "left/0000.jpg", phantom_session / "right/0000.jpg"
    folders = phantom_session / "left", phantom_session / "right"
    for images in (("--images", *first, "--images", *first), ("--images", *folders)):
        code, out, _ = sags(phantom_session / "calib", *images)
        assert code == 0 and "rows agree" in out


def test_a_recording_without_a_launch_file_is_a_session_too(phantom_session: Path, tmp_path: Path) -> None:
    """As everywhere; where it brings no calibration, one is checked against it, else its own."""
    for eye in ("left", "right"):
        (tmp_path / eye).symlink_to(phantom_session / eye)
    for own in (False, True):
        if own:
            (tmp_path / "calib").symlink_to(phantom_session / "calib")
        said = [tmp_path] if own else [phantom_session / "calib", "--session", tmp_path]
        code, out, _ = sags(*said)
        assert code == 0 and "rows agree" in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["{session}/calib", "other"], "one calibration at a time"),
        (["{session}/calib", "--session", "gone"], "gone"),
        (["{session}/calib", "--session", "{session}", "source.lefd:=x"], "source.lefd"),
        (["{session}/calib", "--session", "{session}", "--images", "a", "b"], "one of them is enough"),
        (["{session}/left"], "is no calibration; looked for"),
        (["{session}/calib", "--images", "{session}/left", "{session}/calib"], "holds no image"),
    ],
)
def test_usage(phantom_session: Path, arguments: list[str], said: str) -> None:
    code, out, err = sags(*(argument.format(session=phantom_session) for argument in arguments))
    assert code == 2 and out == "" and said in err, err


def test_pictures_of_several_sizes(phantom_session: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(SagsError, match="64x64 and 320x256"):
        pairs_of_files([(phantom_session / "left/0000.jpg", tmp_path / "small.png")])


def test_a_session_without_a_right_eye(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    (tmp_path / "depth").mkdir()
    for folder, value in (("images", 90), ("masks", 0), ("depth", 50)):
        shape = (48, 64, 3) if folder == "images" else (48, 64)
        for index in range(2):
            cv2.imwrite(str(tmp_path / folder / f"{index}.png"), np.full(shape, value, np.uint8))
    pose = np.hstack([np.eye(3), np.zeros((3, 1)), [[48.0], [64.0], [60.0]]]).ravel()
    np.save(tmp_path / "poses_bounds.npy", np.tile(np.append(pose, [0.0, 1.0]), (2, 1)))
    code, _, err = sags(tmp_path)
    assert code == 2 and "no right eye" in err
