"""The offline fit: canonical Gaussians and the deformation field, learnt from a clip's training frames.

`paper`: Adam on everything against the paper's loss. `online`: the start knows where the tissue went and how
it looked; what is left are small corrections of the field and of single Gaussians (`fitting.residuals`), by
squared colour residuals and the closed-form colour step, as the online mapper does.
"""

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, reduce
from itertools import repeat
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sags_node.engine.adam import AdamState
from sags_node.engine.losses.tissue import tissue_loss
from sags_node.engine.rasterizer.rasterize import Rasterizer, make_rasterizer
from sags_node.field.adam import RowAdam
from sags_node.field.canvas import Canvas
from sags_node.field.decoder import Decoder
from sags_node.field.deformation import Deltas, Field, NodeField
from sags_node.field.drawing import Drawing
from sags_node.field.hexplane import for_clip
from sags_node.field.model import DeformableModel, Rates
from sags_node.kernels.threads import configure_threads, thread_count
from sags_node.mapping.optimiser import LearningRates
from sags_node.mapping.refiner import DEPTH_SCALE, DEPTH_WEIGHT
from sags_node.model import columns
from sags_node.model.exposure import Exposure
from sags_node.tools.fitting.clip import Clip, ClipFrame
from sags_node.tools.fitting.density import Density, quarter
from sags_node.tools.fitting.field import make_box, make_field, marked, row_rates, unit_row
from sags_node.tools.fitting.midway import midway_frames
from sags_node.tools.fitting.pictures import Pictures
from sags_node.tools.fitting.refined import RefinedModel
from sags_node.tools.fitting.residuals import Residuals
from sags_node.tools.fitting.settings import FitSettings
from sags_node.tools.fitting.start import Progress, follow_online, learn_paths, pooled_rows, remainder
from sags_node.types import F32, Gaussians

REFINE_RATES = LearningRates()  # the mapper's, gentle: the start is good
REFINE_FIELD_SHARE = 0.003  # of the field's rates, which are for learning from nothing
REFINE_RELAXATION = 1.6  # of the colour step: a frame is seen again after many others
REFINE_DECAY = 0.1  # share of their first lengths to which the steps fall
RELAXATION = 0.9  # of the colour step of the paper's schedule; it falls with the rates, so frames average out
WARM_UP, HALF, FITTING = "warming up", "fitting at half the size", "fitting"  # stages


