"""What is odd about the images of a recording: sizes, gaps, borders, interlacing, masks and depth."""

from collections.abc import Collection, Sequence
from pathlib import Path

import cv2
import numpy as np

from sags_node.checks import Finding
from sags_node.config.schema import GeometryConfig
from sags_node.sources.pictures import list_pictures, read_picture, size_text, some_of
from sags_node.sources.truth import UNKNOWN, fitting_units
from sags_node.tools.calibration.matches import match_eyes
from sags_node.types import U8, Bool

LOOKED_AT = 8  # images, spread over the folder
COMB_STEP = 12  # grey levels that a row must differ from both neighbours, alike
COMB_SHARE = 0.02  # least share of the pixels that show combs, and
COMB_RATIO = 3.0  # times as many as in columns: texture has no favourite direction
DARK = 12  # grey level of a border
NARROWEST_BORDER = 4  # px
FEWEST_MATCHES = 30
RIGHT_FIRST = "source.geometry.first:=right"
CROP = "source.geometry.crop:="

Box = tuple[int, int, int, int]  # x, y, width, height, px


def read_some(files: Sequence[Path], flags: int = cv2.IMREAD_COLOR) -> dict[Path, U8]:
    """Read images spread over the files. Also try the last and the smallest one: there copies break off.

    Raises:
        SagsError: one cannot be read.
    """
    chosen = set(some_of(files, LOOKED_AT))
    # A link may lead nowhere, as in a data set that was not fetched whole: that file cannot be read, either.
    smallest = min(files, key=lambda file: file.stat().st_size if file.exists() else -1)
    suspects = {files[-1], smallest} - chosen
    for file in suspects:
        read_picture(file, flags)
    return {file: read_picture(file, flags) for file in files if file in chosen}


def check_eye(what: str, pictures: Collection[U8], keep: Box | None = None) -> list[Finding]:
    """Look at one eye's images [H, W, 3] RGB: sizes, black borders, interlacing.

    Args:
        keep: the box to keep where there are borders; None: what is lit of this eye.
    """
    sizes = {picture.shape[1::-1] for picture in pictures}
    if len(sizes) > 1:
        said = " and ".join(size_text(*size) for size in sorted(sizes))
        return [Finding("error", f"{what}: images of {said} px", "all images must have one size")]
    gray = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
    found = []
    x, y, width, height = lit_box(np.max(gray, axis=0))
    if (width, height) != gray[0].shape[::-1]:
        crop = CROP + str([*(keep or (x, y, width, height))]).replace(" ", "")
        fix = (
            f"set {crop} (videos, cameras) or cut both eyes alike, and calibrate such images; a "
            "calibration of whole ones needs the borders"
        )
        what_is = f"{what}: black borders; the image is {size_text(width, height)} px at {x},{y}"
        said = f"{what_is}, of {size_text(*gray[0].shape[::-1])}"
        found.append(Finding("warning", said, fix, launch=(crop,)))
    combs = [(combing(each), combing(np.ascontiguousarray(each.T))) for each in gray]
    rows, columns = np.max([comb[0] for comb in combs]), np.median([comb[1] for comb in combs])
    if rows > COMB_SHARE and rows > COMB_RATIO * columns:
        fix = "videos: source.geometry.deinterlace:=top or bottom; folders: deinterlace before (ffmpeg bwdif)"
        said = f"{what}: interlaced, {rows:.0%} of the pixels show combs"
        found.append(Finding("warning", said, fix, launch=("source.geometry.deinterlace:=top",)))
    return found or [
        Finding("ok", f"{what}: {size_text(*gray[0].shape[::-1])} px, not interlaced, no borders")
    ]


def combing(gray: U8) -> float:
    """The share of pixels of [H, W] that differ from the rows above and below alike: two fields in motion."""
    middle = gray[1:-1].astype(np.int16)
    above, below = middle - gray[:-2], middle - gray[2:]
    return float(np.mean((np.minimum(above, below) > COMB_STEP) | (np.maximum(above, below) < -COMB_STEP)))


def lit_in_both(left: Collection[U8], right: Collection[U8], geometry: GeometryConfig | None) -> Box | None:
    """The box without black borders of either eye, in each eye's image before `geometry` cuts and flips it.
    None: the images' sizes differ, or there is none."""
    if len({picture.shape for picture in (*left, *right)}) != 1:
        return None
    boxes = [
        lit_box(np.max([cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in eye], 0)) for eye in (left, right)
    ]
    (x, y), far = (
        np.max([box[:2] for box in boxes], 0),
        np.min([np.add(box[:2], box[2:]) for box in boxes], 0),
    )
    width, height = far[0] - x, far[1] - y
    if min(width, height) < 1:
        return None
    if geometry is not None:
        across, down = next(iter(left)).shape[1::-1]
        if geometry.flip in ("horizontal", "both"):
            x = across - x - width
        if geometry.flip in ("vertical", "both"):
            y = down - y - height
        x, y = np.add((x, y), geometry.crop[:2] if geometry.crop else 0)
    return int(x), int(y), int(width), int(height)


