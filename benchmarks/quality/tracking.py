"""How well points stay on the tissue of a recording: anchors and Gaussians; anchors are compared with common
methods without a model (`followers`)."""

import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from benchmarks import Advance
from benchmarks.quality.followers import CONSISTENT, FOLLOWERS, dis_flow, sample
from sags_lab.protocols.point_tracks import (
    average_jaccard,
    calibration_error,
    reliability,
    shares_within,
    surely_seen,
)
from sags_node.engine.interface import BEHIND_SURFACE
from sags_node.errors import SagsError
from sags_node.geometry import project, transform
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session, open_posed
from sags_node.pipeline.warm_up import prepare
from sags_node.quality.metrics import percentiles
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F32, F64, I64, AnchorStates, Bool, FrameResult, StereoFrame

SPACING = 34  # px between anchors
BESIDE = 40  # points, at most, that all methods are compared on: CSRT is slow
BORDER = 60  # px: what is nearer to the image's edge soon leaves it
RIGHT = 4.0 / 640  # of the width: a confident anchor should be this near to its point
RIGHT_MM = 2.0  # mm, the same in space
WRONG = 8.0 / 640  # of the width: what is farther, and said to be seen there, is wrong


@dataclass(frozen=True, slots=True)
class _Truth:
    """Where the followed points are in one frame."""

    pixels: F64  # [P, 2]
    known: Bool  # [P] whether that is known
    visible: Bool  # [P] known, in the image, and not hidden
    points: F64 | None = None  # [P, 3] m, world


@dataclass(frozen=True, slots=True)
class _Said:
    """The results of one method for the points, in the frames that are measured."""

    pixels: list[F64] = field(default_factory=list)  # [P, 2] of each
    seen: list[Bool] = field(default_factory=list)  # [P] of each: the method is sure to see the point there
    times_s: list[float] = field(default_factory=list)  # of every frame


RELIABILITY = "least most count said right"  # of anchors that were that sure; also of `recall`
TABLES = (
    "frame motion_px.p50 motion_px.p90 anchors anchors_px.p50 anchors_px.p90 gaussians gaussians_px.p50"
    " gaussians_px.p90",
    "off_by_px.p50 off_by_px.p90 within.average sure wrong average_jaccard us_per_point",
    RELIABILITY,
)


def measure_tracking(
    session: Session, frames: Sequence[int], advance: Advance, beside: Collection[str] = tuple(FOLLOWERS)
) -> dict[str, Any]:
    """Pin anchors in the first frame and follow them, one step of the mapper a frame.

    A recording that has true points (`source.reference.tracks`) is measured against those that the first
    frame shows. In any other recording, a point's truth in a later frame is where the flow from the first
    frame to that one (Kroeger et al., ECCV 2016) takes it, if this is on tissue and the flow back returns
    within `CONSISTENT`. The frames between are not used. Points behind an instrument have no such truth.

    Args:
        frames: after how many to measure.
        beside: names of `FOLLOWERS`, shown the same points and images.
    """
    prepare(session.config)
    pipeline, budget, last = Pipeline(session.config, session.rig), StepBudget(1), max(frames)
    receipt = Receipt(session.rig, session.working_size, None)
    run: _Run | None = None
    rows = []
    with open_posed(session.config, session.rig) as source:
        for number, frame in enumerate(source):
            result = pipeline.process(frame, budget)
            receipt.add(frame, result.observation.tissue)
            if run is None:
                run = _Run(pipeline, frame, result, beside)
            else:
                run.follow(result, measured=number in frames)
                if number in frames:
                    rows.append(run.measured(number, frame, result))
            advance(number + 1, last + 1, "following")
            if number == last:
                break
    if run is None or len(rows) < len(set(frames)):
        raise SagsError(f"the recording ends before frame {last}; choose earlier --frames")
    figures = {"anchors": run.count, "frames": rows, **run.figures()}
    return {"session": session.name, **figures, "receipt": receipt.as_json()}


