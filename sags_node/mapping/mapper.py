"""The online mapper: one observation in, one immutable snapshot out."""

from dataclasses import replace
from functools import partial

import numpy as np

from sags_node.mapping import densify
from sags_node.mapping.budget import Budget
from sags_node.mapping.depth_memory import remember
from sags_node.mapping.exposure import exposure_gain
from sags_node.mapping.focus import tile_grid, tiles_of, with_neighbours
from sags_node.mapping.mapped import Mapped, as_view, can_start, is_lost, most_steps, snapshot_of
from sags_node.mapping.motion import Tracks, depth_pull, scene_flow
from sags_node.mapping.optimiser import LearningRates
from sags_node.mapping.refiner import Refiner
from sags_node.mapping.split import split_where_room
from sags_node.mapping.surface import surface_at
from sags_node.mapping.tissue_map import TissueMap
from sags_node.model.alias_free import narrow
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, Bool, Forecast, Observation, RenderedView
from sags_node.vision.observe import resized

CONTROL_NODES = 512
FIRST_STEPS = 30  # longer steps of a new model, in its first frame or, where time is short, the next ones
TORN = 0.02  # of the Gaussians: where more are removed at once, they leave holes
EXPOSURE_JUMP = 0.01  # smaller changes of the gain are left to the colour steps
FOCUS = 0.2  # share of the image: best quality for its time on pulled tissue and a beating heart
FIRST_RATES = LearningRates().scaled(4.0)
UNHURRIED_RATES = 0.6  # factor: with six steps a frame it gains 0.3 dB, with one it loses as much
NODE_STEP_PX = 0.08  # px at the tissue's median depth: length of one step of the nodes


