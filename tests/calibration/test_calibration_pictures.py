"""Planted errors, and images that tell them."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import ran
from endonerf_clip import write_clip
from places import ROOT

from sags_node.checks import Finding
from sags_node.config.launch_file import load_launch
from sags_node.config.units import UNITS
from sags_node.errors import SagsError
from sags_node.geometry import invert
from sags_node.pipeline.session import rig_of
from sags_node.rig import (
    GUESSED_FOV,
    check_rig,
    guessed_rig,
    load_rig,
    read_rig,
    rectified_rig,
    rectify_eyes,
    save_rig,
)
from sags_node.sources.pictures import read_picture
from sags_node.tools.calibration.check import check_pictures, judge
from sags_node.tools.calibration.guess import guess_rig, with_equal_rows
from sags_node.tools.calibration.matches import match_eyes
from sags_node.tools.calibration.pictures import pairs_of_files, pairs_of_session
from sags_node.tools.calibration.principal_points import judge_known_depths
from sags_node.tools.calibration.rows import judge_scale, rectified_rows
from sags_node.types import F64, U8, StereoFrame, StereoRig
from sags_node.vision.rectify import Rectifier

Pairs = list[tuple[U8, U8]]
Subject = tuple[StereoRig, Pairs]
OfRig = Callable[[StereoRig], StereoRig]
F7 = "hamlyn_f7_pair"
F7_SIZE = 360, 288
K_PLANE = np.array([[600.0, 0, 319.5], [0, 600, 255.5], [0, 0, 1]])
PLANE = rectified_rig("plane", 640, 512, K_PLANE, 0.004)
BENT = 0.06  # of a scale: what the phantom's lens adds to it, since other rays are looked up


@pytest.fixture(scope="module")
def phantom(phantom_session: Path) -> Subject:
    names = [f"{index:04d}.jpg" for index in (0, 15, 30)]
    pairs = [
        (read_picture(phantom_session / "left" / name), read_picture(phantom_session / "right" / name))
        for name in names
    ]
    return load_rig(phantom_session / "calib"), pairs


@pytest.fixture(scope="module")
def f7(data_folder: Path) -> Subject:
    folder = data_folder / F7
    if not folder.is_dir():
        pytest.skip(f"recording {F7} is not under SAGS_DATA ({data_folder})")
    left, right = (read_picture(folder / f"f7_dynamic_deint_{side}_0100.png") for side in "LR")
    return read_rig(folder, F7_SIZE), [(left, right)]


def exchanged(pairs: Pairs) -> Pairs:
    return [(right, left) for left, right in pairs]


def exchanged_files(rig: StereoRig) -> StereoRig:
    return StereoRig(rig.name, rig.right, rig.left)


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
    left, right = (replace(eye, K=np.diag([0.5, 0.5, 1]) @ eye.K) for eye in (rig.left, rig.right))
    return from_matrices(StereoRig(rig.name, left, right), 1.0)


def with_right_K(rig: StereoRig, K: F64) -> StereoRig:
    return StereoRig(rig.name, rig.left, replace(rig.right, K=K))


def with_principal_point_moved(rig: StereoRig, x: float, y: float) -> StereoRig:
    return with_right_K(rig, rig.right.K + np.array([[0, 0, x], [0, 0, y], [0, 0, 0]]))


def with_right_focal(rig: StereoRig, factor: float) -> StereoRig:
    return with_right_K(rig, rig.right.K * [[factor, 1, 1], [1, factor, 1], [1, 1, 1]])


def with_right_turned(rig: StereoRig, degrees: tuple[float, float, float]) -> StereoRig:
    turn = cv2.Rodrigues(np.radians(degrees))[0]
    return StereoRig(rig.name, rig.left, replace(rig.right, R=turn @ rig.right.R))


@pytest.fixture
def subject(request: pytest.FixtureRequest) -> Any:
    return request.getfixturevalue(request.param)


every_subject = pytest.mark.parametrize("subject", ["phantom", "f7"], indirect=True)


def worst(findings: list[Finding]) -> Finding:
    return max(findings, key=lambda finding: ("ok", "warning", "error").index(finding.level))


# ---- what is right stays right ---------------------------------------------------------------------------


@every_subject
def test_a_right_calibration_passes(subject: Subject) -> None:
    findings = check_rig(subject[0]) + check_pictures(*subject)
    assert {finding.level for finding in findings} == {"ok"}, findings


# ---- planted errors --------------------------------------------------------------------------------------


def unchanged(given: Any) -> Any:
    return given


def times(factor: float) -> OfRig:
    return lambda rig: from_matrices(rig, factor)


NOTHING = "", ""
# What is done to the rig and to the images; what images tell of it and its fix; what numbers alone tell.
PLANTED: dict[str, tuple[Any, Any, tuple[str, str], tuple[str, str]]] = {
    "exchanged images": (
        unchanged, exchanged, ("the images are exchanged", "calibration is in order"), NOTHING
    ),
    "exchanged files": (
        exchanged_files, unchanged, ("exchanged in the calibration", "images are in order"), NOTHING
    ),
    "both ends exchanged": (exchanged_files, exchanged, ("images and calibration agree", ""), NOTHING),
    "wrong sign": (times(-1), unchanged, ("has the wrong sign", "images are in order"), ("", "must be -fx")),
    **{
        unit: (times(1 / UNITS[unit]), unchanged, ("", f"--unit {unit}"), (said, f"--unit {unit}"))
        for unit, said in (
            ("mm", "like millimetres"), ("cm", "like centimetres"), ("inch", "unusual"), ("um", "like micro")
        )
    },
    "half size": (half_size, unchanged, ("0.5 times the size", ""), ("camera_matrix is of", "by 2")),
}  # fmt: skip


@every_subject
@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_error_is_found_and_named(subject: Subject, name: str) -> None:
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
    phantom: Subject, change: OfRig, what: str, fix: str
) -> None:
    """What is said to do undoes it, since it is its own inverse."""
    rig, pairs = phantom
    finding = worst(check_pictures(change(rig), pairs))
    assert finding.level == "error" and what in finding.what and fix in finding.fix
    again = change(change(rig))
    np.testing.assert_allclose(again.right.R, from_matrices(rig, 1.0).right.R, atol=1e-9)
    assert worst(judge(again, pairs)).level == "ok"


def test_without_a_baseline_nothing_is_said_of_its_sign(phantom: Subject) -> None:
    rig, pairs = phantom
    P = rig.right.P * [1, 1, 1, 0]
    found = judge(StereoRig("two mono", rig.left, replace(rig.right, P=P)), pairs)
    assert [finding.what for finding in found if finding.level != "ok"] == [
        "projection_matrix[3] is 0 in left.yaml and 0 in right.yaml: there is no baseline"
    ]


@every_subject
def test_another_picture_size(subject: Subject) -> None:
    rig, pairs = subject
    double = [(left.repeat(2, 0).repeat(2, 1), right.repeat(2, 0).repeat(2, 1)) for left, right in pairs]
    (finding,) = check_pictures(rig, double)
    assert finding.level == "error" and "2 times as large" in finding.what
    assert f"{rig.path} -o FOLDER --scale 2" in finding.fix
    (finding,) = check_pictures(rig, [(left[:-20], right[:-20]) for left, right in pairs])
    assert "cropped" in finding.fix


@pytest.mark.parametrize(
    ("change", "said", "figures"),
    [
        (lambda rig: with_right_turned(rig, (0.3, 0, 0)), "warning: one eye were turned", (0.3, 0, None)),
        (lambda rig: with_right_turned(rig, (0, 0, 0.6)), "warning: one eye were turned", (0, 0.6, None)),
        (lambda rig: with_principal_point_moved(rig, 0.0, -1.5), "warning: px lower", (None, None, 1.5)),
        (lambda rig: with_right_turned(rig, (3.0, 0, 1.0)), "error: not of these images", (None, None, None)),
    ],
    ids=["pitch", "roll", "principal point", "another scope"],
)
def test_what_rows_tell_is_said_with_its_figures(
    phantom: Subject, change: OfRig, said: str, figures: Any
) -> None:
    finding = worst(check_pictures(change(phantom[0]), phantom[1]))
    level, what = said.split(": ")
    assert finding.level == level and what in finding.what + finding.fix
    for name, true in zip(("pitch_deg", "roll_deg", "row_offset_px"), figures, strict=True):
        tolerance = 0.1 if not true or name == "row_offset_px" else 0.05
        assert true is None or abs(finding.figures[name]) == pytest.approx(true, abs=tolerance)


@pytest.mark.parametrize("scale", [0.01, -0.01])
def test_an_eye_of_another_scale_is_said_with_its_fix(phantom: Subject, scale: float) -> None:
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


def test_a_scale_too_large_for_stereo_is_said_with_the_rows(phantom: Subject) -> None:
    rig, pairs = phantom
    (finding,) = check_pictures(with_right_focal(rig, 1 / 1.1), pairs)
    assert finding.level == "error" and "rows differ" in finding.what
    assert "larger than the calibration says" in finding.what
    assert finding.figures["scale"] == pytest.approx(0.1, rel=BENT)


@pytest.mark.parametrize("bent", [0.0, 3.0])
def test_a_scale_is_named_only_where_it_fixes_the_rows(bent: float) -> None:
    """By arithmetic: rows 1 % too large, and bent by so many px to either side."""
    rng = np.random.default_rng(0)
    columns, lines = rng.uniform(40, 630, 500), rng.uniform(10, 500, 500)
    right = 255.5 + 1.01 * (lines - 255.5) + bent * np.cos(columns / 50) + rng.normal(0, 0.2, 500)
    rows = rectified_rows(PLANE, np.column_stack([columns, lines, columns - 30, right]))
    (finding,) = judge_scale(PLANE, rows)
    assert finding.figures["scale"] == pytest.approx(0.01, abs=4 * rows.scale_error)
    assert rows.left_over == pytest.approx(np.hypot(0.2, bent / np.sqrt(2)), rel=0.15)
    assert ("set fx to" in finding.fix) == (bent == 0)
    assert ("distortion is wrong" in finding.what) == (bent > 0)


def test_known_depths_show_what_rows_cannot(phantom_session: Path, phantom: Subject) -> None:
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
def test_an_offset_is_told_from_a_longer_baseline_if_depths_differ(nearest: float, farthest: float) -> None:
    """By arithmetic: disparity = f B / Z + 0.3 px, with noise of 0.2 px, on a leaning plane."""
    depth = np.tile(1 / np.linspace(1 / nearest, 1 / farthest, 640), (512, 1)).astype(np.float32)
    rng = np.random.default_rng(0)
    columns, lines = rng.integers(10, 630, 4000), rng.integers(10, 500, 4000)
    disparity = 2.4 / depth[lines, columns] + 0.3 + rng.normal(0, 0.2, 4000)
    matches = np.column_stack([columns, lines, columns - disparity, lines])
    (finding,) = judge_known_depths(PLANE, [matches], [depth])
    assert finding.figures["offset_px"] == pytest.approx(0.3, abs=0.02)
    assert ("longer" in finding.what) == (farthest - nearest < 0.01)
    depth[:, 1::2] = 0
    assert judge_known_depths(PLANE, [matches], [depth]) == []  # every point lies beside an unknown one


def test_rectified_pictures_exchanged(data_folder: Path) -> None:
    """Rows tell nothing here; on which side the points lie does."""
    folder, rig = data_folder / "hamlyn_invivo_001_100", load_rig(ROOT / "calib/hamlyn_heart")
    left, right = (read_picture(min((folder / side).iterdir())) for side in ("left", "right"))
    assert worst(check_pictures(rig, [(left, right)])).level == "ok"
    assert "the images are exchanged" in worst(check_pictures(rig, [(right, left)])).what


def test_principal_points_far_apart_are_not_taken_for_an_exchange(phantom: Subject) -> None:
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


def test_highlights_are_no_points_of_the_tissue(phantom: Subject) -> None:
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


def test_pictures_that_show_nothing(phantom: Subject) -> None:
    grey = np.full_like(phantom[1][0][0], 90)
    (finding,) = check_pictures(phantom[0], [(grey, grey)])
    assert finding.level == "warning" and "too few to judge" in finding.what


# ---- numbers alone ---------------------------------------------------------------------------------------


def test_distortion_that_turns_back(phantom: Subject) -> None:
    rig, _ = phantom
    folded = replace(rig.left, distortion=np.array([-0.089, 0.94, 0, 0, -14.8]))
    findings = check_rig(StereoRig("folded", folded, rig.right))
    (warned,) = [finding for finding in findings if finding.level == "warning"]
    radius = np.linspace(0, 1, 100_000)  # where the model's radius stops growing, by brute force
    grown = radius * (1 - 0.089 * radius**2 + 0.94 * radius**4 - 14.8 * radius**6)
    reached = grown.max() * rig.left.K[0, 0]
    assert f"left.yaml: the distortion turns back {reached:.0f} px" in warned.what


# ---- the command -----------------------------------------------------------------------------------------


IMAGES = "--images {session}/left/0000.jpg {session}/right/0000.jpg"
CALIB = "{session}/calib"


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (f"{CALIB} {IMAGES} {IMAGES}", 0, "rows agree"),
        # A recording without a launch file is a session, too, with its own calibration or to check one with.
        (CALIB + " --session {bare}", 0, "rows agree"),
        ("{whole}", 0, "rows agree"),
        (
            CALIB + " --session {session} source.left:={session}/right source.right:={session}/left",
            1, "the images are exchanged",
        ),
        ("{wrong} --session {session}", 1, "has the wrong sign"),  # with it no session opens
        (CALIB + " other", 2, "one calibration at a time"),
        (CALIB + " --session {session} --images a b", 2, "one of them is enough"),
        ("{session}/left", 2, "is no calibration; looked for"),
        ("{one_eyed}", 2, "no right eye"),
    ],
)  # fmt: skip
def test_the_command(phantom_session: Path, tmp_path: Path, arguments: str, code: int, said: str) -> None:
    save_rig(from_matrices(load_rig(phantom_session / "calib"), -1), tmp_path / "wrong")
    for name, parts in (("bare", ("left", "right")), ("whole", ("left", "right", "calib"))):
        (tmp_path / name).mkdir()
        for part in parts:
            (tmp_path / name / part).symlink_to(phantom_session / part)
    write_clip(tmp_path / "one_eyed", 2)
    places = {name: tmp_path / name for name in ("wrong", "bare", "whole", "one_eyed")}
    found = ran("calib", "check", *arguments.format(session=phantom_session, **places).split())
    assert found[0] == code and said in found[2 if code == 2 else 1], found
    assert bool(found[1]) == (code != 2) and ("cannot be used" in found[2]) == (code == 1)


def test_pictures_of_several_sizes(phantom_session: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(SagsError, match="64x64 and 320x256"):
        pairs_of_files([(phantom_session / "left/0000.jpg", tmp_path / "small.png")])


# ---- a rig for eyes that nobody has calibrated ------------------------------------------------------------


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
