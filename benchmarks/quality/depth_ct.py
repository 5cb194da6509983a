"""Depth from stereo against a surface from computed tomography: one pair of the Open-CAS set.

Maier-Hein et al., "Comparative Validation of Single-Shot Optical Techniques for Laparoscopic 3-D Surface
Reconstruction", IEEE TMI 2014.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks import Advance
from benchmarks.kernels.timing import median_ms
from benchmarks.quality.depth import Matcher, by_confidence, error_figures, make_matchers, rounded
from sags_node.config.schema import StereoConfig
from sags_node.errors import UsageError
from sags_node.geometry import project, unproject
from sags_node.rig import read_rig
from sags_node.sources.pictures import read_picture
from sags_node.tools.evaluation.provenance import machine_name
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F32, F64, U8, Bool, RectifiedPair, StereoFrame
from sags_node.vision.rectify import Rectifier
from sags_node.vision.stereo import StereoDepth

MILLIMETRE = 1e-3
SURFACE, EVALUATED = "*_CT_cut.xyz", "*_MASK_eval.png"
LARGEST_FILE = 2**24  # bytes, of the surface
HIDES_WITHIN = 13  # px: neighbouring points of the surface are at most this far apart
HIDDEN = 2e-3  # m behind a nearer point: the organ folds over itself
RUNS = 11  # of each matcher, for its time
MARGIN = 30  # px around the region, in the image
LARGEST_SHOWN = 3.0  # mm
JPEG_QUALITY = 72


@dataclass(frozen=True, slots=True)
class CTPair:
    """A rectified pair and the points of the CT surface that its left eye sees."""

    name: str
    pair: RectifiedPair
    evaluated: Bool  # [H, W] of the left rectified image
    points: F64  # [P, 3] m, left rectified camera: seen, and in the evaluated region
    pixels: F64  # [P, 2] where they are seen
    receipt: dict[str, Any]  # see `Receipt.as_json`


def read_ct_pair(folder: Path) -> CTPair:
    """Read left.png, right.png, a calibration of text matrices, the CT surface `*_CT_cut.xyz` (mm, left raw
    camera) and the region to evaluate, which is 0 in `*_MASK_eval.png`.

    Raises:
        UsageError: a file is missing or of another form.
        SagsError: an image is damaged.
    """
    left, right = (read_picture(folder / f"{side}.png") for side in ("left", "right"))
    height, width = left.shape[:2]
    rig = read_rig(folder, (width, height))
    rectifier = Rectifier(rig, width, height)
    ignored = read_picture(_only(folder, EVALUATED), cv2.IMREAD_GRAYSCALE)
    evaluated = _largest_piece(rectifier.mask(ignored == 0))
    points = _read_points(_only(folder, SURFACE)) * MILLIMETRE @ rig.left.R.T
    pixels, seen = _seen(rectifier, points, evaluated)
    frame, receipt = StereoFrame(0, 0, 0, left, right), Receipt(rig, (width, height), None)
    receipt.add(frame, evaluated)
    return CTPair(
        folder.resolve().name, rectifier(frame), evaluated, points[seen], pixels[seen], receipt.as_json()
    )


def _largest_piece(mask: Bool) -> Bool:
    """The largest piece of a mask: so strong a distortion folds the corners, and repeats the region there."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    return np.asarray(labels == 1 + np.argmax(stats[1:, cv2.CC_STAT_AREA]), np.bool_)


def _only(folder: Path, pattern: str) -> Path:
    files = sorted(folder.glob(pattern))
    if len(files) != 1:
        raise UsageError(f"{folder} holds {len(files)} files {pattern}, one is needed; check the folder")
    return files[0]


def _read_points(file: Path) -> F64:
    if file.stat().st_size > LARGEST_FILE:
        raise UsageError(f"{file} is too large for a surface; check the folder")
    try:
        points = np.loadtxt(file, np.float64, ndmin=2)
    except ValueError:
        raise UsageError(f"{file} holds something else than three numbers in each line") from None
    if points.shape[1] != 3 or not np.isfinite(points).all():  # x, y, z
        raise UsageError(f"{file} holds something else than three numbers in each line")
    return points


def _seen(rectifier: Rectifier, points: F64, evaluated: Bool) -> tuple[F64, Bool]:
    """Pixels [P, 2] of the points, and which are in the region and behind no other."""
    camera = rectifier.camera
    projected, depths = project(camera, points)
    x, y = np.rint(np.nan_to_num(projected, nan=-1)).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    x, y = x.clip(0, camera.width - 1), y.clip(0, camera.height - 1)
    front = np.full((camera.height, camera.width), np.inf, np.float32)
    np.minimum.at(front, (y[inside], x[inside]), depths[inside].astype(np.float32))
    front = cv2.erode(front, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (HIDES_WITHIN, HIDES_WITHIN)))
    seen = inside & evaluated[y, x] & (depths < front[y, x] + HIDDEN)
    return np.asarray(projected, np.float64), np.asarray(seen, np.bool_)


def errors_along_z(ct: CTPair, depth: F32) -> tuple[F64, Bool]:
    """Return measured minus true depth (mm) of points whose pixel has a depth, and which those are [P]."""
    x, y = np.rint(ct.pixels).astype(int).T
    measured = depth[y, x]
    given = measured > 0
    errors = measured[given].astype(np.float64) - ct.points[given, 2]
    return errors * 1e3, np.asarray(given, np.bool_)


