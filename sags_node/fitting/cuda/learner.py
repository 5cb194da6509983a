"""The learner on a GPU. The model goes up once and stays until the host wants it: for density control, a
checkpoint, a measurement. A step copies nothing but learning rates and, where not all frames have room there,
its frame; and it waits once, for the number of pairs that its drawing sorts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from sags_node.engine.cuda.backend import default_device
from sags_node.engine.cuda.losses import tissue_loss
from sags_node.engine.cuda.photometric import PhotometricLoss
from sags_node.engine.cuda.rasterizer import CudaRasterizer
from sags_node.engine.cuda.scene import DeviceGradients
from sags_node.engine.losses.pieces import LEVEL
from sags_node.engine.rasterizer.rasterize import as_pinhole
from sags_node.fitting.clip import ClipFrame
from sags_node.fitting.cuda.field import DeviceField, Loan
from sags_node.fitting.cuda.model import DeviceModel
from sags_node.fitting.density import Density
from sags_node.fitting.learner import DeviceKind
from sags_node.fitting.paths import Paths
from sags_node.fitting.settings import FitSettings
from sags_node.mapping.refiner import DEPTH_SCALE, DEPTH_WEIGHT
from sags_node.model import columns
from sags_node.model.deformable import DeformableModel
from sags_node.model.field import Field, FieldRates
from sags_node.types import F32, I64, Bool

if TYPE_CHECKING:
    from torch import Tensor


FRAMES_BYTES = 1 << 30  # of frames that stay on the GPU: 400 of 640x512


class CudaLearner:
    """`learner.Learner` on the current GPU, or on the CPU under Triton's interpreter."""

    device: DeviceKind = "cuda"
    problem: str | None = None

    def __init__(self, settings: FitSettings, unseen: Bool) -> None:
        """Of a fit for pictures of the size of `unseen` [H, W]: the pixels that no frame shows."""
        height, width = unseen.shape
        device = self._device = default_device()
        self._rasterizer = CudaRasterizer(width, height, settings.antialias, device)
        self._loss = PhotometricLoss(width, height, settings.weights, device)
        self._unseen = torch.tensor(unseen, device=device)
        self._v_planes = torch.zeros((5, height, width), device=device)
        self._weight = torch.zeros((height, width), device=device)
        self._residual = torch.zeros((), device=device)
        self._frames = _Frames(device)
        self._loan: Loan | None = None  # there is one while the model, or the field, is on the device

    @property
    def residual(self) -> float:
        return float(self._residual)

    def begin(self, model: DeformableModel, density: Density) -> None:
        self.download()
        self._host, self._density = model, density

    def descend(
        self, frame: ClipFrame, rates: F32, field_rates: FieldRates, exposure_rate: float, deformed: bool
    ) -> None:
        self._borrow_model()
        there = self._frames.of(frame)
        planes = self._draw(frame, deformed)
        self._loss.evaluate(
            planes, there.colors(), there.tissue, there.depth, self._v_planes, self._weight,
            self._unseen,
        )  # fmt: skip
        self._residual = self._loss.color
        gradients = self._pull_back()
        self._model.descend(gradients, rates, field_rates, exposure_rate)
        self._pull += torch.linalg.vector_norm(gradients.means, dim=1)
        self._seen += gradients.contribution > 0

    def refine(self, frame: ClipFrame, rates: F32, relaxation: float, field_rates: FieldRates) -> None:
        self._borrow_model()
        there = self._frames.of(frame)
        planes = self._draw(frame, True)
        self._residual = tissue_loss(
            planes, there.colors(), there.tissue, there.depth, self._v_planes, self._weight,
            DEPTH_WEIGHT, DEPTH_SCALE,
        )  # fmt: skip
        self._model.refine(self._pull_back(), rates, relaxation, field_rates)

    def begin_paths(self, field: Field, rows: F32, paths: Paths) -> None:
        self.download()
        field.follow(rows[:, columns.MEAN])
        self._field_host, self._paths_host = field, (rows, paths)

    def learn_paths(self, slot: int, picked: I64, rates: FieldRates) -> None:
        self._borrow_field()
        chosen = torch.tensor(picked, device=self._device)
        self._field.pick(chosen)
        canonical = self._canonical[chosen]
        deformed = self._field.deform(canonical, int(self._times_ns[slot]))
        off = deformed[:, columns.MEAN] - self._places[slot, chosen]
        v_deformed = torch.zeros_like(deformed)
        v_deformed[:, columns.MEAN] = off.sign() / len(chosen)
        self._field.backward(v_deformed)
        self._field.step(rates)

    def download(self) -> None:
        if self._loan is not None:
            self._loan.download()
            self._loan = None

    def _borrow_model(self) -> None:
        if self._loan is None:
            loan = Loan(self._device)
            self._model = DeviceModel(self._host, loan)
            self._pull, self._seen = loan.take(self._density.pull), loan.take(self._density.seen)
            self._loan = loan  # now all of it is here

    def _borrow_field(self) -> None:
        if self._loan is None:
            loan, (rows, paths) = Loan(self._device), self._paths_host
            self._field = DeviceField(self._field_host, loan)
            self._canonical, self._times_ns = loan.copy(rows), paths.times_ns
            self._places = loan.copy(paths.states[..., columns.MEAN])
            self._loan = loan

    def _draw(self, frame: ClipFrame, deformed: bool) -> Tensor:
        """Planes [5, H, W] of the model at the frame's time."""
        gaussians = self._model.at(frame.t_capture_ns, frame.camera, deformed)
        return self._rasterizer.draw(gaussians, as_pinhole(frame.camera))

    def _pull_back(self) -> DeviceGradients:
        return self._rasterizer.backward_pass(self._v_planes, self._weight)


@dataclass(frozen=True, slots=True)
class _DeviceFrame:
    """A `ClipFrame` on the device, 8 bytes a pixel."""

    image: Tensor  # [H, W, 3] uint8 RGB
    tissue: Tensor  # [H, W] bool
    depth: Tensor  # [H, W] m

    def colors(self) -> Tensor:
        """RGB 0..1."""
        return self.image.float() * float(LEVEL)


class _Frames:
    """Frames on the device: those that come first stay, as far as there is room."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._room = FRAMES_BYTES
        self._kept: dict[int, _DeviceFrame] = {}

    def of(self, frame: ClipFrame) -> _DeviceFrame:
        found = self._kept.get(frame.frame_id)
        if found is None:
            arrays = frame.image, frame.tissue, frame.depth
            found = _DeviceFrame(*(torch.tensor(array, device=self._device) for array in arrays))
            size = sum(array.nbytes for array in arrays)
            if size <= self._room:
                self._kept[frame.frame_id] = found
                self._room -= size
        return found
