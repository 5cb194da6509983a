"""Go through a recording once more and measure what a spooled run showed of each of its frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from sags_node.config.schema import Box, PoseWay
from sags_node.detail.memory import Matched, Memory
from sags_node.detail.seen import SeenFrame
from sags_node.detail.show import LESSON_EVERY, Detail, Lessons
from sags_node.engine.rasterizer.rasterize import make_rasterizer, to_view
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import UsageError
from sags_node.evaluation import calibration, metrics
from sags_node.evaluation.aside import Aside
from sags_node.evaluation.carried import Seen, carried
from sags_node.evaluation.flicker import Flicker
from sags_node.evaluation.gallery import Gallery, Picture
from sags_node.evaluation.lpips import Lpips
from sags_node.evaluation.receipt import Receipt
from sags_node.evaluation.spool import RunFacts, Spool, SpooledFrame
from sags_node.evaluation.tracking import PointTracks, TrackErrors
from sags_node.evaluation.trajectory import RigidOdometry
from sags_node.evaluation.views import between, extrapolated
from sags_node.evaluation.warp import warp_to_right
from sags_node.geometry import transform
from sags_node.mapping.right_eye import right_eye_mask
from sags_node.messaging import published
from sags_node.types import F32, F64, I64, U8, Bool, Camera, Gaussians, RectifiedPair, Reference, StereoFrame
from sags_node.vision.rectify import Rectifier

PREDICTED = 3  # frames ahead, at most

Figures = dict[str, float]
Progress = Callable[[str, int], None]  # what is going on, frames done
OnPicture = Callable[[int, U8], None]  # a frame's number and its rectified left picture
TissueOf = Callable[[StereoFrame, RectifiedPair], Bool]


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """What to measure, and what the run must leave out for it.

    Raises:
        UsageError: a count is out of range, or there is no file of weights.
    """

    hold_out: int = 8  # frames i > 0 with (i - 1) % hold_out == 0 are never mapped; 0: none
    every: int = 5  # the right eye and LPIPS are measured on every so many processed frames
    lpips_weights: Path | None = None
    paper_psnr: bool = False
    hidden: bool = False  # a second run, in which boxes of tissue are hidden, see `measure_hidden`
    aside: bool = False  # views of the phantom from places that no eye of it has, see `Aside`

    def __post_init__(self) -> None:
        if self.hold_out < 0 or self.every < 1:
            raise UsageError(f"hold_out {self.hold_out} must be 0 or more, every {self.every} 1 or more")
        if self.lpips_weights is not None and not self.lpips_weights.is_file():
            raise UsageError(f"there is no file of LPIPS weights at {self.lpips_weights}; check the path")

    def holds_out(self, frame_id: int) -> bool:
        """The literature's test split, by frame number."""
        return self.hold_out > 0 and frame_id > 0 and (frame_id - 1) % self.hold_out == 0


@dataclass(frozen=True, slots=True)
class Poses:
    """Of one frame's camera, `T_world_cam` [4, 4]."""

    known: F64  # as the session says
    shown: F64  # as the run had it
    rigid: F64  # of the baseline, see `RigidOdometry`


@dataclass(frozen=True, slots=True)
class FrameRow:
    """All figures of one frame of the recording."""

    frame_id: int
    seconds: float  # on the recording's clock
    figures: dict[str, Figures]  # those of `summary.GROUPS` that apply
    facts: RunFacts | None = None  # None: held out, or dropped by the run
    track: TrackErrors | None = None
    poses: Poses | None = None  # None: the session has none, or the run was given them
    calibration: I64 | None = None  # of the depth's confidence, see `calibration.tally`


@dataclass(slots=True)
class _Before:
    """A processed frame, from which later ones are predicted."""

    shown: SpooledFrame
    given: Camera  # as the session says
    truth: F32
    seconds: float  # on the recording's clock
    lent: SeenFrame  # as views have its detail
    right: U8 | None  # [H, W, 3] the other eye's picture

    def seen(self, weight: float) -> Seen:
        """As a part of the mean of several, with a share of `weight`."""
        snapshot = self.shown.snapshot
        return Seen(snapshot.gaussians, snapshot.camera, self.truth, self.shown.tissue, weight)


@dataclass(slots=True)
class _HeldOut:
    """A frame that was not mapped, until the next one was."""

    row: FrameRow
    camera: Camera
    truth: F32
    tissue: Bool


