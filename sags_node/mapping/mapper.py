"""The online mapper: one observation in, one immutable snapshot out."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from sags_node.engine.rasterizer.confidence import with_confidence
from sags_node.engine.rasterizer.views import to_view
from sags_node.mapping import densify, initialise
from sags_node.mapping.budget import Budget
from sags_node.mapping.depth_memory import remember
from sags_node.mapping.focus import tile_grid, tiles_of, with_neighbours
from sags_node.mapping.motion import HALVINGS, depth_pull, scene_flow, track
from sags_node.mapping.motion_field import MotionField
from sags_node.mapping.optimiser import LearningRates
from sags_node.mapping.refiner import Refiner
from sags_node.mapping.split import split_worst
from sags_node.model.alias_free import narrow
from sags_node.model.deformation import NodeDeformation, nearest_nodes
from sags_node.model.gaussians import GaussianModel
from sags_node.model.light import carried, is_near
from sags_node.types import (
    F32,
    F64,
    I64,
    U8,
    Bool,
    Camera,
    Forecast,
    Gaussians,
    Observation,
    RenderedView,
    Snapshot,
)
from sags_node.vision.flow import OpticalFlow
from sags_node.vision.margin import ClearOfInstruments
from sags_node.vision.observe import resized
from sags_node.vision.pyramid import pyramid_of

CONTROL_NODES = 512
FIRST_STEPS = 30  # of a new model: long ones, in its first frame or, where time is short, in the next ones
HOLES = 200  # Gaussians per frame that are exchanged for new ones when the model is full
GROWN = 0.8  # of the Gaussians that are allowed: up to there splitting adds some
ADDED = 500  # Gaussians per frame that may be added even when there are as many as the machine affords
TORN = 0.02  # of the Gaussians: where more are removed at once, they leave holes
EXPOSURE_JUMP = 0.01  # smaller changes of the gain are left to the colour steps
SETTLED = 10  # frames: a model that has not changed for so long has little more to learn
SETTLED_EVERY = 5  # frames: then it is refined so rarely
FOCUS = 0.15  # of the picture; measured: half the gain of a whole step in a quarter of its time
MIN_FIRST_DEPTHS = 200  # px
LOST_COVERAGE = 0.3  # of the tissue
FIRST_RATES = LearningRates().scaled(4.0)
UNHURRIED_RATES = 0.6  # measured with six steps: +0.3 dB; with one step a frame it loses as much
NODE_STEP_PX = 0.08
FINE_FLOW, COARSE_FLOW = 4, 6  # px between patches


@dataclass(frozen=True, slots=True)
class Drawn:
    """A frame and the model drawn for it: what the next frame's motion starts from."""

    observation: Observation
    view: RenderedView


@dataclass(frozen=True, slots=True)
class Learnt:
    """A copy of the model and of how it moves, to go back to."""

    model: GaussianModel
    deformation: NodeDeformation | None
    lamp: F64 | None


@dataclass(frozen=True, slots=True)
class Mapped:
    """What the mapper made of one frame."""

    snapshot: Snapshot
    view: RenderedView  # the model drawn for the left eye


