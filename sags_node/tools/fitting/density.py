"""Densification and pruning of canonical Gaussians under a cap (Kerbl et al., SIGGRAPH 2023)."""

import numpy as np
import torch
from torch import Tensor

from sags_node.field.model import DeformableModel
from sags_node.geometry import quat_to_matrix
from sags_node.model import columns
from sags_node.types import F32

MIN_OPACITY_LOGIT = float(np.log(0.005 / 0.995))
SHRINK = 1.6  # how many times smaller the two are that a Gaussian is split into


class Density:
    """Collects each Gaussian's position gradient (its pull); now and then splits those pulled hardest."""

    def __init__(self, model: DeformableModel, cap: int, share: float) -> None:
        """Allow at most `cap` Gaussians, and split at most this share of them at a time."""
        self._model = model
        self._share = share
        self._cap = cap
        self._forget()

    def observe(self, v_means: Tensor, contribution: Tensor) -> None:
        """Add one iteration's gradient by the drawn means [N, 3], and the Gaussians' contribution [N]."""
        x, y, z = v_means.square().unbind(1)
        self.pull += (x + y + z).double().sqrt().float()  # torch's root of a float32 is an ulp off
        self.seen += contribution > 0

    def adapt(self, rng: np.random.Generator) -> tuple[int, int]:
        """Prune transparent Gaussians, and split those pulled hardest up to the cap; return both counts."""
        model, rows = self._model, self._model.table
        kept = rows[:, columns.LOGIT] > MIN_OPACITY_LOGIT
        kept &= np.isfinite(rows).all(1)
        pull = (self.pull.cpu().numpy() / np.maximum(self.seen.cpu().numpy(), 1))[kept]
        pruned = int(np.count_nonzero(~kept))
        model.keep(kept)
        room = min(self._cap - len(model), int(self._share * len(model)))
        split = np.argsort(-pull, kind="stable")[: max(room, 0)]
        split = split[pull[split] > 0]
        if len(split) > 0:
            halves, twins = _split(model.table[split], rng)
            model.rows.detach()[torch.from_numpy(split).to(model.device)] = torch.from_numpy(halves).to(
                model.device
            )
            model.append(twins, split)
        self._forget()
        return pruned, len(split)

    def _forget(self) -> None:
        count, device = len(self._model), self._model.device
        self.pull = torch.zeros(count, device=device)
        self.seen = torch.zeros(count, dtype=torch.int64, device=device)


def _split(parents: F32, rng: np.random.Generator) -> tuple[F32, F32]:
    """Split each of the rows [M, 14] into two smaller ones, shifted along its longest axis to either side."""
    every = np.arange(len(parents))
    longest = parents[:, columns.LOG_SCALE].argmax(1)
    along = quat_to_matrix(parents[:, columns.QUAT])[every, :, longest]
    reach = np.exp(parents[:, columns.LOG_SCALE][every, longest])
    shift = along * (reach * rng.uniform(0.5, 1.0, len(parents)))[:, None].astype(np.float32)
    there: F32 = parents.copy()
    there[:, columns.LOG_SCALE] -= np.float32(np.log(SHRINK))
    here: F32 = there.copy()
    there[:, columns.MEAN] += shift
    here[:, columns.MEAN] -= shift
    return there, here


def quarter(model: DeformableModel) -> None:
    """Replace each Gaussian by four, side by side and half as large in its plane, for images of twice the
    size. The colour of each is that of the old one at the new centre."""
    every, parents = np.arange(len(model)), model.table.copy()
    scales = np.exp(parents[:, columns.LOG_SCALE])
    axes = quat_to_matrix(parents[:, columns.QUAT])
    plane = np.argsort(-scales, axis=1)[:, :2]  # its two longest axes
    smaller = np.ones_like(scales)
    np.put_along_axis(smaller, plane, np.float32(0.5), axis=1)
    parents[:, columns.LOG_SCALE] += np.log(smaller)
    quarters = [parents.copy() for _ in range(4)]
    for quarter, side in zip(quarters, ((-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)), strict=True):
        away = np.zeros_like(scales)  # in standard deviations
        np.put_along_axis(away, plane, np.array(side, np.float32), axis=1)
        quarter[:, columns.MEAN] += (axes @ (away * scales)[:, :, None])[:, :, 0]
        if model.slopes is not None:
            slopes = model.slopes.detach().cpu().numpy()
            quarter[:, columns.COLOR] += (slopes * away).sum(1, keepdims=True)
    if model.slopes is not None:
        model.slopes.detach().mul_(torch.from_numpy(smaller).to(model.device))
    model.rows.detach().copy_(torch.from_numpy(quarters[0]))
    model.append(np.concatenate(quarters[1:]), np.tile(every, 3))
