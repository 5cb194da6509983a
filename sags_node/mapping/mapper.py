"""The online mapper: one observation in, one immutable snapshot out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sags_node.mapping import densify, initialise
from sags_node.mapping.budget import Budget
from sags_node.mapping.focus import with_neighbours
from sags_node.mapping.motion import OpticalFlow, depth_pull, found_again, scene_flow
from sags_node.mapping.optimiser import Rates
from sags_node.mapping.refiner import Refiner
from sags_node.mapping.split import split_worst
from sags_node.model.alias_free import smoothing_variances
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, U8, Bool, Observation, RenderedView, Snapshot

CONTROL_NODES = 512
INITIAL_STEPS = 30
HOLES = 200  # Gaussians per frame that are exchanged for new ones when the model is full
ADDED = 500  # Gaussians per frame that may be added even when there are as many as the machine affords
TORN = 0.02  # of the Gaussians: where more are removed at once, they leave holes
EXPOSURE_JUMP = 0.01  # smaller changes of the gain are left to the colour steps
SETTLED = 10  # frames: a model that has not changed for so long has little more to learn
SETTLED_EVERY = 5  # frames: then it is refined so rarely
FOCUS = 0.15  # of the picture; measured: half the gain of a whole step in a quarter of its time
HURRIED_SHARE = 0.6  # of the picture, in the first step of a frame that is late
MIN_FIRST_DEPTHS = 200  # px
LOST_RESIDUAL = 0.08  # mean over RGB and tissue, 0..1; a beating heart stays below half of it
LOST_COVERAGE = 0.3  # of the tissue
INITIAL_RATES = Rates().scaled(4.0)
UNHURRIED_RATES = 0.6  # measured with six steps: +0.3 dB; with one step a frame it loses as much
NODE_STEP_PX = 0.08


@dataclass(slots=True)
class Drawn:
    """A frame and the model drawn for it: what the next frame's motion starts from."""

    observation: Observation
    view: RenderedView


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
    ) -> None:
        """
        Args:
            refiner: draws and refines the model; it must be drawn with `refiner.show` for `drawn`.
            smoothing: draw the Gaussians with the 3D filter (`model.alias_free`).
            unhurried: see `pace`.
            focus: share of the picture, where it is worst, for the steps after the first of a frame.
        """
        self.model = GaussianModel(max_gaussians)
        self.step = 0
        self.restarts = 0  # how often a new model was begun because the old one did not fit any more
        self._refiner = refiner
        self._smoothing = smoothing
        self._focus = focus
        self.pace(unhurried)
        self._deformation: NodeDeformation | None = None
        self._last: Drawn | None = None
        self._found: tuple[U8, F32] | None = None  # a picture, and the pixels where the Gaussians are in it
        self._still = False  # whether nothing moved in the frame taken in last
        self.stale_tiles: Bool | None = None  # [1, rows, columns] to be drawn anew after `update`; None: all
        self._frames = 0
        self._frames_to_depth = 0  # since depth was known last
        self._metres_per_px = 0.0  # at the tissue's median depth

    def update(self, observation: Observation, budget: Budget, still: int = 0) -> Snapshot:
        """Take one frame in. Call `drawn` with the picture of the snapshot before the next update.

        Args:
            still: for how many frames, this one included, nothing has moved.
        """
        self._frames += 1
        self._still = still > 0
        self.stale_tiles = None
        known = observation.depth[::8, ::8]
        known = known[known > 0]
        if known.size:
            self._metres_per_px = float(np.median(known)) / observation.camera.K[0, 0]
        if self._deformation is None:
            counts = self._initialise(observation)
        elif still:
            counts = self._touch_up(observation, budget, settled=still > SETTLED)
        else:
            counts = self._follow(observation, budget)
        return Snapshot(
            frame_id=observation.frame_id,
            t_capture_ns=observation.t_capture_ns,
            step=self.step,
            gaussians=self.model.frozen(),
            velocities=self.model.velocities.copy(),
            camera=observation.camera,
            loss=self._refiner.loss,
            counts=counts,
        )

    def pace(self, unhurried: bool) -> None:
        """Whether there is time for several steps a frame. They are shorter then, and the flow is finer."""
        self._flow = OpticalFlow(fine=unhurried)
        self._rates = Rates().scaled(UNHURRIED_RATES) if unhurried else Rates()

    def restart(self) -> None:
        """Forget the model; the next frame, or this one if it is being taken in, makes a new one."""
        self.model.clear()
        self._deformation = None
        self._last = None
        self.restarts += 1

    def found_again(self, observation: Observation) -> F32:
        """Pixels [N, 2] where the Gaussians are found in a frame that is not taken in yet, see
        `motion.found_again`; all NaN where there is no frame before."""
        if self._found is None or self._found[0] is not observation.gray:
            pixels = np.full((self.model.count, 2), np.float32(np.nan))
            if self._last is not None:
                before = self._last.observation
                flow = self._flow(before.gray, observation.gray)
                pixels = found_again(
                    self.model.means, self._last.view, before.tissue, flow, observation.tissue
                )
            self._found = observation.gray, pixels
        return self._found[1]

    def drawn(self, observation: Observation, view: RenderedView) -> None:
        """Remember how the model looked at `observation`: the next frame's motion starts from there, and what
        is worst in it is split. A still frame is passed over: slow motion adds up until it is seen."""
        if not self._still or self._last is None:
            self.start_from(Drawn(observation, view))
            if self.model.free > HOLES:  # else what hardly shows is needed to fill holes
                split_worst(self.model, observation, view)

    @property
    def last(self) -> Drawn | None:
        """What the next frame's motion starts from; None: nothing yet."""
        return self._last

    def start_from(self, last: Drawn | None) -> Drawn | None:
        """Let the next frame's motion start from this one; returns from which it would have started."""
        before, self._last, self._found = self._last, last, None
        return before

    def _initialise(self, observation: Observation) -> dict[str, int]:
        if not self._can_start(observation):
            return {"inserted": 0}  # a black or covered picture: try again with the next frame
        limit = int(initialise.INITIAL_SHARE * self.model.capacity)
        pixels, depths, spacing = initialise.first_pixels(observation, limit)
        rows = initialise.insert(self.model, observation, pixels, depths, spacing, self._smoothing)
        self._deformation = NodeDeformation(self.model.means, CONTROL_NODES)
        self._deformation.attach(self.model, rows)
        self._begin(observation)
        for _ in range(INITIAL_STEPS):
            self._refiner.draw()
            self._refiner.refine(INITIAL_RATES)
        self._refiner.give_back()
        self.step += INITIAL_STEPS
        return {"inserted": len(pixels), "iterations": INITIAL_STEPS}

    def _follow(self, observation: Observation, budget: Budget) -> dict[str, int]:
        assert self._deformation is not None
        self._predict(observation)
        limit = self._limit(budget)
        removed = self.model.remove(densify.doomed(self.model, observation, limit))
        if self._smoothing:
            self._sharpen(observation)

        self._begin(observation)
        self._refiner.draw()
        gain = self._refiner.exposure_gain()
        if np.abs(gain - 1).max() > EXPOSURE_JUMP:
            self.model.colors[:] *= gain
            self._refiner.take(self._all_rows)
            self._refiner.draw()
        planes = self._refiner.planes()
        if _is_lost(planes, observation) and self._can_start(observation):
            self.restart()
            return self._initialise(observation) | {"restarted": 1}
        pixels, depths = densify.candidates(planes, observation, phase=7 * self._frames)
        iterations = 0
        if budget.more():  # before inserting, so that the drawing above serves both
            self._refiner.refine(self._rates, 1.0 if budget.affords_whole() else HURRIED_SHARE)
            iterations = 1
        room = max(ADDED, limit - self.model.count)
        pixels, depths = pixels[:room], depths[:room]
        lacking = min(len(pixels), HOLES) - self.model.free
        if 0 < lacking < self.model.count:  # the view has grown: what is in it gives way
            self._refiner.give_back()
            removed += self.model.remove(densify.least_shown(self.model, lacking))
            self._refiner.take(self._all_rows)
        rows = initialise.insert(self.model, observation, pixels, depths, densify.GRID, self._smoothing)
        self._deformation.attach(self.model, rows)
        self._refiner.take(rows)
        while budget.more():
            self._refiner.refine_worst(self._focus, self._rates)
            iterations += 1
        self._refiner.give_back()
        self.step += iterations
        return {"inserted": rows.stop - rows.start, "removed": removed, "iterations": iterations}

    def _touch_up(self, observation: Observation, budget: Budget, settled: bool) -> dict[str, int]:
        """Nothing moved: what was drawn last shows where steps pay, and only there the picture changes."""
        doomed = densify.doomed(self.model, observation, self._limit(budget))
        if np.count_nonzero(doomed) > TORN * self.model.count:
            return self._follow(observation, budget)  # damage: there are holes to be filled
        self.model.velocities[:] = 0
        removed = self.model.remove(doomed)
        rests = settled and self._frames % SETTLED_EVERY > 0
        iterations = 0
        self._begin(observation)
        while not (rests or (settled and iterations)) and budget.more():
            self._refiner.refine_worst(self._focus, self._rates, nodes=False)
            iterations += 1
        self._refiner.give_back()
        self.step += iterations
        if removed == 0:
            self.stale_tiles = with_neighbours(self._refiner.touched())
        return {"inserted": 0, "removed": removed, "iterations": iterations}

    def _begin(self, observation: Observation) -> None:
        assert self._deformation is not None
        step = NODE_STEP_PX * self._metres_per_px
        self._refiner.begin(self.model, self._deformation, observation, step)

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
        displacements, seen = scene_flow(
            self.model.means, self.found_again(observation), observation, depth_pull(self._frames_to_depth)
        )
        if observation.depth.any():
            self._frames_to_depth = 0
        start = self.model.means.copy()
        self._deformation.follow(self.model, displacements, seen)
        seconds = (observation.t_capture_ns - before.t_capture_ns) * 1e-9
        if seconds > 0:
            self.model.velocities[:] = (self.model.means - start) / np.float32(seconds)

    def _sharpen(self, observation: Observation) -> None:
        """Narrow the 3D filter of what this camera sees finer than any before. What is out of view keeps its
        filter. The right eye has the left's depths and so its sampling rates."""
        variances = smoothing_variances(self.model.means, [observation.camera])
        np.minimum(self.model.smoothing, variances, out=self.model.smoothing)

    def _limit(self, budget: Budget) -> int:
        """How many Gaussians this machine can afford."""
        return round(min(budget.share, self._refiner.share) * self.model.capacity)

    def _can_start(self, observation: Observation) -> bool:
        """Whether this frame has depth enough for a first model."""
        return bool(np.count_nonzero(observation.depth) >= MIN_FIRST_DEPTHS)


def _is_lost(planes: F32, observation: Observation) -> bool:
    """Whether the model, moved to this frame, shows another scene: after a cut, a blackout or damage. Looking
    at every eighth pixel is enough."""
    tissue = observation.tissue[::8, ::8]
    alpha = planes[4, ::8, ::8]
    covered = tissue & (alpha > densify.HOLE_ALPHA)
    tissue_pixels, covered_pixels = np.count_nonzero(tissue), np.count_nonzero(covered)
    if tissue_pixels == 0:
        return False  # all is instrument: nothing to judge by
    if covered_pixels < LOST_COVERAGE * tissue_pixels:
        return True
    drawn = planes[:3, ::8, ::8][:, covered] / alpha[covered]
    residual = np.abs(drawn - observation.image[::8, ::8][covered].T).mean()
    return bool(residual > LOST_RESIDUAL)
