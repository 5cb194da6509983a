"""The deformation decoder on all cores: for points that do not see each other, and for control nodes that do.

Work goes by blocks of 128 points whose activations stay in the cache of one core. The backward pass of points
computes them again instead of fetching them from memory; nodes are few and keep them. Gradients of weights
are summed by group of blocks, then over the groups in order, so who did which makes no difference.
"""

from __future__ import annotations

import numpy as np

from sags_node.engine.field import decoder_stages as stages
from sags_node.engine.field.decoder_block import Weights, Workspace
from sags_node.engine.field.decoder_layout import Sizes, make_gradients, make_nodes, make_workspace
from sags_node.engine.field.decoder_nodes import Nodes
from sags_node.engine.field.dense import COLUMNS
from sags_node.kernels.jit import aligned, read_only
from sags_node.kernels.threads import thread_count
from sags_node.types import F32

_GROUPS = 32  # of blocks of points: more would cost memory traffic, fewer would leave cores without work


class _Blocks:
    """What both kinds of decoder keep between calls, and the way to run a stage on it."""

    _work: Workspace
    _nodes: Nodes
    _gradients: Weights  # of groups of blocks

    def __init__(self, sizes: Sizes) -> None:
        self._sizes = sizes
        self._head_rows = read_only(np.cumsum([0, *sizes.deltas]))
        self._deltas = aligned((0, sum(sizes.deltas)))
        self._v_features = aligned((0, sizes.tokens * sizes.channels))
        self._v_deltas = read_only(self._deltas)
        self._workers = 0

    def _begin(self, features: F32, weights: Weights) -> None:
        self._features, self._weights = read_only(features), weights
        self._workers = thread_count()
        if len(features) > len(self._deltas):
            self._deltas = aligned((len(features), self._deltas.shape[1]))
            self._v_features = aligned((len(features), self._v_features.shape[1]))

    def _begin_backward(self, v_deltas: F32) -> None:
        self._v_deltas = read_only(v_deltas)
        for gradient in self._gradients:
            gradient[:] = 0.0

    def _run(self, stage: int, items: int) -> None:
        stages.run(
            stage,
            items,
            np.zeros(1, np.int64),
            self._workers,
            self._features,
            self._v_deltas,
            self._weights,
            self._head_rows,
            self._sizes.attention_heads,
            self._work,
            self._nodes,
            self._gradients,
            self._deltas,
            self._v_features,
        )

    @property
    def _blocks(self) -> int:
        return -(-len(self._features) // COLUMNS)

    def _finish_backward(self, gradients: Weights) -> F32:
        for groups, total in zip(self._gradients, gradients, strict=True):
            np.sum(groups, axis=0, out=total)
        return self._v_features[: len(self._features)]


class PointDecoder(_Blocks):
    """Decodes points that do not see each other: with attention heads, each attends to its own tokens.

    Not for use by two threads at once.
    """

    def __init__(self, sizes: Sizes) -> None:
        super().__init__(sizes)
        self._gradients = make_gradients(sizes, _GROUPS)
        self._work = make_workspace(sizes, 1)
        self._nodes = make_nodes(sizes, 0, 0, 0)

    def forward(self, features: F32, weights: Weights) -> F32:
        """Deltas [N, D] of features [N, T C]; 0 where a feature is NaN or infinite. A view into own memory,
        overwritten by the next `forward`."""
        self._begin(features, weights)
        if self._workers > len(self._work.row):
            self._work = make_workspace(self._sizes, self._workers)
        self._run(stages.DECODE, self._blocks)
        return self._deltas[: len(features)]

    def backward(self, v_deltas: F32, gradients: Weights) -> F32:
        """Gradients of sum(v_deltas * deltas) for the last `forward`, whose arrays must be unchanged.

        Args:
            v_deltas: [N, D]; a row with a NaN or an infinity counts as 0.
            gradients: written with those of the weights.

        Returns:
            v_features [N, T C], a view into own memory, overwritten by the next `backward`.
        """
        self._begin_backward(v_deltas)
        self._run(stages.DECODE_BACKWARD, _GROUPS)
        return self._finish_backward(gradients)


class NodeDecoder(_Blocks):
    """Decodes control nodes of one token each; every node attends to all nodes.

    Not for use by two threads at once.
    """

    def __init__(self, sizes: Sizes) -> None:
        super().__init__(sizes)
        self._make_room(0)

    def forward(self, features: F32, weights: Weights) -> F32:
        """Deltas [M, D] of features [M, C]; 0 where a feature is NaN or infinite (the others attend to such a
        node as if its features were 0). A view into own memory, overwritten by the next `forward`."""
        self._begin(features, weights)
        if len(features) != self._nodes.keys.shape[1] or self._workers > len(self._nodes.scratch):
            self._make_room(len(features))
        self._run(stages.EMBED, self._blocks)
        self._run(stages.ATTEND, self._blocks * self._sizes.attention_heads)
        self._run(stages.FINISH, self._blocks)
        return self._deltas[: len(features)]

    def backward(self, v_deltas: F32, gradients: Weights) -> F32:
        """As `PointDecoder.backward`."""
        self._begin_backward(v_deltas)
        for gradient in (self._nodes.v_keys, self._nodes.v_values):
            gradient[:] = 0.0
        self._run(stages.FINISH_BACKWARD, self._blocks)
        self._run(stages.ATTEND_BACKWARD, self._blocks * self._sizes.attention_heads)
        for gradient in (self._nodes.v_keys, self._nodes.v_values):
            gradient[:1] = gradient.sum(axis=0, keepdims=True)
        self._run(stages.EMBED_BACKWARD, self._blocks)
        return self._finish_backward(gradients)

    def _make_room(self, count: int) -> None:
        blocks = -(-count // COLUMNS)
        self._gradients = make_gradients(self._sizes, blocks)
        self._work = make_workspace(self._sizes, blocks)
        self._nodes = make_nodes(self._sizes, count, blocks, self._workers)
