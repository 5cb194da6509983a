"""The SAGS model: canonical Gaussians, the field that deforms them, and the exposure they are seen with.

Beyond SAGS a Gaussian may have residuals of its own (`residuals`), added to what the field makes of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sags_node.engine.adam import AdamState, adam_step
from sags_node.engine.interface import Gradients
from sags_node.model import columns
from sags_node.model.activation import activate, activate_backward
from sags_node.model.alias_free import smoothing_variances
from sags_node.model.exposure import Exposure
from sags_node.model.field import Field, FieldRates
from sags_node.model.residuals import COLOR_DAMPING, Residuals, Steps
from sags_node.types import F32, I64, Bool, Camera, Gaussians

BETAS = (0.9, 0.999)
LOOK_BACK_NS = 200_000_000  # a prediction's velocity is the mean over this time
FADE_NS = 150_000_000  # in which it falls to 1/e


class DeformableModel:
    """Canonical Gaussians in rows (`columns`) with their optimiser, and a field. Not for two threads."""

    def __init__(
        self,
        rows: F32,
        field: Field,
        exposure: Exposure,
        smooth: bool = True,
        residuals: Residuals | None = None,
        slopes: F32 | None = None,
    ) -> None:
        """
        Args:
            rows: [N, 14] canonical.
            field: deforms them.
            exposure: scales their colours.
            smooth: whether the 3D filter is on.
            residuals: of these Gaussians.
            slopes: [N, 3] of the luminance, see `types.Gaussians`; they turn with the Gaussian, and neither
                field nor residuals change them. None: every Gaussian has one colour.
        """
        self.rows = np.ascontiguousarray(rows, np.float32)
        self.ids: I64 = np.arange(len(rows))
        self.field = field
        self.exposure = exposure
        self.residuals = residuals
        self.slopes = slopes
        self.smooth = smooth
        self.next_id = len(rows)
        self.adam = AdamState.new(*self.rows.shape)
        field.follow(self.rows[:, columns.MEAN])

    def __len__(self) -> int:
        return len(self.rows)

    def at(self, t_ns: int, cameras: Sequence[Camera], deformed: bool = True) -> Gaussians:
        """The Gaussians at one time.

        Args:
            t_ns: the time.
            cameras: those it was fitted to, for the 3D filter.
            deformed: False leaves the field out.
        """
        self._t_ns, self._deformed = t_ns, deformed
        rows = self._rows_at(t_ns) if deformed else self.rows.copy()
        return self._finished(rows, t_ns, cameras)

    def between(self, t_ns: int, before_ns: int, after_ns: int, cameras: Sequence[Camera]) -> Gaussians:
        """The Gaussians at a time between two that were learnt, on straight lines from the one to the other:
        in between the field was given nothing to learn.

        Args:
            t_ns: the time.
            before_ns, after_ns: the times learnt around it.
            cameras: those it was fitted to, for the 3D filter.
        """
        share = np.float32((t_ns - before_ns) / (after_ns - before_ns))
        before, after = self._rows_at(before_ns), self._rows_at(after_ns)
        return self._finished(before + share * (after - before), t_ns, cameras)

    def predict(self, t_ns: int, last_ns: int, cameras: Sequence[Camera]) -> Gaussians:
        """The Gaussians at a time after all that was learnt.

        They go on as the field moved them just before, slower and slower; all else stays as it was last.
        What single Gaussians did beyond the field is no guide: it added nothing where it was tried.

        Args:
            t_ns: the time.
            last_ns: the last time that was learnt, before `t_ns`.
            cameras: those it was fitted to, for the 3D filter.
        """
        before = self.field.deform(self.rows, last_ns - LOOK_BACK_NS)[:, columns.MEAN]
        rows = self.field.deform(self.rows, last_ns)
        velocity = (rows[:, columns.MEAN] - before) / np.float32(LOOK_BACK_NS)
        if self.residuals is not None:
            rows += self.residuals.at(last_ns)
        ahead = FADE_NS * -math.expm1((last_ns - t_ns) / FADE_NS)
        rows[:, columns.MEAN] += np.float32(ahead) * velocity
        return self._finished(rows, last_ns, cameras)

    def _rows_at(self, t_ns: int) -> F32:
        rows = self.field.deform(self.rows, t_ns)
        if self.residuals is not None:
            rows += self.residuals.at(t_ns)
        return rows

    def _finished(self, rows: F32, t_ns: int, cameras: Sequence[Camera]) -> Gaussians:
        """As they are drawn: with the exposure of a time, and filtered."""
        self._plain = rows[:, columns.COLOR].copy()
        self._gain = self.exposure.at(t_ns)
        rows[:, columns.COLOR] *= self._gain
        means = np.ascontiguousarray(rows[:, columns.MEAN])
        smoothing = smoothing_variances(means, cameras) if self.smooth else None
        self._drawn = activate(rows, self.ids, smoothing)
        if self.slopes is not None:
            self._drawn = replace(self._drawn, slopes=self.slopes * self._gain.mean())
        return self._drawn

    def descend(
        self, gradients: Gradients, rates: F32, field_rates: FieldRates, exposure_rate: float
    ) -> None:
        """One step of Adam on everything but residuals, against the gradients of what `at` gave last.

        Args:
            gradients: of the loss by those Gaussians.
            rates: [14] learning rates of the canonical rows.
            field_rates: of the field.
            exposure_rate: of the gains.
        """
        v_rows = activate_backward(self._drawn, gradients)
        self.exposure.descend(self._t_ns, (v_rows[:, columns.COLOR] * self._plain).sum(axis=0), exposure_rate)
        v_rows[:, columns.COLOR] *= self._gain
        seen = np.flatnonzero(gradients.contribution > 0)
        if self._deformed:
            v_rows = self.field.backward(v_rows)
            self.field.step(field_rates)
        adam_step(self.rows, v_rows, self.adam, rates, rows=seen, betas=BETAS)

    def refine(self, gradients: Gradients, rates: F32, relaxation: float, field_rates: FieldRates) -> None:
        """One step on residuals, slopes and field, against the gradients of what `at` gave last.

        Args:
            gradients: of half the squared colour residuals, weighted for SIRT, by those Gaussians.
            rates: [14] lengths of the residuals' steps; none for colours.
            relaxation: of the step on colours; on slopes it is half as much (`mapping.optimiser.Optimiser`).
            field_rates: of the field. It is not moved by colours: those are the residuals'.

        Raises:
            ValueError: the model has no residuals.
        """
        if self.residuals is None:
            raise ValueError("a model without residuals cannot be refined")
        v_rows = activate_backward(self._drawn, gradients)
        v_rows[:, columns.COLOR] = 0
        steps = Steps(rates, np.float32(relaxation) / self._gain)
        self.residuals.refine(self._t_ns, v_rows, gradients.colors, gradients.contribution, steps)
        if self.slopes is not None:
            seen = gradients.contribution + COLOR_DAMPING
            wide = np.maximum(gradients.spread / seen - 1, 1)
            length = relaxation / (6 * self._gain.mean() * wide * seen)
            self.slopes -= length.astype(np.float32)[:, None] * gradients.slopes
        self.field.backward(v_rows)
        self.field.step(field_rates)

    def keep(self, kept: Bool) -> None:
        """Remove the Gaussians where `kept` [N] is False."""
        if self.residuals is not None:
            self.residuals.keep(kept)
        if self.slopes is not None:
            self.slopes = self.slopes[kept]
        self._replace(self.rows[kept], self.ids[kept], self.adam.moments[kept], self.adam.shares[kept])

    def append(self, rows: F32, parents: I64) -> None:
        """Add Gaussians [M, 14], canonical, that otherwise do as their parents, rows [M] of the model."""
        if self.residuals is not None:
            self.residuals.append(parents)
        if self.slopes is not None:
            self.slopes = np.concatenate([self.slopes, self.slopes[parents]])
        new = AdamState.new(*rows.shape)
        ids = np.arange(self.next_id, self.next_id + len(rows))
        self.next_id += len(rows)
        self._replace(
            np.concatenate([self.rows, rows]),
            np.concatenate([self.ids, ids]),
            np.concatenate([self.adam.moments, new.moments]),
            np.concatenate([self.adam.shares, new.shares]),
        )

    def _replace(self, rows: F32, ids: I64, moments: F32, shares: F32) -> None:
        self.rows, self.ids, self.adam = rows, ids, AdamState(moments, shares)
        self.field.follow(rows[:, columns.MEAN])
