"""D4D's truth: the scans of structured light as depth in the left image, and a check of their place."""

from itertools import product
from pathlib import Path

import cv2
import numpy as np

from sags_lab.protocols.d4d_files import Scan, instruments_are_white, matrix_in, read_tools
from sags_node import geometry
from sags_node.clients.overlay.mesh_files import parse_mesh
from sags_node.config.yaml_reader import read_yaml
from sags_node.errors import SagsError, UsageError
from sags_node.files import read_file
from sags_node.types import F32, F64, Bool, Camera

LARGEST_CLOUD = 1 << 30  # bytes
BEHIND = 3e-3  # m: a point so far behind another within `AROUND` px may be seen through gaps in the surface
AROUND = 2  # px
ALIKE = 0.1  # share of the depth that scan and stereo may differ by, if the scan is in the right place
LEAST_ALIKE = 0.5  # share of the pixels known to both that must be alike
LEAST_SHARED = 0.05  # share of the pixels known to stereo that the scan must know, too
LEAST_INSIDE = 0.9  # share of a scan that must lie inside the mask over the scanner's image


def read_surface(scan: Scan) -> tuple[F64, Bool | None]:
    """Read the points [P, 3] m of a scan, and which of them are tissue [P] by the mask over the scanner's
    image; None: there is no such mask.

    Raises:
        SagsError: a file is missing or damaged, or the files do not fit each other.
    """
    try:
        data = read_file(scan.cloud, LARGEST_CLOUD)
    except OSError as error:
        raise SagsError(f"cannot read {scan.cloud}: {error.strerror}") from None
    points, _ = parse_mesh(scan.cloud, data)
    points = points[np.isfinite(points).all(1) & (points[:, 2] > 0)]
    if not len(points):
        raise SagsError(f"{scan.cloud} holds no point in front of the scanner; download it again")
    return points, None if scan.tools is None else _is_tissue(points, scan, scan.tools)


def _is_tissue(points: F64, scan: Scan, tools: Path) -> Bool:
    white = instruments_are_white([tools])
    assert white is not None  # there is a mask
    marked = read_tools(tools, white)
    said = read_yaml(scan.scanner, "calibration of the scanner")
    try:
        K = matrix_in(said, "K", "camera_matrix", (3, 3))
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{scan.scanner} is no camera_info file ({error}); download it again") from None
    seen = points @ K.T
    columns, rows = np.rint(seen[:, :2] / seen[:, 2:]).astype(np.int64).T
    height, width = marked.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    if np.mean(inside) < LEAST_INSIDE:
        raise SagsError(
            f"{tools} is {width}x{height} px, and {np.mean(~inside):.0%} of {scan.cloud} lies outside it by "
            f"{scan.scanner}; is the mask of another size?"
        )
    tissue = np.zeros(len(points), np.bool_)
    tissue[inside] = ~marked[rows[inside], columns[inside]]
    return tissue


def scan_depth(points: F64, T_cloud_cam: F64, camera: Camera) -> F32:
    """Draw points [P, 3] as depth [H, W] m, 0 unknown, of a camera whose pose is `T_cloud_cam`.

    Each pixel takes the nearest of the points that fall on it. What is then far behind a neighbour is left
    out: it may be seen through the gaps between points.
    """
    seen = geometry.transform(geometry.invert(T_cloud_cam), points)
    seen = seen[seen[:, 2] > 0]
    pixels = seen @ camera.K.T
    columns, rows = np.rint(pixels[:, :2] / pixels[:, 2:]).clip(-1, 1 << 20).astype(np.int64).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    nearest = np.full((camera.height, camera.width), np.inf, np.float32)
    np.minimum.at(nearest, (rows[inside], columns[inside]), seen[inside, 2].astype(np.float32))
    around = cv2.erode(nearest, np.ones((2 * AROUND + 1, 2 * AROUND + 1), np.uint8))
    known: F32 = np.where(nearest <= around + BEHIND, nearest, np.inf).astype(np.float32)
    return np.where(np.isfinite(known), known, np.float32(0))


def check_scan(scan: Scan, points: F64, camera: Camera, measured: F32) -> float:
    """Return the share of pixels known to scan and stereo (`measured` [H, W] m, 0 unknown) that agree.

    Raises:
        SagsError: the surface is not where stereo sees it; it says whether another unit or the pose taken the
            other way round would put it there.
    """
    share = _alike(scan_depth(points, scan.T_cloud_cam, camera), measured)
    if share >= LEAST_ALIKE:
        return share
    better = ""
    for inverted, metres, pose_metres in product((False, True), (1.0, 1e-3), (1.0, 1e-3)):
        T = scan.T_cloud_cam.copy()
        T[:3, 3] *= pose_metres
        other = _alike(scan_depth(points * metres, geometry.invert(T) if inverted else T, camera), measured)
        if other >= LEAST_ALIKE:
            said = [
                "the pose taken the other way round" if inverted else "",
                "the points in mm" if metres < 1 else "",
                "the pose in mm" if pose_metres < 1 else "",
            ]
            better = f"; with {' and '.join(filter(None, said))} it would in {other:.0%}: correct the files"
            break
    raise SagsError(
        f"{scan.cloud.name} seen from {scan.pose} agrees with stereo in {share:.0%} of the pixels that both "
        f"know, at least {LEAST_ALIKE:.0%} should{better or '; do pose and scan belong together?'}"
    )


def _alike(depth: F32, measured: F32) -> float:
    both = (depth > 0) & (measured > 0)
    if both.sum() < LEAST_SHARED * np.count_nonzero(measured):
        return 0.0
    return float(np.mean(np.abs(depth[both] - measured[both]) <= ALIKE * measured[both]))