class Measurer:
    """Measures a run frame by frame.

    Attributes:
        rows: one for each frame of the recording.
        gallery: a few frames to look at.
        depth_kind: what the reference depth is, None without one.
    """

    def __init__(
        self,
        spool: Spool,
        rectifier: Rectifier,
        tissue_of: TissueOf,
        options: MeasureOptions,
        receipt: Receipt,
        exclude: tuple[Box, ...] = (),
        pose: PoseWay = "session",
        on_picture: OnPicture = lambda frame_id, left: None,
        backend: str = "numba",
        detail: bool = False,
        aside: Aside | None = None,
    ) -> None:
        """
        Args:
            tissue_of: the run's own tissue mask, for frames that it held out.
            receipt: takes note of what is compared.
            exclude: boxes of the raw pictures that are never measured (captions, burnt into both eyes).
            pose: where the run had its poses from.
            on_picture: called with each frame of the recording.
            backend: what draws, as `make_rasterizer` has it.
            detail: views have that of pictures (`publish.detail`).
            aside: measures views from there.
        """
        self.rows: list[FrameRow] = []
        self.gallery = Gallery(len(spool))
        self.depth_kind: str | None = None
        self._spool = spool
        self._receipt = receipt
        self._places = {frame_id: place for place, frame_id in enumerate(spool.frame_ids)}
        self._rectifier = rectifier
        self._tissue_of = tissue_of
        self._options = options
        self._exclude = exclude
        camera = rectifier.camera
        self._rasterizer = make_rasterizer(backend, camera.width, camera.height)
        self._lpips = Lpips(options.lpips_weights) if options.lpips_weights else None
        self._usable_right: Bool | None = None
        self._right_before: U8 | None = None  # of the frame processed before
        self._flicker = Flicker()
        self._tracks: PointTracks | None = None
        self._pose = pose
        self._on_picture = on_picture
        self._rigid = RigidOdometry()
        self._earlier: deque[_Before] = deque(maxlen=PREDICTED)  # the latest first
        self._detail = Detail(Lessons()) if detail else None
        self._memory, self._matched = Memory(), Matched()
        self._held: _HeldOut | None = None
        self._aside = aside

    def run(self, frames: Iterable[StereoFrame], progress: Progress) -> None:
        """Measure all frames of the recording that the run was played from, but for those of its warm-up."""
        for frame in frames:
            if frame.warm_up:
                continue
            pair = self._rectifier(frame)
            self._on_picture(frame.frame_id, published.picture(pair, "left"))
            seconds = frame.t_capture_ns * 1e-9
            place = self._places.get(frame.frame_id)
            if place is not None:
                self.rows.append(self._processed(frame, pair, seconds, place))
            elif self._measures_held_out(frame) and self._earlier:
                self.rows.append(self._held_out(frame, pair, seconds, self._earlier[0]))
            else:
                self.rows.append(FrameRow(frame.frame_id, seconds, {}))
            progress("measuring", len(self.rows))

    def _measures_held_out(self, frame: StereoFrame) -> bool:
        """Not where the robot does not tell from where it was seen."""
        return self._options.holds_out(frame.frame_id) and frame.pose_problem is None

    def _processed(self, frame: StereoFrame, pair: RectifiedPair, seconds: float, place: int) -> FrameRow:
        shown = self._spool.read(place)
        self._receipt.add(frame, shown.tissue)
        truth = metrics.as_float(pair.left)
        costly = place % self._options.every == 0
        figures = {"online": self._quality(metrics.as_float(shown.rgb), truth, shown.tissue, costly)}
        for frames, before in enumerate(self._earlier, 1):
            group = "predict" if frames == 1 else f"predict_{frames}"
            figures[group] = self._predict(before, shown, truth, seconds, frames)
        if costly and pair.right is not None:
            figures |= self._right_eye(shown, pair.left, pair.right, frame)
        self._right_before = pair.right
        flicker = self._flicker(pair.left, shown)
        if flicker is not None:
            figures["flicker"] = flicker
        track, counts = None, None
        if frame.reference is not None:
            if frame.reference.depth is not None:
                self.depth_kind = frame.reference.depth_kind
                figures |= _depth_figures(shown, frame.reference.depth)
                counts = _calibration(shown, frame.reference.depth)
            track = self._follow(shown, frame.reference, pair.camera)
        after = _Before(shown, pair.camera, truth, seconds, self._lent(shown, pair), pair.right)
        if self._aside is not None and self._aside.due(shown):
            figures |= self._aside(
                shown, pair.left, lambda camera: self._view(after, shown.snapshot.gaussians, camera, 0)
            )
        psnr = figures["online"]["psnr"]
        seen = Picture(frame.frame_id, psnr, pair.left, shown.rgb, shown.depth, shown.tissue)
        self.gallery.offer(place, seen)
        self._learn(after)
        if self._held is not None and seconds > self._earlier[0].seconds:
            self._held.row.figures["between"] = self._between(self._earlier[0], self._held, after)
        self._held = None
        self._earlier.appendleft(after)
        poses = self._poses(frame, pair, shown)
        return FrameRow(frame.frame_id, seconds, figures, shown.facts, track, poses, counts)

    def _poses(self, frame: StereoFrame, pair: RectifiedPair, shown: SpooledFrame) -> Poses | None:
        if self._pose == "session" or frame.T_world_cam is None:
            return None
        rigid = self._rigid(pair.left, shown.measured_depth, shown.tissue, pair.camera)
        return Poses(frame.T_world_cam, shown.snapshot.camera.T_world_cam, rigid)

    def _in_world_of_run(self, given: Camera, shown: SpooledFrame) -> F64:
        """[4, 4] from the session's world to the run's, where one frame's camera is the same in both."""
        return shown.snapshot.camera.T_world_cam @ given.viewmat

    def _camera_of_run(self, given: Camera, before: _Before) -> Camera:
        """The camera of a frame that the run never saw: since the frame before it has moved as given."""
        if self._pose == "session":
            return given
        if self._pose == "fixed":
            return before.shown.snapshot.camera
        world = self._in_world_of_run(before.given, before.shown)
        return replace(given, T_world_cam=world @ given.T_world_cam)

    def _learn(self, now: _Before) -> None:
        """As a node that draws views learns from a frame."""
        if self._detail is None or len(self.rows) % LESSON_EVERY:
            return
        if now.right is not None:
            self._detail.learn_aside(now.lent, now.shown.snapshot, now.right, now.shown.baseline)
        if self._earlier:
            before = self._earlier[0]
            expected = extrapolated(before.shown.snapshot, now.seconds - before.seconds)
            self._detail.learn_ahead(before.lent, expected, now.lent)

    def _lent(self, shown: SpooledFrame, pair: RectifiedPair) -> SeenFrame:
        """A frame as it lends its picture to views of other moments."""
        snapshot, left, camera = shown.snapshot, pair.left, shown.snapshot.camera
        lent = SeenFrame(
            pair.t_capture_ns, camera, snapshot.gaussians, lambda: left, shown.tissue, shown.depth,
            self._matched(pair.t_capture_ns, shown.depth, shown.measured_depth),
        )  # fmt: skip
        if self._detail is None:
            return lent
        whole = self._detail.left(shown.rgb, shown.depth, camera, lent, self._memory.frames)
        self._memory.add(lent)
        return replace(lent, whole=whole)

    def _predict(
        self, before: _Before, shown: SpooledFrame, truth: F32, seconds: float, frames: int
    ) -> Figures:
        """`psnr` of what is shown of a moment some frames ahead; of the model alone, and of the picture then,
        shown again."""
        expected = extrapolated(before.shown.snapshot, seconds - before.seconds)
        guess, model = self._view(before, expected, shown.snapshot.camera, frames)
        pictures = {"psnr": guess, "model_psnr": model, "copy_psnr": before.truth}
        return {name: metrics.psnr(picture, truth, shown.tissue) for name, picture in pictures.items()}

    def _view(self, of: _Before, gaussians: Gaussians, camera: Camera, ahead: int) -> tuple[F32, F32]:
        """What a view of a frame shows, and the model alone in it, [H, W, 3] 0..1.

        Args:
            gaussians: of the frame, moved `ahead` frames.
        """
        planes = self._rasterizer.forward(gaussians, camera)
        model = colours_of(planes)
        if self._detail is None:
            return model, model
        drawn, baseline = to_view(planes, camera, 0, 0), of.shown.baseline
        shown = self._detail.view(drawn.rgb, drawn.depth, camera, gaussians, of.lent, baseline, float(ahead))
        return metrics.as_float(shown.rgb), model

    def _held_out(self, frame: StereoFrame, pair: RectifiedPair, seconds: float, before: _Before) -> FrameRow:
        camera = self._camera_of_run(pair.camera, before)
        guess = self._draw(extrapolated(before.shown.snapshot, seconds - before.seconds), camera)
        tissue, truth = self._tissue_of(frame, pair), metrics.as_float(pair.left)
        quality = self._quality(guess, truth, tissue, costly=True)
        quality["copy_psnr"] = metrics.psnr(before.truth, truth, tissue)
        row = FrameRow(frame.frame_id, seconds, {"heldout": quality})
        self._held = _HeldOut(row, camera, truth, tissue)
        return row

    def _between(self, before: _Before, held: _HeldOut, after: _Before) -> Figures:
        """A held-out frame, drawn when the next one is known; beside it both pictures carried there, and the
        mean of both as they are."""
        share = (held.row.seconds - before.seconds) / (after.seconds - before.seconds)
        states = before.shown.snapshot.gaussians, after.shown.snapshot.gaussians
        middle = between(*states, share)
        guess = self._draw(middle, held.camera)
        around = [before.seen(1 - share), after.seen(share)]
        brought = carried(self._rasterizer, middle, held.camera, around)
        mean = before.truth + np.float32(share) * (after.truth - before.truth)
        return {
            "psnr": metrics.psnr(guess, held.truth, held.tissue),
            "carried_psnr": metrics.psnr(brought, held.truth, held.tissue),
            "mean_psnr": metrics.psnr(mean, held.truth, held.tissue),
        }

    def _quality(self, picture: F32, truth: F32, tissue: Bool, costly: bool) -> Figures:
        return quality(picture, truth, tissue, self._options, self._lpips if costly else None)

    def _draw(self, gaussians: Gaussians, camera: Camera) -> F32:
        return colours_of(self._rasterizer.forward(gaussians, camera))

    def _right_eye(
        self, shown: SpooledFrame, left: U8, picture: U8, frame: StereoFrame
    ) -> dict[str, Figures]:
        """PSNR of the right eye's picture, each after a fit of gain and offset. `novel`: of the model alone;
        the mapper never saw it. `right`: of what was shown, of the left picture warped by the stereo stage's
        depth, where that is known, and of the right picture before."""
        if self._usable_right is None:
            self._usable_right = self._right_pixels(frame)
        camera, focal_px = shown.snapshot.camera, float(shown.snapshot.camera.K[0, 0])
        known = shown.depth[shown.tissue & (shown.depth > 0)]
        mask = right_eye_mask(shown.tissue, known, focal_px, shown.baseline)
        mask &= self._usable_right
        model = self._draw(shown.snapshot.gaussians, camera.moved_right(shown.baseline))
        truth = metrics.as_float(picture)

        def quality(drawn: F32, where: Bool) -> float:
            return metrics.psnr(metrics.fit_gain_offset(drawn, truth, where), truth, where)

        figures: dict[str, Figures] = {"novel": {"psnr": quality(model, mask)}}
        if shown.right_rgb is None:
            return figures
        warp, known_there = warp_to_right(
            metrics.as_float(left), shown.measured_depth, focal_px, shown.baseline
        )
        both = mask & known_there
        if both.any():
            figures["right"] = {
                "psnr": quality(metrics.as_float(shown.right_rgb), both),
                "warp_psnr": quality(warp, both),
                "model_psnr": quality(model, both),
                "coverage": float(both.sum() / mask.sum()),
            }
            if self._right_before is not None:
                figures["right"]["copy_psnr"] = quality(metrics.as_float(self._right_before), both)
        return figures

    def _right_pixels(self, frame: StereoFrame) -> Bool:
        """Where the rectified right picture shows the raw one, without the boxes left out."""
        white = np.full_like(frame.left, 255)
        for x, y, width, height in self._exclude:
            white[y : y + height, x : x + width] = 0
        rectified = self._rectifier(replace(frame, right=white)).right
        assert rectified is not None
        usable: Bool = (rectified == 255).all(-1)
        return usable

    def _follow(self, shown: SpooledFrame, reference: Reference, given: Camera) -> TrackErrors | None:
        if reference.points is None or reference.points_visible is None:
            return None
        if self._tracks is None:
            self._tracks = PointTracks(len(reference.points))
        snapshot, points = shown.snapshot, reference.points
        if self._pose != "session":
            points = np.asarray(transform(self._in_world_of_run(given, shown), points), np.float64)
        return self._tracks.update(snapshot.gaussians, points, reference.points_visible, snapshot.camera)


