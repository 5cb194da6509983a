"""Public data sets played through the node's own pipeline, and measured by their own rules."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sags_lab.protocols import arithmetic
from sags_lab.protocols.layouts import (
    StereoMisSequence,
    as_stir_counts,
    check_sizes,
    stereomis_sequence,
    stir_clips,
)
from sags_lab.protocols.playing import AS_GIVEN, STEP, Progress, check_default, configured, stride_of
from sags_lab.protocols.point_tracker import Followed, PointTracker, raw_pair
from sags_lab.protocols.point_tracks import shares_within
from sags_lab.protocols.stir_2026 import is_stir_2026, measure_stir_2026
from sags_lab.protocols.tracked_points import is_tracked, measure_tracked
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LaunchConfig
from sags_node.errors import SagsError
from sags_node.geometry import rigid
from sags_node.media.video import Video
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_posed, rig_of
from sags_node.pipeline.warm_up import prepare
from sags_node.quality.metrics import resample_nearest
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.session import evaluate
from sags_node.types import F64, StereoRig

LEAST_POSES = 3  # for an alignment
HOLD_OUT = 8  # every so many frames: the split of EndoNeRF that EndoGaussian and later papers use
PICKED = ("paper_psnr", "paper_ssim", "lpips", "psnr", "ssim", "copy_psnr")


def measure_endonerf(
    folder: Path, overrides: Sequence[str], lpips: Path | None, progress: Progress
) -> dict[str, Any]:
    """Measure with frames 1, 9, 17, ... held out; masked pixels are black in both images and count. Masks
    are used as they are, without the margin that a node puts around instruments.

    Each held-out frame is drawn from the frames before it. Published fits see those after it, too.
    """
    options = MeasureOptions(HOLD_OUT, every=1, lpips_weights=lpips, paper_psnr=True)
    found = evaluate(
        folder, [AS_GIVEN, *overrides], options, "step", None, lambda what, done, count: progress(done, what)
    )
    heldout = found.summary["heldout"]
    if heldout is None:
        raise SagsError(f"{folder} has no frame to hold out; it needs more than {HOLD_OUT}")
    figures = {key: heldout[key] for key in PICKED if heldout.get(key) is not None}
    settings = found.summary["settings"]
    return {"held_out": found.summary["held_out"], "causal": figures, "settings": settings}


def measure_scared(folder: Path, overrides: Sequence[str], progress: Progress) -> dict[str, Any]:
    """Measure the mean absolute depth error of each frame, mm, mean over frames: of stereo and the model."""
    config = load_launch(folder, [*overrides, *STEP])
    rig = rig_of(config)
    prepare(config)
    pipeline = Pipeline(config, rig)
    budget, size = pipeline.make_budget(), config.vision.working_size(rig.left.width, rig.left.height)
    errors: dict[str, list[tuple[float, float]]] = {"measured": [], "model": []}
    with open_posed(config, rig) as frames:
        for number, frame in enumerate(frames):
            result = pipeline.process(frame, budget)
            progress(number + 1, "playing")
            if frame.reference is None or frame.reference.depth is None:
                continue
            truth = resample_nearest(frame.reference.depth, *size)
            shown = {"measured": result.observation.depth, "model": result.views["left"].depth}
            for name, depth in shown.items():
                error = arithmetic.mean_depth_error(depth, truth)
                if error is not None:
                    errors[name].append(error)
    if not errors["model"]:
        raise SagsError(f"{folder} has no frame with enough true depth; scene_points are needed")
    return {
        name: {"frames": len(each), "mae_mm": mean(each, 0), "given": mean(each, 1)}
        for name, each in errors.items()
        if each
    }


def mean(rows: Sequence[tuple[float, ...]], column: int) -> float:
    return float(np.mean([row[column] for row in rows]))


def measure_stir(folder: Path, overrides: Sequence[str], progress: Progress) -> dict[str, Any]:
    """Measure points pinned in each clip's first frame and followed to its last. In 2D a point that is lost
    or cannot be pinned counts where it was last; in 3D one that cannot be pinned counts as missed. Sequences
    of 2026 are measured by their own rules."""
    if is_stir_2026(folder):
        return measure_stir_2026(folder, overrides, progress)
    clips, distances, unmoved, times, lost = {}, [], [], [], 0
    deep, deep_unmoved = [], []
    for clip in stir_clips(folder):
        given = ["source.kind:=videos", f"source.left:={clip.left}", f"source.right:={clip.right}"]
        check_default(config := configured(given, overrides), "start", "frames", "stride")
        tracks = _follow(config, clip.rig, clip.starts, clip.name, progress)
        clips[clip.name] = arithmetic.nearest_distances(tracks.pixels, clip.ends)
        distances.append(clips[clip.name])
        unmoved.append(arithmetic.nearest_distances(clip.starts, clip.ends))
        if len(clip.starts_mm) and len(clip.ends_mm):
            deep.append(arithmetic.nearest_distances(tracks.points_mm, clip.ends_mm))
            deep_unmoved.append(arithmetic.nearest_distances(clip.starts_mm, clip.ends_mm))
        times += tracks.times_ms
        lost += tracks.lost
    if not distances:
        raise SagsError(f"no sequence of {folder} has a marked point in its first and last frame")
    return {
        "points": int(sum(map(len, distances))),
        "lost": lost,
        "tracked": shares_within(np.concatenate(distances), arithmetic.STIR_PX),
        "unmoved": shares_within(np.concatenate(unmoved), arithmetic.STIR_PX),  # the evaluator's control
        "points_3d": int(sum(map(len, deep))),
        "tracked_mm": _within_mm(deep),
        "unmoved_mm": _within_mm(deep_unmoved),
        "latency_ms": arithmetic.latency_score(times),
        "clips": {name: float(np.mean(each)) for name, each in clips.items()},
    }


def _within_mm(distances: Sequence[F64]) -> dict[str, float] | None:
    if not distances:
        return None
    return shares_within(np.concatenate(distances), arithmetic.STIR_MM)


def measure_stereomis(folder: Path, overrides: Sequence[str], progress: Progress) -> dict[str, Any]:
    """Measure the trajectory that the node estimates against the robot's: means over the ranges of the
    sequence's table, each with a new model, or over all of it. Of StereoMIS-Tracking points are measured."""
    if is_tracked(folder):
        return measure_tracked(folder, overrides, progress)
    sequence = stereomis_sequence(folder)
    check_sizes(Video(sequence.video), sequence.rig)
    given = ["source.kind:=videos", f"source.left:={sequence.video}", "source.geometry.layout:=over_under"]
    config = configured([*given, "vision.pose:=estimate"], overrides)
    ways = [_way(config, sequence, frames, progress) for frames in sequence.ranges]
    ways = [(estimated, known) for estimated, known in ways if len(known) >= LEAST_POSES]
    if not ways:
        raise SagsError(f"{folder}: fewer than {LEAST_POSES} frames played have a pose in groundtruth.txt")
    figures = [
        arithmetic.trajectory_figures(np.stack(estimated), np.stack(known)) for estimated, known in ways
    ]
    return {
        "frames": sum(len(known) for _, known in ways),
        "ranges": len(ways),
        "masks": sequence.masks is not None,
        **{key: float(np.mean([each[key] for each in figures])) for key in figures[0]},
    }


