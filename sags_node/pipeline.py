"""One stereo frame in, one result out: the straight line. No threads, sockets or clock decisions here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from sags_node.confidence import HALVING, confidence_of
from sags_node.config import LaunchConfig
from sags_node.engine.rasterizer.confidence import doubted
from sags_node.engine.rasterizer.rasterize import to_view
from sags_node.findings import Findings, by_stage
from sags_node.mapping.anchors import Anchors
from sags_node.mapping.budget import Budget
from sags_node.mapping.camera_tracker import CameraTracker
from sags_node.mapping.depth_memory import UNWATCHED
from sags_node.mapping.devices import affordable, make_budget, make_refiner
from sags_node.mapping.mapper import Mapped, Mapper
from sags_node.types import (
    F32,
    NO_TIME,
    AnchorStates,
    Bool,
    Camera,
    Finding,
    FrameResult,
    Observation,
    RectifiedPair,
    RenderedView,
    StereoFrame,
    StereoRig,
)
from sags_node.vision.change import StillScene, rms_difference
from sags_node.vision.match_watch import MatchWatch
from sags_node.vision.observe import observe
from sags_node.vision.onnx_depth import NetworkDepth
from sags_node.vision.pair_watch import PairWatch
from sags_node.vision.pyramid import pyramids
from sags_node.vision.rectify import Rectifier
from sags_node.vision.scene_watch import Advice, SceneWatch, enlarged, exposed
from sags_node.vision.stereo import StereoDepth
from sags_node.vision.tissue import TissueMask
from sags_node.vision.tissue_topic import NearestMask

UNHURRIED_MS = 60.0  # a budget that has room for several steps and a finer flow
FARTHEST = 10.0  # m: what a session says to be beyond is no depth
NOTICED_LATE = HALVING  # m: what was measured before matches are found to be wrong may be wrong by so much
DUPLICATE_RMS = 0.6  # grey levels: below a video codec's own noise (PSNR > 52 dB)


class Pipeline:
    """rectify -> tissue mask -> depth -> map -> render.

    Args:
        masks: of another process, for `vision.tissue.method` topic.
        on_rectified: called with each pair and its epoch, before anything else is done with it.
    """

    def __init__(
        self,
        config: LaunchConfig,
        rig: StereoRig,
        masks: NearestMask | None = None,
        on_rectified: Callable[[RectifiedPair, int], None] = lambda pair, epoch: None,
    ) -> None:
        vision = config.vision
        width, height = vision.working_size(rig.left.width, rig.left.height)
        self.rectifier = Rectifier(rig, width, height)
        self.tissue = TissueMask(vision.tissue, self.rectifier, masks)
        self._on_rectified = on_rectified
        camera, baseline = self.rectifier.camera, self.rectifier.baseline
        self.stereo = StereoDepth(vision.stereo, camera, baseline)
        self._network: NetworkDepth | None = None
        if vision.onnx.path is not None:
            self._network = NetworkDepth(vision, self.stereo, camera, baseline)
        self._refiner = make_refiner(config, width, height)
        self._config = config
        self.mapper = Mapper(
            self._refiner,
            affordable(config, width, height),
            config.mapping.smoothing,
            unhurried=config.mapping.budget_ms >= UNHURRIED_MS,
        )
        self._tracker: CameraTracker | None = None
        if vision.pose == "estimate":
            self._tracker = CameraTracker(self.mapper, self._draw_model)
        self.anchors = Anchors()
        self._still = StillScene()
        self._eyes = PairWatch()
        self._matches = MatchWatch()
        self._scene = SceneWatch(moving=vision.pose == "estimate")
        self._unmatched = ""  # why what was measured last is no depth; empty: it is
        self._mapped: FrameResult | None = None  # the last frame that was really mapped
        self._unwatched = 0.0  # m: how far tissue may have moved in frames that were held since

    def reset(self) -> None:
        """Forget the model; the next frame makes a new one, in a new epoch."""
        self.mapper.restart()
        self._scene.forget()
        self._still.forget()
        self._mapped = None
        self._unwatched = 0.0

    @property
    def newest(self) -> FrameResult | None:
        """The frame mapped last; None before the first, and after a reset."""
        return self._mapped

    @property
    def warnings(self) -> Findings:
        """What is wrong and how to mend it. May be read from any thread."""
        watches = self._eyes, self._matches, self._scene, self.stereo
        found = [finding for watch in watches for finding in watch.findings]
        lost = None if self._tracker is None else self._tracker.lost
        if lost is not None:
            back = "bring the scope back to tissue that it saw before"
            found.append(Finding("camera_lost", f"the camera is lost: {lost}; {back}"))
        if self._network is not None and self._network.problem:
            found.append(Finding("network_failed", self._network.problem))
        if self.tissue.problem:
            found.append(Finding("mask_missing", self.tissue.problem))
        if self._refiner.problem is not None:
            found.append(self._refiner.problem)
        return by_stage(found)

    def reconfigure(self, config: LaunchConfig) -> None:
        """Take changed parameters over; the model stays."""
        self._config = config
        self.mapper.pace(config.mapping.budget_ms >= UNHURRIED_MS)

    def make_budget(self, speed: float | None = None) -> Budget:
        """What frames get, by the configuration and how long this machine takes (`Ladder.speed`); None: it is
        measured now, which takes less than a tenth of a second."""
        camera = self.rectifier.camera
        return make_budget(self._config, camera.width, camera.height, speed)

    def process(self, frame: StereoFrame, budget: Budget, waited: float = 0.0) -> FrameResult:
        """Everything that happens to one frame, `waited` seconds after it came."""
        budget.start(waited)
        rung = budget.state
        watch = Stopwatch()
        with watch("rectify"):
            pair = self._placed(frame)
        with watch("watch"):
            verdict = self._eyes(frame, pair)
        self._on_rectified(pair, self._epoch(frame))
        if self._mapped is not None and self._config.mapping.skip_duplicates:
            if rms_difference(pair, self._mapped.pair) < DUPLICATE_RMS:
                anchors = self.anchors.at(pair.t_capture_ns)
                return _repeat(self._mapped, pair, self._epoch(frame), watch.timings_ms, anchors)
        advice = Advice()
        if self._mapped is not None and verdict.left:
            advice = Advice(verdict.left)
        elif self._mapped is not None:
            with watch("watch"):
                advice = self._scene(pair, self._mapped, not verdict.learn)
        if advice.is_new:
            self.reset()
        elif advice.held:
            held = self._held(pair, self._epoch(frame), watch.timings_ms, "picture", advice.held)
            return replace(held, observation=_unseen(pair))
        seen = pair if advice.gain is None else exposed(pair, advice.gain)
        still = self._still_frames(pair)
        skipped: dict[str, str] = {}
        with watch("mask"):
            drawn = None if self._mapped is None else self._mapped.views["left"]
            tissue = self.tissue(frame, seen, drawn)
            if advice.covered is not None:
                tissue = tissue & ~enlarged(advice.covered, tissue.shape)
            if self.tissue.problem:
                skipped["mask"] = self.tissue.problem
        with watch("depth"):
            known = self._mapped.observation if still and self._mapped is not None else None
            if known is not None and known.depth.any():
                depth, confidence = known.depth * tissue, known.depth_confidence * tissue
                self.stereo.rows.stay()
                skipped |= dict.fromkeys(("depth", "motion"), "nothing moves")
            elif self._lacks_time_for_depth(frame, budget):
                depth, confidence = np.zeros((2, *tissue.shape), np.float32)
                skipped["depth"] = NO_TIME
            else:
                matched, self._unmatched = not self._unmatched, ""
                unpaired = verdict.right if frame.depth is None and pair.right is not None else ""
                if not unpaired:
                    depth, confidence = self.depth(frame, seen, tissue)
                if self._unmatched and matched:
                    self.mapper.doubt(NOTICED_LATE)
                if unpaired or self._unmatched:
                    depth, confidence = np.zeros((2, *tissue.shape), np.float32)
                    skipped["depth"] = unpaired or self._unmatched
                if self._network is not None and self._network.problem:
                    skipped["network"] = self._network.problem
            observation = observe(seen, tissue, depth, confidence, self._config.mapping.right_eye)
        if advice.guess is not None:
            self.mapper.found_again(observation, advice.guess)
        if self._tracker is not None and not still:
            with watch("pose"):
                tracked = self._tracker.track(observation)
                camera = replace(pair.camera, T_world_cam=self._tracker.pose)
                pair, observation = replace(pair, camera=camera), replace(observation, camera=camera)
            lost = self._tracker.lost
            if not tracked and lost is not None and self._mapped is not None:
                held = self._held(pair, self._epoch(frame), watch.timings_ms, "pose", lost)
                return replace(held, observation=observation)
        with watch("map"):
            learn = advice.learn and verdict.learn
            if self._unwatched:
                self.mapper.doubt(self._unwatched)
                self._unwatched = 0.0
            mapped = self.mapper.update(observation, budget, still, learn)
            snapshot = mapped.snapshot
            if self._tracker is not None:
                self._tracker.mapped(observation, mapped.view)
        with watch("render"):
            views = {"left": mapped.view}
            if self._config.publish.right:
                views["right"] = self._right_eye(mapped, pair.baseline)
        with watch("anchors"):
            self.anchors.update(observation, snapshot, mapped.view, learn)
            anchors = self.anchors.at(pair.t_capture_ns)
        if not still:  # which tells nothing of what a moving frame costs
            budget.finish(self.mapper.model.count)
        epoch = self._epoch(frame)
        self._mapped = FrameResult(
            pair, observation, snapshot, views, epoch, watch.timings_ms, skipped, anchors, rung
        )
        return self._mapped

    def _placed(self, frame: StereoFrame) -> RectifiedPair:
        """The rectified pair; until its pose is estimated its camera is where it was last."""
        if self._config.vision.pose == "session":
            return self.rectifier(frame)
        pose = None if self._tracker is None else self._tracker.pose
        return self.rectifier(replace(frame, T_world_cam=pose))

    def _still_frames(self, pair: RectifiedPair) -> int:
        if not self._config.mapping.skip_still:
            return 0
        if self._tracker is not None:  # an estimated pose tells nothing that the pictures do not
            pair = replace(pair, camera=self.rectifier.camera)
        return self._still(pair)

    def _held(
        self, pair: RectifiedPair, epoch: int, timings: dict[str, float], what: str, reason: str
    ) -> FrameResult:
        """For a frame that something (`what`) forbids to take in: the last model, and nothing is learnt from
        the picture. The tissue moves meanwhile, and the depth is less and less sure."""
        assert self._mapped is not None
        self._still.forget()
        seconds = max(0, pair.t_capture_ns - self._mapped.pair.t_capture_ns) * 1e-9
        self._unwatched = UNWATCHED * seconds
        anchors = self.anchors.at(pair.t_capture_ns, held=True)
        held = _doubted(_repeat(self._mapped, pair, epoch, timings, anchors), self._unwatched)
        return replace(held, skipped={what: reason})

    def _lacks_time_for_depth(self, frame: StereoFrame, budget: Budget) -> bool:
        costs = frame.depth is None or self._network is not None
        needs_matching = costs and self.mapper.model.count > 0  # a first model needs depth
        return needs_matching and self._config.mapping.skip_depth and not budget.affords_depth()

    def depth(self, frame: StereoFrame, pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        """Depth and confidence [H, W]: the network's where one delivers, else what is measured."""
        if self._network is not None:

            def measure() -> F32 | None:
                can = frame.depth is not None or pair.right is not None
                return self._measured(frame, pair, tissue)[0] if can else None

            found = self._network(pair, tissue, measure)
            if found is not None:
                return found
        return self._measured(frame, pair, tissue)

    def _measured(self, frame: StereoFrame, pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        """The session's own depth, fully trusted, or else stereo; all unknown for one camera alone."""
        if frame.depth is not None:
            given = self.rectifier.depth(frame.depth)
            known = tissue & (given > 0) & (given < FARTHEST)
            return np.where(known, given, np.float32(0)), known.astype(np.float32)
        if pair.right is None:
            return np.zeros(tissue.shape, np.float32), np.zeros(tissue.shape, np.float32)
        measured = self.stereo(pair, tissue)
        if self.stereo.rows.newest is not None:
            self._unmatched = self._matches(pair.t_capture_ns, pyramids(pair)[0], self.stereo.rows.newest)
        return measured

    def _epoch(self, frame: StereoFrame) -> int:
        """Grows with the source's epochs and with every new model: ids then mean other Gaussians."""
        return frame.epoch + self.mapper.restarts

    def _right_eye(self, mapped: Mapped, baseline: float) -> RenderedView:
        """The model drawn for the right eye."""
        before, stamp = self._mapped, mapped.view.t_capture_ns
        if before is not None and "right" in before.views and before.views["left"].rgb is mapped.view.rgb:
            return replace(before.views["right"], frame_id=mapped.view.frame_id, t_capture_ns=stamp)
        camera = mapped.snapshot.camera.moved_right(baseline)
        planes = self._refiner.show(mapped.snapshot.gaussians, camera)
        return to_view(planes, camera, mapped.view.frame_id, stamp)

    def _draw_model(self, camera: Camera) -> RenderedView:
        """The model as it is now, in the light of a scope that is there."""
        return to_view(self._refiner.show(self.mapper.lit_from(camera), camera), camera, 0, 0)


class Stopwatch:
    """Wall time of named stages, ms; of one that comes twice the sum."""

    def __init__(self) -> None:
        self.timings_ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        passed = (time.perf_counter() - started) * 1e3
        self.timings_ms[stage] = self.timings_ms.get(stage, 0.0) + passed


def _doubted(held: FrameResult, error: float) -> FrameResult:
    """A result whose depth may be wrong by so much more, m."""
    gaussians, anchors = held.snapshot.gaussians, held.anchors
    if gaussians.depth_errors is not None:
        gaussians = replace(gaussians, depth_errors=gaussians.depth_errors + np.float32(error))
    sure = anchors.depth_confidence * confidence_of(np.float32(error))
    return replace(
        held,
        snapshot=replace(held.snapshot, gaussians=gaussians),
        views={eye: doubted(view, error) for eye, view in held.views.items()},
        anchors=replace(anchors, depth_confidence=sure),
    )


def _restamped(views: Mapping[str, RenderedView], frame_id: int, stamp: int) -> dict[str, RenderedView]:
    """Pictures of what has not changed since."""
    return {eye: replace(view, frame_id=frame_id, t_capture_ns=stamp) for eye, view in views.items()}


def _unseen(pair: RectifiedPair) -> Observation:
    """Of a picture of which nothing may be used."""
    shape = pair.left.shape[:2]
    nothing = np.zeros(shape, np.float32)
    return observe(pair, np.zeros(shape, np.bool_), nothing, nothing)


def _repeat(
    mapped: FrameResult, pair: RectifiedPair, epoch: int, timings: dict[str, float], anchors: AnchorStates
) -> FrameResult:
    """The last mapped result under the ids of a frame that equals it."""
    frame_id, stamp = pair.frame_id, pair.t_capture_ns
    still = np.zeros_like(mapped.snapshot.velocities)
    return replace(
        mapped,
        pair=pair,
        observation=replace(mapped.observation, frame_id=frame_id, t_capture_ns=stamp),
        snapshot=replace(
            mapped.snapshot,
            frame_id=frame_id,
            t_capture_ns=stamp,
            velocities=still,
            counts={"iterations": 0},
        ),
        views=_restamped(mapped.views, frame_id, stamp),
        epoch=epoch,
        timings_ms=timings,
        skipped={**mapped.skipped, "frame": "equals its predecessor"},
        anchors=anchors,
    )
