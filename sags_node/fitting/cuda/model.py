"""The deformable model on a GPU: what `model.deformable` and `model.residuals` do, on tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.nn.functional import pad

from sags_node.engine.cuda.adam import adam_step
from sags_node.engine.cuda.scene import DeviceGaussians, DeviceGradients
from sags_node.engine.pinhole import pack
from sags_node.fitting.cuda.field import DeviceField, Loan
from sags_node.model import columns, deformable, residuals
from sags_node.model.alias_free import FILTER_VARIANCE, VIEW_MARGIN
from sags_node.model.deformable import DeformableModel
from sags_node.model.exposure import Exposure
from sags_node.model.field import FieldRates
from sags_node.model.residuals import Residuals, slots_around
from sags_node.types import F32, Camera

if TYPE_CHECKING:
    from torch import Tensor


class DeviceModel:
    """`model.deformable.DeformableModel`, on loan. Nothing is read back to the host."""

    def __init__(self, model: DeformableModel, loan: Loan) -> None:
        self._loan = loan
        self._rows, self._adam = loan.take(model.rows), loan.take_adam(model.adam)
        self._field = DeviceField(model.field, loan)
        self._exposure = DeviceExposure(model.exposure, loan)
        self._residuals = None if model.residuals is None else DeviceResiduals(model.residuals, loan)
        self._smooth = model.smooth

    def at(self, t_ns: int, camera: Camera, deformed: bool = True) -> DeviceGaussians:
        """The Gaussians at one time, as `DeformableModel.at` has them."""
        self._t_ns, self._deformed = t_ns, deformed
        rows = self._field.deform(self._rows, t_ns) if deformed else self._rows.clone()
        if deformed and self._residuals is not None:
            rows += self._residuals.at(t_ns)
        self._plain = rows[:, columns.COLOR].clone()
        self._gain = self._exposure.at(t_ns)
        means = rows[:, columns.MEAN].contiguous()
        self._drawn = DeviceGaussians(
            means=means,
            quats=rows[:, columns.QUAT].contiguous(),
            scales=rows[:, columns.LOG_SCALE].exp(),
            opacities=rows[:, columns.LOGIT].sigmoid(),
            colors=self._plain * self._gain,
            smoothing=smoothing_variances(means, camera) if self._smooth else None,
        )
        return self._drawn

    def descend(
        self, gradients: DeviceGradients, rates: F32, field_rates: FieldRates, exposure_rate: float
    ) -> None:
        """As `DeformableModel.descend`. All gradients are found before anything moves: where that takes too
        much memory, the model is as it was."""
        v_rows = self._by_rows(gradients)
        v_gain = (v_rows[:, columns.COLOR] * self._plain).sum(dim=0)
        v_rows[:, columns.COLOR] *= self._gain
        if self._deformed:
            v_rows = self._field.backward(v_rows)
            self._field.step(field_rates)
        self._exposure.descend(self._t_ns, v_gain, exposure_rate)
        seen = gradients.contribution > 0
        adam_step(self._rows, v_rows, self._adam, self._loan.copy(rates), taken=seen, betas=deformable.BETAS)

    def refine(
        self, gradients: DeviceGradients, rates: F32, relaxation: float, field_rates: FieldRates
    ) -> None:
        """As `DeformableModel.refine`; of memory, as `descend`."""
        if self._residuals is None:
            raise ValueError("a model without residuals cannot be refined")
        v_rows = self._by_rows(gradients)
        v_rows[:, columns.COLOR] = 0
        self._field.backward(v_rows)
        self._field.step(field_rates)
        steps = self._loan.copy(rates), relaxation / self._gain
        self._residuals.refine(self._t_ns, v_rows, gradients.colors, gradients.contribution, *steps)

    def _by_rows(self, gradients: DeviceGradients) -> Tensor:
        """Gradient [N, 14] by the raw rows that were drawn last."""
        v_rows = torch.empty_like(self._rows)
        opacities = self._drawn.opacities
        v_rows[:, columns.MEAN] = gradients.means
        v_rows[:, columns.LOG_SCALE] = gradients.scales * self._drawn.scales
        v_rows[:, columns.QUAT] = gradients.quats
        v_rows[:, columns.COLOR] = gradients.colors
        v_rows[:, columns.LOGIT] = gradients.opacities * opacities * (1 - opacities)
        return v_rows


class DeviceExposure:
    """`model.exposure.Exposure`: gains on loan."""

    def __init__(self, exposure: Exposure, loan: Loan) -> None:
        self._times_ns = exposure.times_ns
        self._gains, self._adam = loan.take(exposure.gains), loan.take_adam(exposure.adam)

    def at(self, t_ns: int) -> Tensor:
        """Gain [3] at one time."""
        return _blend(self._gains, slots_around(self._times_ns, t_ns))

    def descend(self, t_ns: int, v_gain: Tensor, rate: float) -> None:
        """One step on the gain of the frame nearest in time, against its gradient [3]."""
        nearest = int(np.abs(self._times_ns - t_ns).argmin())
        row = slice(nearest, nearest + 1)
        adam_step(self._gains[row], v_gain[None], self._adam.rows(row), torch.full_like(v_gain, rate))


class DeviceResiduals:
    """`model.residuals.Residuals`: values [K, N, 14] on loan."""

    def __init__(self, given: Residuals, loan: Loan) -> None:
        self._times_ns = given.times_ns
        self._values = loan.take(given.values)
        self._adam = [loan.take_adam(state) for state in given.adam]

    def at(self, t_ns: int) -> Tensor:
        """Deltas [N, 14] at one time."""
        return _blend(self._values, slots_around(self._times_ns, t_ns))

    def refine(
        self,
        t_ns: int,
        v_rows: Tensor,
        v_colors: Tensor,
        contribution: Tensor,
        geometry: Tensor,
        relaxation: Tensor,
    ) -> None:
        """As `Residuals.refine`: steps of length `geometry` [14], and on the colours `relaxation` [3]."""
        seen = contribution > residuals.LEAST_CONTRIBUTION
        colors = v_colors * (relaxation / (contribution[:, None] + residuals.COLOR_DAMPING))
        colors = torch.where(seen[:, None], colors, 0.0)  # what is not seen may be anything
        parts = slots_around(self._times_ns, t_ns)
        norm = sum(share * share for _, share in parts)
        for slot, share in parts:
            values = self._values[slot]
            adam_step(
                values, v_rows * share, self._adam[slot], geometry, taken=seen,
                betas=residuals.BETAS, eps=residuals.EPS,
            )  # fmt: skip
            # the smallest change of both slots whose blend is the step
            values[:, columns.COLOR] -= share / norm * colors


def _blend(values: Tensor, parts: list[tuple[int, float]]) -> Tensor:
    """The weighted sum of some of values [K, ...]."""
    (slot, share), *rest = parts
    total = share * values[slot]
    for slot, share in rest:
        total += share * values[slot]
    return total


def smoothing_variances(means: Tensor, camera: Camera) -> Tensor:
    """As `model.alias_free.smoothing_variances`, [N] m^2, of means [N, 3] m and one camera."""
    view = pack(camera).tolist()
    x, y, z = (
        view[k] * means[:, 0] + view[k + 1] * means[:, 1] + view[k + 2] * means[:, 2] + view[k + 3]
        for k in (0, 4, 8)
    )
    fx, fy, cx, cy = view[12:]
    u, v = fx * x / z + cx, fy * y / z + cy
    margin_x, margin_y = VIEW_MARGIN * camera.width, VIEW_MARGIN * camera.height
    seen = (z > 0) & (u >= -margin_x) & (u < camera.width + margin_x)
    seen &= (v >= -margin_y) & (v < camera.height + margin_y)
    intervals = torch.where(seen, z / max(fx, fy), 0.0)
    largest = pad(intervals, (0, 1)).amax()  # padded: there may be no Gaussian
    intervals = torch.where(seen, intervals, largest)
    return FILTER_VARIANCE * intervals * intervals
