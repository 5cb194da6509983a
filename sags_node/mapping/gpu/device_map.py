"""The model and its nodes on a GPU. What the host changes goes up; Adam's moments never leave."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from sags_node.engine.gpu.rasterizer import DERIVED, KINDS
from sags_node.mapping.gpu import kernels
from sags_node.mapping.optimiser import BETA1, BETA2, LearningRates
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import I32, Camera

# Columns of the model on the GPU, 124 bytes a Gaussian. `REFINED` come back, 88 bytes a Gaussian.
REFINED: dict[str, Any] = {
    "means": wp.vec3, "quats": wp.vec4, "log_scales": wp.vec3, "opacity_logits": float, "scales": wp.vec3,
    "opacities": float, "colors": wp.vec3, "slopes": wp.vec3, "contribution": float,
}  # fmt: skip
GIVEN: dict[str, Any] = {"smoothing": float, "node_index": wp.vec4i, "node_weight": wp.vec4}


class DeviceMap:
    """A copy of the model's rows and of its nodes.

    Attributes:
        rows: arrays [capacity, ...] by their names in the model.
        adam_m, adam_v: [capacity] Adam's moments.
        nodes: [M, 3] m.
        momentum, variance: [M, 3] of the nodes, as in `NodeDeformation`.
    """

    def __init__(self, device: wp.Device) -> None:
        self.rows: dict[str, wp.array] = {}
        self._device = device
        self._model: GaussianModel | None = None
        self._host: dict[str, wp.array] = {}
        self._deformation: NodeDeformation | None = None
        self.momentum: wp.array
        self.variance: wp.array
        self._steps = 0

    def begin(self, model: GaussianModel, deformation: NodeDeformation) -> None:
        """Take the whole model and its nodes. New nodes begin without momentum and variance."""
        if self._model is not model:
            self._adopt(model)
        if self._deformation is not deformation:
            self._hold_nodes(0)
        self._deformation = deformation
        self.take(slice(0, model.count))

    def take(self, rows: slice) -> None:
        """Take these rows of the model, which the host has written, and the nodes."""
        assert self._model is not None and self._deformation is not None
        model, nodes = self._model, self._deformation.nodes
        for name in (*REFINED, *GIVEN):
            self._copy(self.rows[name], self._host[name], rows)
        self._carry_moments(model.origin)
        model.origin[:] = np.arange(1, model.count + 1, dtype=np.int32)
        if len(nodes) > len(self.nodes):
            self._hold_nodes(len(nodes))
        self.nodes.assign(np.ascontiguousarray(nodes, np.float32))

    def download(self) -> None:
        """Write what was refined into the model and the nodes."""
        assert self._model is not None and self._deformation is not None
        nodes = self.nodes.numpy()  # waits: what failed on the GPU fails here, before anything is written
        for name in REFINED:
            self._copy(self._host[name], self.rows[name], slice(0, self._model.count))
        wp.synchronize_device(self._device)
        self._deformation.nodes[:] = nodes

    def drawn(self) -> dict[str, wp.array]:
        """Return the columns that `DeviceRasterizer.forward` takes."""
        return {name: self._live(name) for name in KINDS}

    def descend(self, gradients: dict[str, wp.array], step: float) -> None:
        """Do as `NodeDeformation.descend`."""
        self._total.zero_()
        self._mass.zero_()
        follow = [self._live("node_index"), self._live("node_weight")]
        pulls = [gradients["means"], gradients["contribution"], *follow, self._total, self._mass]
        self._launch(kernels.gather_nodes, len(gradients["means"]), pulls)
        state = [self.nodes, self.momentum, self.variance, self._motion]
        self._launch(kernels.move_nodes, len(self.nodes), [self._total, self._mass, step, *state])
        self._launch(kernels.skin, len(gradients["means"]), [self._motion, *follow, self._live("means")])

    def optimise(self, gradients: dict[str, wp.array], rates: LearningRates, camera: Camera) -> None:
        """Do as `optimiser.Optimiser.step`."""
        self._steps += 1
        corrections = [1.0 / (1.0 - beta**self._steps) for beta in (BETA1, BETA2)]
        names = [name for name in REFINED if name != "contribution"]
        self._launch(kernels.optimise, len(gradients["means"]), [
            *(gradients[name] for name in DERIVED), kernels.parameters(*rates.of_columns),
            wp.vec4(*camera.viewmat[2].astype(np.float32)), float(camera.K[0, 0]), *corrections,
            *(self._live(name) for name in names), self.adam_m, self.adam_v,
        ])  # fmt: skip

    def note_contribution(self, contribution: wp.array) -> None:
        """Store each Gaussian's contribution [N] px."""
        wp.copy(self.rows["contribution"], contribution, count=len(contribution))

    def _adopt(self, model: GaussianModel) -> None:
        """Allocate memory for a model, with Adam's moments at 0. The model's columns move to pinned memory,
        which the GPU reads directly."""
        self._model = model
        model.origin[:] = 0
        for name, kind in (REFINED | GIVEN).items():
            held = model.rows[name]
            if self._device.is_cuda:
                pinned = wp.empty(model.capacity, dtype=kind, device="cpu", pinned=True)
                pinned.numpy()[:] = held
                model.rows[name] = pinned.numpy()
                self._host[name] = pinned
            else:
                self._host[name] = wp.array(held, dtype=kind, device="cpu", copy=False)
            self.rows[name] = wp.zeros(model.capacity, dtype=kind, device=self._device)
        self.adam_m, self.adam_v, self._old_m, self._old_v = (
            wp.zeros(model.capacity, dtype=kernels.parameters, device=self._device) for _ in range(4)
        )

    def _carry_moments(self, origin: I32) -> None:
        self._old_m, self.adam_m = self.adam_m, self._old_m
        self._old_v, self.adam_v = self.adam_v, self._old_v
        sent = wp.array(origin, dtype=int, device=self._device)
        moments = [self._old_m, self._old_v, self.adam_m, self.adam_v]
        self._launch(kernels.carry_moments, len(origin), [sent, *moments])

    def _hold_nodes(self, count: int) -> None:
        """Make room for `count` nodes; those that are here keep momentum and variance."""
        old: list[wp.array] = [] if count == 0 else [self.momentum, self.variance]
        room = [wp.zeros(count, dtype=wp.vec3, device=self._device) for _ in range(5)]
        self.momentum, self.variance, self.nodes, self._motion, self._total = room
        self._mass = wp.zeros(count, dtype=float, device=self._device)
        for before, after in zip(old, room, strict=False):
            wp.copy(after, before, count=len(before))

    def _live(self, name: str) -> wp.array:
        assert self._model is not None
        return self.rows[name][: self._model.count]

    def _copy(self, to: wp.array, source: wp.array, rows: slice) -> None:
        if rows.stop > rows.start:
            wp.copy(to, source, rows.start, rows.start, rows.stop - rows.start)

    def _launch(self, kernel: Any, dim: int, inputs: list[Any]) -> None:
        wp.launch(kernel, dim, inputs=inputs, device=self._device)