class Fit:
    """A model being fitted: `start`, then `iterate` until `done`.

    Attributes:
        seconds: wall time since the clip was read, up to the last `tick`: images half way, start, measuring
            `prices`, iterations, checkpoints (written and read), pauses. It goes on over `restore`.
    """

    def __init__(
        self,
        clip: Clip,
        settings: FitSettings,
        device: str | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            clip: what it learns from.
            settings: of the fit.
            device: where Warp draws, and where torch keeps the model and the images; not for
                schedule = online. None: the kernels of the CPU.
            now: the clock, s.
        """
        self._now, self._counted = now, now()
        seen = np.any([frame.tissue for frame in clip.train], axis=0)
        self.clip = clip
        self.settings = settings = settings.of_clip(int(np.count_nonzero(seen)), len(clip.train))
        self._on_device = device
        # A core for each image of an iteration: two that share one wait for each other all the time
        cores = 1 if device else min(self._batch, thread_count())
        self._cores = ThreadPoolExecutor(cores, initializer=_take_one_core) if cores > 1 else None
        self._device = torch.device(device or "cpu")
        self.iteration = 0
        self.seconds = 0.0
        self.pruned = self.split = 0
        height, width = clip.train[0].tissue.shape
        self.rasterizer = make_rasterizer("numba", width, height, antialias=settings.antialias)
        self._residual: float | Tensor = 0.0
        self._v_planes = np.zeros((5, height, width), np.float32)
        self._weight = np.zeros((height, width), np.float32)
        self._rng = np.random.default_rng(settings.seed)
        self._order: list[int] = []
        self._decays = marked(settings.rates.decaying)

    @cached_property
    def _learnt(self) -> list[ClipFrame]:
        """All frames that are learnt. A finished fit that is only drawn needs none half way."""
        return [*self.clip.train, *(midway_frames(self.clip.train) if self.settings.midway else ())]

    @property
    def _cap(self) -> int:
        """The most Gaussians in the current stage."""
        return self.settings.max_gaussians // (4 if self.is_coarse else 1)

    def _look(self) -> None:
        """Prepare the images and the learning rates of the current stage."""
        settings, frames = self.settings, self._learnt
        if self.is_coarse:
            frames = [frame.halved() for frame in frames]
        self._pictures = Pictures(frames, settings, self._on_device)
        self._rates = row_rates(settings.rates, self._pictures.pixel)
        self._refine_rates = self._rates.copy()
        if settings.slopes:
            self._rates[columns.COLOR] = 0  # colours have a closed-form step
        self._refine_rates[columns.QUAT] = REFINE_RATES.quat
        self._refine_rates[columns.COLOR] = 0  # colours have a closed-form step
        self._refine_rates[columns.LOGIT] = REFINE_RATES.opacity_logit

    def start(self, progress: Progress) -> None:
        """Make the model.

        Raises:
            SagsError: no frame has depth enough.
        """
        self._look()
        settings, exposure = self.settings, self._make_exposure()
        if settings.schedule == "paper":
            on_device = None if self._on_device is None else self._device
            rows = pooled_rows(self.clip, exposure, replace(settings, max_gaussians=self._cap), on_device)
            field = self._make_field(rows[:, columns.MEAN])
            slopes = np.zeros((len(rows), 3), np.float32) if settings.slopes else None
            self.model = DeformableModel(rows, field, exposure, settings.antialias, slopes)
            self.model.arrange()
        else:
            rows, slopes, paths = follow_online(self.clip, self.rasterizer, exposure, settings, progress)
            field = self._make_field(rows[:, columns.MEAN])
            learn_paths(field, rows, paths, settings, progress)
            residuals = remainder(field, rows, paths)
            self.model = RefinedModel(rows, field, exposure, settings.antialias, slopes, residuals)
        self._start_means = np.ascontiguousarray(rows[:, columns.MEAN])
        self._density = self._make_density()
        self.tick()

    def tick(self) -> None:
        """Count the time up to now into `seconds`."""
        before, self._counted = self._counted, self._now()
        self.seconds += self._counted - before

    @property
    def residual(self) -> float:
        """The colour term of the last iteration's loss. Reading it waits for the device."""
        return float(self._residual)

    @property
    def warm_up(self) -> int:
        """The number of iterations without deformation."""
        return self.settings.warm_up if self.settings.schedule == "paper" else 0

    @property
    def coarse(self) -> int:
        """The number of iterations with deformation on images of half the size."""
        share = self.settings.coarse if self.settings.schedule == "paper" else 0.0
        return round(share * self.settings.iterations)

    @property
    def is_coarse(self) -> bool:
        """Tell whether the current stage uses images of half the size."""
        return self.coarse > 0 and self.iteration < self.warm_up + self.coarse

    @property
    def done(self) -> bool:
        return self.iteration >= self.total

    @property
    def total(self) -> int:
        """The number of iterations in all."""
        return self.warm_up + self.coarse + self.settings.iterations

    def iterate(self) -> None:
        """Do one step on one training frame, or on `batch_size` of them."""
        if isinstance(self.model, RefinedModel):
            self._refine(self.model)
        else:
            self._descend()
        self.tick()

    def prices(self) -> dict[str, float]:
        """Measure what an iteration of each stage still to come takes, s: its drawing and gradients."""

        def took(deformed: bool) -> float:
            found = []
            for _ in range(3):  # the first may compile kernels and allocate memory
                started = self._now()
                self._differentiated(self._pictures.frames[: self._batch if deformed else 1], deformed)
                float(self._residual)  # waits for the device
                found.append(self._now() - started)
            return min(found)

        plain, deformed = took(False) if self.iteration < self.warm_up else 0.0, took(True)
        self.model.forget()
        return {WARM_UP: plain, HALF: deformed, FITTING: deformed * (4 if self.is_coarse else 1)}

    def _differentiated(self, frames: Sequence[ClipFrame], deformed: bool) -> list[Drawing]:
        """Draw training frames and compare them; all that is learnt then holds its gradients."""
        if isinstance(self.model, RefinedModel):
            (frame,) = frames
            drawing = self.model.draw_to_refine(self.rasterizer, frame.t_capture_ns, frame.camera)
            self._residual = tissue_loss(
                drawing.planes.detach().numpy(), frame.image, frame.tissue, frame.depth, self._v_planes,
                self._weight, DEPTH_WEIGHT, DEPTH_SCALE,
            )  # fmt: skip
            drawing.differentiate(self._v_planes, self._weight)
            return [drawing]
        apply = self._cores.map if self._cores is not None and len(frames) > 1 else map
        found = list(apply(self._compared, self._pictures.drawers, frames, repeat(deformed)))
        drawings, gradients, residuals = zip(*found, strict=True)
        for leaf, *parts in zip(self.model.leaves, *gradients, strict=True):
            given = [part for part in parts if part is not None]
            leaf.grad = reduce(torch.add, given) if given else None
        self._residual = residuals[-1]
        return list(drawings)

    def _compared(
        self, drawer: Rasterizer | Canvas, frame: ClipFrame, deformed: bool
    ) -> tuple[Drawing, Sequence[Tensor | None], Tensor]:
        """A drawing, the gradients of its loss by the model's leaves, and the loss's colour term."""
        drawing = self.model.draw(drawer, frame.t_capture_ns, frame.camera, deformed)
        found = self._pictures.compare(drawing.planes, frame)
        gain = float(self.model.exposure.at(frame.t_capture_ns).mean())
        weight = found.weight * gain**2  # of a colour before exposure
        gradients = drawing.gradients(found.loss, weight, self.model.leaves)
        return drawing, gradients, found.terms["color"].detach()

    def _descend(self) -> None:
        """A step of the paper's schedule."""
        settings, deformed = self.settings, self.iteration >= self.warm_up
        frames = [self._next_frame() for _ in range(self._batch)] if deformed else self._pictures.frames[:1]
        drawings = self._differentiated(frames, deformed)
        for drawing in drawings:
            self._density.observe(drawing.v_means, drawing.contribution)
        share = 1.0 if deformed and self.is_coarse else settings.rate_share(*self.stage[1:])
        colors = 0.0
        if settings.slopes:
            pixels = float(np.mean([np.count_nonzero(frame.tissue) for frame in frames]))
            colors = share * RELAXATION * 3 * pixels * settings.color_softness / settings.weights.color
        rates = Rates(
            self._rates * np.float32(share) ** self._decays, settings.field_rates.scaled(share), colors
        )
        self.model.descend(drawings, rates)
        was_coarse = self.is_coarse
        self.iteration += 1
        growth = settings.growth
        if was_coarse and not self.is_coarse:
            self._look()
            quarter(self.model)
            self.model.arrange()
            self._density = self._make_density()
        elif self.iteration % growth.every == 0 and self._progress() < growth.until:
            pruned, split = self._density.adapt(self._rng)
            self.pruned, self.split = self.pruned + pruned, self.split + split
            self.model.arrange()

    def _refine(self, model: RefinedModel) -> None:
        """A step of the joint refinement after the online pass."""
        share = REFINE_DECAY ** self._progress()
        (drawing,) = self._differentiated([self._next_frame()], deformed=True)
        model.refine(
            drawing,
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
        found: dict[str, NDArray[Any]] = {
            "rows": model.table,
            "gains": model.exposure.gains,
            "cells": _array(deltas.hexplane.cells),
            "ids": model.ids,
            "start": self._start_means,
            "pull": _array(self._density.pull),
            "seen": _array(self._density.seen),
        }
        remembered: dict[str, Sequence[AdamState | RowAdam]]
        remembered = {"rows": [model.adam], "cells": [deltas.hexplane.adam]}
        if isinstance(model.field, NodeField):
            found |= {"index": _array(model.field.index), "weight": _array(model.field.weight)}
        if model.slopes is not None:
            found["slopes"] = _array(model.slopes)
        if isinstance(model, RefinedModel):
            residuals = model.residuals
            found |= {"residuals": residuals.values, "residuals.times": residuals.times_ns}
            remembered["residuals"] = residuals.adam
        for name, states in remembered.items():
            found[f"{name}.moments"] = np.stack([_array(adam.moments) for adam in states])
            found[f"{name}.shares"] = np.stack([_array(adam.shares) for adam in states])
        for name, values in deltas.decoder.state_dict().items():
            found[f"decoder.{name}"] = _array(values)
        for number, state in deltas.optimizer.state_dict()["state"].items():
            found |= {f"optimizer.{number}.{key}": _array(values) for key, values in state.items()}
        return found

    def state(self) -> dict[str, Any]:
        """The rest of what `restore` needs."""
        self.tick()
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
        """Continue from a stored state, instead of `start`; bit for bit as if never interrupted."""
        self._start_means, rows = arrays["start"], arrays["rows"]
        field, exposure, smooth = (
            self._make_field(self._start_means),
            self._make_exposure(),
            self.settings.antialias,
        )
        if self.settings.schedule == "online":
            residuals = Residuals(arrays["residuals.times"], len(rows))
            residuals.values[:] = arrays["residuals"]
            remembered = zip(arrays["residuals.moments"], arrays["residuals.shares"], strict=True)
            residuals.adam = [AdamState(*each) for each in remembered]
            self.model = RefinedModel(rows, field, exposure, smooth, arrays["slopes"], residuals)
        else:
            self.model = DeformableModel(rows, field, exposure, smooth, arrays.get("slopes"))
        model, deltas = self.model, field.deltas
        if isinstance(field, NodeField):
            field.attach(torch.from_numpy(arrays["index"]), torch.from_numpy(arrays["weight"]))
        deltas.hexplane.cells.detach()[:] = self._tensor(arrays["cells"])
        exposure.gains[:] = arrays["gains"]
        model.adam, deltas.hexplane.adam = (
            RowAdam(*(self._tensor(arrays[f"{name}.{part}"][0]) for part in ("moments", "shares")))
            for name in ("rows", "cells")
        )
        model.ids, model.next_id = arrays["ids"], int(state["next_id"])
        of_decoder = {
            name: torch.from_numpy(arrays[f"decoder.{name}"]) for name in deltas.decoder.state_dict()
        }
        deltas.decoder.load_state_dict(of_decoder)
        optimizer = deltas.optimizer.state_dict()
        for name, values in arrays.items():
            if name.startswith("optimizer."):
                _, number, key = name.split(".")
                optimizer["state"].setdefault(int(number), {})[key] = torch.from_numpy(values)
        deltas.optimizer.load_state_dict(optimizer)
        self.iteration, self._order = int(state["iteration"]), list(state["order"])
        if not self.done:
            self._look()
        self._density = self._make_density()
        self._density.pull, self._density.seen = map(self._tensor, (arrays["pull"], arrays["seen"]))
        self.seconds = float(state["seconds"])
        self.pruned, self.split = int(state["pruned"]), int(state["split"])
        self._rng.bit_generator.state = state["rng"]

    def _progress(self) -> float:
        """How far the stage is, 0..1; each stage has its own schedule."""
        _, done, of = self.stage
        return done / max(1, of)

    @property
    def _batch(self) -> int:
        return self.settings.batch_size if self.settings.schedule == "paper" else 1

    @property
    def stages(self) -> dict[str, int]:
        """How many iterations each stage has, in their order."""
        return {WARM_UP: self.warm_up, HALF: self.coarse, FITTING: self.settings.iterations}

    @property
    def stage(self) -> tuple[str, int, int]:
        """The current stage, its iterations done, and how many it has."""
        done = self.iteration
        for name, length in self.stages.items():
            if done < length or name == FITTING:
                break
            done -= length
        return name, done, length

    def _next_frame(self) -> ClipFrame:
        """The next frame to learn: each comes once in random order, then each comes again."""
        if not self._order:
            self._order = self._rng.permutation(len(self._learnt)).tolist()
        return self._pictures.frames[self._order.pop()]

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(array).to(self._device)

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
        hexplane = for_clip(
            make_box(means), min(times), max(times), shape.slots(len(times)), cells=shape.cells,
            levels=shape.levels, channels=shape.channels, seed=settings.seed, space_range=shape.first_values,
            device=self._device,
        )  # fmt: skip
        decoder = Decoder(
            hexplane.features, settings.tokens, settings.block, seed=settings.seed, xavier=shape.xavier
        )
        return make_field(Deltas(hexplane, decoder, unit_row(shape.units)), means, settings.tokens)

    def _make_density(self) -> Density:
        return Density(self.model, self._cap, self.settings.growth.share)


def _array(values: Tensor | NDArray[Any]) -> NDArray[Any]:
    found: NDArray[Any] = values.detach().cpu().numpy() if isinstance(values, Tensor) else values
    return found


def _take_one_core() -> None:
    configure_threads(1)
    torch.set_num_threads(1)
