"""The frame path: one stereo frame in, one result out. No threads, sockets or clock decisions here."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from sags_node.confidence import HALVING, confidence_of
from sags_node.config.schema import LaunchConfig
from sags_node.detail.memory import Matched, Memory
from sags_node.detail.seen import SeenFrame
from sags_node.detail.show import ASIDE_EVERY, Detail, Lessons
from sags_node.engine.rasterizer.rasterize import to_view
from sags_node.errors import SagsError
from sags_node.findings import Findings, by_stage
from sags_node.instruments.instruments import Instruments
from sags_node.mapping.anchors import Anchors
from sags_node.mapping.budget import Budget, FramePlan
from sags_node.mapping.camera_tracker import CameraTracker
from sags_node.mapping.depth_memory import UNWATCHED
from sags_node.mapping.devices import ALL_SKIPS, Skips, affordable, make_budget, make_refiner
from sags_node.mapping.given_camera import GivenCamera, Localizer
from sags_node.mapping.mapped import Mapped
from sags_node.mapping.mapper import Mapper
from sags_node.mapping.motion import Drawn, SurfaceTracker, Tracks
from sags_node.mapping.pose_refiner import PoseRefiner
from sags_node.mapping.right_view import LEARN_EVERY, RightView
from sags_node.mapping.tissue_map import TissueMap
from sags_node.messaging import published
from sags_node.model.strain import SURE, Strain
from sags_node.pipeline.results import FINDING, MOST, doubted, repeated, unseen, unsure
from sags_node.resizing import resized_image
from sags_node.types import (
    Bool,
    Camera,
    Finding,
    FrameResult,
    InstrumentStates,
    Observation,
    RectifiedPair,
    RectifiedPictures,
    RenderedView,
    StereoFrame,
    StereoRig,
    ToolPose,
)
from sags_node.vision.change import StillScene, is_repeat
from sags_node.vision.depth import DepthChoice, Measured
from sags_node.vision.observe import observe
from sags_node.vision.pyramid import pyramids
from sags_node.vision.rectify import Rectifier
from sags_node.vision.tissue import TissueMask
from sags_node.vision.tissue_topic import NearestMask
from sags_node.vision.watch.color_watch import ColorWatch
from sags_node.vision.watch.freeze_watch import FreezeWatch
from sags_node.vision.watch.judgement import Evidence, Judgement, PoseWatch, Watcher
from sags_node.vision.watch.lens_watch import LensWatch
from sags_node.vision.watch.pair_watch import PairWatch
from sags_node.vision.watch.scene_watch import SceneWatch, enlarged, exposed

if TYPE_CHECKING:
    from sags_node.mapping.sags_mapper import SagsMapper

UNHURRIED_MS = 60.0  # a budget with room for several optimiser steps and finer optical flow
GAP = 3.0  # times the usual period: after a longer one, frames have failed to come
NOTICED_LATE = HALVING  # m, error assumed of depth from before wrong matches were noticed


@dataclass(frozen=True, slots=True)
class FrameRequest:
    """What consumers want of one frame."""

    waited: float = 0.0  # s since the frame came
    left: bool = False  # somebody looks at the left view: it gets the image's detail
    right: bool = False  # somebody looks at the right eye: it is drawn, where there is one
    latency: float = 0.0  # s, recent time from capture to publication
    instruments: bool = False  # somebody wants to know where the instruments are


NOTHING_ASKED = FrameRequest()


class Pipeline:
    """watch -> segment -> depth -> track -> locate -> map, then draw.

    Args:
        masks: of another process, for `vision.tissue.method` topic.
        on_rectified: called with each pair and its epoch, before anything else is done with it.
        rate: the attribute's first value.

    Attributes:
        rate: frames that come per second; None: they come when taken. Call `reconfigure` after a change.
        newest: the frame mapped last; None before the first, and after a reset.
        held: why the last frame was not taken in; empty: it was.
        seen: the frames that lend views their images, the newest first: the one mapped last and older ones.
        metric: whether lengths are metres: the calibration is no guess.
    """

    def __init__(
        self,
        config: LaunchConfig,
        rig: StereoRig,
        masks: NearestMask | None = None,
        on_rectified: Callable[[RectifiedPair, int], None] = lambda pair, epoch: None,
        rate: float | None = None,
        skips: Skips = ALL_SKIPS,
    ) -> None:
        self.rate = rate
        self.metric = rig.metric
        self._skips = skips
        vision = config.vision
        raw_size = rig.left.width, rig.left.height
        width, height = vision.working_size(*raw_size)
        self.rectifier = Rectifier(rig, width, height, vision.published_size(*raw_size))
        self.tissue = TissueMask(vision.tissue, self.rectifier, masks)
        self._on_rectified = on_rectified
        self.depth = DepthChoice(vision, self.rectifier)
        self._refiner = make_refiner(config, width, height)
        self.map = TissueMap(affordable(config, width, height), field=config.mapping.field is True)
        self.mapper: Mapper | SagsMapper
        if config.mapping.method == "sags":
            from sags_node.mapping.sags_mapper import SagsMapper  # it loads torch, which takes a second

            self.mapper = SagsMapper(self.map)
        else:
            self.mapper = Mapper(self._refiner, self.map)
        self._surface = SurfaceTracker()
        self.reconfigure(config)
        self._detail = Detail(Lessons()) if config.publish.detail else None
        self._memory, self._matched = Memory(), Matched()
        self._right, self._right_views = RightView(), 0
        self._camera: Localizer = GivenCamera(follows=vision.pose == "session")
        if vision.pose == "estimate":
            self._camera = CameraTracker(self.map, self._surface, self._draw_model)
        elif vision.pose == "refine":
            self._camera = PoseRefiner(self.map)
        self.anchors = Anchors(self.tissue.usable)
        self._instruments = Instruments(self.tissue.usable)
        self._instruments_asked = False  # for the last frame that was mapped
        self._tools: tuple[ToolPose, ...] = ()  # of the newest frame, as a robot reports them
        self._pose = PoseWatch(needed=vision.pose in ("session", "refine"))
        self._scene = SceneWatch(moving=vision.pose == "estimate")
        self._freeze = FreezeWatch(vision.tissue.exclude)
        self._watchers: tuple[Watcher, ...] = (
            self._pose, self._freeze, PairWatch(), self._scene, LensWatch(), ColorWatch()
        )  # fmt: skip
        self._still = StillScene()
        self._reset_due = False
        self.newest: FrameResult | None = None
        self.held = ""
        self.seen: tuple[SeenFrame, ...] = ()
        self._strain: Strain | None = None  # None: nobody asked for it
        self._last: Drawn | None = None  # where motion starts: the last frame in which something moved
        self._unwatched = 0.0  # m: how far tissue may have moved while no frame was taken in
        self._came_ns: int | None = None  # when the last frame was captured
        self._mapped_ns = 0  # when the last mapped frame was captured, corrected where the clock was set back
        self._steps: deque[float] = deque(maxlen=15)  # s between the last frames

    def reset(self) -> None:
        """Forget the model; the next frame makes a new one, in a new epoch.

        While the scope's pose is unknown, the model stays until a frame with a known pose comes.
        """
        self._reset_due = True
        if not self._pose.findings:
            self._forget()

    def _forget(self) -> None:
        self._reset_due = False
        self.map.restart()
        self._scene.forget()
        self._still.forget()
        self._memory.forget()
        self.newest, self._last, self.seen, self._strain = None, None, (), None
        self._unwatched = 0.0

    @property
    def may_be_sure(self) -> bool:
        """Tell whether neither calibration nor scale is a guess. May be read from any thread."""
        return self.metric and not self.depth.scale_is_declared

    def anchor_confidence(self, anchor_id: int) -> float:
        """Return how far to trust the depth of an existing anchor now, 0..1."""
        sure = self.anchors.depth_confidence(anchor_id) * float(confidence_of(np.float32(self._unwatched)))
        return sure if self.may_be_sure else min(sure, MOST)

    def start_strain(self) -> int:
        """Report from now on the strain of tissue since the newest frame; returns that frame's stamp (ns).

        Raises:
            SagsError: no depth is sure enough to tell strain from noise.
        """
        assert self.newest is not None  # else there is no tissue
        strain = Strain(replace(self.newest.snapshot, t_capture_ns=self._mapped_ns))
        if strain.knows_nothing:
            raise SagsError(
                f"no depth here is sure to {1e3 * SURE:g} mm, so no strain could be told; with one "
                "camera none ever is, else begin when the tissue is seen well"
            )
        self._strain, self.newest = strain, replace(self.newest, strain=strain)
        return strain.since_ns

    def stop_strain(self) -> dict[str, Any]:
        """Report strain no more."""
        self._strain = None
        return {}

    def predict_motion(self) -> None:
        """Begin to predict motion. Any thread may call this."""
        if self._config.mapping.field is not False and self._config.mapping.method == "nodes":
            self.map.remember_motion()

    @property
    def warnings(self) -> Findings:
        """Return what is wrong and how to fix it. May be read from any thread."""
        found = [*self.depth.findings]
        for watcher in self._watchers:
            found += watcher.findings
        if (lost := self._camera.lost) is not None:
            back = "bring the scope back to tissue that it saw before"
            found.append(Finding("camera_lost", f"the camera is lost: {lost}; {back}"))
        if unknown := "; ".join(tool.problem for tool in self._tools if tool.problem):
            said = f"{unknown}; instruments come from the image alone: check the robot's program"
            found.append(Finding("tool_pose_missing", said))
        if not self.metric:
            found = [*(each for each in found if each.code != "rows_differ"), FINDING]  # a guess fits no rows
        if self.tissue.problem:
            found.append(Finding("mask_missing", self.tissue.problem))
        if self._refiner.problem is not None:
            found.append(self._refiner.problem)
        return by_stage(found)

    def reconfigure(self, config: LaunchConfig) -> None:
        """Apply changed parameters; the model stays."""
        self._config = config
        unhurried = config.mapping.frame_ms(self.rate) >= UNHURRIED_MS
        self.mapper.pace(unhurried)
        self._surface.pace(unhurried)

    def make_budget(self, speed: float | None = None) -> Budget:
        """Return the budget of frames, by the configuration and this machine's speed (`Ladder.speed`). None:
        the speed is measured now, which takes less than a tenth of a second."""
        camera = self.rectifier.camera
        return make_budget(self._config, camera.width, camera.height, speed, self.rate, self._skips)

    def process(
        self, frame: StereoFrame, budget: Budget, request: FrameRequest = NOTHING_ASKED,
        pictures: RectifiedPictures | None = None,
    ) -> FrameResult:  # fmt: skip
        """Do all the work on one frame. `pictures`: the result of `rectifier.pictures`, if another thread has
        made it already."""
        result = replace(self._processed(frame, budget, request, pictures), recorded_s=frame.recorded_s)
        self.held = result.held
        return result if self.may_be_sure else unsure(result)

    def _processed(
        self, frame: StereoFrame, budget: Budget, request: FrameRequest, pictures: RectifiedPictures | None
    ) -> FrameResult:
        plan, clock = budget.start(request.waited), Stopwatch()
        self._note_gap(frame.t_capture_ns)
        self._tools = frame.tools
        with clock("rectify"):
            pair = self._rectified(frame, pictures)
        clock.timings_ms["rectify"] += 0.0 if pictures is None else pictures.ms
        self._on_rectified(pair, self._epoch(frame))
        # 1. Watch: may this frame be trusted? If not, it is held. An equal one repeats the last result.
        right = pair.right is not None and (request.right or self._config.publish.right is True)
        left = request.left or right
        with clock("watch"):
            judged = self._watch(frame, pair, left, right, request.instruments)
        if self.newest is not None and (judged.hold or judged.repeats):
            return self._carried_on(frame, pair, judged, unseen(pair), clock)
        if judged.is_new_scene:
            self._forget()
        # 2. Segment: where is tissue? What covers it, and drops on the lens, are not tissue.
        seen = pair if judged.gain is None else exposed(pair, judged.gain)  # in the exposure of the model
        still = self._still_frames(pair)
        with clock("mask"):
            tissue = self._segmented(frame, seen, judged)
        # 3. Depth, where both eyes see tissue and the plan has time for it.
        with clock("depth"):
            by_both = _without(tissue, judged.covered_right)
            measured = self._measured(frame, seen, by_both, still > 0, plan, judged)
            observation = observe(seen, tissue, measured)
        # 4. Track: where did the known surface go? By optical flow since the last frame.
        with clock("track"):
            tracks = self._tracks(observation, still, judged)
        # 5. Locate the camera, where its pose is not given.
        with clock("pose"):
            pair, observation, tracks = self._located(pair, observation, still, tracks)
        if self._camera.lost and self.newest is not None:
            judged = replace(judged, hold=self._camera.lost, stage="pose")
            return self._carried_on(frame, pair, judged, observation, clock)
        # 6. Map: deform, refine, add and prune Gaussians.
        with clock("map"):
            mapped = self._mapped(observation, tracks, budget, still, judged.learn, right)
        # Then draw what consumers watch: the right eye, and their anchors.
        with clock("render"):
            self._lend(mapped, seen, observation, judged)
            views = {"left": self._left_eye(mapped.view, pair, left)}
            if right:
                views["right"] = self._right_eye(mapped, observation, pair, seen, judged, by_both)
        if not still:  # still frames cost less: they would bias the estimate
            budget.finish(self.map.model.count, matched=plan.depth and measured.is_new)
        with clock("anchors"):
            self.anchors.update(observation, mapped.snapshot, mapped.view, judged.learn)
            self.anchors.age(pair.t_capture_ns)
            anchors = self.anchors.ahead(self.anchors.states(), mapped.snapshot, request.latency)
        if self._strain is not None:
            self._strain = self._strain.followed(mapped.snapshot)
        self._instruments_asked = request.instruments
        with clock("instruments"):
            instruments = self._located_instruments(seen, observation, mapped, judged, request)
        self._mapped_ns = pair.t_capture_ns
        self.newest = FrameResult(
            pair, observation, mapped.snapshot, views, self._epoch(frame), clock.timings_ms,
            self._skipped(measured), anchors, plan.state, hurried=measured.hurried, strain=self._strain,
            instruments=instruments, plain=len(self.seen) > 0 and views["left"].shown is None,
        )  # fmt: skip
        return replace(self.newest, held=judged.hold) if judged.hold else self.newest

    def _rectified(self, frame: StereoFrame, pictures: RectifiedPictures | None) -> RectifiedPair:
        """Rectify a frame. Until its pose is found, it has the last camera pose, or the given one."""
        return self.rectifier(replace(frame, T_world_cam=self._camera.guess(frame.T_world_cam)), pictures)

    def _watch(
        self, frame: StereoFrame, pair: RectifiedPair, left: bool, right: bool, instruments: bool
    ) -> Judgement:
        """Return the judgement of all watchers on a frame."""
        if self._reset_due and frame.pose_problem is None:
            self._forget()
        last = self.newest
        lacks = last is not None and (  # somebody has just asked for it
            (left and last.plain)
            or (right and "right" not in last.views)
            or (instruments and not self._instruments_asked)
        )
        equal = last is not None and self._skips.duplicates and not lacks and is_repeat(pair, last.pair)
        evidence = Evidence(frame, pair, last, equal, self.depth.eyes_are_late)
        judged = Judgement(repeats=equal)
        for watcher in self._watchers:
            judged = watcher.judge(evidence, judged)
        return judged

    def _carried_on(
        self, frame: StereoFrame, pair: RectifiedPair, judged: Judgement, observation: Observation,
        clock: Stopwatch,
    ) -> FrameResult:  # fmt: skip
        """The last result, for a frame that is not mapped: it equals the last one, or it is held. While
        frames are held the tissue moves unseen, so the depth gets less and less sure."""
        assert self.newest is not None
        if not judged.hold:
            self.anchors.age(pair.t_capture_ns, equal=not self._freeze.findings)
            return repeated(self.newest, pair, self._epoch(frame), clock.timings_ms, self.anchors.states())
        self._still.forget()
        self._unwatched = UNWATCHED * ((pair.t_capture_ns - self._mapped_ns) * 1e-9)
        self.anchors.age(pair.t_capture_ns, held=True)
        last = repeated(self.newest, pair, self._epoch(frame), clock.timings_ms, self.anchors.states())
        held = doubted(last, self._unwatched)
        skipped = {judged.stage: judged.hold}
        return replace(held, observation=observation, skipped=skipped, held=judged.hold, hurried=False)

    def _note_gap(self, t_capture_ns: int) -> None:
        """Note how long no frame came: after an unusual gap the tissue may have moved unseen. If the clock
        was set back, correct the stamps that are kept."""
        before, self._came_ns = self._came_ns, t_capture_ns
        seconds = 1e-9 * (t_capture_ns - before) if before is not None else 0.0
        if before is not None and t_capture_ns < before:
            self._mapped_ns += t_capture_ns - before
            if self._strain is not None and self.newest is not None:
                self._strain = self._strain.set_back(before - t_capture_ns)
                self.newest = replace(self.newest, strain=self._strain)
        if self._steps and seconds > GAP * median(self._steps):
            self._unwatched = max(self._unwatched, UNWATCHED * seconds)
        if seconds > 0:  # long ones, too: after a fall of the camera's rate they are usual
            self._steps.append(seconds)

    def _still_frames(self, pair: RectifiedPair) -> int:
        """Return for how many frames nothing has moved."""
        if not self._skips.still:
            return 0
        if self._camera.by_picture:
            pair = replace(pair, camera=self.rectifier.camera)
        return self._still(pair)

    def _segmented(self, frame: StereoFrame, pair: RectifiedPair, judged: Judgement) -> Bool:
        drawn = None if self.newest is None else self.newest.views["left"]
        tissue = self.tissue(frame, pair, drawn)
        return _without(_without(tissue, judged.covered), judged.covered_left)

    def _measured(
        self, frame: StereoFrame, pair: RectifiedPair, tissue: Bool, still: bool, plan: FramePlan,
        judged: Judgement,
    ) -> Measured:  # fmt: skip
        # A first model cannot do without depth.
        has_time = plan.depth or not self._skips.depth or self.map.model.count == 0
        measured = self.depth(frame, pair, tissue, still, has_time, judged.no_stereo)
        if measured.found_out:
            self.map.doubt(NOTICED_LATE)
        return measured

    def _tracks(self, observation: Observation, still: int, judged: Judgement) -> Tracks | None:
        if still or self._last is None or self.map.deformation is None:
            return None
        return self._surface.track(self.map.model.means, self._last, observation, judged.guess)

    def _located(
        self, pair: RectifiedPair, observation: Observation, still: int, tracks: Tracks | None
    ) -> tuple[RectifiedPair, Observation, Tracks | None]:
        if not (still and self._camera.by_picture):
            tracks = self._camera.locate(observation, self._last, tracks)
        camera = replace(pair.camera, T_world_cam=self._camera.pose)
        return replace(pair, camera=camera), replace(observation, camera=camera), tracks

    def _mapped(
        self, observation: Observation, tracks: Tracks | None, budget: Budget, still: int, learn: bool,
        right: bool,
    ) -> Mapped:  # fmt: skip
        if self._unwatched:
            self.map.doubt(self._unwatched)
            self._unwatched = 0.0
        if right:
            self._right.wake(self.map.model)
        else:
            self._right.miss()
        begins = self.map.deformation is None
        mapped = self.mapper.update(observation, tracks, budget, still, learn, right)
        if not still or begins:  # skips still frames, so that slow motion adds up until seen
            self._last = Drawn(observation, mapped.view)
        self._camera.learn(observation, mapped.view)
        return mapped

    def _lend(self, mapped: Mapped, seen: RectifiedPair, observation: Observation, judged: Judgement) -> None:
        """Note the images from which views may take detail. None is taken from one that is not learnt from,
        or if the model is empty.

        Args:
            seen: the frame in the exposure of the model.
        """
        self.seen = ()
        known = len(mapped.snapshot.gaussians) > 0
        if self._detail is None or not known or not judged.learn:
            return
        now = SeenFrame(
            seen.t_capture_ns, observation.camera, mapped.snapshot.gaussians,
            partial(published.picture, seen, "left"), observation.tissue, mapped.view.depth,
            self._matched(seen.t_capture_ns, mapped.view.depth, observation.depth),
        )  # fmt: skip
        self._memory.add(now)
        self.seen = now, *self._memory.frames

    def _left_eye(self, view: RenderedView, pair: RectifiedPair, wanted: bool) -> RenderedView:
        """The model drawn for the left eye; with the image's detail, if somebody looks."""
        if self._detail is None or not wanted or not self.seen:
            return view
        now, *older = self.seen
        camera = published.camera_of(pair)
        drawn = view.colours.at(camera.width, camera.height)
        shown = self._detail.left(drawn, view.depth, camera, now, older)
        self.seen = replace(now, whole=shown), *older
        return replace(view, shown=shown)

    def _right_eye(
        self, mapped: Mapped, observation: Observation, pair: RectifiedPair, seen: RectifiedPair,
        judged: Judgement, by_both: Bool,
    ) -> RenderedView:  # fmt: skip
        """The model drawn for the right eye, whose colours are learnt where both eyes see tissue."""
        last, stamp = self.newest, mapped.view.t_capture_ns
        if last is not None and "right" in last.views and last.views["left"].colours is mapped.view.colours:
            return replace(last.views["right"], frame_id=mapped.view.frame_id, t_capture_ns=stamp)
        view, baseline = self._right.draw(mapped, observation.baseline, self._refiner.show), pair.baseline
        self._right_views += 1
        if self._detail is not None and self.seen:
            now, gaussians = self.seen[0], mapped.snapshot.gaussians
            camera = replace(published.camera_of(pair), T_world_cam=view.camera.T_world_cam)
            drawn = view.colours.at(camera.width, camera.height)
            tint = self._detail.tint(mapped.snapshot, gaussians, camera)
            shown = self._detail.view(drawn, view.depth, camera, gaussians, now, baseline, tint=tint)
            view = replace(view, shown=shown)
            if self._right_views % ASIDE_EVERY == 1:
                self._detail.learn_aside(now, mapped.snapshot, published.picture(seen, "right"), baseline)
        if self._right_views % LEARN_EVERY == 0:
            assert seen.right is not None  # else nothing is drawn for it
            rgb = view.rgb
            if view.shown is not None:
                rgb = resized_image(view.shown.rgb, rgb.shape[1::-1])
            sure = by_both if judged.learn and not judged.no_stereo else np.zeros_like(by_both)
            self._right.learn(view, rgb, mapped, self.map.model, seen.right, sure, baseline)
        return view

    def _located_instruments(
        self, pair: RectifiedPair, observation: Observation, mapped: Mapped, judged: Judgement,
        request: FrameRequest,
    ) -> InstrumentStates | None:  # fmt: skip
        if not request.instruments:
            return None
        right, rows = pyramids(pair)[1], self.depth.stereo.rows.newest
        return self._instruments.update(
            self.tissue.instruments,
            observation.gray,
            None if right is None or judged.no_stereo else right.full,
            observation.camera,
            pair.baseline,
            mapped.view,
            0.0 if rows is None else rows.median,
            self._tools if self.metric else (),
        )

    def _skipped(self, measured: Measured) -> dict[str, str]:
        """Return what was left out of a frame that was mapped, and why."""
        skipped = {"mask": self.tissue.problem} if self.tissue.problem else {}
        if self._camera.unsure:
            skipped["refine"] = self._camera.unsure
        return {**skipped, **measured.skipped}

    def _draw_model(self, camera: Camera) -> RenderedView:
        """The model drawn as it is now, lit by a scope that is at `camera`."""
        return to_view(self._refiner.show(self.map.relight(camera), camera), camera, 0, 0)

    def _epoch(self, frame: StereoFrame) -> int:
        """The epoch: it grows with the source's and with every new model, whose ids mean other Gaussians."""
        return frame.epoch + self.map.restarts


def _without(tissue: Bool, cover: Bool | None) -> Bool:
    """The tissue mask without what a smaller mask says is covered."""
    return tissue if cover is None else tissue & ~enlarged(cover, tissue.shape)


class Stopwatch:
    """Measures the wall time of named stages, ms; the times of a repeated stage are added."""

    def __init__(self) -> None:
        self.timings_ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        passed = (time.perf_counter() - started) * 1e3
        self.timings_ms[stage] = self.timings_ms.get(stage, 0.0) + passed
