"""What the node makes of disturbed images, for a second in the middle of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np

from benchmarks import Advance
from benchmarks.disturbances import DISTURBANCES, Disturbance, Scene, Taken, disturbed
from benchmarks.quality.tracking import true_points
from sags_node.errors import SagsError, UsageError
from sags_node.findings import by_code
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.budget import StepBudget
from sags_node.messaging import published
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.pipeline.session import Session
from sags_node.quality import metrics
from sags_node.quality.gallery import Picture, depth_range, depth_tile, shrunk
from sags_node.sources.source import open_source
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F32, F64, I64, U8, AnchorStates, Bool, FrameResult, RenderedView, StereoFrame
from sags_node.vision.tissue import TissueMask

LEAD = 10  # frames from pinning the anchors to the beginning of the disturbance
RECOVERY = 10  # frames after the disturbance, within which all should be as before
AFTER_SECONDS = 2.0  # played after the disturbance
BEGINS_AT = 0.4  # of the recording, where the launch file names no segment
WITHIN_DB = 1.0  # a PSNR this close to what it was has recovered
STEADY = 3  # frames in a row that must have recovered
CONFIDENT = 0.5
SUPPORTED_SECONDS = 0.5  # a depth that was measured in this time is not borrowed
ANCHORS = 24
ANCHOR_WRONG = 2e-3  # m: an instrument guided to an anchor that is farther off misses its target
ANCHOR_WRONG_PX = 8 / 640  # of the width, where depth has no truth: 1.1 mm sideways at 80 mm

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame of a run to look at: what came, and what the node made of it."""

    left: U8  # [H, W, 3] rectified, as it came
    right: U8  # [H, W, 3] likewise
    shown: U8  # [H, W, 3] the left view as it is published
    view: RenderedView
    tissue: Bool  # [H, W] in truth


@dataclass(frozen=True, slots=True)
class _Shown:
    """What one frame of a run showed."""

    psnr: float  # dB of what is published over the true tissue, against the true image
    model_psnr: float  # dB, the same of the model alone
    borrowed: float  # share of the published depth, see `_Run._borrowed`
    confident_borrowed: float  # share of the depth that is published as confident
    depth: dict[str, metrics.DepthErrors]  # `all` that is published, and `confident`; empty: no reference
    warnings: frozenset[str]
    restarts: int  # of the model, since the first frame


TABLES = (
    "name psnr_before psnr_during psnr_after frames_to_recover model_psnr_during model_psnr_after"
    " model_frames_to_recover restarts",
    "name confident_depth_p90_mm depth_median_mm coverage borrowed_share warned_after_s cleared_after_s"
    " warned_of anchors_back anchors_wrong",
)


def measure_disturbances(
    session: Session,
    names: Sequence[str],
    start: int | None,
    seconds: float,
    advance: Advance,
    look: Callable[[str, list[Shot]], None],
) -> dict[str, Any]:
    """Play a recording once for each disturbance, the undisturbed run first: the others are judged by it.

    Args:
        names: of `DISTURBANCES`.
        start: the frame in which each begins; None: that of the launch file's first segment, or `BEGINS_AT`.
        seconds: length of the disturbances that have no length of their own.
        look: called after each run with a frame before, in the middle, and after the disturbance.

    Returns:
        `rows`, one for each name; the keys are explained in benchmarks/disturbances.md.
    """
    configure_threads(session.config.engine.threads)
    rate, during = _stretch(session, start, seconds)
    scene = Scene(session.rig, _references(session, during))
    last = during.stop + round(AFTER_SECONDS * rate)
    order = ["clean", *(name for name in names if name != "clean")]
    clean: _Run | None = None
    rows: list[Row] = []
    for number, name in enumerate(order):
        disturbance = DISTURBANCES[name]
        length = disturbance.length(len(during), rate)
        run = _Run(session, disturbance, range(during.start, during.start + length), rate, clean)
        with open_source(session.config.source) as source:
            frames = source.frame_count or 1
            for done, taken in enumerate(disturbed(disturbance, source, run.during, rate, scene)):
                run.take(taken)
                advance(number * frames + done + 1, len(order) * frames, name)
                if taken.clean.frame_id >= last:
                    break
        clean = clean or run
        if name in names:
            rows.append(run.row())
            look(name, run.shots)
    assert clean is not None  # it was played first
    return {
        "session": session.name,
        "settings": {
            "from": during.start,
            "seconds": seconds,
            "rate": rate,
            "masks": session.config.vision.tissue.method,
            "width": session.working_size[0],
            "height": session.working_size[1],
        },
        "rows": rows,
        "receipt": clean.receipt.as_json(),
    }


