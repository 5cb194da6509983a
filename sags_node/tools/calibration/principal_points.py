"""Whether the eyes' principal points differ, from matches whose depth is known.

In rectified images disparity = f B / Z + c, where c is how much farther to the right the left eye's
principal point lies than the calibration says. Matches alone cannot show c: every other depth fits them as
well. Only depths from elsewhere do, and only where these are right: an error of theirs looks the same. In
heights it is otherwise: rows must agree whatever the depth (`rows`).
"""

from collections.abc import Sequence

import cv2
import numpy as np

from sags_node.checks import Finding
from sags_node.tools.calibration.rows import FEWEST_MATCHES, fit_without_outliers, rectified_rows
from sags_node.types import F32, F64, StereoRig

NOTICED = 0.1  # px of the full image: reference depths and matches are no more exact
SLOPE = 0.03  # of the depth, over `AROUND`: more is an edge, and its depth belongs to either side
AROUND = 9  # px
OUTLIER = 3.0 * 1.4826  # times the median distance: 3 sigma


def judge_known_depths(rig: StereoRig, matches: Sequence[F64], depths: Sequence[F32 | None]) -> list[Finding]:
    """Return what known depths say of a rig's principal points; nothing where there are too few.

    Args:
        matches: of each image pair, [M, 4] raw pixels, as `match_eyes` gives them.
        depths: of the same pairs, [H, W] m of the left rectified image, 0 unknown; None: not known.
    """
    known = []
    for found, picture in zip(matches, depths, strict=True):
        if picture is not None and len(pair := _disparities(rig, found, picture)) >= FEWEST_MATCHES:
            known.append(pair)
    if not known:
        return []
    each = [float(np.median(pair[:, 0] - pair[:, 1])) for pair in known]
    seen, true = np.concatenate(known).T
    offset = float(np.median(seen - true))
    line = np.column_stack([true, np.ones(len(true))])
    scale, free = map(float, fit_without_outliers(line, seen, OUTLIER)[0])
    f_b = float(rig.left.P[0, 0]) * rig.baseline
    depth = f_b / float(np.median(true))
    nearer = offset * depth**2 / f_b * 1e3
    figures = {
        "offset_px": round(offset, 3),
        "offset_smallest_px": round(min(each), 3),
        "offset_largest_px": round(max(each), 3),
        "offset_with_scale_px": round(free, 3),
        "scale": round(scale, 4),
        "pictures": len(each),
        "matches": len(true),
        "depth_median_m": round(depth, 4),
        "nearer_mm": round(nearer, 3),
    }
    spread = f"{offset:+.2f} px ({min(each):+.2f} to {max(each):+.2f} in {len(each)} images)"
    if abs(offset) < NOTICED:
        return [Finding("ok", f"disparities fit the known depths to {spread}", "", figures)]
    where = f"{abs(nearer):.1f} mm too {'near' if nearer > 0 else 'far'}"
    what = (
        f"disparities are {spread} off those of the known depths, as if the principal points differed so "
        f"much: at {depth * 1e3:.0f} mm depth comes out {where}"
    )
    if abs(free - offset) > NOTICED:
        what += f"; a baseline longer by {scale - 1:.1%} and {free:+.2f} px fit as well"
    fixed = rig.right.K[0, 2] - offset
    fix = (
        "calibrate again with a board near and far; or, if the known depths are not from these images "
        f"(say, structured light or CT), set cx in camera_matrix of right.yaml to {fixed:.2f}"
    )
    return [Finding("warning", what, fix, figures)]


def _disparities(rig: StereoRig, matches: F64, depth: F32) -> F64:
    """Seen and expected disparity, [M, 2] px of the rectified images, away from edges of the depth."""
    rows = rectified_rows(rig, matches)
    K = rig.left.P[:, :3]
    pixels = cv2.undistortPoints(matches[:, None, :2], rig.left.K, rig.left.distortion, R=rig.left.R, P=K)
    columns, lines = np.rint(pixels[:, 0]).astype(np.intp).T
    height, width = depth.shape
    inside = (columns >= 0) & (columns < width) & (lines >= 0) & (lines < height)
    columns, lines, seen = columns[inside], lines[inside], rows.disparities[inside]
    window = np.ones((AROUND, AROUND), np.uint8)
    nearest, farthest = (
        change(depth, window)[lines, columns].astype(np.float64) for change in (cv2.erode, cv2.dilate)
    )
    smooth = (nearest > 0) & (farthest - nearest < SLOPE * nearest)  # 0 is unknown
    true = rig.left.P[0, 0] * rig.baseline / depth[lines, columns][smooth].astype(np.float64)
    return np.column_stack([seen[smooth], true])
