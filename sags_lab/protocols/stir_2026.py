"""STIR by the rules of 2026: points known in many frames, and whether each eye sees them.

By the challenge's page (stir-challenge.github.io/evaluation) and its evaluator
(github.com/mertkaraoglu/stir-challenge-2026-metrics): points are given in the left image of the first
frame. Their 3D positions there are asked for, so the right eye is matched, too. The evaluator counts all
annotated frames but the first.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from sags_lab.protocols.arithmetic import stir_2026_figures
from sags_lab.protocols.layouts import LARGEST_TEXT, as_stir_counts, stir_rig
from sags_lab.protocols.playing import Progress, check_default, configured, stride_of
from sags_lab.protocols.point_tracker import Followed, PointTracker, raw_pair
from sags_node.errors import SagsError, UsageError
from sags_node.files import read_file
from sags_node.media.video import Video
from sags_node.pipeline.session import open_posed
from sags_node.types import F64, Bool, StereoFrame, StereoRig

QUERIES, TRUTH = "queries.json", "annotations.json"
WARM_UP = 10  # number of the last frame whose latency is not counted


@dataclass(frozen=True, slots=True)
class Annotated:
    """The points in one frame."""

    left: F64  # [P, 2] px
    right: F64  # [P, 2] px, in the same rows
    in_left: Bool  # [P] whether the left eye sees them
    in_both: Bool  # [P]


@dataclass(frozen=True, slots=True)
class Stir2026Sequence:
    folder: Path
    rig: StereoRig
    queries: F64  # [P, 2] px of the first left image
    truth: dict[int, Annotated]  # by number of the frame


def is_stir_2026(folder: Path) -> bool:
    return any(_below(folder, QUERIES))


def _below(folder: Path, name: str) -> chain[Path]:
    return chain.from_iterable(folder.glob(depth + name) for depth in ("", "*/", "*/*/"))


def stir_2026_sequences(folder: Path) -> list[Stir2026Sequence]:
    """Return all annotated sequences below a folder.

    Raises:
        UsageError: there are none, or a file is missing or wrong.
    """
    found = sorted(file.parent.resolve() for file in _below(folder, QUERIES))
    annotated = [each for each in found if (each / TRUTH).is_file()]
    if not annotated:
        raise UsageError(
            f"{folder} has {QUERIES}, but nowhere {TRUTH} beside it, which the public validation sequences "
            "lack; without it nothing can be measured"
        )
    return [_sequence(each) for each in annotated]


def _sequence(folder: Path) -> Stir2026Sequence:
    asked = _rows(folder / QUERIES, ("left_x", "left_y"))
    if 0 not in asked:
        raise UsageError(f"{folder / QUERIES} asks for no point of frame 0; download it again")
    names = ("left_x", "left_y", "disparity", "left_visibility", "right_visibility")
    truth = {number: _annotated(row) for number, row in _rows(folder / TRUTH, names).items()}
    queries = asked[0].T
    if wrong := [number for number, each in truth.items() if len(each.left) != len(queries)]:
        raise UsageError(
            f"{folder / TRUTH} has {len(truth[wrong[0]].left)} points in frame {wrong[0]}, "
            f"{QUERIES} {len(queries)}; do they belong together?"
        )
    rig = stir_rig(folder / "calib.json", Video(folder / "left.mp4").size)
    return Stir2026Sequence(folder, rig, queries, truth)


def _rows(file: Path, names: Sequence[str]) -> dict[int, F64]:
    """Values [names, P] of each frame, unknown ones NaN. A key is frame/instance: as in the evaluator, only
    instance 0 is taken."""
    try:
        said = json.loads(read_file(file, LARGEST_TEXT))
        rows = {tuple(map(int, key.split("/"))): row for key, row in said.items()}
        return {
            frame: np.array([row[name] for name in names], np.float64).reshape(len(names), -1)
            for (frame, instance), row in rows.items()
            if instance == 0
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UsageError(
            f"{file} holds no points of STIR ({str(error)[:200]}): "
            f'{{"frame/instance": {{{", ".join(names)}}}}}, a list each'
        ) from None


def _annotated(row: F64) -> Annotated:
    x, y, disparity, in_left, in_right = row
    left, right = np.stack([x, y], axis=1), np.stack([x - disparity, y], axis=1)
    return Annotated(left, right, in_left > 0, (in_left > 0) & (in_right > 0))


@dataclass(slots=True)
class _Judged:
    """Points of all frames compared so far."""

    distances: list[F64] = field(default_factory=list)
    visible: list[Bool] = field(default_factory=list)
    said: list[Bool] = field(default_factory=list)

    def add(self, found: F64, truth: F64, visible: Bool, said: Bool) -> None:
        known = visible & np.isfinite(found).all(1)  # distances of invisible points do not count
        distances = np.full(len(found), np.inf)
        distances[known] = np.linalg.norm(found[known] - truth[known], axis=1)
        self.distances.append(distances)
        self.visible.append(visible)
        self.said.append(said)

    def figures(self) -> dict[str, float] | None:
        if not self.distances:
            return None
        distances, visible = np.concatenate(self.distances), np.concatenate(self.visible)
        return stir_2026_figures(distances, visible, np.concatenate(self.said))


def measure_stir_2026(folder: Path, overrides: Sequence[str], progress: Progress) -> dict[str, Any]:
    """Measure points followed from the first frame on: `mono`, px in the left image; `stereo`, mm, where a
    point is visible if both eyes see it; `stereo_first_frame`, the same in the first frame alone; `unmoved`,
    px, for points that stay and are said to be visible. All are pooled over points, frames and sequences, as
    in the evaluator. `latency_p95_ms` is of frames after number `WARM_UP`."""
    judged = {name: _Judged() for name in ("mono", "stereo", "stereo_first_frame", "unmoved")}
    times: list[float] = []
    points = 0
    sequences = stir_2026_sequences(folder)
    for sequence in sequences:
        times += _play(sequence, overrides, judged, progress)
        points += len(sequence.queries)
    figures = {name: each.figures() for name, each in judged.items()}
    if figures["mono"] is None:
        raise SagsError(f"{folder}: no annotated frame after the first was played; look at source.frames")
    return {
        "rules": 2026,
        "sequences": len(sequences),
        "points": points,
        **figures,
        "latency_p95_ms": float(np.percentile(times, 95)) if times else None,
    }


def _play(
    sequence: Stir2026Sequence, overrides: Sequence[str], judged: dict[str, _Judged], progress: Progress
) -> list[float]:
    """Judge one sequence; returns the times of the frames whose latency counts, ms."""
    left, right = sequence.folder / "left.mp4", sequence.folder / "right.mp4"
    given = ["source.kind:=videos", f"source.left:={left}", f"source.right:={right}"]
    check_default(config := configured(given, overrides), "start")
    stride = stride_of(config)
    tracker = PointTracker(config, sequence.rig)
    pixels, times = sequence.queries, list[float]()
    before: StereoFrame | None = None
    with open_posed(config, sequence.rig, references=False) as frames:
        for frame in frames:
            started = time.perf_counter()
            followed = tracker.pin(pixels, frame) if before is None else tracker.follow(pixels, before, frame)
            number, before, pixels = frame.frame_id * stride, frame, followed.pixels
            if number > WARM_UP:
                times.append((time.perf_counter() - started) * 1e3)
            if (truth := sequence.truth.get(number)) is not None:
                _judge(judged, sequence, followed, truth, first=number == 0)
            progress(number + 1, sequence.folder.name)
    return times


def _judge(
    judged: dict[str, _Judged], sequence: Stir2026Sequence, followed: Followed, truth: Annotated, first: bool
) -> None:
    """Compare one frame."""
    rig, known = sequence.rig, np.flatnonzero(np.isfinite(followed.points).all(1))
    left, right = raw_pair(rig, followed.points[known])
    points, in_both = np.full_like(followed.points, np.nan), np.zeros_like(followed.visible)
    points[known] = as_stir_counts(rig, left, right)
    in_both[known] = ((right >= 0) & (right < (rig.right.width, rig.right.height))).all(1)
    true_points = np.full_like(points, np.nan)
    true_points[truth.in_both] = as_stir_counts(rig, truth.left[truth.in_both], truth.right[truth.in_both])
    stereo = judged["stereo_first_frame" if first else "stereo"]
    stereo.add(points, true_points, truth.in_both, followed.visible & in_both)
    if not first:
        judged["mono"].add(followed.pixels, truth.left, truth.in_left, followed.visible)
        judged["unmoved"].add(sequence.queries, truth.left, truth.in_left, np.ones_like(truth.in_left))
