"""Densification and pruning of canonical Gaussians under a cap (Kerbl et al., SIGGRAPH 2023)."""

from __future__ import annotations

import numpy as np

from sags_node.field.model import DeformableModel
from sags_node.model import columns
from sags_node.types import F32

MIN_OPACITY_LOGIT = float(np.log(0.005 / 0.995))
SHRINK = 1.6  # a Gaussian's scale against that of the two it is split into


class Density:
    """Collects how hard the pictures pull at each Gaussian; now and then splits those pulled hardest."""

    def __init__(self, model: DeformableModel, cap: int, share: float) -> None:
        """At most `cap` Gaussians, of which at most this share is split at a time."""
        self._model = model
        self._share = share
        self._cap = cap
        self._forget()

    def observe(self, v_means: F32, contribution: F32) -> None:
        """Count one iteration's pull at the drawn means, and who was seen, [N, 3] and [N]."""
        self.pull += np.linalg.norm(v_means, axis=1)
        self.seen += contribution > 0

    def adapt(self, rng: np.random.Generator) -> tuple[int, int]:
        """Prune what is transparent, split what is pulled hardest while there is room; both counts."""
        model = self._model
        kept = model.table[:, columns.LOGIT] > MIN_OPACITY_LOGIT
        kept &= np.isfinite(model.table).all(1)
        pull = (self.pull / np.maximum(self.seen, 1))[kept]
        pruned = int(np.count_nonzero(~kept))
        model.keep(kept)
        room = min(self._cap - len(model), int(self._share * len(model)))
        split = np.argsort(-pull, kind="stable")[: max(room, 0)]
        split = split[pull[split] > 0]
        if len(split) > 0:
            model.append(_split(model.table, split, rng), split)
        self._forget()
        return pruned, len(split)

    def _forget(self) -> None:
        self.pull = np.zeros(len(self._model), np.float32)
        self.seen = np.zeros(len(self._model), np.int64)


def _split(rows: F32, split: np.ndarray, rng: np.random.Generator) -> F32:
    """Shrink `rows[split]` and shift them along their longest axis; returns their twins on the other side."""
    parents = rows[split]
    longest = parents[:, columns.LOG_SCALE].argmax(1)
    along = _axes(parents[:, columns.QUAT])[np.arange(len(split)), :, longest]
    reach = np.exp(parents[:, columns.LOG_SCALE][np.arange(len(split)), longest])
    shift = along * (reach * rng.uniform(0.5, 1.0, len(split)))[:, None].astype(np.float32)
    twins: F32 = parents.copy()
    twins[:, columns.LOG_SCALE] -= np.float32(np.log(SHRINK))
    rows[split] = twins
    rows[split, columns.MEAN] += shift
    twins[:, columns.MEAN] -= shift
    return twins


def _axes(quats: F32) -> F32:
    """Rotation matrices [M, 3, 3]; column k is the k-th axis."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    axes: F32 = np.moveaxis(matrix, 2, 0)
    return axes