class _Run:
    """The points of one recording, from the first frame on."""

    def __init__(
        self, pipeline: Pipeline, frame: StereoFrame, result: FrameResult, beside: Collection[str]
    ) -> None:
        """Pin anchors at true points that are seen, where the recording has any, else on a grid."""
        self._first, self._flow = result, dis_flow()
        points = true_points(frame, result)
        self._exact = points is not None
        if points is None:
            places = _grid(result)
            wanted = np.ones(len(places), np.bool_)
        else:
            places = np.asarray(project(result.pair.camera, points)[0], np.float64)
            wanted = _visible(frame) & middle(places, result)
        pinned = [*pin(pipeline, result, places, np.flatnonzero(wanted)).values()]
        self._rows, self._places, self.count = np.array(pinned), places[pinned], len(pinned)
        self._shared = np.unique(np.linspace(0, self.count - 1, BESIDE).round().astype(np.int64))
        picture, places = result.pair.left, self._places[self._shared]
        self._followers = {name: FOLLOWERS[name](picture, places) for name in beside}
        names = ["anchors", *beside, *(["direct_flow"] if self._exact else [])]
        self._said = {name: _Said() for name in names}
        self._truths: list[_Truth] = []
        self._states: list[AnchorStates] = []
        self._frame_s: list[float] = []

    def follow(self, result: FrameResult, measured: bool) -> None:
        """Show a frame to all followers, and note the anchors."""
        self._frame_s.append(sum(result.timings_ms.values()) * 1e-3)
        self._said["anchors"].times_s.append(result.timings_ms.get("anchors", 0.0) * 1e-3)
        for name, follower in self._followers.items():
            started, said = time.perf_counter(), self._said[name]
            pixels, seen = follower.follow(result.pair.left)
            said.times_s.append(time.perf_counter() - started)
            if measured:
                said.pixels.append(pixels)
                said.seen.append(seen)
        if measured:
            states = result.anchors
            self._states.append(states)
            self._said["anchors"].pixels.append(states.pixels[self._shared].astype(np.float64))
            self._said["anchors"].seen.append(surely_seen(states)[self._shared])

    def measured(self, number: int, frame: StereoFrame, result: FrameResult) -> dict[str, Any]:
        """Return the figures of one frame; call it after `follow`."""
        started = time.perf_counter()
        there = np.asarray(self._flow.calc(self._first.observation.gray, result.observation.gray, None))
        back = np.asarray(self._flow.calc(result.observation.gray, self._first.observation.gray, None))
        ends, consistent = _follow(self._places, there, back, result.observation.tissue)
        if self._exact:
            direct = self._said["direct_flow"]
            direct.times_s.append(time.perf_counter() - started)
            direct.pixels.append(ends[self._shared])
            direct.seen.append(consistent[self._shared])
            points = true_points(frame, result)
            assert points is not None
            points = points[self._rows]
            places = np.asarray(project(result.pair.camera, points)[0], np.float64)
            truth = _Truth(places, np.ones(len(points), np.bool_), _visible(frame)[self._rows], points)
        else:
            truth = _Truth(ends, consistent, consistent)
        self._truths.append(truth)
        pixels = self._states[-1].pixels
        known = truth.visible & np.isfinite(pixels).all(1)
        started_at, ended_at = _common_gaussians(self._first, result)
        wanted, sure = _follow(started_at, there, back, result.observation.tissue)
        return {
            "frame": number,
            "motion_px": percentiles(np.linalg.norm(truth.pixels - self._places, axis=1)[known]),
            "anchors": int(known.sum()),
            "anchors_px": percentiles(np.linalg.norm(truth.pixels - pixels, axis=1)[known]),
            "gaussians": int(sure.sum()),
            "gaussians_px": percentiles(np.linalg.norm(wanted - ended_at, axis=1)[sure]),
        }

    def figures(self) -> dict[str, Any]:
        """Return figures of all methods over all measured frames, and of the anchors' confidence."""
        confidence = np.concatenate([states.confidence for states in self._states]).astype(np.float64)
        in_sight = np.concatenate([states.visibility for states in self._states]) == 1
        known = np.concatenate([truth.known for truth in self._truths])
        pixels = np.concatenate([states.pixels for states in self._states])
        off_px = np.linalg.norm(pixels - np.concatenate([truth.pixels for truth in self._truths]), axis=1)
        right = off_px < RIGHT * self._first.pair.camera.width
        found = {
            "truth": "exact" if self._exact else "direct flow",
            "frame_ms": float(np.median(self._frame_s)) * 1e3,
            "points_beside": len(self._shared),
            "methods": {name: self._judged(name, said) for name, said in self._said.items()},
            "reliability_px": reliability_rows(confidence[known], right[known], in_sight[known]),
        }
        if self._exact:
            points = np.concatenate([states.points for states in self._states])
            off = np.linalg.norm(points - np.concatenate([truth.points for truth in self._truths]), axis=1)
            found["reliability_mm"] = reliability_rows(confidence, off < RIGHT_MM * 1e-3, in_sight)
        return found

    def _judged(self, name: str, said: _Said) -> dict[str, Any]:
        visible = np.array([truth.visible[self._shared] for truth in self._truths])
        wanted = np.array([truth.pixels[self._shared] for truth in self._truths])
        seen, off = np.array(said.seen), np.linalg.norm(np.array(said.pixels) - wanted, axis=2)
        off = np.where(np.isfinite(off), off, np.inf)  # the method gives no position
        points = self.count if name in ("anchors", "direct_flow") else len(self._shared)
        return {
            "off_by_px": percentiles(off[visible & np.isfinite(off)]),
            "within": shares_within(off[visible]),
            "sure": float(np.mean(seen[visible])),
            "wrong": float(np.mean((seen & (off > WRONG * self._first.pair.camera.width))[visible])),
            "average_jaccard": average_jaccard(off, visible, seen) if self._exact else None,
            "visibility_right": float(np.mean(seen == visible)) if self._exact else None,
            "us_per_point": float(np.median(said.times_s)) * 1e6 / points,
        }


