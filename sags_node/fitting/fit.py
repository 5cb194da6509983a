"""The offline fit: canonical Gaussians and the deformation field, learnt from a clip's training frames.

`paper`: Adam on everything against the paper's loss. `online`: the start knows where the tissue went and how
it looked; what is left are small corrections of the field and of single Gaussians (`model.residuals`), by
squared colour residuals and the closed-form colour step, as the online mapper does.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sags_node.engine.adam import AdamState
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.fitting.clip import Clip, ClipFrame
from sags_node.fitting.density import Density
from sags_node.fitting.field import make_box, make_deltas, make_field, marked, row_rates
from sags_node.fitting.learner import Learner
from sags_node.fitting.settings import FitSettings
from sags_node.fitting.start import Progress, follow_online, learn_paths, pooled_rows, remainder
from sags_node.mapping.optimiser import LearningRates
from sags_node.model import columns
from sags_node.model.deformable import DeformableModel
from sags_node.model.exposure import Exposure
from sags_node.model.field import Field, NodeField
from sags_node.model.hexplane import HexPlaneField
from sags_node.model.residuals import Residuals
from sags_node.types import F32, Gaussians

REFINE_RATES = LearningRates()  # the mapper's, gentle: the start is good
REFINE_FIELD_SHARE = 0.003  # of the field's rates, which are for learning from nothing
REFINE_RELAXATION = 1.6  # of the colour step: a frame is seen again after many others
REFINE_DECAY = 0.1


class Fit:
    """A model being fitted: `start`, then `iterate` until `done`."""

    def __init__(self, clip: Clip, settings: FitSettings) -> None:
        """
        Args:
            clip: what it learns from.
            settings: of the fit.
        """
        self.clip = clip
        self.settings = settings
        self.iteration = 0
        self.seconds = 0.0  # spent on starting and iterating
        self.pruned = self.split = 0
        first = clip.train[0]
        height, width = first.tissue.shape
        self.rasterizer = make_rasterizer("numba", width, height, antialias=settings.antialias)
        unseen = ~np.any([frame.tissue for frame in clip.train], axis=0) | settings.smooth_everywhere
        self._learner = Learner(self.rasterizer, settings, unseen)
        self._rng = np.random.default_rng(settings.seed)
        self._order: list[int] = []
        known = first.depth[first.depth > 0]
        pixel = float(np.median(known)) / float(first.camera.K[0, 0]) if known.size else 1e-4
        self._rates = row_rates(settings.rates, pixel)
        self._decays = marked(settings.rates.decaying)
        self._refine_rates = self._rates.copy()
        self._refine_rates[columns.QUAT] = REFINE_RATES.quat
        self._refine_rates[columns.COLOR] = 0  # which has its closed form
        self._refine_rates[columns.LOGIT] = REFINE_RATES.opacity_logit

    def start(self, progress: Progress) -> None:
        """Make the model.

        Raises:
            SagsError: no frame has depth enough.
        """
        started = time.perf_counter()
        settings, exposure, residuals, slopes = self.settings, self._make_exposure(), None, None
        if settings.schedule == "paper":
            rows = pooled_rows(self.clip, exposure, settings)
            field = self._make_field(rows[:, columns.MEAN])
        else:
            rows, slopes, paths = follow_online(self.clip, self.rasterizer, exposure, settings, progress)
            field = self._make_field(rows[:, columns.MEAN])
            learn_paths(self._learner, field, rows, paths, settings, progress)
            residuals = remainder(field, rows, paths)
        self._start_means = np.ascontiguousarray(rows[:, columns.MEAN])
        model = DeformableModel(rows, field, exposure, settings.antialias, residuals, slopes)
        self._begin(model, self._make_density(model))
        self.seconds += time.perf_counter() - started

    @property
    def warm_up(self) -> int:
        """Iterations without deformation."""
        return self.settings.warm_up if self.settings.schedule == "paper" else 0

    @property
    def done(self) -> bool:
        return self.iteration >= self.total

    @property
    def total(self) -> int:
        """Iterations in all."""
        return self.warm_up + self.settings.iterations

    @property
    def residual(self) -> float:
        """Mean absolute colour residual of the last iteration."""
        return self._learner.residual

    def iterate(self) -> None:
        """One step on one training frame."""
        started = time.perf_counter()
        if self.settings.schedule == "paper":
            self._descend()
        else:
            self._refine()
        self.seconds += time.perf_counter() - started

    def _descend(self) -> None:
        """A step of the paper's schedule."""
        deformed = self.iteration >= self.warm_up
        frame = self._next_frame() if deformed else self.clip.train[0]
        done, of = self._stage
        share = self.settings.decay ** (done / (self.settings.decay_over or max(1, of)))
        self._learner.descend(
            frame,
            self._rates * np.float32(share) ** self._decays,
            self.settings.field_rates.scaled(share),
            self.settings.exposure_rate * share,
            deformed,
        )
        self.iteration += 1
        growth = self.settings.growth
        if self.iteration % growth.every == 0 and self._progress() < growth.until:
            pruned, split = self._density.adapt(self._rng)
            self.pruned, self.split = self.pruned + pruned, self.split + split

    def _refine(self) -> None:
        """A step of the joint refinement after the online pass."""
        share = REFINE_DECAY ** self._progress()
        self._learner.refine(
            self._next_frame(),
            self._refine_rates * np.float32(share),
            REFINE_RELAXATION * math.sqrt(share),  # less and less, so that frames average out
            self.settings.field_rates.scaled(REFINE_FIELD_SHARE * share),
        )
        self.iteration += 1

    def gaussians(self, frame: ClipFrame) -> Gaussians:
        """The model at the time of a frame; after the last training frame it is a prediction."""
        t_ns, last_ns = frame.t_capture_ns, self.clip.train[-1].t_capture_ns
        if t_ns > last_ns:
            return self.model.predict(t_ns, last_ns, [frame.camera])
        around = self.clip.around(t_ns)
        if around is None or self.settings.schedule == "paper":
            return self.model.at(t_ns, [frame.camera])
        before, after = around
        return self.model.between(t_ns, before.t_capture_ns, after.t_capture_ns, [frame.camera])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays that `restore` needs."""
        model, deltas = self.model, self.model.field.deltas
        tables = {
            "rows": (model.rows, model.adam),
            "gains": (model.exposure.gains, model.exposure.adam),
            "cells": (deltas.hexplane.cells, deltas.hexplane.adam),
            "decoder": (deltas.decoder.values, deltas.adam),
        }
        found: dict[str, NDArray[Any]] = {name: values for name, (values, _) in tables.items()}
        for name, (_, adam) in tables.items():
            found |= {f"{name}.moments": adam.moments, f"{name}.shares": adam.shares}
        if isinstance(model.field, NodeField):
            found |= {"index": model.field.index, "weight": model.field.weight}
        residuals = model.residuals
        if residuals is not None:
            found |= {"residuals": residuals.values, "residuals.times": residuals.times_ns}
            found |= {"residuals.moments": np.stack([adam.moments for adam in residuals.adam])}
            found |= {"residuals.shares": np.stack([adam.shares for adam in residuals.adam])}
        if model.slopes is not None:
            found["slopes"] = model.slopes
        return found | {
            "ids": model.ids,
            "start": self._start_means,
            "pull": self._density.pull,
            "seen": self._density.seen,
        }

    def state(self) -> dict[str, Any]:
        """The rest of what `restore` needs."""
        return {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "pruned": self.pruned,
            "split": self.split,
            "next_id": self.model.next_id,
            "order": self._order,
            "rng": self._rng.bit_generator.state,
        }

    def restore(self, state: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        """Go on from there, instead of `start`: the same bits as without the interruption."""
        self._start_means = arrays["start"]
        field = self._make_field(self._start_means)
        residuals = None
        if self.settings.schedule == "online":
            residuals = Residuals(arrays["residuals.times"], len(arrays["rows"]))
            residuals.values[:] = arrays["residuals"]
            adam = zip(arrays["residuals.moments"], arrays["residuals.shares"], strict=True)
            residuals.adam = [AdamState(moments, shares) for moments, shares in adam]
        model = DeformableModel(
            arrays["rows"], field, self._make_exposure(), self.settings.antialias, residuals,
            arrays.get("slopes"),
        )  # fmt: skip
        if isinstance(field, NodeField):
            field.index, field.weight = arrays["index"], arrays["weight"]
        deltas = field.deltas
        deltas.hexplane.cells[:] = arrays["cells"]
        deltas.decoder.values[:] = arrays["decoder"]
        model.exposure.gains[:] = arrays["gains"]
        model.exposure.adam = AdamState(arrays["gains.moments"], arrays["gains.shares"])
        model.adam = AdamState(arrays["rows.moments"], arrays["rows.shares"])
        deltas.hexplane.adam = AdamState(arrays["cells.moments"], arrays["cells.shares"])
        deltas.adam = AdamState(arrays["decoder.moments"], arrays["decoder.shares"])
        model.ids, model.next_id = arrays["ids"], int(state["next_id"])
        density = self._make_density(model)
        density.pull, density.seen = arrays["pull"], arrays["seen"]
        self._begin(model, density)
        self.iteration, self._order = int(state["iteration"]), list(state["order"])
        self.seconds = float(state["seconds"])
        self.pruned, self.split = int(state["pruned"]), int(state["split"])
        self._rng.bit_generator.state = state["rng"]

    def _begin(self, model: DeformableModel, density: Density) -> None:
        self.model, self._density = model, density
        self._learner.begin(model, density)

    def _progress(self) -> float:
        """How far the stage is, 0..1; each stage has its own schedule."""
        done, of = self._stage
        return done / max(1, of)

    @property
    def _stage(self) -> tuple[int, int]:
        """Iterations of the stage that are done, and all it has."""
        if self.iteration < self.warm_up:
            return self.iteration, self.warm_up
        return self.iteration - self.warm_up, self.settings.iterations

    def _next_frame(self) -> ClipFrame:
        """Every training frame once, in random order, then again."""
        if not self._order:
            self._order = self._rng.permutation(len(self.clip.train)).tolist()
        return self.clip.train[self._order.pop()]

    def _make_exposure(self) -> Exposure:
        times = np.array([frame.t_capture_ns for frame in self.clip.train])
        brightness = [
            frame.image[frame.tissue].mean(axis=0) / 255 if frame.tissue.any() else np.zeros(3)
            for frame in self.clip.train
        ]
        return Exposure(times, np.array(brightness, np.float32))

    def _make_field(self, means: F32) -> Field:
        """A new field over canonical means [N, 3] m, which decide where its box and its nodes are."""
        settings = self.settings
        times = [frame.t_capture_ns for frame in (*self.clip.train, *self.clip.test)]
        shape = settings.shape
        hexplane = HexPlaneField.for_clip(
            make_box(means), min(times), max(times), shape.slots(len(times)), cells=shape.cells,
            levels=shape.levels, channels=shape.channels, seed=settings.seed, space_range=shape.first_values,
        )  # fmt: skip
        deltas = make_deltas(hexplane, shape, settings.tokens, settings.block, settings.seed)
        return make_field(deltas, means, settings.tokens)

    def _make_density(self, model: DeformableModel) -> Density:
        return Density(model, self.settings.max_gaussians, self.settings.growth.share)