class Mapper:
    """Builds and refines the model while the video runs.

    Each frame: predict where the tissue went (optical flow and depth, averaged on control nodes), remove what
    floats in free space, insert where the model has a hole or something new appears, refine while the budget
    lasts: once the whole picture, then where it is worst. The order and the constants follow a measured
    design; see `benchmarks/`.
    """

    def __init__(
        self,
        refiner: Refiner,
        max_gaussians: int,
        smoothing: bool = True,
        unhurried: bool = False,
        focus: float = FOCUS,
        field: bool = False,
    ) -> None:
        """
        Args:
            refiner: draws and refines the model.
            smoothing: draw the Gaussians with the 3D filter (`model.alias_free`).
            unhurried: see `pace`.
            focus: share of the picture, where it is worst, for the steps after the first of a frame.
            field: remember motion (`mapping.motion_field`), for hidden tissue and to predict.
        """
        self.model = GaussianModel(max_gaussians)
        self.step = 0
        self.restarts = 0  # how often a new model was begun because the old one did not fit any more
        self._refiner = refiner
        self._smoothing = smoothing
        self._focus = focus
        self.pace(unhurried)
        self._deformation: NodeDeformation | None = None
        self._field = MotionField() if field else None
        self._lamp: F64 | None = None  # T_world_cam of the scope whose light the colours show
        self._last: Drawn | None = None
        self._found: tuple[U8, F32] | None = None  # a picture, and the pixels where the Gaussians are in it
        self._clear = ClearOfInstruments(HALVINGS)
        self._view: RenderedView | None = None  # the model as it was drawn last
        self._scale = 1.0  # of the pictures' size: at which the model was drawn last
        self._first_steps = 0  # that a new model has had
        self._split = False  # whether Gaussians were, since the model was drawn
        self._frames = 0
        self._frames_to_depth = 0  # since depth was known last
        self._metres_per_px = 0.0  # at the tissue's median depth

    def update(
        self,
        observation: Observation,
        budget: Budget,
        still: int = 0,
        learn: bool = True,
        right: bool = False,
    ) -> Mapped:
        """Take one frame in.

        Args:
            still: for how many frames, this one included, nothing has moved.
            learn: else the model only follows the motion: the picture's colours are not the tissue's.
            right: somebody looks at the right eye: the snapshot says what that eye sees more.
        """
        self._frames += 1
        before, self._scale = self._scale, budget.rung.scale
        known = observation.depth[::8, ::8]
        known = known[known > 0]
        if known.size:
            self._metres_per_px = float(np.median(known)) / observation.camera.K[0, 0]
        if self._deformation is None:
            counts = self._initialise(observation, budget)
        elif not learn:
            counts = self._follow_only(observation)
        elif still and self._scale == before:
            counts = self._touch_up(observation, budget, settled=still > SETTLED)
        else:
            counts = self._follow(observation, budget)
        forecast = self._remember(observation.t_capture_ns, still > 0)
        snapshot = Snapshot(
            frame_id=observation.frame_id,
            t_capture_ns=observation.t_capture_ns,
            step=self.step,
            gaussians=self.model.snapshot(),
            velocities=self.model.velocities.copy(),
            camera=observation.camera,
            loss=self._refiner.loss,
            counts=counts,
            forecast=forecast,
            right_colors=self.model.right_colors.copy() if right else None,
        )
        assert self._view is not None
        drawn = Drawn(observation, self._view)
        mapped = Mapped(snapshot, drawn.view)
        if not still or self._last is None:  # a still frame is passed over: slow motion adds up until seen
            self.start_from(drawn)
            if not learn:
                return mapped
            room = self._limit(budget) - self.model.count
            if room > HOLES:  # else what hardly shows is needed to fill holes
                grown = round(GROWN * self._limit(budget)) - self.model.count
                self._split = split_worst(self.model, observation, drawn.view, max(0, grown)) > 0
        return mapped

    def pace(self, unhurried: bool) -> None:
        """Whether there is time for several steps a frame. They are shorter then, and the flow is finer."""
        self._flow = OpticalFlow(FINE_FLOW if unhurried else COARSE_FLOW)
        self._rates = LearningRates().scaled(UNHURRIED_RATES) if unhurried else LearningRates()

    def remember_motion(self) -> None:
        """From now on, see `mapping.motion_field`. Any thread may call this."""
        if self._field is None:
            self._field = MotionField()

    def restart(self) -> None:
        """Forget the model; the next frame, or this one if it is being taken in, makes a new one."""
        self.model.clear()
        self._deformation = None
        self._forget_motion()
        self._last = None
        self.restarts += 1

    def learnt(self) -> Learnt:
        """What is known now."""
        return Learnt(*deepcopy((self.model, self._deformation)), self._lamp)

    def go_back(self, learnt: Learnt) -> None:
        """Forget what was learnt since. The next frame's motion has nothing to start from (`start_from`)."""
        learnt.model.never_reuse(self.model)
        self.model, self._deformation, self._lamp = learnt.model, learnt.deformation, learnt.lamp
        self._forget_motion()
        self.start_from(None)

    def relight(self, camera: Camera) -> Gaussians:
        """The model as the scope's light shows it when its left eye is there; views, for drawing now."""
        gaussians, lamp = self.model.gaussians(), self._lamp
        if lamp is None or self._deformation is None or np.array_equal(lamp, camera.T_world_cam):
            return gaussians
        model, normals = self.model, self._deformation.normals(lamp[:3, 3])
        colors = carried(
            model.colors, model.means, normals, model.node_index, model.node_weight, lamp, camera.T_world_cam
        )
        return replace(gaussians, colors=colors)

    def _move_light(self, camera: Camera) -> None:
        """Let the colours be those that the scope's light shows from where it is now."""
        if self._lamp is None or not is_near(self._lamp, camera.T_world_cam):
            self.model.colors[:] = self.relight(camera).colors
            self._lamp = camera.T_world_cam

    def track(self, observation: Observation, guess: F32 | None = None) -> F32:
        """Pixels [N, 2] where the Gaussians are found in a frame that is not taken in yet, see
        `motion.track`; all NaN where there is no frame before.

        Args:
            guess: [rows, columns, 2] px, of square cells over the picture, from where to search.
        """
        if self._found is None or self._found[0] is not observation.gray:
            pixels = np.full((self.model.count, 2), np.float32(np.nan))
            if self._last is not None:
                before = self._last.observation
                flow = self._flow(pyramid_of(before), pyramid_of(observation), guess)
                clear = self._clear(before.tissue), self._clear(observation.tissue)
                pixels = track(self.model.means, self._last.view, clear[0], flow, clear[1])
            self._found = observation.gray, pixels
        return self._found[1]

    def away(self, rows: I64) -> F32:
        """How far [K, 3] m from where they rest the Gaussians in `rows` are now."""
        if self._deformation is None:
            return np.zeros((len(rows), 3), np.float32)
        return self._deformation.away(self.model.node_index[rows], self.model.node_weight[rows])

    def displacement_at(self, points: F32) -> F32:
        """How far [K, 3] m from where it rests the tissue at places [K, 3] is now."""
        if self._deformation is None:
            return np.zeros_like(points)
        index, weight, _ = nearest_nodes(points, self._deformation.nodes)
        return self._deformation.away(index, weight)

    def settle(self, share: float) -> None:
        """Let where the tissue rests follow where it is now, by a share of the way."""
        if self._deformation is not None:
            self._deformation.settle(share)

    def doubt(self, error: float) -> None:
        """The depth of all Gaussians may be wrong by so much more, m, until it is measured again."""
        self.model.depth_errors[:] = np.minimum(
            self.model.depth_errors + np.float32(error), initialise.LARGEST_ERROR
        )

    @property
    def last(self) -> Drawn | None:
        """What the next frame's motion starts from; None: nothing yet."""
        return self._last

    def start_from(self, last: Drawn | None) -> Drawn | None:
        """Let the next frame's motion start from this one; returns from which it would have started."""
        before, self._last, self._found = self._last, last, None
        return before

    def _initialise(self, observation: Observation, budget: Budget) -> dict[str, int]:
        if not self._can_start(observation):  # a black or covered picture: try again with the next frame
            planes = self._refiner.show(self.model.gaussians(), observation.camera)
            self._view = self._as_view(planes, observation)
            return {"inserted": 0}
        drawn = resized(observation, self._scale)
        limit = int(initialise.INITIAL_SHARE * self._limit(budget))
        pixels, depths, errors, spacing = initialise.first_pixels(drawn, limit)
        rows = initialise.insert(self.model, drawn, pixels, depths, errors, spacing, self._smoothing)
        self._deformation = NodeDeformation(self.model.means, CONTROL_NODES)
        self._deformation.attach(self.model, rows)
        self._lamp = observation.camera.T_world_cam
        self._begin(drawn)
        self._first_steps = 0
        while self._first_steps < FIRST_STEPS and budget.more_at_first(self._first_steps):
            self._refiner.draw()
            self._refiner.refine(FIRST_RATES)
            self._first_steps += 1
        self._refiner.download()
        self._show(observation, 1.0, tile_grid(drawn.tissue))
        self.step += self._first_steps
        return {"inserted": len(pixels), "iterations": self._first_steps}

    def _follow(self, observation: Observation, budget: Budget) -> dict[str, int]:
        assert self._deformation is not None
        # 1. Deform: every Gaussian goes to where flow and depth saw its tissue go.
        self._predict(observation)
        self._move_light(observation.camera)
        # 2. Prune: what floats in front of the tissue, and what the machine does not afford.
        limit = self._limit(budget)
        removed = self.model.remove(densify.prune_mask(self.model, observation, limit))
        removed += densify.prune_to_budget(self.model, limit)
        if self._smoothing:
            narrow(self.model.smoothing, self.model.means, observation.camera)

        # 3. Draw, and let the colours follow a jump of the exposure.
        drawn = resized(observation, self._scale)
        self._begin(drawn)
        self._refiner.draw()
        gain = self._refiner.exposure_gain()
        if np.abs(gain - 1).max() > EXPOSURE_JUMP:
            self.model.colors[:] *= gain
            self._refiner.take(self._all_rows)
            self._refiner.draw()
        planes = self._refiner.planes()
        if _is_lost(planes, drawn) and self._can_start(observation):
            self.restart()
            return self._initialise(observation, budget) | {"restarted": 1}
        # 4. Refine once on that drawing, before inserting: it serves both, since it shows the holes, too.
        pixels, depths, errors = densify.candidates(planes, drawn, phase=7 * self._frames)
        iterations = 0
        if budget.more():
            self._refiner.refine(self._next_rates(), budget.first_share())
            iterations = 1
        # 5. Densify: new Gaussians in the holes. A full model gives up what shows least for them.
        room = max(ADDED, limit - self.model.count)
        pixels, depths, errors = pixels[:room], depths[:room], errors[:room]
        lacking = min(len(pixels), HOLES) - max(0, limit - self.model.count)
        if 0 < lacking < self.model.count:
            self._refiner.download()
            removed += self.model.remove(densify.least_shown(self.model, lacking))
            self._refiner.take(self._all_rows)
        rows = initialise.insert(self.model, drawn, pixels, depths, errors, densify.GRID, self._smoothing)
        self._deformation.attach(self.model, rows)
        self._refiner.take(rows)
        # 6. Refine where it is worst, while the frame's time lasts; then draw what is shown.
        while budget.more():
            self._refiner.refine_worst(self._focus, self._next_rates())
            iterations += 1
        self._refiner.download()
        self._show(observation, budget.rung.redraw, tiles_of(pixels, drawn.tissue))
        self.step += iterations
        return {"inserted": rows.stop - rows.start, "removed": removed, "iterations": iterations}

    def _follow_only(self, observation: Observation) -> dict[str, int]:
        self._predict(observation)
        drawn = resized(observation, self._scale)
        self._begin(drawn)
        self._show(observation, 1.0, tile_grid(drawn.tissue))
        self._refiner.download()
        return {"inserted": 0, "removed": 0, "iterations": 0}

    def _touch_up(self, observation: Observation, budget: Budget, settled: bool) -> dict[str, int]:
        """Nothing moved: what was drawn last shows where steps pay, and only there the picture changes."""
        prune_mask = densify.prune_mask(self.model, observation, self._limit(budget))
        if np.count_nonzero(prune_mask) > TORN * self.model.count:
            counted = replace(observation, depth_is_new=False)
            return self._follow(counted, budget)  # damage: there are holes to be filled
        self.model.velocities[:] = 0
        removed = self.model.remove(prune_mask)
        rests = settled and self._frames % SETTLED_EVERY > 0
        iterations = 0
        self._begin(resized(observation, self._scale))
        while not (rests or (settled and iterations)) and budget.more():
            self._refiner.refine_worst(self._focus, self._next_rates(), nodes=False)
            iterations += 1
        self._refiner.download()
        stale = with_neighbours(self._refiner.touched())
        if removed or self._split:
            self._show(observation, 1.0, stale)
        elif stale.any():
            self._show(observation, 0.0, stale)
        elif self._view is not None:
            stamp = observation.t_capture_ns
            self._view = replace(self._view, frame_id=observation.frame_id, t_capture_ns=stamp)
        self.step += iterations
        return {"inserted": 0, "removed": removed, "iterations": iterations}

    def _begin(self, observation: Observation) -> None:
        assert self._deformation is not None
        step = NODE_STEP_PX * self._metres_per_px
        self._refiner.begin(self.model, self._deformation, observation, step)

    def _next_rates(self) -> LearningRates:
        """Of the next step."""
        self._first_steps += 1
        return FIRST_RATES if self._first_steps <= FIRST_STEPS else self._rates

    def _show(self, observation: Observation, share: float, tiles: Bool) -> None:
        """Draw the model to be shown; see `Refiner.redraw`."""
        self._refiner.redraw(share, tiles)
        self._split = False
        self._view = self._as_view(self._refiner.planes(), observation)

    def _as_view(self, planes: F32, observation: Observation) -> RenderedView:
        view = to_view(planes, observation.camera, observation.frame_id, observation.t_capture_ns)
        return with_confidence(view, self.model.gaussians(), observation.grid)

    @property
    def _all_rows(self) -> slice:
        return slice(0, self.model.count)

    def _predict(self, observation: Observation) -> None:
        """Move all Gaussians to where flow and depth saw the tissue go."""
        assert self._deformation is not None
        if self._last is None:
            return
        before = self._last.observation
        self._frames_to_depth += 1
        pull = depth_pull(self._frames_to_depth) if observation.depth_is_new else 0.0
        displacements, seen = scene_flow(self.model.means, self.track(observation), observation, pull)
        if pull and observation.depth.any():
            self._frames_to_depth = 0
        start = self.model.means.copy()
        if self._field is None:
            self._deformation.follow(self.model, displacements, seen)
        else:
            self._deformation.follow(self.model, displacements, seen, self._field.recalled)
        seconds = (observation.t_capture_ns - before.t_capture_ns) * 1e-9
        if seconds > 0:
            self.model.velocities[:] = (self.model.means - start) / np.float32(seconds)
        remember(self.model, observation, pull, max(seconds, 0.0))

    def _remember(self, t_ns: int, still: bool) -> Forecast | None:
        """Take the nodes' places at the end of a frame into the field; what it expects next."""
        deformation, model = self._deformation, self.model
        if self._field is None or deformation is None:
            return None
        self._field.take(deformation.nodes, deformation.seen, t_ns)
        expected = self._field.forecast()
        if expected is None or still:
            return None
        moves, frame_s, state = expected
        return Forecast(
            state, frame_s, deformation.nodes.copy(), moves, model.node_index.copy(), model.node_weight.copy()
        )

    def _forget_motion(self) -> None:
        if self._field is not None:
            self._field.forget()

    def _limit(self, budget: Budget) -> int:
        """How many Gaussians this machine can afford."""
        return min(budget.rung.gaussians, round(self._refiner.share * self.model.capacity))

    def _can_start(self, observation: Observation) -> bool:
        """Whether this frame has depth enough for a first model."""
        return bool(np.count_nonzero(observation.depth) >= MIN_FIRST_DEPTHS)


def _is_lost(planes: F32, observation: Observation) -> bool:
    """Whether the model, moved to this frame, hardly covers it: after damage, or where the camera is known to
    be in another place. Looking at every eighth pixel is enough. What the picture shows is judged before, see
    `vision.scene_watch`."""
    tissue = observation.tissue[::8, ::8]
    covered = tissue & (planes[4, ::8, ::8] > densify.HOLE_ALPHA)
    return bool(np.count_nonzero(covered) < LOST_COVERAGE * np.count_nonzero(tissue))
