"""The deformation field on a GPU: HexPlane kernels, the decoder in torch, and Gaussians that follow nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel

from sags_node.engine.cuda.adam import AdamState, adam_step
from sags_node.engine.cuda.hexplane import HexPlane
from sags_node.engine.field.decoder_layout import named_weights, weights_in
from sags_node.engine.reference.decoder import decode
from sags_node.model import columns
from sags_node.model.cuda.nodes import Followers
from sags_node.model.cuda.skinning import skin
from sags_node.model.decoder import Decoder
from sags_node.model.field import Deltas, Field, FieldRates, NodeField

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from sags_node.engine import adam


class Loan:
    """Arrays of the host that are on a device for a while."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._lent: list[tuple[NDArray[np.generic], Tensor]] = []

    def take(self, array: NDArray[np.generic]) -> Tensor:
        """A copy on the device, to be changed."""
        tensor = self.copy(array)
        self._lent.append((array, tensor))
        return tensor

    def take_adam(self, state: adam.AdamState) -> AdamState:
        """What Adam remembers, likewise."""
        return AdamState(self.take(state.moments), self.take(state.shares))

    def copy(self, array: NDArray[np.generic]) -> Tensor:
        """A copy on the device, to be read."""
        return torch.tensor(array, device=self.device)

    def download(self) -> None:
        """Write what was taken into the host's arrays. Waits for the device."""
        for array, tensor in self._lent:
            torch.from_numpy(array).copy_(tensor)


class DeviceDeltas:
    """`model.field.Deltas`: HexPlane and decoder, whose parameters are on loan. The decoder is its readable
    twin: its matrix products are the device's own."""

    def __init__(self, deltas: Deltas, loan: Loan) -> None:
        hexplane, decoder = deltas.hexplane, deltas.decoder
        self._config = decoder.config
        self._locate = hexplane.locate
        self._hexplane = HexPlane(hexplane.grid, loan.device)
        self._cells, self._cells_adam = loan.take(hexplane.cells), loan.take_adam(hexplane.adam)
        self._values, self._values_adam = loan.take(decoder.values), loan.take_adam(deltas.adam)
        self._gradients = torch.zeros_like(self._values)
        self._weights = {
            name: view.detach().requires_grad_() for name, view in _named(self._values, decoder).items()
        }
        self._weight_gradients = _named(self._gradients, decoder)
        self._still = deltas.still
        self._units = loan.copy(deltas.units)

    def forward(self, points: Tensor, t_ns: int) -> Tensor:
        """[N, 14] of points [N, 3] m, differentiable in the features and the decoder's weights. As on the
        CPU, what is not finite in a row of features, or of the deltas' gradient, takes that row out."""
        features = self._hexplane.forward(self._cells, points, self._locate(t_ns))
        self._features = features.requires_grad_()
        usable = features.isfinite().all(dim=1, keepdim=True)
        # the other ways to attend add up atomically when they are differentiated
        with sdpa_kernel(SDPBackend.MATH):
            deltas = decode(
                self._weights,
                self._config.sizes,
                torch.where(usable, features, 0.0),
                self._config.tokens == "nodes",
            )
        deltas = torch.where(usable, deltas, 0.0)
        deltas.register_hook(_finite_rows)  # type: ignore[no-untyped-call]  # torch's own
        return deltas * self._units

    def backward(self, deformed: Tensor, rows: Tensor, v_deformed: Tensor) -> tuple[Tensor, Tensor]:
        """From the gradient by what was made of the last deltas and of `rows`: that by the rows, and by the
        points [N, 3]. Those of the parameters are kept for `step`."""
        inputs = [rows, self._features, *self._weights.values()]
        v_rows, v_features, *v_weights = torch.autograd.grad(deformed, inputs, v_deformed)
        for name, v_weight in zip(self._weights, v_weights, strict=True):
            if name not in self._still:
                self._weight_gradients[name].copy_(v_weight)
        self._found = self._hexplane.backward(v_features.contiguous())
        return v_rows, self._found.v_points

    def step(self, rates: FieldRates) -> None:
        """As `Deltas.step`."""
        decoder_rates = torch.full_like(self._values, rates.decoder)
        adam_step(self._values[None], self._gradients[None], self._values_adam, decoder_rates)
        cell_rates = torch.full_like(self._cells[0], rates.cells)
        adam_step(self._cells, self._found.v_cells, self._cells_adam, cell_rates, taken=self._found.touched)


def _named(values: Tensor, decoder: Decoder) -> dict[str, Tensor]:
    """Views of the decoder's parameters, or gradients, in one tensor [P]."""
    named: dict[str, Tensor] = named_weights(  # type: ignore[assignment]  # of views into a tensor
        weights_in(values, decoder.config.sizes), decoder.config.tokens != "self"
    )
    return named


def _finite_rows(gradient: Tensor) -> Tensor:
    return torch.where(gradient.isfinite().all(dim=1, keepdim=True), gradient, 0.0)


class DeviceField:
    """`model.field.Field` of tensors. Who follows which node is the host's to say, before the loan."""

    def __init__(self, field: Field, loan: Loan) -> None:
        self._deltas = DeviceDeltas(field.deltas, loan)
        self._nodes: Tensor | None = None
        if isinstance(field, NodeField):
            self._nodes = loan.copy(field.nodes)
            self._index, self._weight = loan.copy(field.index), loan.copy(field.weight)
            self._followers = Followers.of(self._index, self._weight, len(self._nodes))

    def pick(self, picked: Tensor) -> None:
        """Deform only these [P] of the Gaussians from now on."""
        if self._nodes is not None:
            index, weight = self._index[picked], self._weight[picked]
            self._followers = Followers.of(index, weight, len(self._nodes))

    def deform(self, rows: Tensor, t_ns: int) -> Tensor:
        """Canonical rows [N, 14] at one time, in a fresh tensor."""
        self._rows = rows.detach().requires_grad_()
        if self._nodes is None:
            points = rows[:, columns.MEAN].contiguous()
            self._deformed = self._rows + self._deltas.forward(points, t_ns)
        else:
            deltas = self._deltas.forward(self._nodes, t_ns)
            self._deformed = skin(self._rows, self._nodes, deltas, self._followers)
        return self._deformed.detach().clone()

    def backward(self, v_deformed: Tensor) -> Tensor:
        """Gradient [N, 14] by the canonical rows of the last `deform`, which must be unchanged."""
        v_rows, v_points = self._deltas.backward(self._deformed, self._rows, v_deformed)
        if self._nodes is None:
            v_rows = v_rows.clone()
            v_rows[:, columns.MEAN] += v_points
        return v_rows

    def step(self, rates: FieldRates) -> None:
        """Move the field's parameters against the gradients of the last `backward`."""
        self._deltas.step(rates)
