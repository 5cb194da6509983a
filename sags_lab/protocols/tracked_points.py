"""StereoMIS-Tracking: points followed through StereoMIS, as its authors measure them.

By the public description of Hayoz et al., "Online 3D reconstruction and dense tracking in endoscopic videos"
(MICCAI 2024; github.com/mhayoz/online_endo_track, data: doi.org/10.5281/zenodo.10867949): rectified images,
camera poses, masks, and where points are in each frame.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sags_lab.protocols import arithmetic
from sags_lab.protocols.layouts import read_tum
from sags_lab.protocols.playing import Progress, check_default, configured
from sags_lab.protocols.point_tracker import Followed, PointTracker
from sags_node import geometry
from sags_node.config.schema import LaunchConfig, RecordedSource
from sags_node.config.yaml_reader import read_yaml
from sags_node.errors import SagsError, UsageError
from sags_node.files import read_file
from sags_node.rig import rectified_rig
from sags_node.sources.pictures import read_picture
from sags_node.types import F64, Bool, StereoFrame, StereoRig

TRACKS = "track_pts.json"
PUBLISHED = "track_pts.pckl"  # a pickle runs what it holds, so it is not opened here
CONVERT = (
    "import json, pickle; json.dump(pickle.load(open('track_pts.pckl', 'rb')), "
    "open('track_pts.json', 'w'), default=lambda array: array.tolist())"
)
LARGEST_JSON = 256 << 20  # bytes
RATE = 30.0  # Hz; the files do not say it
ERODED = 7  # px: the authors' margin around instruments


@dataclass(frozen=True, slots=True)
class TrackedSequence:
    """The frames of one sequence that its configuration asks for."""

    left: tuple[Path, ...]
    right: tuple[Path, ...]
    masks: tuple[Path | None, ...]  # black where there is an instrument
    rig: StereoRig
    poses: F64  # [T, 4, 4] T_world_cam of the left camera, m; the first is the world's origin
    pixels: F64  # [P, T, 2] where the points are
    visible: Bool  # [P, T]; all are in the very first frame


def is_tracked(folder: Path) -> bool:
    return any((folder / name).is_file() for name in (TRACKS, PUBLISHED))


def tracked_sequence(folder: Path) -> TrackedSequence:
    """Read one sequence, e.g. `P3_1`, with the authors' configuration of it (`P3_1.yaml`) in it.

    Raises:
        UsageError: a file is missing or wrong.
    """
    rig, frames = _configuration(folder)
    left = sorted(folder.glob("video_frames*/*l.png"))
    right = [file.with_name(file.name.removesuffix("l.png") + "r.png") for file in left]
    if not left or not all(file.is_file() for file in right):
        raise UsageError(f"{folder} lacks images: video_frames/000001l.png and 000001r.png of each frame")
    _, poses = read_tum(folder / "groundtruth.txt")
    pixels, visible = _tracks(folder / TRACKS)
    counts = {"images": len(left), "poses": len(poses), "frames with points": pixels.shape[1]}
    needed = len(range(*frames.indices(len(left))))
    short = {what: count for what, count in counts.items() if len(range(*frames.indices(count))) < needed}
    if short or needed < 2:
        raise UsageError(f"{folder} is not whole: {short or counts}, of {needed} frames that are measured")
    masks = [Path(str(file).replace("video_frames", "masks")) for file in left[frames]]
    size = np.array([rig.left.width, rig.left.height])
    if (pixels[visible] >= size).any():
        raise UsageError(
            f"{folder / TRACKS} has points outside images of {size[0]}x{size[1]} px: other size?"
        )
    return TrackedSequence(
        tuple(left[frames]),
        tuple(right[frames]),
        tuple(file if file.is_file() else None for file in masks),
        rig,
        geometry.invert(poses[frames][0]) @ poses[frames][:needed],
        pixels[:, frames][:, :needed],
        visible[:, frames][:, :needed],
    )


def _configuration(folder: Path) -> tuple[StereoRig, slice]:
    """Rig and frames of the authors' configuration; `stereo_baseline` is focal length x baseline, px mm."""
    files = sorted(folder.glob("*.yaml"))
    for file in files:
        said = read_yaml(file, "configuration")
        if not isinstance(said, dict) or "cam" not in said:
            continue
        try:
            cam, data = said["cam"], said.get("data", {})
            f, cx, cy, product = (float(cam[key]) for key in ("fx", "cx", "cy", "stereo_baseline"))
            K = np.array([[f, 0, cx], [0, float(cam["fy"]), cy], [0, 0, 1]])
            start, stop, step = (
                None if data.get(key) is None else int(data[key]) for key in ("start", "stop", "step")
            )
            rig = rectified_rig(folder.name, int(cam["W"]), int(cam["H"]), K, product / f * 1e-3)
            return rig, slice(start, stop, step)
        except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
            raise UsageError(f"{file} is no configuration of StereoMIS-Tracking ({error})") from None
    raise UsageError(
        f"{folder} holds no configuration: copy configs/StereoMIS/{folder.name}.yaml of "
        "github.com/mhayoz/online_endo_track into it; it has the calibration and the frames to be measured"
    )


