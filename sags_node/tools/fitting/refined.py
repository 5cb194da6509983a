"""The model after an online start: the field, plus residuals of single Gaussians."""

import numpy as np
import torch
from torch import Tensor

from sags_node.engine.rasterizer.rasterize import Rasterizer
from sags_node.field.deformation import Field, FieldRates
from sags_node.field.drawing import Drawing
from sags_node.field.model import DeformableModel
from sags_node.model import columns
from sags_node.model.exposure import Exposure
from sags_node.tools.fitting.residuals import COLOR_DAMPING, Residuals, Steps
from sags_node.types import F32, Camera


class RefinedModel(DeformableModel):
    """A deformable model with residuals and slopes, which are refined together with the field."""

    def __init__(
        self, rows: F32, field: Field, exposure: Exposure, smooth: bool, slopes: F32, residuals: Residuals
    ) -> None:
        """See `DeformableModel`; `residuals` are of these Gaussians."""
        super().__init__(rows, field, exposure, smooth, slopes)
        self.residuals = residuals

    def rows_at(self, t_ns: int, deformed: bool = True) -> Tensor:
        return super().rows_at(t_ns, deformed) + torch.from_numpy(self.residuals.at(t_ns))

    def draw_to_refine(self, rasterizer: Rasterizer, t_ns: int, camera: Camera) -> Drawing:
        """Draw the model at one time, for `refine`. Colour gradients go to the residuals, not the field."""
        self._t_ns = t_ns
        self._own = torch.from_numpy(self.residuals.at(t_ns)).requires_grad_()
        rows = self.field.deform(self.rows.detach(), t_ns)
        color = columns.COLOR
        still = torch.cat([rows[:, : color.start], rows[:, color].detach(), rows[:, color.stop :]], 1)
        return self._drawn(rasterizer, still + self._own, t_ns, camera)

    def refine(self, drawing: Drawing, rates: F32, relaxation: float, field_rates: FieldRates) -> None:
        """Do one step on residuals, slopes and field, down the gradients of the drawing's loss: half the
        squared colour residuals, weighted for SIRT.

        Args:
            drawing: of `draw_to_refine`.
            rates: [14] lengths of the residuals' steps; 0 for colours.
            relaxation: of the step on colours; on slopes it is half as much (`mapping.optimiser.Optimiser`).
            field_rates: of the field.
        """
        assert self._own.grad is not None and self.slopes is not None and self.slopes.grad is not None
        gain: F32 = self.exposure.at(self._t_ns)
        v_rows: F32 = self._own.grad.numpy()
        v_colors: F32 = v_rows[:, columns.COLOR] / gain
        v_rows[:, columns.COLOR] = 0
        contribution: F32 = drawing.contribution.numpy()
        steps = Steps(rates, (relaxation / gain).astype(np.float32))
        self.residuals.refine(self._t_ns, v_rows, v_colors, contribution, steps)
        seen = contribution + COLOR_DAMPING
        wide = np.maximum(drawing.spread.numpy() / seen - 1, 1)
        length = relaxation / (6 * gain.mean() ** 2 * wide * seen)
        self.slopes.detach().numpy()[:] -= length.astype(np.float32)[:, None] * self.slopes.grad.numpy()
        self.slopes.grad = None
        self.field.deltas.step(field_rates)
