"""One stereo frame in, one result out: the straight line. No threads, sockets or clock decisions here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from sags_node.confidence import HALVING
from sags_node.config.schema import LaunchConfig
from sags_node.engine.rasterizer.rasterize import to_view
from sags_node.findings import Findings, by_stage
from sags_node.mapping.anchors import Anchors
from sags_node.mapping.budget import Budget
from sags_node.mapping.camera_tracker import CameraTracker
from sags_node.mapping.depth_memory import UNWATCHED
from sags_node.mapping.devices import ALL_SKIPS, Skips, affordable, make_budget, make_refiner
from sags_node.mapping.mapper import Mapped, Mapper
from sags_node.mapping.pose_refiner import PoseRefiner
from sags_node.mapping.right_view import RightView
from sags_node.pipeline.repeats import doubted, repeated, unseen
from sags_node.types import (
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
from sags_node.vision.change import StillScene, is_repeat
from sags_node.vision.depth import DepthChoice, Measured
from sags_node.vision.freeze_watch import FreezeWatch
from sags_node.vision.lens_watch import LensWatch, OnLenses
from sags_node.vision.observe import observe
from sags_node.vision.pair_watch import PairWatch, Verdict
from sags_node.vision.rectify import Rectifier
from sags_node.vision.scene_watch import Advice, SceneWatch, enlarged, exposed
from sags_node.vision.tissue import TissueMask
from sags_node.vision.tissue_topic import NearestMask

UNHURRIED_MS = 60.0  # a budget that has room for several steps and a finer flow
NOTICED_LATE = HALVING  # m: what was measured before matches are found to be wrong may be wrong by so much


class Pipeline:
    """rectify -> tissue mask -> depth -> map -> render.

    Args:
        masks: of another process, for `vision.tissue.method` topic.
        on_rectified: called with each pair and its epoch, before anything else is done with it.
        rate: see below.

    Attributes:
        rate: frames that come a second; None: they come when they are taken. `reconfigure` after a change.
        draws_right: somebody looks at the right eye. It is drawn then, where there is one. Any thread may
            change this.
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
        self._skips = skips
        vision = config.vision
        width, height = vision.working_size(rig.left.width, rig.left.height)
        self.rectifier = Rectifier(rig, width, height)
        self.tissue = TissueMask(vision.tissue, self.rectifier, masks)
        self._on_rectified = on_rectified
        self.depth = DepthChoice(vision, self.rectifier)
        self._refiner = make_refiner(config, width, height)
        self._config = config
        self.mapper = Mapper(
            self._refiner,
            affordable(config, width, height),
            unhurried=config.mapping.frame_ms(rate) >= UNHURRIED_MS,
            field=config.mapping.field is True,
        )
        self.draws_right = config.publish.right is True
        self._right = RightView()
        self._tracker: CameraTracker | PoseRefiner | None = None
        if vision.pose == "estimate":
            self._tracker = CameraTracker(self.mapper, self._draw_model)
        elif vision.pose == "refine":
            self._tracker = PoseRefiner(self.mapper)
        self.anchors = Anchors(self.tissue.usable)
        self._still = StillScene()
        self._freeze = FreezeWatch()
        self._eyes = PairWatch()
        self._lenses = LensWatch()
        self._scene = SceneWatch(moving=vision.pose == "estimate")
        self._is_sound = True  # what was matched last is depth
        self._unposed: Finding | None = None  # why the newest frame's pose is not known
        self._reset_due = False
        self._mapped: FrameResult | None = None  # the last frame that was really mapped
        self._depth: Measured | None = None  # of the last frame in which it was measured, or could not be
        self._unwatched = 0.0  # m: how far tissue may have moved in frames that were held since

    def reset(self) -> None:
        """Forget the model; the next frame makes a new one, in a new epoch.

        While the scope's pose is not known no frame can: it is forgotten when one comes whose pose is.
        """
        self._reset_due = True
        if self._unposed is None:
            self._forget()

    def _forget(self) -> None:
        self._reset_due = False
        self.mapper.restart()
        self._scene.forget()
        self._still.forget()
        self._mapped = None
        self._unwatched = 0.0

    def predict_motion(self) -> None:
        """Somebody wants motion predicted. Any thread may call this."""
        if self._config.mapping.field is not False:
            self.mapper.remember_motion()

    @property
    def newest(self) -> FrameResult | None:
        """The frame mapped last; None before the first, and after a reset."""
        return self._mapped

    @property
    def warnings(self) -> Findings:
        """What is wrong and how to fix it. May be read from any thread."""
        watches = self._freeze, self._eyes, self._lenses, self.depth, self._scene
        found = [finding for watch in watches for finding in watch.findings]
        lost = None if self._tracker is None else self._tracker.lost
        if lost is not None:
            back = "bring the scope back to tissue that it saw before"
            found.append(Finding("camera_lost", f"the camera is lost: {lost}; {back}"))
        if self._unposed is not None:
            found.append(self._unposed)
        if self.tissue.problem:
            found.append(Finding("mask_missing", self.tissue.problem))
        if self._refiner.problem is not None:
            found.append(self._refiner.problem)
        return by_stage(found)

    def reconfigure(self, config: LaunchConfig) -> None:
        """Take changed parameters over; the model stays."""
        self._config = config
        self.mapper.pace(config.mapping.frame_ms(self.rate) >= UNHURRIED_MS)

    def make_budget(self, speed: float | None = None) -> Budget:
        """What frames get, by the configuration and how long this machine takes (`Ladder.speed`); None: it is
        measured now, which takes less than a tenth of a second."""
        camera = self.rectifier.camera
        return make_budget(self._config, camera.width, camera.height, speed, self.rate, self._skips)

    def process(self, frame: StereoFrame, budget: Budget, waited: float = 0.0) -> FrameResult:
        """Everything that happens to one frame, `waited` seconds after it came."""
        budget.start(waited)
        rung = budget.state
        watch = Stopwatch()
        # 1. May this frame be trusted? One without a pose, or of a feed that stands still, is held.
        with watch("rectify"):
            pair = self._placed(frame)
        with watch("watch"):
            frozen = self._freeze(frame)
            eyes = self._eyes(frame, pair)
        self._on_rectified(pair, self._epoch(frame))
        self._unposed = frame.pose_problem if self._config.vision.pose in ("session", "refine") else None
        if self._unposed is not None and self._mapped is not None:
            return self._held(frame, pair, watch, "pose", self._unposed.text, unseen(pair))
        if frozen and self._mapped is not None:
            return self._held(frame, pair, watch, "picture", frozen, unseen(pair))
        if self._reset_due:
            self._forget()
        # 2. Is it new? An equal one is the last again, another scene begins a new model, a bad one is held.
        draws_right = self.draws_right and pair.right is not None
        if self._equals_the_last(pair, draws_right):
            return self._repeated(frame, pair, watch)
        with watch("watch"):
            scene = self._compared(pair, eyes)
            hidden = self._hidden(pair, eyes, scene)
        if scene.is_new:
            self._forget()
        elif scene.held:
            return self._held(frame, pair, watch, "picture", scene.held, unseen(pair))
        # 3. Where is tissue, and how deep is it?
        seen = pair if scene.gain is None else exposed(pair, scene.gain)
        still = self._still_frames(pair)
        with watch("mask"):
            tissue = self._tissue_in(frame, seen, scene.covered, hidden.left)
        with watch("depth"):
            seen_by_both = _without(tissue, hidden.right)
            measured = self._measured(frame, seen, seen_by_both, still, budget, eyes)
            observation = observe(seen, tissue, measured)
        # 4. Where is the camera? The tissue's motion is searched from where the watch saw it go.
        if scene.guess is not None:
            self.mapper.track(observation, scene.guess)
        if self._tracker is not None:
            with watch("pose"):
                tracked = still > 0 or self._tracker.track(observation)
                camera = replace(pair.camera, T_world_cam=self._tracker.pose)
                pair, observation = replace(pair, camera=camera), replace(observation, camera=camera)
            if not tracked and self._tracker.lost is not None and self._mapped is not None:
                return self._held(frame, pair, watch, "pose", self._tracker.lost, observation)
        # 5. Deform, refine, add and prune Gaussians.
        learn = scene.learn and eyes.learn
        with watch("map"):
            mapped = self._map(observation, budget, still, learn, draws_right)
        # 6. Draw the right eye for who looks, and follow the anchors.
        with watch("render"):
            views = {"left": mapped.view}
            if draws_right:
                sure = seen_by_both if learn and not eyes.right else np.zeros_like(tissue)
                views["right"] = self._right_eye(mapped, observation, seen, learn, sure)
        with watch("anchors"):
            self.anchors.update(observation, mapped.snapshot, mapped.view, learn)
            anchors = self.anchors.ahead(self.anchors.at(pair.t_capture_ns), mapped.snapshot)
        if not still:  # which tells nothing of what a moving frame costs
            budget.finish(self.mapper.model.count)
        skipped = {**self._without_mask(), **self._without_refinement(), **measured.skipped}
        self._mapped = FrameResult(
            pair, observation, mapped.snapshot, views, self._epoch(frame), watch.timings_ms,
            skipped, anchors, rung, hurried=measured.hurried,
        )  # fmt: skip
        return replace(self._mapped, held=frozen) if frozen else self._mapped

    def _placed(self, frame: StereoFrame) -> RectifiedPair:
        """The rectified pair; until its pose is found its camera is where it was last, or as it is given."""
        if self._config.vision.pose == "session":
            return self.rectifier(frame)
        pose = None if self._tracker is None else self._tracker.guess(frame.T_world_cam)
        return self.rectifier(replace(frame, T_world_cam=pose))

    def _equals_the_last(self, pair: RectifiedPair, draws_right: bool) -> bool:
        if self._mapped is None or not self._skips.duplicates:
            return False
        if draws_right and "right" not in self._mapped.views:  # for somebody who has just come
            return False
        return is_repeat(pair, self._mapped.pair)

    def _repeated(self, frame: StereoFrame, pair: RectifiedPair, watch: Stopwatch) -> FrameResult:
        assert self._mapped is not None
        anchors = self.anchors.at(pair.t_capture_ns, equal=True)
        return repeated(self._mapped, pair, self._epoch(frame), watch.timings_ms, anchors)

    def _compared(self, pair: RectifiedPair, eyes: Verdict) -> Advice:
        """What to do with a frame, by how it fits the last one."""
        if self._mapped is None:
            return Advice()
        return Advice(eyes.left) if eyes.left else self._scene(pair, self._mapped, not eyes.learn)

    def _hidden(self, pair: RectifiedPair, eyes: Verdict, scene: Advice) -> OnLenses:
        """What sits on the lenses, where both eyes can be compared."""
        if self._mapped is None:
            return OnLenses()
        sound = eyes.learn and not (eyes.left or eyes.right or scene.held or self.depth.eyes_are_late)
        return self._lenses(pair, self._mapped, sound)

    def _held(
        self, frame: StereoFrame, pair: RectifiedPair, watch: Stopwatch, what: str, why: str,
        observation: Observation,
    ) -> FrameResult:  # fmt: skip
        """For a frame that something (`what`) forbids to take in: the last model, and nothing is learnt from
        the picture. The tissue moves meanwhile, and the depth is less and less sure."""
        assert self._mapped is not None
        self._still.forget()
        seconds = max(0, pair.t_capture_ns - self._mapped.pair.t_capture_ns) * 1e-9
        self._unwatched = UNWATCHED * seconds
        anchors = self.anchors.at(pair.t_capture_ns, held=True)
        last = repeated(self._mapped, pair, self._epoch(frame), watch.timings_ms, anchors)
        held = doubted(last, self._unwatched)
        return replace(held, observation=observation, skipped={what: why}, held=why, hurried=False)

    def _still_frames(self, pair: RectifiedPair) -> int:
        if not self._skips.still:
            return 0
        if self._tracker is not None:  # an estimated pose tells nothing that the pictures do not
            pair = replace(pair, camera=self.rectifier.camera)
        return self._still(pair)

    def _tissue_in(self, frame: StereoFrame, pair: RectifiedPair, *covers: Bool | None) -> Bool:
        drawn = None if self._mapped is None else self._mapped.views["left"]
        tissue = self.tissue(frame, pair, drawn)
        for cover in covers:
            tissue = _without(tissue, cover)
        return tissue

    def _without_mask(self) -> dict[str, str]:
        return {"mask": self.tissue.problem} if self.tissue.problem else {}

    def _without_refinement(self) -> dict[str, str]:
        unsure = self._tracker.unsure if isinstance(self._tracker, PoseRefiner) else ""
        return {"refine": unsure} if unsure else {}

    def _measured(
        self, frame: StereoFrame, pair: RectifiedPair, tissue: Bool, still: int, budget: Budget, eyes: Verdict
    ) -> Measured:
        """The depth of a frame: where nothing moves, that which was measured before."""
        self.depth.see(pair)
        if still and self._depth is not None and self._depth.depth.any():
            self.depth.stereo.rows.stay()
            return self._depth.handed_on(tissue)
        self._depth = self._measured_now(frame, pair, tissue, budget, eyes)
        return self._depth

    def _measured_now(
        self, frame: StereoFrame, pair: RectifiedPair, tissue: Bool, budget: Budget, eyes: Verdict
    ) -> Measured:
        """None where there is no time, or no right eye."""
        if self._lacks_time_for_depth(frame, budget):
            return Measured.nothing(tissue.shape, "no time", hurried=True)
        was_sound, self._is_sound = self._is_sound, True
        if eyes.right and frame.depth is None and pair.right is not None:
            return Measured.nothing(tissue.shape, eyes.right)
        measured = self.depth(frame, pair, tissue)
        self._is_sound = measured.is_sound
        if was_sound and not measured.is_sound:
            self.mapper.doubt(NOTICED_LATE)
        return measured

    def _lacks_time_for_depth(self, frame: StereoFrame, budget: Budget) -> bool:
        needs_matching = self.depth.takes_time(frame) and self.mapper.model.count > 0  # the first needs depth
        return needs_matching and self._skips.depth and not budget.affords_depth()

    def _map(
        self, observation: Observation, budget: Budget, still: int, learn: bool, draws_right: bool
    ) -> Mapped:
        if self._unwatched:
            self.mapper.doubt(self._unwatched)
            self._unwatched = 0.0
        if draws_right:
            self._right.wake(self.mapper.model)
        else:
            self._right.miss()
        mapped = self.mapper.update(observation, budget, still, learn, draws_right)
        if self._tracker is not None:
            self._tracker.mapped(observation, mapped.view)
        return mapped

    def _epoch(self, frame: StereoFrame) -> int:
        """Grows with the source's epochs and with every new model: ids then mean other Gaussians."""
        return frame.epoch + self.mapper.restarts

    def _right_eye(
        self, mapped: Mapped, observation: Observation, seen: RectifiedPair, learn: bool, sure: Bool
    ) -> RenderedView:
        """The model drawn for the right eye, which is learnt from where tissue is `sure`."""
        before, stamp = self._mapped, mapped.view.t_capture_ns
        if before is not None and "right" in before.views and before.views["left"].rgb is mapped.view.rgb:
            return replace(before.views["right"], frame_id=mapped.view.frame_id, t_capture_ns=stamp)
        drawn = self._right.draw(mapped, observation, seen.left, self._refiner.show, learn)
        assert seen.right is not None  # else nothing is drawn for it
        self._right.learn(drawn, self.mapper.model, seen.right, sure, observation.baseline)
        return drawn.view

    def _draw_model(self, camera: Camera) -> RenderedView:
        """The model as it is now, in the light of a scope that is there."""
        return to_view(self._refiner.show(self.mapper.relight(camera), camera), camera, 0, 0)


def _without(tissue: Bool, cover: Bool | None) -> Bool:
    """The mask less what a small mask says is covered."""
    return tissue if cover is None else tissue & ~enlarged(cover, tissue.shape)


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