def _way(
    config: LaunchConfig, sequence: StereoMisSequence, frames: range, progress: Progress
) -> tuple[list[F64], list[F64]]:
    """Estimated and known poses [4, 4] of the frames of one range whose pose is known."""
    stride = stride_of(config)
    pipeline = Pipeline(config, sequence.rig)
    budget, T_rectified_raw = pipeline.make_budget(), rigid(sequence.rig.left.R, np.zeros(3))
    known_at = dict(zip(sequence.frames, sequence.poses, strict=True))
    estimated, known = [], []
    with open_posed(config, sequence.rig, references=False) as played:
        for frame in played:
            number = frame.frame_id * stride
            if number >= frames.stop:
                break
            if number < frames.start:
                continue
            result = pipeline.process(replace(frame, tissue=sequence.tissue_in(number)), budget)
            progress(number - frames.start + 1, "playing")
            pose = known_at.get(number)
            if pose is not None:
                estimated.append(result.snapshot.camera.T_world_cam @ T_rectified_raw)
                known.append(pose)
    return estimated, known


@dataclass(frozen=True, slots=True)
class _Tracks:
    """Points of the first raw left image, where they were known last."""

    pixels: F64  # [P, 2] raw, left
    points_mm: F64  # [P, 3] in the raw left camera, as STIR counts; infinite: never pinned
    lost: int
    times_ms: list[float]  # of calls; the first one processes two frames


def _follow(config: LaunchConfig, rig: StereoRig, starts: F64, name: str, progress: Progress) -> _Tracks:
    """Follow points as STIR's evaluator does: each call gets what the call before it returned."""
    tracker, followed = PointTracker(config, rig), Followed.unknown(starts)
    points_mm = np.full((len(starts), 3), np.inf)
    times: list[float] = []
    with open_posed(config, rig, references=False) as frames:
        for number, (now, following) in enumerate(pairwise(frames)):
            started = time.perf_counter()
            followed = tracker.follow(followed.pixels, now, following)
            times.append((time.perf_counter() - started) * 1e3)
            pixels = raw_pair(rig, followed.points[followed.found])
            points_mm[followed.found] = as_stir_counts(rig, *pixels)
            progress(number + 2, name)
    if not times:
        raise SagsError(f"{name} has fewer than two frames; is its video whole?")
    return _Tracks(followed.pixels, points_mm, int(np.count_nonzero(~followed.found)), times)