def distances_to_surface(ct: CTPair, depth: F32) -> F64:
    """Return the distance (mm) of each point with a measured pixel to the region's nearest measured point.

    Measured points are a tenth of a millimetre apart, so the nearest one stands for the surface.
    """
    rows, columns = np.nonzero(depth * ct.evaluated > 0)
    if len(rows) == 0:
        return np.empty(0)
    measured = unproject(ct.pair.camera, np.stack([columns, rows], -1), depth[rows, columns])
    _, given = errors_along_z(ct, depth)
    wanted = ct.points[given].astype(np.float32)
    nearest, _ = cv2.batchDistance(wanted, measured.astype(np.float32), cv2.CV_32F, K=1)
    return np.asarray(nearest[:, 0], np.float64) * 1e3


def measure_ct(ct: CTPair, advance: Advance, network: Path | None = None) -> dict[str, Any]:
    """Measure the errors of every setting along z, as everywhere else, and to the nearest surface, and the
    share of the region that has a depth.

    `median_abs_mm`, `p90_abs_mm` and `coverage` are those of the stage as a launch file has it by default.

    Args:
        network: an ONNX file to compare as well.

    Raises:
        UsageError: as `make_matchers`.
    """
    matchers = make_matchers(StereoConfig(), ct.pair.camera, ct.pair.baseline, network)
    rows = []
    for done, (name, matcher) in enumerate(matchers.items()):
        advance(done, len(matchers), name)
        rows.append({"name": name, **_measured(ct, matcher)})
    first = rows[0]
    depth, confidence = configured_depth(ct)
    errors, given = errors_along_z(ct, depth)
    x, y = np.rint(ct.pixels[given]).astype(int).T
    return {
        "truth": "ct",
        "session": ct.name,
        "size": ct.evaluated.shape[::-1],
        "points": len(ct.points),
        "machine": machine_name(),
        "median_abs_mm": first["median_mm"],
        "p90_abs_mm": first["p90_mm"],
        "coverage": first["coverage"],
        "settings": rows,
        "confidence": by_confidence(errors, confidence[y, x]),
        "receipt": ct.receipt,
    }


def configured_depth(ct: CTPair) -> tuple[F32, F32]:
    """Return depth (m) and confidence [H, W] of the stage as a launch file has it by default."""
    return StereoDepth(StereoConfig(), ct.pair.camera, ct.pair.baseline)(ct.pair, np.ones_like(ct.evaluated))


def _measured(ct: CTPair, matcher: Matcher) -> dict[str, Any]:
    everywhere = np.ones_like(ct.evaluated)
    depth, _ = matcher(ct.pair, everywhere)
    errors, _ = errors_along_z(ct, depth)
    distances = error_figures(distances_to_surface(ct, depth))
    return {
        **error_figures(errors),
        "nearest_median_mm": distances["median_mm"],
        "nearest_p90_mm": distances["p90_mm"],
        "coverage": rounded((depth > 0)[ct.evaluated].mean()),
        "ms": rounded(median_ms(lambda: matcher(ct.pair, everywhere), RUNS)),
    }


def picture(ct: CTPair) -> bytes:
    """Draw left image, measured depth and its error against the CT surface side by side, as JPEG."""
    depth, _ = configured_depth(ct)
    errors, given = errors_along_z(ct, depth)
    rows, columns = np.nonzero(ct.evaluated)
    top, left = max(0, rows.min() - MARGIN), max(0, columns.min() - MARGIN)
    crop = np.s_[top : rows.max() + MARGIN, left : columns.max() + MARGIN]
    near, far = np.percentile(depth[ct.evaluated & (depth > 0)], [1, 99])
    shown = np.asarray(np.clip((far - depth) / (far - near), 0, 1) * 255, np.uint8)
    colored = cv2.applyColorMap(shown, cv2.COLORMAP_TURBO)[..., ::-1].copy()
    colored[depth == 0] = 0
    dotted = ct.pair.left // 3
    levels = np.asarray(np.clip(errors / (2 * LARGEST_SHOWN) + 0.5, 0, 1) * 255, np.uint8)
    colors = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    for place, color in zip(ct.pixels[given], colors, strict=True):
        cv2.circle(dotted, [round(c) for c in place], 2, [int(c) for c in color], cv2.FILLED, cv2.LINE_AA)
    for place in ct.pixels[~given]:
        cv2.circle(dotted, [round(c) for c in place], 1, (255, 255, 255), 1)
    panels = {
        "left eye": ct.pair.left,
        f"depth, {near * 1e3:.0f} (red) to {far * 1e3:.0f} mm": colored,
        f"minus CT, -{LARGEST_SHOWN:g} (blue) to {LARGEST_SHOWN:g} mm": dotted,
    }
    framed = [_titled(title, panel[crop]) for title, panel in panels.items()]
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return cv2.imencode(".jpg", np.hstack(framed)[..., ::-1], quality)[1].tobytes()


def _titled(title: str, panel: U8) -> U8:
    doubled = cv2.resize(panel, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    bar = np.full((32, doubled.shape[1], 3), 255, np.uint8)
    cv2.putText(bar, title, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([bar, doubled])
