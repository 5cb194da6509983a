"""`sags calib check`: a calibration, alone or against the images it is for."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.checks import Finding, is_wrong
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LaunchConfig, PhantomSource
from sags_node.errors import SagsError, UsageError
from sags_node.phantom import cached_session
from sags_node.rig import (
    already_rectified,
    check_eyes,
    check_pair,
    find_form,
    read_rig,
    rectifies,
    unknown_form,
    with_unit,
    wrong_size,
)
from sags_node.sources.rectified import as_named, as_pictures_come
from sags_node.sources.source import recorded_rig
from sags_node.tools.calibration.guess import first_pairs
from sags_node.tools.calibration.matches import match_eyes
from sags_node.tools.calibration.pictures import Pair, pairs_of_files, pairs_of_session
from sags_node.tools.calibration.principal_points import judge_known_depths
from sags_node.tools.calibration.rows import Rows, judge_matches, judge_rectified, judge_scale, rectified_rows
from sags_node.types import F32, U8, Bool, StereoFrame, StereoRig
from sags_node.vision.inverse_search import at_pixels, centres
from sags_node.vision.matchers import Patches, match_patches
from sags_node.vision.pyramid import gray_pyramid
from sags_node.vision.rectify import Rectifier
from sags_node.vision.stereo import FULL_SIZE_BELOW

FEWEST_KNOWN = 0.1  # share of the patches that must match
FOUND_BACK = 0.7  # px: largest distance at which a patch is matched back to itself

Progress = Callable[[int, int], None]
Launched = Callable[[Path, Sequence[str]], LaunchConfig]
GOOD_ROWS = (0.7, 2.0)  # px of the full image, median and 90 %
FIRST_PAIRS = 2  # that tell whether images were rectified
DISPARITY_MARGIN = 4.0  # px beyond those of matched points


def check_calibration(
    path: Path,
    session: Path | None = None,
    images: Sequence[tuple[Path, Path]] = (),
    overrides: Sequence[str] = (),
    size: tuple[int, int] | None = None,
    metres: float | None = None,
    progress: Progress | None = None,
    launched: Launched = load_launch,
) -> list[Finding]:
    """Look over a calibration, or the one a session uses, and compare it with images where there are some.

    Args:
        path: a calibration of any known form, or a session, which is then compared with its own images.
        session: launch file or recording whose images are used.
        images: pairs of files or of folders.
        overrides: `key:=value` of the session.
        size, metres: as in `read_rig`.
        launched: reads a session.

    Raises:
        UsageError: a path is wrong, or nothing known is there.
        SagsError: images cannot be read.
    """
    own = None if find_form(path) is not None else _launched(path, overrides, launched)
    config = own if session is None else launched(session, overrides)
    pairs: list[Pair] = []
    depths: Sequence[F32 | None] = ()
    if images:
        pairs = pairs_of_files(images)
    elif config is not None:
        pairs, depths = pairs_of_session(config, progress)
    if pairs and size is None:
        size = pairs[0][0].shape[1], pairs[0][0].shape[0]
    if own is not None:
        rig = _rig_of(own, size, metres)
    elif config is not None:
        rig = as_pictures_come(read_rig(path, size, metres), config.model_copy(update={"rig": path}))
    else:
        rig = as_named(read_rig(path, size, metres), *(file for pair in images for file in pair))
    return judge(rig, pairs, depths, metres)


def read_calibration(
    path: Path, size: tuple[int, int] | None, metres: float | None, launched: Launched = load_launch
) -> StereoRig:
    """Read a calibration by `read_rig`, or the one that a session uses."""
    known = find_form(path) is not None
    return read_rig(path, size, metres) if known else _rig_of(_launched(path, (), launched), size, metres)


def judge(
    rig: StereoRig, pairs: Sequence[Pair], depths: Sequence[F32 | None] = (), metres: float | None = None
) -> list[Finding]:
    """Look over a calibration, and compare it with raw images where there are some."""
    findings = check_eyes(rig)
    if is_wrong(findings):
        return findings
    findings += check_pair(rig, metres)
    if rig.left.P[0, 3] == rig.right.P[0, 3]:  # without a baseline images tell nothing
        return findings
    return findings + (check_pictures(rig, pairs, depths) if pairs else [])


def check_pictures(rig: StereoRig, pairs: Sequence[Pair], depths: Sequence[F32 | None] = ()) -> list[Finding]:
    """Return what raw images say of a rig whose numbers are sound.

    Args:
        depths: what is known of each pair's depth, [H, W] m of the left rectified image, 0 unknown.
    """
    height, width = pairs[0][0].shape[:2]
    if wrong := wrong_size(rig.path, (rig.left.width, rig.left.height), (width, height)):
        return [wrong]
    found = [match_eyes(*pair) for pair in pairs]
    matches = np.concatenate(found)
    rectified = judge_rectified(rig, matches)
    if rectified:
        rig = already_rectified(rig)
    findings = rectified + judge_matches(rig, matches)
    if findings[-1].level == "ok":
        rows = rectified_rows(rig, matches)
        findings.append(_check_rows(rig, pairs, rows))
        findings += judge_scale(rig, rows)
        if depths:
            findings += judge_known_depths(rig, found, depths)
    return findings


def rectified_before(config: LaunchConfig) -> bool:
    """Tell whether the first images of a session show that they were rectified, though their names do not
    say so; False where they cannot be read."""
    try:
        rig = _rig_of(config, None, None)
        if config.rectified is not None or not rectifies(rig):
            return False
        matches = [match_eyes(*pair) for pair in first_pairs(config.source, FIRST_PAIRS)[2]]
    except SagsError:  # that is reported when it is played
        return False
    return bool(matches) and bool(judge_rectified(rig, np.concatenate(matches)))


def _launched(path: Path, overrides: Sequence[str], launched: Launched) -> LaunchConfig:
    if not path.exists():
        raise UsageError(unknown_form(path))
    try:
        return launched(path, overrides)
    except UsageError as error:
        if (path / "launch.yaml").exists():
            raise
        raise UsageError(f"{unknown_form(path)}. Nor is it a session: {error}") from None


def _rig_of(config: LaunchConfig, size: tuple[int, int] | None, metres: float | None) -> StereoRig:
    """The calibration that a session would use, not judged yet."""
    if isinstance(config.source, PhantomSource):
        return read_rig(cached_session(config.source) / "calib")
    if config.rig is not None:
        return as_pictures_come(read_rig(config.rig, size, metres), config)
    rig = recorded_rig(config.source, judged=False)
    if rig is None:
        raise UsageError("the session names no calibration: set rig to its folder")
    return as_pictures_come(with_unit(rig, metres), config)


def _check_rows(rig: StereoRig, pairs: Sequence[Pair], rows: Rows) -> Finding:
    """A finding on dense row errors: more exact than matched points, which must fit roughly already."""
    rectifier = Rectifier(rig, rig.left.width, rig.left.height)
    smallest, largest = np.percentile(rows.disparities, [2, 98])
    measured = []
    for left, right in pairs:
        pair = rectifier(StereoFrame(0, 0, 0, left, right))
        assert pair.right is not None  # this frame has one
        error = measure_rows(pair.left, pair.right, smallest - DISPARITY_MARGIN, largest + DISPARITY_MARGIN)
        if error is not None:
            measured.append(error)
    if not measured:
        return Finding("warning", "too little matches densely to measure rows", "give sharper images")
    median, p90, matched = (float(figure) for figure in np.median(measured, axis=0))
    figures = {"row_median_px": round(median, 3), "row_p90_px": round(p90, 3), "matched": round(matched, 3)}
    what = f"rows agree to {median:.2f} px (median), {p90:.2f} px (90 %), over {matched:.0%} of the image"
    if median <= GOOD_ROWS[0] and p90 <= GOOD_ROWS[1]:
        return Finding("ok", what, "", figures)
    fix = "depth suffers: calibrate again, with the scope as it is used"
    if rows.scale_differs:  # that is reported next, and what is left is no rotation
        return Finding("warning", what, fix, figures)
    pitch, roll = rows.turn
    lower = float(np.median(rows.errors))
    turned = (
        f"; as if one eye were turned by {pitch:.2f} degrees up or down, {roll:.2f} about its axis, or the "
        f"right one's principal point lay {abs(lower):.1f} px {'lower' if lower > 0 else 'higher'}"
    )
    turn = {"pitch_deg": pitch, "roll_deg": roll, "row_offset_px": round(lower, 3)}
    return Finding("warning", what + turned, fix, figures | turn)


class RowError(NamedTuple):
    """The row errors of a rectified pair, px of the full images."""

    median: float
    p90: float
    matched: float  # share of the image, 0..1


def measure_rows(left: U8, right: U8, smallest: float, largest: float) -> RowError | None:
    """Measure row errors all over a rectified pair [H, W, 3] (RGB); None where next to nothing matches.

    A patch counts only where its match is matched back to it.

    Args:
        smallest, largest: disparities to search, px.
    """
    halvings = 1 if left.shape[1] >= FULL_SIZE_BELOW else 0
    disparities = smallest / 2**halvings, largest / 2**halvings
    found = match_patches(gray_pyramid(left), gray_pyramid(right), disparities, halvings)
    there, back = (gray_pyramid(np.ascontiguousarray(eye[:, ::-1])) for eye in (right, left))
    mirrored = match_patches(there, back, disparities, halvings)
    known = found.good & _found_back(found, mirrored)
    if np.mean(known) < FEWEST_KNOWN:
        return None
    median, p90 = np.percentile(np.abs(found.field[..., 1][known]) * 2**halvings, [50, 90])
    return RowError(float(median), float(p90), float(np.mean(known)))


def _found_back(found: Patches, mirrored: Patches) -> Bool:
    """Where a left patch's match is matched back to it: each patch has some match, also a wrong one."""
    flow = at_pixels(mirrored.left, mirrored.right, mirrored.stride, mirrored.field)
    back = np.ascontiguousarray(flow[:, ::-1])  # to the right in the mirror is to the left
    columns, rows = centres(found.left, found.stride)
    there = columns + found.field[..., 0], rows + found.field[..., 1]
    x, y = (cv2.remap(back[..., k], *there, cv2.INTER_LINEAR, borderValue=np.inf) for k in (0, 1))
    near: Bool = np.hypot(x - found.field[..., 0], y + found.field[..., 1]) < FOUND_BACK
    return near