def lit_box(brightest: U8) -> Box:
    """The box within the black borders; the whole image where all is dark."""
    columns, rows = (np.flatnonzero(np.percentile(brightest, 99, axis=axis) > DARK) for axis in (0, 1))
    height, width = brightest.shape
    if not len(columns) or not len(rows):
        return 0, 0, width, height
    left, right = (0 if edge < NARROWEST_BORDER else edge for edge in (columns[0], width - 1 - columns[-1]))
    top, bottom = (0 if edge < NARROWEST_BORDER else edge for edge in (rows[0], height - 1 - rows[-1]))
    return int(left), int(top), int(width - left - right), int(height - top - bottom)


def check_eyes(left: Collection[U8], right: Collection[U8]) -> list[Finding]:
    """Check both eyes without a calibration: are they in order, and are rows aligned?"""
    pairs = [(a, b) for a, b in zip(left, right, strict=False) if a.shape == b.shape]
    if not pairs:
        return [Finding("error", "the eyes' images have not one size", "resize both eyes alike")]
    matches = np.concatenate([match_eyes(a, b) for a, b in pairs])
    if len(matches) < FEWEST_MATCHES:
        fix = "are they of one moment and of one scope? Sharper images with more texture tell more"
        return [Finding("warning", f"only {len(matches)} points are found in both eyes", fix)]
    across, down = (float(np.median(matches[:, k] - matches[:, k + 2])) for k in (0, 1))
    rows = float(np.median(np.abs(matches[:, 1] - matches[:, 3])))
    figures = {"disparity_px": round(across, 2), "rows_px": round(rows, 2)}
    if np.mean(matches[:, 0] < matches[:, 2]) > 0.8:
        fix = "exchange left and right, unless each image was cut out elsewhere (then calibrate as they are)"
        what = "points lie farther to the right in the right eye: eyes exchanged?"
        return [Finding("warning", what, fix, figures, launch=(RIGHT_FIRST,))]
    aligned = rows < 1 / 180 * pairs[0][0].shape[1]
    what = f"disparity {across:.1f} px, rows {'agree' if aligned else 'differ'} ({down:+.1f} px)"
    fix = "" if aligned else "not rectified: a calibration with distortion and rectification is needed"
    return [Finding("ok" if aligned else "warning", what, fix, figures)]


def check_both(
    left: Collection[U8], right: Collection[U8], *, geometry: GeometryConfig | None = None
) -> list[Finding]:
    """Look at each eye, and at how they belong together; `geometry`: how the images were cut."""
    keep = lit_in_both(left, right, geometry)
    return [*check_eye("left", left, keep), *check_eye("right", right, keep), *check_eyes(left, right)]


def check_shares(shares: Sequence[float]) -> list[Finding]:
    """A finding on masks, from the share of each frame that is instrument."""
    if not any(shares):  # the source reports masks that mark nothing
        return []
    return [Finding("ok", f"masks: {np.median(shares):.0%} of the image is instrument")]


def check_depth(
    folder: Path, size: tuple[int, int], unit: float | None = None, stated: bool = False
) -> list[Finding]:
    """Check kind, size and unit (m per count) of depth images; `stated`: their author states that unit."""
    medians = []
    for file, depth in read_some(list_pictures(folder), cv2.IMREAD_UNCHANGED).items():
        if (wrong := _no_depth(file, depth, size)) is not None:
            return [wrong]
        known: Bool = (depth > 0) & (depth != UNKNOWN)
        if known.any():
            medians.append(float(np.median(depth[known])))
            coarse = depth.dtype == np.uint8
    if not medians:
        return [Finding("error", "depth: no image knows a pixel", "export it again")]
    median = float(np.median(medians))
    fitting = fitting_units(median)
    ask = "the files do not say it: ask who made them"
    if unit is not None and unit in fitting:
        said = f"depth: {median * unit * 1e3:.0f} mm (median) with {unit:g} m per count"
        if stated:
            return [Finding("ok", f"{said}, as their author states")]
        return [Finding("ok", said, ask)]
    if not fitting:
        what = f"depth: a median of {median:g} counts is no distance in an endoscope's view in any usual unit"
        return [Finding("error", what, "is it a disparity, or inverse depth? Convert it to depth")]
    distance = " or ".join(f"{median * one * 1e3:.0f} mm with {one:g} m per count" for one in fitting)
    found = [
        Finding(
            "ok" if unit is None else "warning",
            f"depth: {median:g} counts (median): {distance}",
            f"set source.depth_unit (EndoNeRF's layout) or source.reference.depth_unit to {fitting[0]:g}; "
            f"{ask}",
        )
    ]
    if coarse:
        fix = "steps of a whole count: export 16 bit"
        found.append(Finding("warning", "depth: only 8 bit", fix))
    return found


def _no_depth(file: Path, depth: U8, size: tuple[int, int]) -> Finding | None:
    """Why an image cannot be depth; None: it can."""
    export = "export depth as grey PNG of 16 bit, e.g. in 1e-5 m"
    if depth.ndim != 2:
        what = f"depth: {file.name} has {depth.shape[2]} channels: it is coloured for people"
        return Finding("error", what, export)
    if depth.dtype.kind == "f":
        return Finding("error", f"depth: {file.name} holds floating numbers, which are not read", export)
    if depth.shape[::-1] != size:
        what = f"depth: {file.name} is {size_text(*depth.shape[::-1])} px, the images {size_text(*size)}"
        return Finding("error", what, "resize depth with nearest neighbour, never a mean")
    return None