def _stretch(session: Session, start: int | None, seconds: float) -> tuple[float, range]:
    """Frames per second, and the frames to disturb."""
    if session.config.one_camera:
        raise UsageError("disturbances are made for two eyes; this recording has one")
    with open_source(session.config.source, references=False) as source:
        rate, count = source.rate, source.frame_count
        first = next(iter(source)).frame_id
    assert count is not None  # it does not loop
    if start is None:
        begins = [begin for begin, _ in session.config.played_segments.values() if begin >= first + LEAD]
        start = begins[0] if begins else first + round(BEGINS_AT * count)
    during = range(start, start + max(1, round(seconds * rate)))
    if start < first + LEAD or during.stop + RECOVERY + STEADY > first + count:
        raise UsageError(
            f"{during.start} to {during.stop - 1} does not lie well inside frames {first} to "
            f"{first + count - 1}: at least {LEAD} frames are needed before and {RECOVERY + STEADY} after; "
            "choose another --from, or fewer --seconds"
        )
    return rate, during


def _references(session: Session, during: range) -> dict[int, F32]:
    """Reference depths by frame, from the last one before the stretch to the first one after it."""
    found: dict[int, F32] = {}
    with open_source(session.config.source) as source:
        for frame in source:
            if frame.right is None:
                raise UsageError("disturbances are made for two eyes; this recording has one")
            if frame.reference is None or frame.reference.depth is None:
                continue
            if frame.frame_id <= during.start:
                found.clear()
            found[frame.frame_id] = frame.reference.depth
            if frame.frame_id >= during.stop:
                break
    return found