def quality(
    picture: F32, truth: F32, tissue: Bool, options: MeasureOptions, lpips: Lpips | None = None
) -> Figures:
    """How near a picture [H, W, 3] is to the truth where there is tissue [H, W]."""
    figures = {
        "psnr": metrics.psnr(picture, truth, tissue),
        "ssim": metrics.ssim(picture, truth, tissue),
    }
    if options.paper_psnr:
        figures["paper_psnr"] = metrics.paper_psnr(picture, truth, tissue)
        figures["paper_ssim"] = metrics.paper_ssim(picture, truth, tissue)
    if lpips is not None:
        figures["lpips"] = lpips(picture, truth, tissue)
    return figures


def _calibration(shown: SpooledFrame, reference: F32) -> I64 | None:
    height, width = shown.depth.shape
    truth = metrics.resample_nearest(reference, width, height)
    if np.isnan(shown.confidence).any():
        return None
    return calibration.tally(shown.depth, shown.confidence, truth, shown.tissue)


def _depth_figures(shown: SpooledFrame, reference: F32) -> dict[str, Figures]:
    height, width = shown.depth.shape
    truth = metrics.resample_nearest(reference, width, height)
    figures = {"depth": asdict(metrics.depth_errors(shown.depth, truth, shown.tissue))}
    if shown.measured_depth.any():  # there may have been no time for it
        measured = metrics.depth_errors(shown.measured_depth, truth, shown.tissue)
        figures["measured_depth"] = asdict(measured)
    return figures
