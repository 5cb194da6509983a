"""The model and its nodes on a GPU, and the steps that move them there: torch's twins of the CPU's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from sags_node.engine.interface import MAX_OPACITY
from sags_node.mapping import optimiser
from sags_node.mapping.optimiser import BETA1, BETA2, LearningRates
from sags_node.model import columns
from sags_node.model.deformation import (
    CALM,
    INERTIA,
    LEAST_SEEN,
    MIN_CONTRIBUTION,
    NODE_EPS,
    STEEPEST,
    NodeDeformation,
)
from sags_node.model.gaussians import GaussianModel
from sags_node.types import Camera

if TYPE_CHECKING:
    from torch import Tensor

# Rows of the model, 212 bytes a Gaussian. The first come back, 176 bytes.
REFINED = (
    "means", "quats", "log_scales", "opacity_logits", "scales", "opacities", "colors", "slopes",
    "adam_m", "adam_v", "contribution",
)  # fmt: skip
GIVEN = ("smoothing", "node_index", "node_weight")
DRAWN = ("means", "quats", "scales", "opacities", "colors", "slopes", "smoothing")


class GpuMap:
    """A copy of the model's rows and of its nodes on a GPU.

    Attributes:
        rows: [N, ...] of the model, by their names there.
        nodes: [M, 3] m.
        momentum, variance: [M, 3] of the nodes, as in `NodeDeformation`.
    """

    def __init__(self, device: torch.device) -> None:
        self.rows: dict[str, Tensor] = {}
        self.nodes = self.momentum = self.variance = torch.zeros((0, 3), device=device)
        self._device = device
        self._deformation: NodeDeformation | None = None
        self._steps = 0

    def begin(self, model: GaussianModel, deformation: NodeDeformation) -> None:
        """Take all of it. New nodes remember nothing."""
        if self._deformation is not deformation:
            self.momentum = self.variance = self.nodes[:0]
        self._deformation = deformation
        self.nodes = self.nodes[:0]
        self.take(model, deformation, slice(0, model.count))

    def take(self, model: GaussianModel, deformation: NodeDeformation, rows: slice) -> None:
        """Take these rows of the model, and the nodes that were added."""
        for name in (*REFINED, *GIVEN):
            given = torch.tensor(getattr(model, name)[rows], device=self._device)
            here = self.rows.get(name, given[:0])
            joined = torch.cat([here[: rows.start], given, here[rows.stop :]])
            self.rows[name] = joined[: model.count]
        added = torch.tensor(deformation.nodes[len(self.nodes) :], device=self._device)
        self.nodes = torch.cat([self.nodes, added])
        still = torch.zeros_like(self.nodes[len(self.momentum) :])
        self.momentum = torch.cat([self.momentum, still])
        self.variance = torch.cat([self.variance, still])

    def drawn(self) -> dict[str, Tensor]:
        """What `gsplat_backend.Drawing` takes."""
        return {name: self.rows[name] for name in DRAWN}

    def download(self, model: GaussianModel, deformation: NodeDeformation) -> None:
        """Write what was refined into the model and the nodes."""
        rows = {name: self.rows[name].cpu().numpy() for name in REFINED}
        nodes = self.nodes.cpu().numpy()
        for name, values in rows.items():  # nothing is written before all of it is here
            getattr(model, name)[: len(values)] = values
        deformation.nodes[: len(nodes)] = nodes

    def descend(self, v_means: Tensor, contribution: Tensor, step: float) -> None:
        """`NodeDeformation.descend`, whose `gradients` are `v_means`. On a GPU a sum's order, and so its last
        bits, change from run to run."""
        index, weight = self.rows["node_index"].long(), self.rows["node_weight"]
        counted = (contribution > MIN_CONTRIBUTION)[:, None] & (weight >= 0) & (weight <= 1)
        pulls = torch.where(counted[..., None], weight[..., None] * v_means[:, None], 0.0)  # [N, 4, 3]
        total, mass = torch.zeros_like(self.nodes), torch.zeros_like(self.nodes[:, :1])
        total.index_add_(0, index.flatten(), pulls.flatten(0, 1))
        mass.index_add_(0, index.flatten(), torch.where(counted, weight, 0.0).flatten()[:, None])
        gradient = torch.where(mass > LEAST_SEEN, total / mass, 0.0)
        momentum = self.momentum + INERTIA * (gradient - self.momentum)
        variance = self.variance + CALM * (gradient.square() - self.variance)
        size = variance.sqrt()
        sound = (momentum.abs() <= STEEPEST * size) & torch.isfinite(size)
        self.momentum, self.variance = (torch.where(sound, kept, 0.0) for kept in (momentum, variance))
        motion = -step * self.momentum / (torch.where(sound, size, 0.0) + NODE_EPS)
        self.nodes = self.nodes + motion
        self.rows["means"] = self.rows["means"] + (weight[..., None] * motion[index]).sum(1)

    def optimise(self, gradients: dict[str, Tensor], rates: LearningRates, camera: Camera) -> None:
        """`optimiser.Optimiser.step`: a SIRT step on colours and slopes, Adam on the rest."""
        self._steps += 1
        rows, seen = self.rows, gradients["contribution"]
        m, v, scales, opacities = rows["adam_m"], rows["adam_v"], rows["scales"], rows["opacities"]
        by_logit = gradients["opacities"] * opacities * (1 - opacities)
        by_raw = torch.cat(
            [gradients["means"], gradients["quats"], gradients["scales"] * scales, by_logit[:, None]], 1
        )
        by_color = torch.cat([gradients["colors"], gradients["slopes"]], 1)
        size = seen + (by_raw.abs() + m.abs() + v.abs()).sum(1) + by_color.abs().sum(1)
        raw = rows["opacity_logits"].abs() + rows["log_scales"].abs().sum(1)
        taken = seen > optimiser.MIN_CONTRIBUTION
        moves = taken & (size < optimiser.LARGEST) & (raw < optimiser.LARGEST_RAW)
        broken = taken & ~moves  # its hidden state is made anew from what is drawn of it

        gain = optimiser.COLOUR_RELAXATION / (seen + optimiser.COLOUR_DAMPING)
        colors = rows["colors"] - gain[:, None] * gradients["colors"]
        self._put(moves, "colors", colors.clamp(*columns.COLOR_RANGE))
        per_slope = (gain / (3 * (gradients["spread"] / seen - 1).clamp(min=1)))[:, None]
        slopes = optimiser.SLOPE_DECAY * rows["slopes"] - per_slope * gradients["slopes"]
        self._put(moves, "slopes", slopes.clamp(-optimiser.STEEPEST, optimiser.STEEPEST))
        self._put(broken, "adam_m", torch.zeros_like(m))
        self._put(broken, "adam_v", torch.where(torch.isfinite(by_raw), by_raw.square(), 0.0))
        m, v = m + (1 - BETA1) * (by_raw - m), v + (1 - BETA2) * (by_raw.square() - v)
        self._put(moves, "adam_m", m)
        self._put(moves, "adam_v", v)
        lengths = [rates.mean_px] * 3 + [rates.quat] * 4 + [rates.log_scale] * 3 + [rates.opacity_logit]
        step = by_raw.new_tensor(lengths) * m / (1 - BETA1**self._steps)
        step /= (v / (1 - BETA2**self._steps)).sqrt() + optimiser.EPS

        view_z = by_raw.new_tensor(camera.viewmat[2])
        pixel = (rows["means"] @ view_z[:3] + view_z[3]).abs() / float(camera.K[0, 0])  # m at its depth
        self._put(moves, "means", rows["means"] - pixel[:, None] * step[:, :3])
        self._put(moves, "quats", rows["quats"] - step[:, 3:7])
        log_scales = (rows["log_scales"] - step[:, 7:10]).clamp(*columns.LOG_SCALE_RANGE)
        logits = (rows["opacity_logits"] - step[:, 10]).clamp(*columns.LOGIT_RANGE)
        self._put(broken, "log_scales", scales.log())
        self._put(broken, "opacity_logits", torch.logit(opacities.clamp(max=MAX_OPACITY)))
        self._put(moves, "log_scales", log_scales)
        self._put(moves, "scales", log_scales.exp())
        self._put(moves, "opacity_logits", logits)
        self._put(moves, "opacities", logits.sigmoid())

    def _put(self, where: Tensor, name: str, values: Tensor) -> None:
        """Into the rows where [N] is True."""
        rows = where.reshape(-1, *[1] * (values.ndim - 1))
        self.rows[name] = torch.where(rows, values, self.rows[name])