class _Run:
    """One pass through the recording."""

    def __init__(
        self, session: Session, disturbance: Disturbance, during: range, rate: float, clean: _Run | None
    ) -> None:
        self.during = during
        self.shots: list[Shot] = []
        self._name = disturbance.name
        self._rate = rate
        self._clean = clean or self
        self._pipeline = Pipeline(session.config, session.rig)
        self._budget = StepBudget(1)
        given = session.config.vision.tissue.model_copy(update={"method": "session"})
        self._true_tissue = TissueMask(given, self._pipeline.rectifier)
        self._shown: dict[int, _Shown] = {}  # by frame_id
        self.receipt = Receipt(session.rig, session.working_size, None)  # of what it is compared with
        self._measured_in: I64 | None = None  # [H, W] frame_id in which each pixel's depth was measured last
        self._anchors = _PinnedAnchors(self._pipeline)
        self._shoot_at = [during.start - 1, during.start + len(during) // 2, during.stop]

    def take(self, taken: Taken) -> None:
        """Play one frame and measure it. If it is lost, nothing new is shown and nothing is measured."""
        if taken.given is None:
            return
        result = self._pipeline.process(taken.given, self._budget, FrameRequest(left=True))
        frame, view = taken.clean, result.views["left"]
        truth = self._pipeline.rectifier(frame)
        tissue = self._true_tissue(frame, truth)
        self.receipt.add(frame, tissue)
        size, where = published.size_of(truth), published.nearest(truth, tissue)
        shown, true = published.colours(view, size), metrics.as_float(published.picture(truth, "left"))
        borrowed = self._borrowed(frame.frame_id, result)
        drawn = view.depth > 0
        sure = np.float32(1) if view.confidence is None else view.confidence
        confident = drawn & (sure >= CONFIDENT)
        self._shown[frame.frame_id] = _Shown(
            psnr=metrics.psnr(metrics.as_float(shown), true, where),
            model_psnr=metrics.psnr(metrics.as_float(view.colours.at(*size)), true, where),
            borrowed=_share(borrowed, drawn),
            confident_borrowed=_share(borrowed, confident),
            depth=_depth_errors(frame, view.depth, confident, tissue),
            warnings=frozenset(by_code(self._pipeline.warnings)),
            restarts=self._pipeline.map.restarts,
        )
        if not self._anchors.pinned and frame.frame_id >= self.during.start - LEAD:
            self._anchors.pin(frame, result)
        self._anchors.follow(frame, result)
        if self._shoot_at and frame.frame_id >= self._shoot_at[0]:
            del self._shoot_at[0]
            assert result.pair.right is not None
            self.shots.append(Shot(result.pair.left, result.pair.right, shown, view, tissue))

    def _borrowed(self, frame_id: int, result: FrameResult) -> Bool:
        """Where [H, W] stereo has not measured a depth for `SUPPORTED_SECONDS`: depth that is published there
        is carried over, or taken from elsewhere. A wrong measurement counts as a measurement."""
        measured = result.observation.depth > 0
        if self._measured_in is None:
            self._measured_in = np.full(measured.shape, np.iinfo(np.int64).min // 2)
        self._measured_in[measured] = frame_id
        return np.asarray(frame_id - self._measured_in >= SUPPORTED_SECONDS * self._rate)

    def row(self) -> Row:
        """Return the figures of the run; None where one does not apply."""
        first, stop = self.during.start, self.during.stop
        before = [shown for frame, shown in self._shown.items() if first - self._rate <= frame < first]
        within = [shown for frame, shown in self._shown.items() if frame in self.during]
        after = [shown for frame, shown in self._shown.items() if frame >= stop + RECOVERY]
        amid = (shown.depth for frame, shown in self._shown.items() if first <= frame < stop + RECOVERY)
        depths = [each for each in amid if each]
        psnrs = {
            f"{key}_{when}": _over(getattr(shown, key) for shown in frames)
            for key in ("psnr", "model_psnr")
            for when, frames in {"before": before, "during": within, "after": after}.items()
        }
        known = frozenset[str]().union(*(shown.warnings for shown in before))
        fresh = {frame: shown.warnings - known for frame, shown in self._shown.items() if frame >= first}
        warned, cleared = warning_times(fresh, self.during, self._rate)
        anchors = self._anchors.judge(stop + RECOVERY - 1, self._clean._anchors)
        last = max(self._shown)
        return {
            "name": self._name,
            "frames": len(self.during),
            **psnrs,
            "confident_depth_p90_mm": _over((depth["confident"].p90_mm for depth in depths), max),
            "depth_median_mm": _over((depth["all"].median_mm for depth in depths), max),
            "coverage": _over((depth["all"].coverage for depth in depths), min),
            "confident_coverage": _over((depth["confident"].coverage for depth in depths), min),
            "borrowed_share": _over(shown.borrowed for shown in within),
            "confident_borrowed_share": _over(shown.confident_borrowed for shown in within),
            "warned_after_s": _round(warned),
            "cleared_after_s": _round(cleared),
            "warned_of": sorted(frozenset[str]().union(*fresh.values())),
            "frames_to_recover": self._recovers("psnr", psnrs["psnr_before"]),
            "model_frames_to_recover": self._recovers("model_psnr", psnrs["model_psnr_before"]),
            "restarts": self._shown[last].restarts - before[-1].restarts,
            **anchors,
        }

    def _recovers(self, key: str, before: float | None) -> int | None:
        """Return `frames_to_recover` of a PSNR of `_Shown`."""
        psnr, clean = (
            {frame: getattr(shown, key) for frame, shown in run._shown.items()} for run in (self, self._clean)
        )
        return frames_to_recover(psnr, clean, self.during.stop, before)


def frames_to_recover(
    psnr: Mapping[int, float], clean: Mapping[int, float], stop: int, before: float | None
) -> int | None:
    """Count the frames from the end of a disturbance, `stop`, until `STEADY` frames in a row are within
    `WITHIN_DB` of the PSNR before it, or of the undisturbed run's same frames, where those are worse; None:
    never. PSNR is by frame_id, dB; lost frames are not in it."""
    if before is None:
        return None
    frames = sorted(frame for frame in psnr if frame >= stop)
    good = [psnr[frame] >= min(before, clean[frame]) - WITHIN_DB for frame in frames]
    starts = range(len(good) - STEADY + 1)
    return next((k for k in starts if all(good[k : k + STEADY])), None)


def warning_times(
    warnings: Mapping[int, frozenset[str]], during: range, rate: float
) -> tuple[float | None, float | None]:
    """Return the seconds from the beginning of a disturbance to the first warning, and from its end until
    there is none; None: never. `warnings`: their codes by frame_id, without those that warned before."""
    warned = [frame for frame, codes in warnings.items() if codes and frame >= during.start]
    if not warned:
        return None, None
    after = (min(warned) - during.start) / rate
    if max(warned) == max(warnings):
        return after, None
    return after, max(0, max(warned) + 1 - during.stop) / rate


class _PinnedAnchors:
    """The anchors of one run, and where they were in each frame after they were pinned."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.pinned = False
        self._anchors, self._width = pipeline.anchors, pipeline.rectifier.camera.width
        self._tracks: list[int] = []  # which of the recording's true points each is on, in the order of ids
        self._states: dict[int, AnchorStates] = {}  # by frame_id
        self._truth: dict[int, F64] = {}  # frame_id -> points [A, 3] (m, world), where the recording has any

    def pin(self, frame: StereoFrame, result: FrameResult) -> None:
        """Pin anchors on visible true surface points, where the recording has them, else on a grid."""
        self.pinned = True
        shown = result.observation, result.snapshot, result.views["left"]
        points = true_points(frame, result)
        if points is not None:
            assert frame.reference is not None and frame.reference.points_visible is not None
            visible = np.flatnonzero(frame.reference.points_visible)
            for track in visible[:: max(1, len(visible) // ANCHORS)][:ANCHORS]:
                self._try(int(track), partial(self._anchors.add_point, points[track], *shown))
        else:
            height, width = result.observation.tissue.shape
            columns = round((ANCHORS * width / height) ** 0.5)
            rows = -(-ANCHORS // columns)
            for place in range(ANCHORS):
                u = (place % columns + 0.5) * width / columns
                v = (place // columns + 0.5) * height / rows
                self._try(place, partial(self._anchors.add_pixel, u, v, *shown))
        if not self._tracks:
            raise SagsError(f"nothing can be pinned in frame {frame.frame_id}; choose another --from")

    def _try(self, track: int, add: Callable[[], int]) -> None:
        with suppress(SagsError):  # an instrument, or no depth there
            add()
            self._tracks.append(track)

    def follow(self, frame: StereoFrame, result: FrameResult) -> None:
        """Note where the node says the anchors are, and where they truly are."""
        self._states[frame.frame_id] = result.anchors
        points = true_points(frame, result)
        if points is not None:
            self._truth[frame.frame_id] = points[self._tracks]

    def judge(self, frame_id: int, clean: _PinnedAnchors) -> Row:
        """Return shares 0..1 of the anchors in a frame, or in the first after it that came: confident and
        within `ANCHOR_WRONG` of the truth, and confident and farther away. The rest are unsure or lost.
        Without true points, the truth is where the undisturbed run has the anchors in the image."""
        frame_id = min(frame for frame in self._states if frame >= frame_id)
        states = self._states[frame_id]
        if frame_id in self._truth:
            offsets, most = (states.points - self._truth[frame_id]).astype(np.float32), ANCHOR_WRONG
        else:
            offsets, most = states.pixels - clean._states[frame_id].pixels, ANCHOR_WRONG_PX * self._width
        sure = (states.confidence >= CONFIDENT) & np.isfinite(offsets).all(1)
        if frame_id in self._truth:
            sure &= states.depth_confidence >= CONFIDENT  # below, it may be 3 mm off along the ray
        right = np.linalg.norm(offsets, axis=1) <= most  # NaN: not
        return {
            "anchors": len(states),
            "anchors_back": _round(float(np.mean(sure & right))),
            "anchors_wrong": _round(float(np.mean(sure & ~right))),
        }


def _depth_errors(
    frame: StereoFrame, depth: F32, confident: Bool, tissue: Bool
) -> dict[str, metrics.DepthErrors]:
    if frame.reference is None or frame.reference.depth is None:
        return {}
    truth = metrics.resample_nearest(frame.reference.depth, *depth.shape[::-1])
    sure = np.where(confident, depth, np.float32(0))
    parts = {"all": depth, "confident": sure}
    return {name: metrics.depth_errors(part, truth, tissue) for name, part in parts.items()}


def _share(part: Bool, whole: Bool) -> float:
    count = np.count_nonzero(whole)
    return np.count_nonzero(part & whole) / count if count else float("nan")


def _over(values: Iterable[float], figure: Callable[..., Any] = np.mean) -> float | None:
    """The mean, or another figure, of the values that are known; None if none is."""
    known = [value for value in values if np.isfinite(value)]
    return _round(float(figure(known))) if known else None


def _round(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def strip(shots: Sequence[Shot]) -> bytes:
    """Draw a PNG with a row each for before, middle and after: the left and right images as they came, what
    is shown, and the depth, which is grey on tissue where none is published."""
    shown = [
        Picture(shot.view.frame_id, 0.0, shot.left, shot.shown, shot.view.depth, shot.tissue)
        for shot in shots
    ]
    near, far = depth_range(shown[::2])  # those that nothing is wrong with
    lines = [
        np.hstack([shrunk(shot.left), shrunk(shot.right), shrunk(each.render), depth_tile(each, near, far)])
        for shot, each in zip(shots, shown, strict=True)
    ]
    return cv2.imencode(".png", np.vstack(lines)[..., ::-1])[1].tobytes()
