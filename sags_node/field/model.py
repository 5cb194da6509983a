"""The SAGS model: canonical Gaussians, the field that deforms them, and the exposure they are seen with."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sags_node.engine.interface import Rasterizer
from sags_node.field.adam import RowAdam
from sags_node.field.canvas import Canvas
from sags_node.field.deformation import Field, FieldRates
from sags_node.field.drawing import Drawing, activate, to_gaussians
from sags_node.model import columns
from sags_node.model.exposure import Exposure
from sags_node.types import F32, I64, Bool, Camera, Gaussians

LOOK_BACK_NS = 200_000_000  # ns: a prediction's velocity is the mean over this time
FADE_NS = 150_000_000  # ns in which that velocity falls to 1/e
COLOR_DAMPING = 0.3  # px: a barely seen Gaussian changes its colour slowly


class Rates(NamedTuple):
    """Lengths of a step: of Adam, and beside it of the closed-form one on colours and slopes."""

    rows: F32  # [14] of the canonical rows
    field: FieldRates
    colors: float = 0.0  # relaxation over the loss's second derivative by a pixel's colour; 0: no such step


class DeformableModel:
    """Canonical Gaussians with their optimiser, and a field. Not thread-safe.

    Attributes:
        rows: [N, 14] canonical (`model.columns`), differentiable.
        slopes: [N, 3] of the luminance, see `types.Gaussians`, differentiable; they turn with the Gaussian,
            and the field does not change them. None: every Gaussian has one colour.
    """

    def __init__(
        self, rows: F32, field: Field, exposure: Exposure, smooth: bool = True, slopes: F32 | None = None
    ) -> None:
        """
        Args:
            rows: [N, 14] canonical.
            field: deforms them.
            exposure: scales their colours.
            smooth: whether the 3D filter is on.
            slopes: [N, 3]
        """
        self.device = field.deltas.hexplane.cells.device  # of all that is learnt
        self.rows = self._leaf(rows)
        self.slopes = None if slopes is None else self._leaf(slopes)
        self.ids: I64 = np.arange(len(rows))
        self.next_id = len(rows)
        self.field, self.exposure, self.smooth = field, exposure, smooth
        self.adam = RowAdam.of(self.rows.detach())
        field.follow(self.means)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def leaves(self) -> list[Tensor]:
        """All that is learnt."""
        deltas = self.field.deltas
        leaves = (self.rows, self.slopes, deltas.hexplane.cells, *deltas.decoder.parameters())
        return [leaf for leaf in leaves if leaf is not None and leaf.requires_grad]

    @property
    def table(self) -> F32:
        """The canonical rows: the same memory, or a copy of what a GPU has."""
        rows: F32 = self.rows.detach().cpu().numpy()
        return rows

    @property
    def means(self) -> F32:
        return np.ascontiguousarray(self.table[:, columns.MEAN])

    def rows_at(self, t_ns: int, deformed: bool = True) -> Tensor:
        """The rows [N, 14] at one time, without exposure; `deformed`: False leaves the field out."""
        return self.field.deform(self.rows, t_ns) if deformed else self.rows

    def draw(
        self, rasterizer: Rasterizer | Canvas, t_ns: int, camera: Camera, deformed: bool = True,
        whole: Camera | None = None,
    ) -> Drawing:  # fmt: skip
        """Draw the model at one time for a camera it is fitted to. To learn from it: `Drawing.differentiate`,
        then `descend`. `whole`: the camera of the whole image, for the 3D filter; None: `camera`."""
        return self._drawn(rasterizer, self.rows_at(t_ns, deformed), t_ns, camera, whole)

    def _drawn(
        self, rasterizer: Rasterizer | Canvas, rows: Tensor, t_ns: int, camera: Camera,
        whole: Camera | None = None,
    ) -> Drawing:  # fmt: skip
        (exposed, slopes), fitted = self._exposed(rows, t_ns), [whole or camera]
        return Drawing(rasterizer, camera, exposed, slopes, self.ids, fitted if self.smooth else None)

    @torch.no_grad()
    def at(self, t_ns: int, cameras: Sequence[Camera], deformed: bool = True) -> Gaussians:
        """The Gaussians at one time; `cameras`: those they were fitted to, for the 3D filter."""
        return self._shown(self.rows_at(t_ns, deformed), t_ns, cameras)

    @torch.no_grad()
    def between(self, t_ns: int, before_ns: int, after_ns: int, cameras: Sequence[Camera]) -> Gaussians:
        """The Gaussians at a time between two that were learnt, by linear interpolation: in between, the
        field had nothing to learn from."""
        share = (t_ns - before_ns) / (after_ns - before_ns)
        return self._shown(torch.lerp(self.rows_at(before_ns), self.rows_at(after_ns), share), t_ns, cameras)

    @torch.no_grad()
    def predict(self, t_ns: int, last_ns: int, cameras: Sequence[Camera]) -> Gaussians:
        """The Gaussians at a time after the last that was learnt. They go on with the field's last velocity,
        which decays; all else stays as it was last."""
        deform, rows = self.field.deform, self.rows_at(last_ns).clone()
        moved = deform(self.rows, last_ns) - deform(self.rows, last_ns - LOOK_BACK_NS)
        ahead = FADE_NS * -math.expm1((last_ns - t_ns) / FADE_NS)
        rows[:, columns.MEAN] += ahead / LOOK_BACK_NS * moved[:, columns.MEAN]
        return self._shown(rows, last_ns, cameras)

    def _shown(self, rows: Tensor, t_ns: int, cameras: Sequence[Camera]) -> Gaussians:
        exposed, slopes = self._exposed(rows, t_ns)
        return to_gaussians(activate(exposed), slopes, self.ids, cameras if self.smooth else None)

    def _exposed(self, rows: Tensor, t_ns: int) -> tuple[Tensor, Tensor | None]:
        gain = torch.from_numpy(self.exposure.at(t_ns)).to(self.device, non_blocking=True)
        gains = rows.new_ones(columns.COUNT)  # of all: parts would each have a gradient of whole rows
        gains[columns.COLOR] = gain
        slopes = None if self.slopes is None else self.slopes * gain.mean()
        return rows * gains, slopes

    def descend(self, drawings: Sequence[Drawing], rates: Rates) -> None:
        """One step of Adam on all that the drawings came from, against the gradients they were given.
        Gaussians that none of them saw stay as they are."""
        seen = torch.stack([drawing.contribution > 0 for drawing in drawings]).any(0)
        assert self.rows.grad is not None
        if rates.colors:
            self._solve_colors(drawings, rates.colors)
        row_rates = torch.from_numpy(rates.rows).to(self.device, non_blocking=True)
        self.adam.step(self.rows, self.rows.grad, row_rates, seen)
        self.field.deltas.step(rates.field)
        self.forget()

    def forget(self) -> None:
        """Clear all gradients."""
        for leaf in self.leaves:
            leaf.grad = None

    @torch.no_grad()
    def _solve_colors(self, drawings: Sequence[Drawing], length: float) -> None:
        """Take a SIRT step on colours and slopes within the bounds of `mapping.optimiser.Optimiser`.
        The slopes' is half of the mapper's: with a relaxation of 0.9 that is within its bound at m = 2."""
        assert self.rows.grad is not None
        weight = torch.stack([drawing.contribution for drawing in drawings]).sum(0) + COLOR_DAMPING
        step = (length / weight)[:, None]
        color = columns.COLOR
        self.rows[:, color] -= (step * self.rows.grad[:, color]).nan_to_num(0, 0, 0)
        if self.slopes is not None:
            assert self.slopes.grad is not None
            spread = torch.stack([drawing.spread for drawing in drawings]).sum(0)
            wide = (spread / weight - 1).clamp(min=1)[:, None]
            self.slopes -= (step / (6 * wide) * self.slopes.grad).nan_to_num(0, 0, 0)

    def keep(self, kept: Bool) -> None:
        """Remove the Gaussians where `kept` [N] is False."""
        self._take(np.flatnonzero(kept), self.table[:0], np.zeros(0, np.int64))

    def append(self, rows: F32, parents: I64) -> None:
        """Add canonical Gaussians [M, 14]; all else they take from their parents, rows [M] of the model."""
        self._take(np.arange(len(self)), rows, parents)

    def arrange(self) -> None:
        """Order Gaussians by the cells of the field that they lie in, so that neighbours in the table use the
        same cells in the processor's cache."""
        hexplane = self.field.deltas.hexplane
        low, high = hexplane.box
        x, y, z = ((self.means - low) / (high - low) * hexplane.nodes[0]).astype(np.int64).T
        self._take(np.lexsort((z, x, y)), self.table[:0], np.zeros(0, np.int64))

    def _take(self, kept: I64, rows: F32, parents: I64) -> None:
        """Keep the Gaussians in `kept`, then append `rows`, with the slopes of their parents."""
        ids = np.arange(self.next_id, self.next_id + len(rows))
        self.ids, self.next_id = np.concatenate([self.ids[kept], ids]), self.next_id + len(rows)
        self.rows = self._leaf(np.concatenate([self.table[kept], rows]))
        if self.slopes is not None:
            self.slopes = self._leaf(self.slopes.detach().cpu().numpy()[np.concatenate([kept, parents])])
        known = torch.from_numpy(kept).to(self.device)
        self.adam = self.adam.rows(known).grown(len(rows))
        self.field.follow(self.means)

    def _leaf(self, values: F32) -> Tensor:
        return torch.from_numpy(np.array(values, np.float32)).to(self.device).requires_grad_()
