"""Boards drawn through the exact model of a known rig, and the rig found again."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from command_line import figures_of, ran, refused
from drawn_boards import SIZE, SQUARE, SQUARES, charuco_print, chessboard_print, draw_pairs, known_rig, poses

from sags_node.errors import SagsError
from sags_node.rig import load_rig
from sags_node.tools.calibration.boards import Charuco, Chessboard, StereoView, find_in_both
from sags_node.tools.calibration.solve import Solution, calibrate
from sags_node.tools.calibration.stereo import coverage_hints
from sags_node.types import F32, U8, StereoRig

Pairs = list[tuple[U8, U8]]


def write_pairs(folder: Path, pairs: Pairs) -> tuple[Path, Path]:
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
    for index, pair in enumerate(pairs):
        for side, picture in zip(("left", "right"), pair, strict=True):
            cv2.imwrite(str(folder / side / f"{index:02d}.png"), picture)
    return folder / "left", folder / "right"


@pytest.fixture(scope="module")
def chess_pairs() -> Pairs:
    return draw_pairs(chessboard_print(), poses())


def exact_views(count: int = 18) -> list[StereoView]:
    """The corners themselves, without images."""
    rig, points = known_rig(), Chessboard(SQUARES, SQUARE).points.astype(np.float64)
    views = []
    for index, pose in enumerate(poses()[:count]):
        corners = []
        for eye, T in ((rig.left, np.eye(4)), (rig.right, rig.T_right_left)):
            camera = T @ pose
            rvec = cv2.Rodrigues(camera[:3, :3])[0]
            corners.append(cv2.projectPoints(points, rvec, camera[:3, 3], eye.K, eye.distortion)[0][:, 0])
        left, right = (corner.astype(np.float32) for corner in corners)
        views.append(StereoView(f"{index:02d}.png", np.arange(len(points)), left, right))
    return views


sags = partial(ran, "calib", "stereo")


BOARD = ["--squares", "10x7", "--square-mm", "4.5"]


def assert_recovered(rig: StereoRig) -> None:
    """Focal lengths to 0.5 %, baseline to 1 %, and the found rig rectifies what the known one sees."""
    known = known_rig()
    for found, true in ((rig.left, known.left), (rig.right, known.right)):
        np.testing.assert_allclose(np.diag(found.K), np.diag(true.K), rtol=0.005)
        np.testing.assert_allclose(found.K[:2, 2], true.K[:2, 2], atol=2.0)
    assert rig.baseline == pytest.approx(known.baseline, rel=0.01)
    points = np.random.default_rng(1).uniform([-0.02, -0.015, 0.05], [0.02, 0.015, 0.12], (400, 3))
    rows = []
    for eye, own, T in ((rig.left, known.left, np.eye(4)), (rig.right, known.right, known.T_right_left)):
        rvec = cv2.Rodrigues(T[:3, :3])[0]
        raw = cv2.projectPoints(points, rvec, T[:3, 3], own.K, own.distortion)[0]
        inside = ((raw[:, 0] > 0) & (raw[:, 0] < np.array(SIZE) - 1)).all(-1)
        rectified = cv2.undistortPoints(raw, eye.K, eye.distortion, R=eye.R)[:, 0, 1] * eye.P[1, 1]
        rows.append(np.where(inside, rectified, np.nan))
    errors = np.abs(rows[0] - rows[1])
    assert np.isfinite(errors).sum() > 100
    assert np.nanpercentile(errors, 90) < 0.2


# ---- the whole command -----------------------------------------------------------------------------------


def test_chessboard_pictures_to_a_rig(chess_pairs: Pairs, tmp_path: Path) -> None:
    out, folders = tmp_path / "rig", write_pairs(tmp_path, chess_pairs)
    summary = figures_of("calib", "stereo", *folders, *BOARD, "-o", out, "--json")
    assert_recovered(load_rig(out))
    assert summary["views"] >= 15 and summary["error_px"] < 0.2
    assert summary["row_error_px"]["p90"] < 0.2
    assert {finding["level"] for finding in summary["findings"]} == {"ok"}
    assert summary["dropped"] == {}
    tree = yaml.safe_load((out / "right.yaml").read_text())
    assert tree["distortion_model"] == "plumb_bob" and tree["projection_matrix"]["data"][3] < 0


def test_charuco_seen_in_part(tmp_path: Path) -> None:
    """Held so near that part of the board is outside: only markers tell which corners are seen."""
    near = []
    for pose in poses()[:12]:
        moved = pose.copy()
        moved[:3, 3] *= 0.72
        near.append(moved)
    folders = write_pairs(tmp_path / "pictures", draw_pairs(charuco_print(), near))
    charuco = ["--board", "charuco", "--marker-mm", "3.375", "--dictionary", "4X4_50"]
    code, said, err = sags(*folders, *BOARD, *charuco, "-o", tmp_path / "rig", "--json")
    assert code == 0, err
    corners = [view["corners"] for view in json.loads(said)["per_view"].values()]
    assert min(corners) < 54  # the recording is what the test is for
    assert_recovered(load_rig(tmp_path / "rig"))


def test_live_takes_new_views_that_are_held_still(chess_pairs: Pairs, tmp_path: Path) -> None:
    """A session in which poses are passed, then one is held for two frames; the first comes back last."""
    held: Pairs = []
    for index in range(8):
        held += [chess_pairs[8 + index], chess_pairs[index], chess_pairs[index]]
    held += chess_pairs[:1] * 2
    write_pairs(tmp_path / "session", held)
    launch = tmp_path / "session/launch.yaml"
    source = {"kind": "folders", "left": "left", "right": "right", "rate": 30, "pace": "step"}
    out = tmp_path / "rig"
    launch.write_text(yaml.safe_dump({"source": {**source, "frames": 1}}))
    code, _, err = sags("--live", launch, *BOARD, "-o", out)
    assert code == 1 and "no view was taken: show the board to both eyes" in err  # and it may be tried again
    launch.write_text(yaml.safe_dump({"source": source}))
    code, said, err = sags("--live", launch, *BOARD, "-o", out, "--json")
    assert code == 0, err
    summary = json.loads(said)
    assert summary["pairs"] == 8  # those that were held, once each
    assert len(list((out / "views/left").iterdir())) == len(list((out / "views/right").iterdir())) == 8
    assert load_rig(out).baseline == pytest.approx(known_rig().baseline, rel=0.02)
    code, _, err = sags("--live", launch, *BOARD, "-o", out)
    assert code == 2 and "exists already" in err


# ---- clear messages --------------------------------------------------------------------------------------


def test_too_few_views(chess_pairs: Pairs, tmp_path: Path) -> None:
    folders = write_pairs(tmp_path / "few", chess_pairs[:4])
    code, out, err = sags(*folders, *BOARD, "-o", tmp_path / "rig")
    assert code == 1 and out == "" and "4 usable views" in err and "6 are needed" in err
    assert not (tmp_path / "rig/left.yaml").exists()


@pytest.mark.parametrize("said", ["9x6", "11x8"])
def test_wrong_number_of_squares(chess_pairs: Pairs, tmp_path: Path, said: str) -> None:
    """9x6 is what ROS calls this board: it counts inner corners. A part of the board must not pass for it."""
    folders = write_pairs(tmp_path / "wrong", chess_pairs[:7])
    code, _, err = sags(*folders, "--squares", said, "--square-mm", "4.5", "-o", tmp_path / "rig")
    assert code == 1 and "a board of 10x7 squares is seen" in err


@pytest.mark.parametrize("legacy", [False, True])
def test_charuco_of_the_legacy_pattern(legacy: bool) -> None:
    """A board with an even number of rows: its markers lie on the other squares."""
    squares = SQUARES[0], SQUARES[1] - SQUARES[1] % 2
    picture = charuco_print(squares, legacy).picture
    corners = (squares[0] - 1) * (squares[1] - 1)
    seen, other = (
        Charuco(squares, SQUARE, 0.75 * SQUARE, "4X4_50", said).find(picture) for said in (legacy, not legacy)
    )
    assert seen is not None and len(seen.ids) == corners
    assert other is None or len(other.ids) < corners / 2


def test_wrong_dictionary_and_wrong_charuco(tmp_path: Path) -> None:
    left, right = draw_pairs(charuco_print(), poses()[:1])[0]
    gray = left[..., 0]
    assert "no marker of 6X6_250 is seen" in Charuco(SQUARES, SQUARE, 0.75 * SQUARE, "6X6_250").explain(gray)
    small = Charuco((5, 4), SQUARE, 0.75 * SQUARE, "4X4_50")
    assert find_in_both(small, "a", left, right) is None
    assert "the board has 0 to 9" in small.explain(gray)


def test_counts_that_differ(tmp_path: Path, chess_pairs: Pairs, caplog: pytest.LogCaptureFixture) -> None:
    """Names tell the partners; where they do not, numbers must be equal. The report is for people."""
    left, right = write_pairs(tmp_path / "odd", chess_pairs[:7])
    (right / "03.png").unlink()
    code, said, err = sags(left, right, *BOARD, "-o", tmp_path / "rig")
    assert code == 0 and "03.png; they are left out" in caplog.text and "calibration:" in err
    assert all(part in said for part in ("baseline", "4.7", "focal length", "worst views", "check: ok"))
    for file in right.iterdir():
        file.rename(right / f"r{file.stem}_.png")
    code, _, err = sags(left, right, *BOARD, "-o", tmp_path / "other")
    assert code == 2 and "holds 7 images" in err and "holds 6" in err


CHARUCO = "left right --board charuco"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("left", "give two folders"),
        ("left right --live x.yaml", "give two folders"),
        (CHARUCO, "needs --marker-mm and --dictionary"),
        (f"{CHARUCO} --marker-mm 5 --dictionary 4X4_50", "must be below"),
        (f"{CHARUCO} --marker-mm 3 --dictionary 9X9", "known are"),
        (
            f"{CHARUCO} --marker-mm 3 --dictionary 4X4_50 --squares 12x10",
            "has 50 markers, a board of 12x10 squares 60",
        ),
        ("left right --marker-mm 3", "belong to --board charuco"),
        ("left right --legacy", "belong to --board charuco"),
        ("gone_left gone_right", "image folder gone_left does not exist"),
    ],
)
def test_usage(tmp_path: Path, arguments: str, said: str) -> None:
    refused(2, "calib", "stereo", *BOARD, *arguments.split(), "-o", tmp_path / "rig", said=(said,))


# ---- the solution ----------------------------------------------------------------------------------------


def solve(views: list[StereoView]) -> Solution:
    return calibrate("found", views, Chessboard(SQUARES, SQUARE).points, SIZE)


def test_exact_corners_give_the_exact_rig() -> None:
    solution = solve(exact_views())
    known = known_rig()
    assert solution.error < 1e-3
    np.testing.assert_allclose(solution.rig.left.K, known.left.K, atol=0.05)
    assert solution.rig.baseline == pytest.approx(known.baseline, rel=1e-4)
    np.testing.assert_allclose(solution.board_poses, np.stack(poses()), atol=1e-4)


def test_a_bad_view_is_left_out_and_named() -> None:
    views = exact_views()
    bad = StereoView("bad.png", views[4].ids, views[4].left, views[4].right + np.float32([3.0, 8.0]))
    rng = np.random.default_rng(2)
    noisy = [
        StereoView(view.name, view.ids, jitter(view.left, rng), jitter(view.right, rng)) for view in views
    ]
    noisy[4] = bad
    solution = solve(noisy)
    assert list(solution.dropped) == ["bad.png"] and solution.dropped["bad.png"] > 1
    assert_recovered(solution.rig)


def jitter(corners: F32, rng: np.random.Generator) -> F32:
    return (corners + rng.normal(0, 0.1, corners.shape)).astype(np.float32)


def test_left_and_right_of_different_moments() -> None:
    views = exact_views()
    mixed = [
        StereoView(view.name, view.ids, view.left, other.right)
        for view, other in zip(views, views[1:] + views[:1], strict=True)
    ]
    with pytest.raises(SagsError, match=r"same moment|usable views"):
        solve(mixed)


def test_a_chessboard_upside_down_in_one_eye_is_turned_back(chess_pairs: Pairs) -> None:
    """Symmetric boards (here 9x7 squares) look the same upside down; the eyes must not disagree."""

    class Upside(Chessboard):
        calls = 0

        def find(self, gray: U8) -> Any:
            seen = super().find(gray)
            self.calls += 1
            return seen if seen is None or self.calls % 2 else seen._replace(corners=seen.corners[::-1])

    plain = find_in_both(Chessboard(SQUARES, SQUARE), "a", *chess_pairs[0])
    turned = find_in_both(Upside(SQUARES, SQUARE), "a", *chess_pairs[0])
    np.testing.assert_array_equal(plain.right, turned.right)


# ---- hints -----------------------------------------------------------------------------------------------


def test_good_views_lack_nothing() -> None:
    solution = solve(exact_views())
    assert coverage_hints(solution.views, solution.board_poses, SIZE) == []


def test_hints_name_what_is_lacking() -> None:
    flat = np.tile(np.eye(4), (6, 1, 1))
    flat[:, 2, 3] = 0.07
    corners = np.random.default_rng(0).uniform((165, 0), (SIZE[0] - 1, SIZE[1] - 1), (60, 2))
    views = [
        StereoView(str(i), np.arange(60), corners.astype(np.float32), corners.astype(np.float32))
        for i in range(6)
    ]
    hints = "\n".join(coverage_hints(views, flat, SIZE))
    assert "6 views are few" in hints
    assert "the left image has hardly any corners at top left, middle left, bottom left" in hints
    assert "tilted left and right by 0 degrees" in hints and "tilted up and down by 0 degrees" in hints
    assert "same distance" in hints
    tilted = flat.copy()
    for index, degrees in enumerate(np.linspace(-20, 20, 6)):
        tilted[index, :3, :3] = cv2.Rodrigues(np.radians([0.0, degrees, 0.0]))[0]
    hints = "\n".join(coverage_hints(views, tilted, SIZE))
    assert "left and right by" not in hints and "up and down by 0 degrees" in hints
