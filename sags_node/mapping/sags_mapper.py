"""The paper's model (SAGS, arXiv 2510.27318) learnt while the video runs: `mapping.method` sags.

The field (`sags_node.field`) knows the last seconds: canonical Gaussians, a HexPlane and a self-adaptive
decoder say how they are at each time of the window. The map (`TissueMap`) has them as they are in the newest
frame: that is published. What prunes, inserts, splits and lights Gaussians works on the map, as with
`Mapper`; the field then takes over what was done (`_take_over`).
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import torch
from torch import Tensor

from sags_node.engine.losses.tissue import tissue_loss
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.field.decoder import Decoder
from sags_node.field.deformation import Deltas, FieldRates, NodeField
from sags_node.field.hexplane import FIRST_LINE, HexPlane
from sags_node.field.model import Rates
from sags_node.field.window import WindowModel
from sags_node.mapping import densify
from sags_node.mapping.budget import Budget
from sags_node.mapping.depth_memory import remember
from sags_node.mapping.exposure import exposure_gain
from sags_node.mapping.mapped import (
    Mapped,
    as_view,
    can_start,
    is_lost,
    is_worse_than_one_colour,
    most_steps,
    snapshot_of,
)
from sags_node.mapping.mapper import FIRST_STEPS
from sags_node.mapping.motion import DEPTH_PULL, Tracks
from sags_node.mapping.optimiser import COLOUR_DAMPING, COLOUR_RELAXATION
from sags_node.mapping.refiner import DEPTH_SCALE, DEPTH_WEIGHT
from sags_node.mapping.split import split_where_room
from sags_node.mapping.surface import surface_at
from sags_node.mapping.tissue_map import TissueMap
from sags_node.model import columns
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, F64, Camera, Gaussians, Observation, RenderedView
from sags_node.vision.observe import resized

WINDOW_NS = 2_000_000_000  # ns that the field remembers
SLOT_NS = 100_000_000  # ns from one slot of the field to the next
# Frames of the last KEPT_NS are learnt again. Measured: with those of the whole window, the newest frame is
# 0.6 dB worse and the window no better.
KEPT_NS = 700_000_000
MOST_KEPT = 24  # of these frames, at any frame rate
# Images depend only on differences of the field between two times of its window. What changes all times
# alike walks at random: without forgetting, features of about 1 are up to 130 after 1200 frames, a step
# changes scales by powers of e, and at last a scale is 0 or covers the image.
FORGOTTEN_NS = 2 * WINDOW_NS  # ns in which its cells go all but 1/e of the way back to their first values
NODES = 128  # at which the field is evaluated; 512 double the time of a step, and gain nothing with few steps
CELLS, CHANNELS = 32, 16  # of the HexPlane; twice as many of both gain nothing either
OUTLIERS = 1e-3  # of the Gaussians, on each side of the field's box: strays must not blow it up
LEAST_SIDE = 1e-3  # m, of that box
# Lengths of a step of Adam on the canonical Gaussians. Positions: px at the tissue's median depth. Colours
# take a step in closed form instead (`_refine`).
MEAN_PX, LOG_SCALE, QUAT, LOGIT = 0.08, 5e-3, 1e-3, 0.05
FIRST_SPEED = 4.0  # factor on the lengths of a model's first steps
# A larger change of the gain makes what is kept useless; smaller ones are left to the colour steps, as a
# model that does not fit yet seems to be darker or brighter by some per cent.
EXPOSURE_JUMP = 0.05
EARLIER_RELAXATION = 0.3  # of the step on colours on an earlier frame; what is published is the newest
SEED = 0  # of the first values of the field and of which frames are learnt again
LOOK_BACK_NS = SLOT_NS  # the velocity is the field's mean over this time


@dataclass(frozen=True, slots=True)
class Kept:
    """A frame to learn from."""

    t_ns: int  # on the field's clock
    drawn: Observation  # at the size in which the model was drawn
    camera: Camera  # of the whole image, for the 3D filter


class FrameDeltas(Deltas):
    """Evaluates HexPlane and decoder once for each time, except for gradients: a frame needs the same nodes
    at the same few times again and again. The HexPlane's box must not grow."""

    def __init__(self, hexplane: HexPlane, decoder: Decoder) -> None:
        super().__init__(hexplane, decoder)
        self._said: dict[int, Tensor] = {}
        self._first_planes = hexplane.cells[: hexplane.slot(0).start].detach().clone()
        self._first = [each.detach().clone() for each in decoder.parameters()]

    def __call__(self, points: Tensor, t_ns: int) -> Tensor:
        if torch.is_grad_enabled():
            return super().__call__(points, t_ns)
        if t_ns not in self._said:
            self._said[t_ns] = super().__call__(points, t_ns)
        return self._said[t_ns]

    def step(self, rates: FieldRates) -> None:
        super().step(rates)
        self.forget()

    @torch.no_grad()
    def fade(self, share: float) -> None:
        """Move the cells a share of the way back to their first values, and the decoder by a share that is
        smaller as its rate is (decoupled weight decay: Loshchilov & Hutter, ICLR 2019). The lines in time
        move together, by their mean over the window, so that their differences stay."""
        rates, first_line = FieldRates(), self.hexplane.slot(0).start
        cells = self.hexplane.cells
        lines = cells[first_line:].view(self.hexplane.slots, -1, cells.shape[1])
        lines -= share * (lines.mean(0) - FIRST_LINE)
        cells[:first_line].lerp_(self._first_planes, share)
        for each, first in zip(self.decoder.parameters(), self._first, strict=True):
            each.lerp_(first, share * rates.decoder / rates.cells)
        self.forget()

    def forget(self) -> None:
        """Forget the values of all times, so that they are evaluated anew."""
        self._said = {}


