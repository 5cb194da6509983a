"""What one iteration does to a model."""

from __future__ import annotations

import numpy as np

from sags_node.engine.losses.photometric import PhotometricLoss
from sags_node.engine.losses.tissue import tissue_loss
from sags_node.engine.rasterizer.rasterize import Rasterizer
from sags_node.fitting.clip import ClipFrame
from sags_node.fitting.density import Density
from sags_node.fitting.paths import Paths
from sags_node.fitting.settings import FitSettings
from sags_node.mapping.refiner import DEPTH_SCALE, DEPTH_WEIGHT
from sags_node.model import columns
from sags_node.model.deformable import DeformableModel
from sags_node.model.field import Field, FieldRates
from sags_node.types import F32, I64, Bool


class Learner:
    """Improves a model, frame by frame, or a field, path by path.

    Attributes:
        residual: mean absolute colour residual before the last step on a frame.
    """

    def __init__(self, rasterizer: Rasterizer, settings: FitSettings, unseen: Bool) -> None:
        """
        Args:
            rasterizer: for pictures of the size of `unseen`.
            unseen: [H, W] pixels that no frame shows: where smoothness applies.
        """
        height, width = unseen.shape
        self.residual = 0.0
        self._rasterizer = rasterizer
        self._loss = PhotometricLoss(width, height, settings.weights)
        self._unseen = unseen
        self._v_planes = np.zeros((5, height, width), np.float32)
        self._weight = np.zeros((height, width), np.float32)

    def begin(self, model: DeformableModel, density: Density) -> None:
        """What is to be learnt from now on, and what collects the gradients of the Gaussians."""
        self._model, self._density = model, density

    def descend(
        self, frame: ClipFrame, rates: F32, field_rates: FieldRates, exposure_rate: float, deformed: bool
    ) -> None:
        """A step of the paper's schedule: everything, against its loss. See `DeformableModel.descend`.

        Args:
            frame: whose picture is to be shown.
            rates: [14] learning rates of the canonical rows.
            field_rates: of the field.
            exposure_rate: of the gains.
            deformed: False leaves the field out.
        """
        observation = frame.observation()
        gaussians = self._model.at(frame.t_capture_ns, [frame.camera], deformed)
        planes = self._rasterizer.forward(gaussians, frame.camera)
        self.residual = self._loss.evaluate(
            planes, observation.image, frame.tissue, frame.depth, self._v_planes, self._weight,
            self._unseen,
        ).color  # fmt: skip
        gradients = self._rasterizer.backward(self._v_planes, self._weight)
        self._model.descend(gradients, rates, field_rates, exposure_rate)
        self._density.observe(gradients)

    def refine(self, frame: ClipFrame, rates: F32, relaxation: float, field_rates: FieldRates) -> None:
        """A step of the joint refinement after the online pass: residuals and field, against squared colour
        residuals. See `DeformableModel.refine`."""
        observation = frame.observation()
        gaussians = self._model.at(frame.t_capture_ns, [frame.camera])
        planes = self._rasterizer.forward(gaussians, frame.camera)
        self.residual = tissue_loss(
            planes, observation.image, frame.tissue, frame.depth, self._v_planes, self._weight,
            DEPTH_WEIGHT, DEPTH_SCALE,
        )  # fmt: skip
        gradients = self._rasterizer.backward(self._v_planes, self._weight)
        self._model.refine(gradients, rates, relaxation, field_rates)

    def begin_paths(self, field: Field, rows: F32, paths: Paths) -> None:
        """The field, before there is a model, is to lead canonical rows [N, 14] along these paths."""
        self._field, self._rows, self._paths = field, rows, paths

    def learn_paths(self, slot: int, picked: I64, rates: FieldRates) -> None:
        """A step of the field against the mean absolute errors of the positions of some Gaussians, `picked`
        [P], at one of the paths' times."""
        field, paths = self._field, self._paths
        canonical = self._rows[picked]
        field.follow(canonical[:, columns.MEAN])
        deformed = field.deform(canonical, int(paths.times_ns[slot]))
        off = deformed - paths.states[slot, picked]
        v_deformed = np.zeros_like(deformed)
        v_deformed[:, columns.MEAN] = np.sign(off[:, columns.MEAN]) / np.float32(len(picked))
        field.backward(v_deformed)
        field.step(rates)
