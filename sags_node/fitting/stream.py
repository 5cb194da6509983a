"""The SAGS model learnt from a stream that never ends, in bounded memory.

Of the pictures only those of the last window are kept. With each frame the window advances, what leaves it is
folded into the Gaussians (`field.window`), holes get new ones, and a few steps are taken: some on the newest
frame, to follow it, some on earlier ones, which the field would forget otherwise.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.errors import SagsError
from sags_node.field.decoder import Decoder, Tokens
from sags_node.field.deformation import Deltas, Field, FieldRates
from sags_node.field.drawing import deactivate
from sags_node.field.hexplane import HexPlane
from sags_node.field.losses import LossWeights, compare
from sags_node.field.model import Rates
from sags_node.field.window import WindowModel
from sags_node.fitting.clip import ClipFrame
from sags_node.fitting.field import make_box, make_field, row_rates
from sags_node.fitting.settings import RowRates
from sags_node.mapping import densify, initialise
from sags_node.mapping.mapped import MIN_FIRST_DEPTHS
from sags_node.model import columns
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, I32, I64, Camera, Gaussians, Observation

MOST_KEPT = 64  # frames, at any frame rate
FIRST_STEPS, FIRST_SPEED = 30, 4.0  # on the first frame, without deformation; times the learning rates
TIDY_EVERY = 3  # frames between two looks for holes and for what is transparent
WEIGHTS = LossWeights(coverage=0.1)
MIN_LOGIT = float(np.log(densify.MIN_OPACITY / (1 - densify.MIN_OPACITY)))


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """What can be chosen."""

    window: float = 2.0  # s
    slot: float = 0.1  # s between slots of the field
    newest_steps: int = 2  # per frame, on the newest
    replay_steps: int = 2  # per frame, on random ones of the window
    tokens: Tokens = "nodes"
    max_gaussians: int = 30_000
    cells: int = 64  # of the field, along each axis, coarsest level
    levels: int = 2
    channels: int = 32
    seed: int = 0
    folds: bool = True  # False: forget what leaves the window; shows what folding is for


QUICK = StreamSettings(max_gaussians=4000, cells=16, channels=16)


class StreamFit:
    """`arrive` with each frame, then `learn` from it. Not for two threads."""

    def __init__(self, width: int, height: int, settings: StreamSettings) -> None:
        """Pictures of `width` x `height` px."""
        self.settings = settings
        self.rasterizer = make_rasterizer("numba", width, height)
        self.kept: deque[ClipFrame] = deque()  # of the window, oldest first; the newest is always there
        self.inserted = self.pruned = 0
        self._model: WindowModel | None = None
        self._frames = 0
        self._unseen = np.ones((height, width), np.bool_)
        self._drawn_ns: I64 = np.zeros(0, np.int64)  # [N] newest frame that each Gaussian had a part in
        self._rng = np.random.default_rng(settings.seed)

    @property
    def model(self) -> WindowModel:
        """
        Raises:
            SagsError: no frame so far had depth enough.
        """
        if self._model is None:
            raise SagsError("no frame of the stream had depth enough to start a model; check vision.stereo")
        return self._model

    def arrive(self, frame: ClipFrame) -> int:
        """A frame comes; the model can be drawn at its time now, as the field expects it to be.

        Returns:
            How many slots left the window.
        """
        self._frames += 1
        self._unseen &= ~frame.tissue
        self._keep(frame)
        if self._model is None:
            self._begin(frame)
            return 0
        return self._model.advance(frame.t_capture_ns, self.settings.folds)

    def learn(self) -> None:
        """Refine the model with the frames that are kept."""
        if self._model is None:
            return
        newest, settings = self.kept[-1], self.settings
        if self._frames % TIDY_EVERY == 0:
            self._tidy(newest)
        for step in range(max(settings.newest_steps, settings.replay_steps)):
            if step < settings.replay_steps:
                self._step(self.kept[self._rng.integers(len(self.kept))])
            if step < settings.newest_steps:
                self._step(newest)

    def gaussians(self, t_ns: int, camera: Camera) -> Gaussians:
        """The model at a time within the window."""
        return self.model.at(t_ns, [camera])

    def draw(self, t_ns: int, camera: Camera) -> F32:
        """Planes [5, H, W] of the model at a time within the window, in the rasteriser's memory."""
        return self.rasterizer.forward(self.gaussians(t_ns, camera), camera)

    def _keep(self, frame: ClipFrame) -> None:
        window_ns = round(self.settings.window * 1e9)
        if len(self.kept) > 1 and self.kept[-1].t_capture_ns - self.kept[-2].t_capture_ns < (
            window_ns // MOST_KEPT
        ):
            self.kept.pop()
        self.kept.append(frame)
        while self.kept[0].t_capture_ns < frame.t_capture_ns - window_ns or len(self.kept) > MOST_KEPT:
            self.kept.popleft()

    def _begin(self, frame: ClipFrame) -> None:
        if np.count_nonzero(frame.depth) < MIN_FIRST_DEPTHS:
            return  # a black or covered picture: try again with the next frame
        observation = frame.observation()
        limit = int(initialise.INITIAL_SHARE * self.settings.max_gaussians)
        pixels, depths, errors, spacing = initialise.first_pixels(observation, limit)
        rows = _rows(observation, pixels, depths, errors, spacing)
        self._drawn_ns = np.full(len(rows), frame.t_capture_ns)
        self._model = WindowModel(rows, self._make_field(rows[:, columns.MEAN], frame.t_capture_ns))
        pixel = float(np.median(depths)) / float(frame.camera.K[0, 0])  # m
        self._rates = row_rates(RowRates(), pixel)
        for _ in range(FIRST_STEPS):
            self._step(frame, FIRST_SPEED, deformed=False)

    def _make_field(self, means: F32, t0_ns: int) -> Field:
        settings = self.settings
        hexplane = HexPlane(
            make_box(means),
            t0_ns,
            round(settings.slot * 1e9),
            # One more: the newest slot lies up to one slot after the newest frame.
            slots=round(settings.window / settings.slot) + 2,
            cells=settings.cells,
            levels=settings.levels,
            channels=settings.channels,
            seed=settings.seed,
        )
        decoder = Decoder(hexplane.features, settings.tokens, seed=settings.seed)
        decoder.awaken(settings.seed)
        return make_field(Deltas(hexplane, decoder), means, settings.tokens)

    def _step(self, frame: ClipFrame, speed: float = 1.0, deformed: bool = True) -> None:
        drawing = self.model.draw(self.rasterizer, frame.t_capture_ns, frame.camera, deformed)
        found = compare(drawing.planes, frame.image, frame.tissue, frame.depth, self._unseen, WEIGHTS)
        drawing.differentiate(found.loss, found.weight)
        self.model.descend([drawing], Rates(self._rates * np.float32(speed), FieldRates()))
        drawn = drawing.contribution.numpy() > densify.IDLE
        self._drawn_ns[drawn] = np.maximum(self._drawn_ns[drawn], frame.t_capture_ns)

    def _tidy(self, frame: ClipFrame) -> None:
        """Remove what is transparent, and when N nears its cap what did not show in the whole window; fill
        the holes."""
        model, cap = self.model, self.settings.max_gaussians
        kept = (model.table[:, columns.LOGIT] > MIN_LOGIT) & np.isfinite(model.table).all(axis=1)
        if len(model) > densify.CROWDED * cap:
            kept &= self._drawn_ns >= self.kept[0].t_capture_ns
        self.pruned += len(kept) - int(np.count_nonzero(kept))
        if kept.any() and not kept.all():
            model.keep(kept)
            self._drawn_ns = self._drawn_ns[kept]
        observation = frame.observation()
        planes = self.draw(frame.t_capture_ns, frame.camera)
        pixels, depths, errors = densify.candidates(planes, observation, phase=7 * self._frames)
        room = cap - len(model)
        if min(room, len(pixels)) > 0:
            rows = _rows(observation, pixels[:room], depths[:room], errors[:room], densify.GRID)
            model.insert(rows, frame.t_capture_ns)
            self._drawn_ns = np.concatenate([self._drawn_ns, np.full(len(rows), frame.t_capture_ns)])
            self.inserted += len(rows)


def _rows(observation: Observation, pixels: I32, depths: F32, errors: F32, spacing: float) -> F32:
    """New Gaussians [M, 14] at pixels [M, 2] and depths [M] m, as the mapper makes them."""
    made = GaussianModel(len(pixels))
    initialise.insert(made, observation, pixels, depths, errors, spacing, smoothing=True)
    return deactivate(made.gaussians())