def reliability_rows(confidence: F64, right: Bool, in_sight: Bool) -> dict[str, Any]:
    """Return for JSON `bins`, each as `Bin`, the mean distance between confidence and truth (`error`), and
    the bins of anchors that are wholly `in_sight`, whose patches are searched for, and `out_of_sight`."""
    parts = {"bins": np.ones_like(in_sight), "in_sight": in_sight, "out_of_sight": ~in_sight}
    bins = {name: reliability(confidence[part], right[part]) for name, part in parts.items()}
    rows = {name: [asdict(each) for each in found] for name, found in bins.items()}
    return {"error": calibration_error(bins["bins"]), **rows}


def true_points(frame: StereoFrame, result: FrameResult) -> F64 | None:
    """Return the recording's true surface points [P, 3] in the world of the run; None if it has none."""
    if frame.reference is None or frame.reference.points is None:
        return None
    if frame.T_world_cam is None:
        return frame.reference.points
    world = result.observation.camera.T_world_cam @ np.linalg.inv(frame.T_world_cam)
    return np.asarray(transform(world, frame.reference.points), np.float64)


def _visible(frame: StereoFrame) -> Bool:
    """Which of the recording's true points [P] are seen."""
    assert frame.reference is not None and frame.reference.points_visible is not None
    return frame.reference.points_visible


def _grid(result: FrameResult) -> F64:
    """A regular grid of pixels [P, 2] over the image."""
    height, width = result.observation.tissue.shape
    columns, rows = np.arange(BORDER, width - BORDER, SPACING), np.arange(BORDER, height - BORDER, SPACING)
    return np.stack(np.meshgrid(columns, rows), 2).reshape(-1, 2).astype(np.float64)


def middle(places: F64, result: FrameResult) -> Bool:
    """Tell which of some pixels [P, 2] are not near the image's edge."""
    height, width = result.observation.tissue.shape
    inside = (places >= BORDER) & (places < [width - BORDER, height - BORDER])
    return np.asarray(inside.all(1))


def pin(pipeline: Pipeline, result: FrameResult, places: F64, rows: I64) -> dict[int, int]:
    """Pin anchors at these rows of pixels [P, 2], where possible; return id -> row.

    Raises:
        SagsError: none can be pinned.
    """
    pinned, shown = dict[int, int](), (result.observation, result.snapshot, result.views["left"])
    for row in rows.tolist():
        u, v = places[row].tolist()
        with suppress(SagsError):  # an instrument, or no depth there
            pinned[pipeline.anchors.add_pixel(u, v, *shown)] = row
    if not pinned:
        raise SagsError("no tissue with depth is there to pin anchors; set source.start or source.seed anew")
    return pinned


def _follow(places: F64, there: F32, back: F32, tissue: Bool) -> tuple[F64, Bool]:
    """Where the flow takes places [M, 2] px, and whether the flow is reliable there [M]."""
    ends = places + sample(there, places)
    error = np.linalg.norm(ends + sample(back, ends) - places, axis=1)
    height, width = tissue.shape
    x, y = np.rint(ends).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    on_tissue = inside & tissue[y.clip(0, height - 1), x.clip(0, width - 1)]
    return ends, on_tissue & (error < CONSISTENT)


def _common_gaussians(first: FrameResult, result: FrameResult) -> tuple[F64, F64]:
    """Pixels [M, 2], in both frames, of the Gaussians on the surface seen in the first frame that still
    exist."""
    before, after = first.snapshot.gaussians, result.snapshot.gaussians
    _, i, j = np.intersect1d(before.ids, after.ids, return_indices=True)
    started, z = project(first.snapshot.camera, before.means[i])
    ended, _ = project(result.snapshot.camera, after.means[j])
    view = first.views["left"]
    height, width = view.depth.shape
    x, y = np.rint(np.nan_to_num(started, nan=-1)).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    drawn = view.depth[y.clip(0, height - 1), x.clip(0, width - 1)]
    seen = inside & (drawn > 0) & (np.abs(z - drawn) < BEHIND_SURFACE * drawn)
    return started[seen], ended[seen]
