"""Go through a recording once more and measure what a run showed of each of its frames."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path

import cv2
import numpy as np

from sags_node.config.schema import LaunchConfig
from sags_node.detail.memory import Matched, Memory
from sags_node.detail.motion import SmallDrawings
from sags_node.detail.seen import SeenFrame
from sags_node.detail.show import ASIDE_EVERY, LESSON_EVERY, Detail, Lessons
from sags_node.engine.rasterizer.rasterize import Drawer, to_view
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import UsageError
from sags_node.geometry import transform
from sags_node.mapping.devices import backend_of
from sags_node.messaging import published
from sags_node.quality import metrics
from sags_node.quality.gallery import Gallery, Picture
from sags_node.tools.evaluation import calibration
from sags_node.tools.evaluation.aside import Aside
from sags_node.tools.evaluation.flicker import Flicker
from sags_node.tools.evaluation.lpips import Lpips
from sags_node.tools.evaluation.moments import between, carried, extrapolated
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.tools.evaluation.run import MappedFrame, Run, RunFacts, ShownFrame
from sags_node.tools.evaluation.tracking import PointTracks, TrackErrors
from sags_node.tools.evaluation.trajectory import RigidOdometry
from sags_node.tools.evaluation.warp import right_figures, right_pixels
from sags_node.types import F32, F64, I64, U8, Bool, Camera, Gaussians, RectifiedPair, Reference, StereoFrame
from sags_node.vision.rectify import Rectifier
from sags_node.vision.tissue import TissueMask

PREDICTED = 3  # frames ahead, at most

Figures = dict[str, float]
Progress = Callable[[str, int], None]  # what is going on, frames done
OnPicture = Callable[[int, U8], None]  # a frame's number and its rectified left image


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
    second: bool = False  # two more runs for what this one cannot tell, see `measure_second`
    unseen: bool = False  # in these runs: depth against the frame's own stereo, and no predictions

    def __post_init__(self) -> None:
        if self.hold_out < 0 or self.every < 1:
            raise UsageError(f"hold_out {self.hold_out} must be 0 or more, every {self.every} 1 or more")
        if self.lpips_weights is not None and not self.lpips_weights.is_file():
            raise UsageError(f"there is no file of LPIPS weights at {self.lpips_weights}; check the path")

    def holds_out(self, frame_id: int) -> bool:
        """Tell whether a frame, by its number, is in the literature's test split."""
        return self.hold_out > 0 and frame_id > 0 and (frame_id - 1) % self.hold_out == 0


@dataclass(frozen=True, slots=True)
class Poses:
    """The poses of one frame's camera, `T_world_cam` [4, 4]."""

    known: F64  # as the session says
    shown: F64  # as the run had it
    rigid: F64  # of the baseline, see `RigidOdometry`


@dataclass(frozen=True, slots=True)
class FrameRow:
    """All figures of one frame of the recording."""

    frame_id: int
    seconds: float  # on the recording's clock
    figures: dict[str, Figures]  # those of `figures.MEANS` that apply
    facts: RunFacts | None = None  # None: held out, or dropped by the run
    track: TrackErrors | None = None
    poses: Poses | None = None  # None: the session has none, or the run was given them
    calibration: I64 | None = None  # of the depth's confidence, see `calibration.tally`


@dataclass(frozen=True, slots=True)
class _Recorded:
    """A frame of the recording."""

    frame: StereoFrame
    pair: RectifiedPair
    truth: F32  # [H, W, 3] the left image, 0..1
    seconds: float  # on the recording's clock


@dataclass(frozen=True, slots=True)
class _Mapped:
    """A mapped frame, from which later ones are predicted."""

    recorded: _Recorded
    shown: MappedFrame
    lent: SeenFrame  # as it lends its detail to views


@dataclass(frozen=True, slots=True)
class _HeldOut:
    """A held-out frame, kept until the next frame is mapped."""

    row: FrameRow
    camera: Camera
    truth: F32
    tissue: Bool