def _tracks(file: Path) -> tuple[F64, Bool]:
    """Pixels [P, T, 2] and visibility [P, T] of the points that are visible in the first frame."""
    if not file.is_file():
        raise UsageError(
            f"{file.with_name(PUBLISHED)} is a pickle, which may run any code, so it is not opened here. "
            f'If you trust it, write {TRACKS} beside it: cd {file.parent}; python3 -c "{CONVERT}"'
        )
    try:
        said = json.loads(read_file(file, LARGEST_JSON))
        rows = [[(-1.0, -1.0) if at is None else at for at in track] for track in said["points"]]
        pixels = np.array(rows, np.float64)
        visible: Bool = ~np.array(said["not_visible"], np.bool_)
        if pixels.ndim != 3 or pixels.shape != (*visible.shape, 2) or not pixels.size:
            raise ValueError(f"points {list(pixels.shape)}, not_visible {list(visible.shape)}")
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise UsageError(
            f"{file} holds no tracked points ({str(error)[:200]}); write it again from {PUBLISHED}"
        ) from None
    visible &= pixels.sum(2) > 0
    return pixels[visible[:, 0]], visible[visible[:, 0]]


def measure_tracked(folder: Path, overrides: Sequence[str], progress: Progress) -> dict[str, Any]:
    """Measure points of the first frame followed to the last, with given poses of the camera, as the authors
    do; beside them points that never move."""
    sequence = tracked_sequence(folder)
    eyes = [f"source.{eye}:={folder}" for eye in ("left", "right")]
    config = configured(["source.kind:=folders", *eyes, f"source.rate:={RATE}"], overrides)
    check_default(config, "start", "stride")
    found = _followed(sequence, config, progress)
    size = sequence.rig.left.width, sequence.rig.left.height
    truth, visible = sequence.pixels[:, : found.shape[1]], sequence.visible[:, : found.shape[1]]
    unmoved = np.repeat(truth[:, :1], truth.shape[1], axis=1)
    return {
        "frames": truth.shape[1],
        "points": len(truth),
        "masks": any(mask is not None for mask in sequence.masks),
        "tracked": arithmetic.stereomis_figures(found, truth, visible, size),
        "unmoved": arithmetic.stereomis_figures(unmoved, truth, visible, size),
    }


def _followed(sequence: TrackedSequence, config: LaunchConfig, progress: Progress) -> F64:
    """Pixels [P, T, 2], clipped to the image as the authors do."""
    tracker = PointTracker(config, sequence.rig)
    frames = config.source.frames if isinstance(config.source, RecordedSource) else None
    numbers = range(len(sequence.left))[:frames]
    followed = Followed.unknown(sequence.pixels[:, 0])
    found = [followed.pixels]
    for now, following in pairwise(_frame(sequence, number) for number in numbers):
        followed = tracker.follow(followed.pixels, now, following)
        found.append(followed.pixels)
        progress(following.frame_id + 1, "following")
    if len(found) < 2:
        raise SagsError("one frame is not enough to follow points; set source.frames to 2 or more")
    last = sequence.rig.left.width - 1, sequence.rig.left.height - 1
    return np.stack(found, axis=1).clip(0, last)


def _frame(sequence: TrackedSequence, number: int) -> StereoFrame:
    left, right = read_picture(sequence.left[number]), read_picture(sequence.right[number])
    size = sequence.rig.left.height, sequence.rig.left.width
    if left.shape[:2] != size or right.shape[:2] != size:
        raise SagsError(f"{sequence.left[number]} is not {size[1]}x{size[0]} px as its configuration says")
    stamp, file = round(number / RATE * 1e9), sequence.masks[number]
    tissue = None
    if file is not None:
        mask = cv2.resize(
            read_picture(file, cv2.IMREAD_GRAYSCALE), size[::-1], interpolation=cv2.INTER_NEAREST
        )
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        tissue = cv2.erode(mask, cross, iterations=ERODED) > 0
    return StereoFrame(number, stamp, stamp, left, right, T_world_cam=sequence.poses[number], tissue=tissue)