class Mapper:
    """Builds and refines the map while the video runs.

    Each frame: predict where the tissue went (optical flow and depth, averaged on control nodes), remove what
    floats in free space, insert where the model has a hole or something new appears, refine while the budget
    lasts: once the whole image, then where it is worst. The order and the constants follow a measured
    design; see `benchmarks/`.

    Attributes:
        map: what it refines.
        step: how many steps were taken.
    """

    def __init__(
        self,
        refiner: Refiner,
        tissue_map: TissueMap,
        smoothing: bool = True,
        focus: float = FOCUS,
    ) -> None:
        """
        Args:
            refiner: draws and refines the model.
            smoothing: draw the Gaussians with the 3D filter (`model.alias_free`).
            focus: share of the image, where it is worst, for the steps after the first of a frame.
        """
        self.map = tissue_map
        self.step = 0
        self._refiner = refiner
        self._smoothing = smoothing
        self._focus = focus
        self.pace(False)
        self._view: RenderedView | None = None  # the model as it was drawn last
        self._scale = 1.0  # of the images' size: at which the model was drawn last
        self._first_steps = 0  # steps that a new model has had
        self._split = False  # whether Gaussians were split since the model was drawn
        self._frames = 0
        self._frames_to_depth = 0  # frames since depth was known last
        self._metres_per_px = 0.0  # at the tissue's median depth

    def update(
        self,
        observation: Observation,
        tracks: Tracks | None,
        budget: Budget,
        still: int = 0,
        learn: bool = True,
        right: bool = False,
    ) -> Mapped:
        """Take one frame in.

        Args:
            tracks: where the Gaussians are found in it; None: they have not moved.
            still: for how many frames, this one included, nothing has moved.
            learn: False: the image's colours are not the tissue's, and the model only follows the motion.
            right: somebody looks at the right eye: the snapshot has what its colours differ by.
        """
        self._frames += 1
        before, self._scale = self._scale, budget.plan.rung.scale
        self._note_depth(observation)
        if self.map.deformation is None:  # there is no model yet
            counts = self._initialise(observation, budget)
        elif not learn:
            counts = self._follow_only(observation, tracks)
        elif still and self._scale == before:  # it is drawn as large as the frame before
            counts = self._touch_up(observation, budget, most_steps(still, self._frames))
        else:
            counts = self._follow(observation, tracks, budget)
        assert self._view is not None
        forecast = self._forecast(observation, still > 0)
        snapshot = snapshot_of(
            self.model, observation, self.step, self._refiner.loss, counts, right, forecast
        )
        mapped = Mapped(snapshot, self._view)
        if learn and not still:
            limit = self._limit(budget)
            self._split = split_where_room(self.model, observation, self._view, limit) > 0
        return mapped

    def pace(self, unhurried: bool) -> None:
        """Set the length of steps: shorter if `unhurried`, when there is time for several a frame."""
        self._rates = LearningRates().scaled(UNHURRIED_RATES) if unhurried else LearningRates()

    @property
    def model(self) -> GaussianModel:
        """The Gaussians of the map."""
        return self.map.model

    def _initialise(self, observation: Observation, budget: Budget) -> dict[str, int]:
        if not can_start(observation):  # a black or covered image: try again with the next frame
            planes = self._refiner.show(self.model.gaussians(), observation.camera)
            self._view = as_view(planes, self.model, observation)
            return {"inserted": 0}
        drawn = resized(observation, self._scale)
        depths = self.map.begin(drawn, self._limit(budget), CONTROL_NODES, self._smoothing)
        self._begin(drawn)
        self._first_steps = 0
        while self._first_steps < FIRST_STEPS and budget.more_at_first(self._first_steps):
            self._refiner.draw()
            self._refiner.refine(FIRST_RATES)
            self._first_steps += 1
        self._refiner.download()
        self._show(observation)
        self.step += self._first_steps
        return {"inserted": len(depths), "iterations": self._first_steps}

    def _follow(self, observation: Observation, tracks: Tracks | None, budget: Budget) -> dict[str, int]:
        # 1. Deform: every Gaussian goes to where flow and depth saw its tissue go.
        surface = self._predict(observation, tracks)
        self.map.move_light(observation.camera)
        # 2. Prune: what floats in front of the tissue, and what the machine does not afford.
        limit = self._limit(budget)
        removed = densify.prune(self.model, surface, observation, limit)
        if self._smoothing:
            narrow(self.model.smoothing, self.model.means, observation.camera)

        # 3. Draw, and let the colours follow a jump of the exposure.
        drawn = resized(observation, self._scale)
        self._begin(drawn)
        self._refiner.draw()
        gain = exposure_gain(self._refiner.planes(), drawn.image, drawn.tissue)
        if np.abs(gain - 1).max() > EXPOSURE_JUMP:
            self.model.colors[:] *= gain
            self.model.slopes[:] *= gain.mean()
            self._refiner.take(self._all_rows)
            self._refiner.draw()
        planes = self._refiner.planes()
        if is_lost(planes, drawn) and can_start(observation):
            self.map.restart()
            return self._initialise(observation, budget) | {"restarted": 1}
        # 4. Refine once on that drawing, before inserting: it serves both, since it shows the holes, too.
        iterations = 0
        if budget.more():
            budget.step()
            self._refiner.refine(self._next_rates())
            iterations = 1
        # 5. Densify: new Gaussians in the holes. A full model gives up what shows least for them.
        pixels, inserted, given_up = densify.fill(
            self.model, self.map.nodes, planes, drawn, 7 * self._frames, limit, self._smoothing,
            partial(self._give_up, drawn),
        )  # fmt: skip
        self._refiner.take(slice(self.model.count - inserted, self.model.count))
        tiles = tiles_of(pixels, drawn.tissue)
        # 6. Refine where it is worst, while the frame's time lasts; then draw what is shown.
        while budget.more():
            budget.step()
            tiles |= self._refiner.refine_worst(self._focus, self._next_rates())
            iterations += 1
        budget.end_steps()
        self._refiner.download()
        self._show(observation, tiles, budget.plan.rung.redraw)
        self.step += iterations
        return {"inserted": inserted, "removed": removed + given_up, "iterations": iterations}

    def _give_up(self, observation: Observation, count: int) -> int:
        """`densify.give_up`, in the middle of a frame."""
        self._refiner.download()
        removed = densify.give_up(self.model, observation, count)
        self._refiner.take(self._all_rows)
        return removed

    def _follow_only(self, observation: Observation, tracks: Tracks | None) -> dict[str, int]:
        self._predict(observation, tracks)
        self._begin(resized(observation, self._scale))
        self._show(observation)
        self._refiner.download()
        return {"inserted": 0, "removed": 0, "iterations": 0}

    def _touch_up(self, observation: Observation, budget: Budget, most: float) -> dict[str, int]:
        """Refine where nothing moved, by `most` steps at most. The last drawing shows where steps pay, and
        only those tiles are drawn anew."""
        surface, is_new = surface_at(self.model.means, observation), observation.depth_is_new
        prune_mask = densify.prune_mask(self.model, surface, is_new, self._limit(budget))
        if np.count_nonzero(prune_mask) > TORN * self.model.count:
            counted = replace(observation, depth_is_new=False)
            return self._follow(counted, None, budget)  # damage: there are holes to be filled
        self.model.velocities[:] = 0
        removed = self.model.remove(prune_mask)
        iterations = 0
        drawn = resized(observation, self._scale)
        touched = tile_grid(drawn.tissue)
        self._begin(drawn)
        while iterations < most and budget.more():
            budget.step()
            touched |= self._refiner.refine_worst(self._focus, self._next_rates(), nodes=False)
            iterations += 1
        self._refiner.download()
        if removed or self._split:
            self._show(observation)
        elif touched.any():
            self._show(observation, with_neighbours(touched))
        elif self._view is not None:
            stamp = observation.t_capture_ns
            self._view = replace(self._view, frame_id=observation.frame_id, t_capture_ns=stamp)
        self.step += iterations
        return {"inserted": 0, "removed": removed, "iterations": iterations}

    def _begin(self, observation: Observation) -> None:
        step = NODE_STEP_PX * self._metres_per_px
        self._refiner.begin(self.model, self.map.nodes, observation, step)

    def _next_rates(self) -> LearningRates:
        """The rates of the next step."""
        self._first_steps += 1
        return FIRST_RATES if self._first_steps <= FIRST_STEPS else self._rates

    def _show(self, observation: Observation, tiles: Bool | None = None, share: float = 0.0) -> None:
        """Draw the model to be shown; see `Refiner.draw`."""
        self._refiner.draw(tiles, share)
        self._split = False
        self._view = as_view(self._refiner.planes(), self.model, observation)

    @property
    def _all_rows(self) -> slice:
        return slice(0, self.model.count)

    def _predict(self, observation: Observation, tracks: Tracks | None) -> F32:
        """Move all Gaussians to where flow and depth saw the tissue go; returns `surface_at` there."""
        if tracks is None:
            self.model.velocities[:] = 0
            return surface_at(self.model.means, observation)
        self._frames_to_depth += 1
        pull = depth_pull(self._frames_to_depth) if observation.depth_is_new else 0.0
        displacements, seen = scene_flow(self.model.means, tracks.pixels, observation, pull)
        if pull and observation.depth.any():
            self._frames_to_depth = 0
        start = self.model.means.copy()
        motion = self.map.motion
        if motion is None:
            self.map.nodes.follow(self.model, displacements, seen)
        else:
            self.map.nodes.follow(self.model, displacements, seen, motion.recalled)
        if tracks.seconds > 0:
            self.model.velocities[:] = (self.model.means - start) / np.float32(tracks.seconds)
        surface = surface_at(self.model.means, observation)
        remember(self.model, surface, pull, tracks.seconds)
        return surface

    def _note_depth(self, observation: Observation) -> None:
        known = observation.depth[::8, ::8]
        known = known[known > 0]
        if known.size:
            self._metres_per_px = float(np.median(known)) / observation.camera.K[0, 0]

    def _forecast(self, observation: Observation, still: bool) -> Forecast | None:
        """Add the nodes' places in this frame to the remembered motion; return what it predicts next."""
        motion, deformation, model = self.map.motion, self.map.deformation, self.model
        if motion is None or deformation is None:
            return None
        eye = observation.camera.T_world_cam[:3, 3].astype(np.float32)
        motion.take(deformation.nodes, deformation.seen, observation.t_capture_ns, eye)
        expected = motion.forecast()
        if expected is None or still:
            return None
        moves, frame_s, state = expected
        return Forecast(
            state, frame_s, deformation.nodes.copy(), moves, model.node_index.copy(), model.node_weight.copy()
        )

    def _limit(self, budget: Budget) -> int:
        """How many Gaussians this machine can afford."""
        return min(budget.plan.rung.gaussians, round(self._refiner.share * self.model.capacity))