class Measurer:
    """Measures a run frame by frame: what consumers got of it, and where the model is known, that too.

    Attributes:
        rows: one for each frame of the recording.
        gallery: a few frames to look at.
        depth_kind: what the reference depth is, None without one.
    """

    def __init__(
        self,
        run: Run,
        rectifier: Rectifier,
        config: LaunchConfig,
        options: MeasureOptions,
        receipt: Receipt,
        on_picture: OnPicture = lambda frame_id, left: None,
        aside: Aside | None = None,
    ) -> None:
        """
        Args:
            rectifier: images are compared at its size; smaller ones are enlarged.
            config: what was run.
            receipt: takes note of what is compared.
            on_picture: called with each frame of the recording.
            aside: measures views from the side.
        """
        self.rows: list[FrameRow] = []
        self.gallery = Gallery(len(run))
        self.depth_kind: str | None = None
        self._run = run
        self._receipt = receipt
        self._places = count()
        self._rectifier = rectifier
        self._config, self._options = config, options
        self._lpips = Lpips(options.lpips_weights) if options.lpips_weights else None
        self._usable_right: Bool | None = None
        self._flicker = Flicker()
        self._tracks: PointTracks | None = None
        self._pose = config.vision.pose
        self._on_picture = on_picture
        self._rigid = RigidOdometry()
        self._before: F32 | None = None  # the camera's image of the frame before
        self._earlier: deque[_Mapped] = deque(maxlen=PREDICTED)  # the latest first
        self._detail = Detail(Lessons()) if config.publish.detail else None
        self._memory, self._matched, self._drawings = Memory(), Matched(), SmallDrawings()
        self._held: _HeldOut | None = None
        self._aside = aside

    @cached_property
    def _drawer(self) -> Drawer:
        camera = self._rectifier.camera
        return Drawer(backend_of(self._config), camera.width, camera.height)

    @cached_property
    def _tissue_of(self) -> TissueMask:
        """The run's own mask, for frames that it held out."""
        return TissueMask(self._config.vision.tissue, self._rectifier)

    def run(self, frames: Iterable[StereoFrame], progress: Progress) -> None:
        """Measure all frames of the recording that the run was played from, but for those of its warm-up."""
        for frame in frames:
            if frame.warm_up:
                continue
            pair = self._rectifier(frame)
            self._on_picture(frame.frame_id, published.picture(pair, "left"))
            now = _Recorded(frame, pair, metrics.as_float(pair.left), frame.t_capture_ns * 1e-9)
            self.rows.append(self._row(now))
            self._before = now.truth
            progress("measuring", len(self.rows))

    def _row(self, now: _Recorded) -> FrameRow:
        shown = self._run.read(now.frame.frame_id)
        if shown is not None:
            return self._shown(now, _enlarged(shown, now.pair.camera))
        held_out = self._options.holds_out(now.frame.frame_id)
        if held_out and now.frame.pose_problem is None and self._earlier:  # else its camera is not known
            return self._held_out(now, self._earlier[0])
        return FrameRow(now.frame.frame_id, now.seconds, {})

    def _shown(self, now: _Recorded, shown: ShownFrame) -> FrameRow:
        """The row of a shown frame: figures of what consumers got, and of the model where it is known."""
        frame, left, place = now.frame, now.pair.left, next(self._places)
        self._receipt.add(frame, shown.tissue)
        costly = place % self._options.every == 0
        found = self._quality(metrics.as_float(shown.rgb), now, shown.tissue, costly)
        depth = np.zeros(shown.tissue.shape, np.float32) if shown.depth is None else shown.depth
        self.gallery.offer(
            place, Picture(frame.frame_id, found["psnr"], left, shown.rgb, depth, shown.tissue)
        )
        row = FrameRow(frame.frame_id, now.seconds, {}, shown.facts)
        if frame.reference is not None and frame.reference.depth is not None and shown.depth is not None:
            self.depth_kind = frame.reference.depth_kind
            height, width = shown.depth.shape
            known = metrics.resample_nearest(frame.reference.depth, width, height)
            figures, counts = _depth_figures(shown, shown.depth, known)
            row = replace(row, figures=figures, calibration=counts)
        if isinstance(shown, MappedFrame):
            row.figures["online"] = found
            return self._mapped(now, shown, row, costly)
        # What a live node shows of a frame has the detail of that frame's image.
        row.figures["online" if self._detail is None else "shown"] = found
        if self._before is not None:
            row.figures["predict"] = {"copy_psnr": metrics.psnr(self._before, now.truth, shown.tissue)}
        return row

    def _mapped(self, now: _Recorded, shown: MappedFrame, row: FrameRow, costly: bool) -> FrameRow:
        figures, pair, reference = row.figures, now.pair, now.frame.reference
        for frames, before in () if self._options.unseen else enumerate(self._earlier, 1):
            group = "predict" if frames == 1 else f"predict_{frames}"
            figures[group] = self._predict(before, shown, now, frames)
        if costly and pair.right is not None:
            figures |= self._right_eye(shown, now)
        if self._options.unseen and pair.right is not None and shown.measured_depth.any():
            figures["stereo"] = _apart(shown)
        flicker = self._flicker(pair.left, shown)
        if flicker is not None:
            figures["flicker"] = flicker
        track = None if reference is None else self._follow(shown, reference, pair.camera)
        after = _Mapped(now, shown, self._lent(shown, pair))
        if self._aside is not None and self._aside.due(shown):
            figures |= self._aside(
                shown,
                now.frame.recorded_number,
                pair.left,
                lambda camera: self._view(after, shown.snapshot.gaussians, camera, 0),
            )
        self._learn(after)
        if self._held is not None:
            before = self._earlier[0]
            if now.seconds > before.recorded.seconds and len(before.shown.snapshot.gaussians):
                self._held.row.figures["between"] = self._between(before, self._held, after)
        self._held = None
        self._earlier.appendleft(after)
        return replace(row, track=track, poses=self._poses(now.frame, pair, shown))

    def _poses(self, frame: StereoFrame, pair: RectifiedPair, shown: MappedFrame) -> Poses | None:
        if self._pose == "session" or frame.T_world_cam is None:
            return None
        rigid = self._rigid(pair.left, shown.measured_depth, shown.tissue, pair.camera)
        return Poses(frame.T_world_cam, shown.snapshot.camera.T_world_cam, rigid)

    def _in_world_of_run(self, given: Camera, shown: MappedFrame) -> F64:
        """The transform [4, 4] from the session's world to the run's, by one frame's camera in both."""
        return shown.snapshot.camera.T_world_cam @ given.viewmat

    def _camera_of_run(self, given: Camera, before: _Mapped) -> Camera:
        """The run's camera of a frame that it never saw: it moved from `before` on as the session says."""
        if self._pose == "session":
            return given
        if self._pose == "fixed":
            return before.shown.snapshot.camera
        world = self._in_world_of_run(before.recorded.pair.camera, before.shown)
        return replace(given, T_world_cam=world @ given.T_world_cam)

    def _learn(self, now: _Mapped) -> None:
        """Let the detail learn from a frame, as a node that draws views does."""
        if self._detail is None:
            return
        right = now.recorded.pair.right
        if right is not None and len(self.rows) % ASIDE_EVERY == 0:
            self._detail.learn_aside(now.lent, now.shown.snapshot, right, now.shown.baseline)
        if self._earlier and len(self.rows) % LESSON_EVERY == 0:
            before = self._earlier[0]
            expected = extrapolated(before.shown.snapshot, now.recorded.seconds - before.recorded.seconds)
            self._detail.learn_ahead(before.lent, expected, now.lent)

    def _lent(self, shown: MappedFrame, pair: RectifiedPair) -> SeenFrame:
        """A frame as it lends its image to views of other moments."""
        snapshot, left, camera = shown.snapshot, pair.left, shown.snapshot.camera
        lent = SeenFrame(
            pair.t_capture_ns, camera, snapshot.gaussians, lambda: left, shown.tissue, shown.depth,
            self._matched(pair.t_capture_ns, shown.depth, shown.measured_depth),
        )  # fmt: skip
        if self._detail is None:
            return lent
        self._memory.add(lent)
        whole = self._detail.left(shown.rgb, shown.depth, camera, lent, self._memory.frames)
        return replace(lent, whole=whole)

    def _predict(self, before: _Mapped, shown: MappedFrame, now: _Recorded, frames: int) -> Figures:
        """`psnr` of the view predicted for a moment some frames ahead, `model_psnr` of the model alone in it,
        and `copy_psnr` of the image of `before`, shown again."""
        expected = extrapolated(before.shown.snapshot, now.seconds - before.recorded.seconds)
        guess, model = self._view(before, expected, shown.snapshot.camera, frames)
        pictures = {"psnr": guess, "model_psnr": model, "copy_psnr": before.recorded.truth}
        return {name: metrics.psnr(picture, now.truth, shown.tissue) for name, picture in pictures.items()}

    def _view(self, of: _Mapped, gaussians: Gaussians, camera: Camera, ahead: int) -> tuple[F32, F32]:
        """Return what a view of a frame shows, and the model alone in it, [H, W, 3] 0..1.

        Args:
            gaussians: of the frame, moved `ahead` frames.
        """
        planes = self._drawer.forward(gaussians, camera)
        model = colours_of(planes)
        if self._detail is None:
            return model, model
        drawn, baseline = to_view(planes, camera, 0, 0), of.shown.baseline
        shown = self._detail.view(drawn.rgb, drawn.depth, camera, gaussians, of.lent, baseline, float(ahead))
        return metrics.as_float(shown.rgb), model

    def _held_out(self, now: _Recorded, before: _Mapped) -> FrameRow:
        camera, truth = self._camera_of_run(now.pair.camera, before), now.truth
        expected = extrapolated(before.shown.snapshot, now.seconds - before.recorded.seconds)
        guess = colours_of(self._drawer.forward(expected, camera))
        tissue = self._tissue_of(now.frame, now.pair)
        found = self._quality(guess, now, tissue, costly=True)
        found["copy_psnr"] = metrics.psnr(before.recorded.truth, truth, tissue)
        row = FrameRow(now.frame.frame_id, now.seconds, {"heldout": found})
        self._held = _HeldOut(row, camera, truth, tissue)
        return row

    def _between(self, before: _Mapped, held: _HeldOut, after: _Mapped) -> Figures:
        """The PSNR of a held-out frame drawn once the next one is known, of both images carried there, and
        of the mean of both as they are."""
        (start, first), (end, last) = (
            (each.recorded.seconds, each.recorded.truth) for each in (before, after)
        )
        share = (held.row.seconds - start) / (end - start)
        middle = between(before.lent, after.lent.gaussians, share)
        planes = self._drawer.forward(middle, held.camera)
        around = (before.lent, 1 - share), (after.lent, share)
        pictures = {
            "psnr": colours_of(planes),
            "carried_psnr": carried(planes, middle, held.camera, around, self._drawings),
            "mean_psnr": first + np.float32(share) * (last - first),
        }
        return {name: metrics.psnr(picture, held.truth, held.tissue) for name, picture in pictures.items()}

    def _quality(self, picture: F32, now: _Recorded, tissue: Bool, costly: bool) -> Figures:
        """How near an image [H, W, 3] is to the recorded one where there is tissue [H, W]."""
        truth = now.truth
        figures = {"psnr": metrics.psnr(picture, truth, tissue), "ssim": metrics.ssim(picture, truth, tissue)}
        if self._options.paper_psnr:
            bare = self._bare(now.frame, tissue)
            figures["paper_psnr"] = metrics.paper_psnr(picture, truth, bare)
            figures["paper_ssim"] = metrics.paper_ssim(picture, truth, bare)
        if costly and self._lpips is not None:
            figures["lpips"] = self._lpips(picture, truth, tissue)
        return figures

    def _bare(self, frame: StereoFrame, tissue: Bool) -> Bool:
        """The mask as recorded, without the margin of `tissue`; `tissue` where the recording has none."""
        if self._config.vision.tissue.method != "session" or frame.tissue is None:
            return tissue
        return self._rectifier.mask(frame.tissue) & self._tissue_of.usable

    def _right_eye(self, shown: MappedFrame, now: _Recorded) -> dict[str, Figures]:
        if self._usable_right is None:
            exclude = self._config.vision.tissue.exclude  # boxes of the raw images, burnt into both eyes
            self._usable_right = right_pixels(self._rectifier, now.frame, exclude)
        before = self._earlier[0].recorded.pair.right if self._earlier else None
        figures = right_figures(shown, now.pair, self._usable_right, self._drawer, before)
        return figures if shown.right_rgb is not None else {"novel": figures["novel"]}

    def _follow(self, shown: MappedFrame, reference: Reference, given: Camera) -> TrackErrors | None:
        if reference.points is None or reference.points_visible is None:
            return None
        if self._tracks is None:
            self._tracks = PointTracks(len(reference.points))
        snapshot, points = shown.snapshot, reference.points
        if self._pose != "session":
            points = np.asarray(transform(self._in_world_of_run(given, shown), points), np.float64)
        return self._tracks.update(snapshot.gaussians, points, reference.points_visible, snapshot.camera)