class SagsMapper:
    """Canonical Gaussians, field and decoder of SAGS over a window that slides with the video. It is used
    like `Mapper`; the field, not optical flow, says where tissue went.

    Attributes:
        map: the tissue map, which is published.
        step: how many steps were taken.
        field: of a map that has tissue; its rows are the map's, by their ids.
        kept: frames that are learnt again, oldest first; the newest is always there.
    """

    def __init__(self, tissue_map: TissueMap) -> None:
        torch.set_num_threads(1)  # results then do not depend on it; so few nodes gain little from more
        self.map = tissue_map
        self.step = 0
        self.kept: deque[Kept] = deque()
        self._rasterizer_of = cache(partial(make_rasterizer, "numba"))  # by width and height, px
        self._now_ns = self._ahead_ns = 0  # the field's clock, and by how much it is ahead of the stamps
        self._frames = self._first_steps = 0
        self._loss = 0.0
        self._view: RenderedView | None = None  # the model as it was drawn last

    def update(
        self, observation: Observation, tracks: Tracks | None, budget: Budget, still: int = 0,
        learn: bool = True, right: bool = False,
    ) -> Mapped:  # fmt: skip
        """Take one frame in; see `Mapper.update`. `tracks` are not needed."""
        self._frames += 1
        before_ns = self._now_ns
        drawn = resized(observation, budget.plan.rung.scale)
        frame = Kept(self._time_of(observation), drawn, observation.camera)
        if self.map.deformation is None:
            counts = self._initialise(observation, frame, budget)
        else:
            counts = self._follow(observation, frame, budget, still, learn)
            surface, pull = surface_at(self.model.means, observation), 0.0
            if learn and observation.depth_is_new:
                pull = DEPTH_PULL
            remember(self.model, surface, pull, (self._now_ns - before_ns) * 1e-9)
        assert self._view is not None
        snapshot = snapshot_of(self.model, observation, self.step, self._loss, counts, right)
        return Mapped(snapshot, self._view)

    def pace(self, unhurried: bool) -> None:
        """Do nothing: the length of steps does not depend on time, unlike in `Mapper.pace`."""

    @property
    def model(self) -> GaussianModel:
        """The Gaussians of the map."""
        return self.map.model

    def at(self, t_ns: int, cameras: Sequence[Camera]) -> Gaussians:
        """The Gaussians at a time of the window; see `WindowModel.at`."""
        return self.field.at(t_ns + self._ahead_ns, cameras)

    def _initialise(self, observation: Observation, frame: Kept, budget: Budget) -> dict[str, int]:
        drawn, model = frame.drawn, self.model
        if not can_start(observation):  # a black or covered image: try again with the next frame
            self._show(observation, frame)
            return {"inserted": 0}
        depths = self.map.begin(drawn, self._limit(budget), NODES)
        self._deltas = self._make_deltas(model.means, frame.t_ns)
        self.field = WindowModel(rows_of(model), NodeField(self._deltas, self.map.nodes.nodes.copy()))
        self._ids, self._written = model.ids.copy(), rows_of(model)
        self.kept = deque([frame])
        pixel = float(np.median(depths)) / float(drawn.camera.K[0, 0])  # m
        lengths = [MEAN_PX * pixel] * 3 + [LOG_SCALE] * 3 + [QUAT] * 4 + [0.0] * 3 + [LOGIT]
        self._rates = np.array(lengths, np.float32)
        self._rng = np.random.default_rng(SEED)
        steps = self._first_steps = 0
        while steps < FIRST_STEPS and budget.more_at_first(steps):
            self._refine(frame, COLOUR_RELAXATION, deformed=False)
            steps += 1
        self._write(frame)
        self._show(observation, frame)
        self.step += steps
        return {"inserted": len(depths), "iterations": steps}

    def _make_deltas(self, means: F32, t_ns: int) -> FrameDeltas:
        low, high = np.quantile(means, [OUTLIERS, 1 - OUTLIERS], axis=0)
        box: F64 = np.array([low, np.maximum(high, low + LEAST_SIDE)])
        slots = WINDOW_NS // SLOT_NS + 2  # the newest slot lies up to one slot after the newest frame
        hexplane = HexPlane(box, t_ns, SLOT_NS, slots, cells=CELLS, channels=CHANNELS, seed=SEED)
        decoder = Decoder(hexplane.features, "nodes", seed=SEED)
        decoder.awaken(SEED)
        return FrameDeltas(hexplane, decoder)

    def _follow(
        self, observation: Observation, frame: Kept, budget: Budget, still: int, learn: bool
    ) -> dict[str, int]:
        # 1. Predict: the window reaches this frame, old slots are folded and forgotten, the field says how
        # things are now.
        folded = self.field.advance(frame.t_ns)
        self._deltas.forget()
        if folded:
            share = -math.expm1(-folded * SLOT_NS / FORGOTTEN_NS)
            self.field.settle(frame.t_ns, lambda: self._deltas.fade(share))
        self._write(frame)
        self.map.move_light(observation.camera)
        inserted = removed = iterations = 0
        if learn:
            self._keep(frame)
            # 2. Prune; draw, and let the colours follow a jump of the exposure; split, and fill holes.
            model, limit = self.model, self._limit(budget)
            surface = surface_at(model.means, observation)  # also if still: a broken row breaks all gradients
            removed = densify.prune(model, surface, observation, limit)
            if removed or not still:
                planes = self._exposed(frame)
                if is_lost(planes, frame.drawn) and can_start(observation):
                    return self._restart(observation, frame, budget)
                split_where_room(model, observation, as_view(planes, model, observation), limit)
                _, inserted, given_up = densify.fill(
                    model, self.map.nodes, planes, frame.drawn, 7 * self._frames, limit, smoothing=True,
                    give_up=partial(densify.give_up, model, frame.drawn),
                )  # fmt: skip
                removed += given_up
            self._take_over(frame.t_ns)
            # 3. Refine while the time lasts, on the newest frame and on earlier ones, lest they be lost.
            most = most_steps(still, self._frames)
            while iterations < most and budget.more():
                budget.step()
                if iterations % 2 == 0:
                    self._refine(frame, COLOUR_RELAXATION)
                else:
                    self._refine(self.kept[self._rng.integers(len(self.kept))], EARLIER_RELAXATION)
                iterations += 1
            if not still:
                budget.end_steps()
            self._write(frame)
        # 4. Say how it moves, and draw what is shown.
        self.model.velocities[:] = 0 if still else self._velocities(frame.t_ns)
        planes = self._show(observation, frame)
        self.step += iterations
        if iterations and is_worse_than_one_colour(planes, frame.drawn) and can_start(observation):
            return self._restart(observation, frame, budget)
        return {"inserted": inserted, "removed": removed, "iterations": iterations}

    def _restart(self, observation: Observation, frame: Kept, budget: Budget) -> dict[str, int]:
        self.map.restart()
        return self._initialise(observation, frame, budget) | {"restarted": 1}

    def _exposed(self, frame: Kept) -> F32:
        """Draw the map for a frame; if the exposure jumped, change the map's colours first."""
        planes = self._draw(frame)
        gain = exposure_gain(planes, frame.drawn.image, frame.drawn.tissue)
        if np.abs(gain - 1).max() > EXPOSURE_JUMP:
            self.model.colors[:] *= gain
            self.kept = deque([frame])  # the others are in another exposure
            planes = self._draw(frame)
        return planes

    def _refine(self, frame: Kept, relaxation: float, deformed: bool = True) -> None:
        """One step on a frame: Adam on field, decoder and canonical Gaussians; on their colours the step in
        closed form of `optimiser.Optimiser`. With Adam on colours the phantom loses 3 dB."""
        field, seen = self.field, frame.drawn
        rasterizer = self._rasterizer_of(seen.camera.width, seen.camera.height)
        drawing = field.draw(rasterizer, frame.t_ns, seen.camera, deformed, whole=frame.camera)
        planes = drawing.planes.detach().numpy()
        v_planes, weight = np.zeros_like(planes), np.zeros_like(planes[0])
        loss = tissue_loss(
            planes, seen.image, seen.tissue, seen.depth, v_planes, weight, DEPTH_WEIGHT, DEPTH_SCALE
        )
        drawing.differentiate(v_planes, weight)
        assert field.rows.grad is not None
        contribution: F32 = drawing.contribution.numpy()
        share = np.float32(relaxation) / (contribution + np.float32(COLOUR_DAMPING))
        field.table[:, columns.COLOR] -= share[:, None] * field.rows.grad.numpy()[:, columns.COLOR]
        rates = self._rates * np.float32(FIRST_SPEED if self._first_steps < FIRST_STEPS else 1)
        if frame is self.kept[-1]:
            self.model.contribution[:], self._loss = contribution, loss
        field.descend([drawing], Rates(rates, FieldRates()))
        self._first_steps += 1

    def _write(self, frame: Kept) -> None:
        """Write the state of the field at a frame's time into the map."""
        model, now = self.model, self.field.at(frame.t_ns, [frame.camera])
        self.map.nodes.accompany(model, now.means - model.means)
        model.means[:], model.quats[:], model.colors[:] = now.means, now.quats, now.colors
        model.scales[:], model.opacities[:] = now.scales, now.opacities
        model.log_scales[:] = np.log(now.scales)
        opacities = np.clip(now.opacities, 1e-6, 1 - 1e-6)
        model.opacity_logits[:] = np.log(opacities / (1 - opacities))
        assert now.smoothing is not None
        model.smoothing[:] = now.smoothing
        self._written = rows_of(model)

    def _take_over(self, t_ns: int) -> None:
        """Apply to the field what was done to the map since `_write`: changes, except of rotations, at all
        times alike; new Gaussians as if they had always been there, moving as their neighbours."""
        model, field = self.model, self.field
        model.reorder(np.argsort(model.ids))  # as in the field: the oldest first
        kept = np.isin(self._ids, model.ids, assume_unique=True)
        if not kept.all():
            field.keep(kept)
        rows, known = rows_of(model), int(np.count_nonzero(kept))
        changes = rows[:known] - self._written[kept]
        changes[:, columns.QUAT] = 0
        field.table[:] += changes
        if known < model.count:
            field.insert(rows[known:], t_ns)
        self._ids = model.ids.copy()

    def _velocities(self, t_ns: int) -> F32:
        """[N, 3] m/s, by the field over the last `LOOK_BACK_NS`."""
        with torch.no_grad():
            before = self.field.rows_at(t_ns - LOOK_BACK_NS)[:, columns.MEAN].numpy()
        velocities: F32 = (self.model.means - before) / np.float32(LOOK_BACK_NS * 1e-9)
        return velocities

    def _time_of(self, observation: Observation) -> int:
        """The frame's time on the field's clock, ns, which stands still where a camera's goes back."""
        self._ahead_ns = max(self._ahead_ns, self._now_ns - observation.t_capture_ns)
        self._now_ns = observation.t_capture_ns + self._ahead_ns
        return self._now_ns

    def _keep(self, frame: Kept) -> None:
        """Keep this frame; drop those that are too old, and the one before if it came too soon."""
        kept = self.kept
        if len(kept) > 1 and kept[-1].t_ns - kept[-2].t_ns < KEPT_NS // MOST_KEPT:
            kept.pop()
        kept.append(frame)
        while kept[0].t_ns < frame.t_ns - KEPT_NS or len(kept) > MOST_KEPT:
            kept.popleft()

    def _show(self, observation: Observation, frame: Kept) -> F32:
        """Draw the map to be shown; returns the planes."""
        planes = self._draw(frame)
        self._view = as_view(planes, self.model, observation)
        return planes

    def _draw(self, frame: Kept) -> F32:
        camera = frame.drawn.camera
        return self._rasterizer_of(camera.width, camera.height).forward(self.model.gaussians(), camera)

    def _limit(self, budget: Budget) -> int:
        """How many Gaussians this machine can afford."""
        return min(budget.plan.rung.gaussians, self.model.capacity)


def rows_of(model: GaussianModel) -> F32:
    """Copy a map's Gaussians into raw rows [N, 14] (`columns`)."""
    logits = model.opacity_logits[:, None]
    parts = [model.means, model.log_scales, model.quats, model.colors, logits]
    rows: F32 = np.concatenate(parts, axis=1, dtype=np.float32)
    return rows
