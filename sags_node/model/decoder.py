"""The self-adaptive deformation decoder as a model: its parameters, and what its tokens are.

Features of the space-time field become changes of the Gaussians' raw parameters (SAGS, arXiv 2510.27318; the
formulas stand in `engine.field.decoder_block`). There are three choices of tokens for its attention:

- `self`: a Gaussian is a sequence of length one, as in the authors' code. Softmax over one key is 1, so the
  attention is a value layer times an output layer, folded into one matrix. It has no queries and keys.
- `planes`: a Gaussian's own levels (or planes) of features are its tokens.
- `nodes`: control nodes are decoded, and every node attends to all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sags_node.engine.field.decoder import NodeDecoder, PointDecoder
from sags_node.engine.field.decoder_block import (
    ATTENTION_BIAS,
    ATTENTION_WEIGHT,
    VALUE_BIAS,
    VALUE_WEIGHT,
    Weights,
)
from sags_node.engine.field.decoder_layout import Sizes, flat_weights, named_weights
from sags_node.errors import UsageError
from sags_node.types import F32

TOKEN_CHOICES = ("self", "planes", "nodes")
MAX_TOKENS = 12  # per Gaussian
MAX_NODES = 1024
MAX_SIZE = 1024  # of features and width; far beyond what a frame leaves time for
INITIAL_GATE = 1e-4


@dataclass(frozen=True, slots=True)
class DecoderConfig:
    """How a decoder is built.

    Raises:
        UsageError: the sizes do not fit each other.
    """

    tokens: str = "self"  # one of TOKEN_CHOICES
    features: int = 64  # F per Gaussian or node
    levels: int = 1  # T tokens that F is cut into; only with tokens = planes
    width: int = 32
    heads: int = 4  # of the attention
    sh_coefficients: int = 1  # K of the colour, 1, 4, 9 or 16

    def __post_init__(self) -> None:
        wrong = ""
        if self.tokens not in TOKEN_CHOICES:
            wrong = f"tokens is {self.tokens!r}; use one of {', '.join(TOKEN_CHOICES)}"
        elif not (1 <= self.features <= MAX_SIZE and 1 <= self.width <= MAX_SIZE):
            wrong = f"features ({self.features}) and width ({self.width}) must be from 1 to {MAX_SIZE}"
        elif self.levels != 1 and self.tokens != "planes":
            wrong = f"levels is {self.levels}, but only tokens = planes has more than 1"
        elif not 1 <= self.levels <= MAX_TOKENS or self.features % self.levels:
            wrong = (
                f"levels ({self.levels}) must divide features ({self.features}) and be at most {MAX_TOKENS}"
            )
        elif not 1 <= self.heads <= self.width or self.width % self.heads:
            wrong = f"heads ({self.heads}) must divide width ({self.width})"
        elif self.sh_coefficients not in {1, 4, 9, 16}:
            wrong = f"sh_coefficients is {self.sh_coefficients}; use 1, 4, 9 or 16"
        if wrong:
            raise UsageError(f"deformation decoder: {wrong}")

    @property
    def sizes(self) -> Sizes:
        return Sizes(
            tokens=self.levels,
            channels=self.features // self.levels,
            width=self.width,
            attention_heads=0 if self.tokens == "self" else self.heads,
            deltas=(3, 3, 4, 3 * self.sh_coefficients, 1),
        )

    @property
    def columns(self) -> dict[str, slice]:
        """Where in a row of deltas the change of each raw parameter stands."""
        names = ("means", "log_scales", "quats", "colors", "opacity_logits")
        stops = np.cumsum(self.sizes.deltas).tolist()
        return {name: slice(a, b) for name, a, b in zip(names, [0, *stops[:-1]], stops, strict=True)}


class Decoder:
    """The trainable decoder: features [N, F] to deltas [N, D], and back.

    `values` holds all parameters in one array [P], and `gradients` what `backward` found for them, so that
    one optimiser step moves all; `parameters` and `parameter_gradients` are views into them by name.
    Not for use by two threads at once.
    """

    def __init__(
        self, config: DecoderConfig, seed: int = 0, gate: float = INITIAL_GATE, xavier: bool = False
    ) -> None:
        """Xavier-uniform weights from `seed`, biases 0.

        Args:
            config: how it is built.
            seed: of the weights.
            gate: of the block's attention and MLP.
            xavier: False: last layers are 0 instead, so that all deltas are.
        """
        self.config = config
        self.columns = config.columns
        attends = config.tokens != "self"
        self.values, self._weights = flat_weights(config.sizes)
        self.gradients, self._weight_gradients = flat_weights(config.sizes)
        self.parameters = named_weights(self._weights, attends)
        self.parameter_gradients = named_weights(self._weight_gradients, attends)
        self._decoded: F32 = np.zeros((0, sum(config.sizes.deltas)), np.float32)
        self._engine = (NodeDecoder if config.tokens == "nodes" else PointDecoder)(config.sizes)
        self._initialise(np.random.default_rng(seed), gate, xavier)

    def forward(self, features: F32) -> F32:
        """Decode.

        Args:
            features: [N, F], with F = levels * channels, level by level; N at most 1024 with `nodes`. A row
                with a NaN or an infinity gets deltas of 0 and does not touch the others.

        Returns:
            [N, 3 + 3 + 4 + 3 K + 1] to add to means (m), log scales, quats (wxyz), colours and opacity
            logits, see `columns`. A view into own memory, overwritten by the next `forward`.

        Raises:
            UsageError: `features` has the wrong shape, or there are too many nodes.
        """
        _check("features", features, (len(features), self.config.features))
        if self.config.tokens == "nodes" and len(features) > MAX_NODES:
            raise UsageError(
                f"{len(features)} control nodes are too many to attend to each other; use at most {MAX_NODES}"
            )
        weights = self._folded() if self.config.tokens == "self" else self._weights
        self._decoded = self._engine.forward(features, weights)
        return self._decoded

    def backward(self, v_deltas: F32) -> F32:
        """Gradients of sum(v_deltas * deltas) for the last `forward`. Its features and the parameters must be
        unchanged.

        Args:
            v_deltas: [N, D]; rows with a NaN or an infinity count as 0.

        Returns:
            v_features [N, F], a view into own memory. The parameters' gradients go to `gradients`.

        Raises:
            UsageError: `v_deltas` has not the shape of the last deltas.
        """
        _check("v_deltas", v_deltas, self._decoded.shape)
        v_features = self._engine.backward(v_deltas, self._weight_gradients)
        if self.config.tokens == "self":
            self._unfold_gradients()
        return v_features

    def _folded(self) -> Weights:
        """The weights with value and output layer of the attention in one: W_o (W_v x + b_v) + b_o."""
        vectors, matrices = self._weights.vectors.copy(), self._weights.matrices.copy()
        out = self._weights.matrices[ATTENTION_WEIGHT]
        matrices[ATTENTION_WEIGHT] = out @ matrices[VALUE_WEIGHT]
        vectors[ATTENTION_BIAS] += out @ vectors[VALUE_BIAS]
        return self._weights._replace(vectors=vectors, matrices=matrices)

    def _unfold_gradients(self) -> None:
        """From the gradients of the folded layer to those of value and output layer."""
        vectors, matrices = self._weights.vectors, self._weights.matrices
        v_vectors, v_matrices = self._weight_gradients.vectors, self._weight_gradients.matrices
        v_weight, v_bias = v_matrices[ATTENTION_WEIGHT].copy(), v_vectors[ATTENTION_BIAS]
        v_matrices[VALUE_WEIGHT] = matrices[ATTENTION_WEIGHT].T @ v_weight
        v_vectors[VALUE_BIAS] = matrices[ATTENTION_WEIGHT].T @ v_bias
        v_matrices[ATTENTION_WEIGHT] = v_weight @ matrices[VALUE_WEIGHT].T
        v_matrices[ATTENTION_WEIGHT] += np.outer(v_bias, vectors[VALUE_BIAS])

    def _initialise(self, rng: np.random.Generator, gate: float, xavier: bool) -> None:
        for name, parameter in self.parameters.items():
            if name.endswith("_scale"):
                parameter[:] = 1.0
            elif name.endswith("_gate"):
                parameter[:] = gate
            elif name.endswith("_weight") and (xavier or name != "head_out_weight"):
                fan_in, fan_out = parameter.shape[-1], self.config.width
                limit = (6.0 / (fan_in + fan_out)) ** 0.5
                parameter[:] = rng.uniform(-limit, limit, parameter.shape)


def _check(name: str, array: F32, shape: tuple[int, ...]) -> None:
    """The kernels check no bounds, and would compile anew for another type."""
    if array.shape != shape or array.dtype != np.float32:
        wanted, given = f"float32 {list(shape)}", f"{array.dtype} {list(array.shape)}"
        raise UsageError(f"the deformation decoder takes {name} as {wanted}, not {given}")