def _enlarged(shown: ShownFrame, camera: Camera) -> ShownFrame:
    """A shown frame at the size at which it is compared. The right view comes at the published size."""
    size = camera.width, camera.height
    if isinstance(shown, MappedFrame) and shown.right_rgb is not None:
        right = cv2.resize(shown.right_rgb, size, interpolation=cv2.INTER_AREA)
        shown = replace(shown, right_rgb=np.asarray(right, np.uint8))
    if shown.rgb.shape[1::-1] == size:
        return shown
    return replace(
        shown,
        rgb=np.asarray(cv2.resize(shown.rgb, size, interpolation=cv2.INTER_LINEAR), np.uint8),
        depth=None if shown.depth is None else metrics.resample_nearest(shown.depth, *size),
        tissue=metrics.resample_nearest(shown.tissue, *size),
    )


def _apart(shown: MappedFrame) -> Figures:
    """How far the model's depth is from the frame's own stereo, and the share of the tissue of each."""
    errors = metrics.depth_errors(shown.depth, shown.measured_depth, shown.tissue)
    shares = {"coverage": shown.depth, "stereo_coverage": shown.measured_depth}
    return {
        "median_mm": errors.median_mm,
        "p90_mm": errors.p90_mm,
        **{name: float(np.mean(depth[shown.tissue] > 0)) for name, depth in shares.items()},
    }


def _depth_figures(shown: ShownFrame, depth: F32, known: F32) -> tuple[dict[str, Figures], I64 | None]:
    """Errors of the depth, those of the stereo stage beside them, and the counts of `calibration.tally`."""
    figures = {"depth": asdict(metrics.depth_errors(depth, known, shown.tissue))}
    if not isinstance(shown, MappedFrame):
        return figures, None
    if shown.measured_depth.any():  # there may have been no time for it
        figures["measured_depth"] = asdict(metrics.depth_errors(shown.measured_depth, known, shown.tissue))
    if shown.confidence is None or np.isnan(shown.confidence).any():
        return figures, None
    return figures, calibration.tally(depth, shown.confidence, known, shown.tissue)
