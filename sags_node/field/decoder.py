"""The self-adaptive deformation decoder (SAGS, arXiv 2510.27318): features become changes of Gaussians.

For the token x = GELU(W f + b) of a Gaussian or a node, with A(x) = alpha x + beta and the gates gamma learnt
per channel,

    y' = A_pre(x) + gamma_1 MSA(A_pre(x))
    y  = A_post(y') + gamma_2 MLP(A_post(y')) + x

and five heads Linear(GELU(Linear(GELU(y)))) give the changes of mean, scale, rotation, colour and opacity.

There are two choices of tokens for the attention MSA. `self`: a Gaussian is a sequence of length one, as in
the authors' code; softmax over one key is 1, so that MSA is its value layer and its output layer. `nodes`:
control nodes are decoded, and every node attends to all of them.
"""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, linear

from sags_node.errors import UsageError

Tokens = Literal["self", "nodes"]

# What stands between the first layer and the heads. `adaptive`: the block of SAGS. `mlp`: only its linear
# layers learn, an MLP of its size with residual connections: gates stay 1, adaptations the identity.
# `none`: nothing is learnt there, as in EndoGaussian.
Block = Literal["adaptive", "mlp", "none"]

HEADS = {"mean": 3, "log_scale": 3, "quat": 4, "color": 3, "logit": 1}  # as in `model.columns`
MAX_NODES = 1024
INITIAL_GATE = 1e-4
PART = 8192  # tokens decoded at a time, if they do not attend to each other: all do not fit the cache
FIRST_HEAD = 0.01  # largest initial weight of the last layers after `awaken`


class Adaptation(nn.Module):
    """A(x) = alpha x + beta."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.alpha = nn.Parameter(torch.ones(width))
        self.beta = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        return self.alpha * x + self.beta


class Attention(nn.Module):
    """MSA: multi-head self-attention over the N nodes; over one token alone with `tokens` = self."""

    def __init__(self, width: int, heads: int, tokens: Tokens) -> None:
        super().__init__()
        self.heads = heads
        self.query_key = nn.Linear(width, 2 * width) if tokens == "nodes" else None
        self.value = nn.Linear(width, width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        values = self.value(x)
        if self.query_key is not None:
            query, key = self.query_key(x).chunk(2, dim=1)
            # [heads, N, width / heads]; torch's fused attention takes twice as long on a CPU
            query, key, values = (
                part.view(len(x), self.heads, -1).transpose(0, 1).contiguous()
                for part in (query, key, values)
            )
            shares = torch.softmax(query / query.shape[2] ** 0.5 @ key.transpose(1, 2), dim=2)
            values = (shares @ values).transpose(0, 1).reshape(x.shape)
        mixed: Tensor = self.out(values)
        return mixed


class Decoder(nn.Module):
    """Maps features [N, F] to changes [N, 14] of raw parameters (`model.columns`), in the decoder's units."""

    def __init__(
        self,
        features: int,
        tokens: Tokens = "self",
        block: Block = "adaptive",
        width: int = 32,
        heads: int = 4,
        seed: int = 0,
        xavier: bool = False,
    ) -> None:
        """Xavier-uniform weights from `seed`, biases 0.

        Args:
            features: F.
            tokens: what attends to what.
            block: what is learnt between the first layer and the heads.
            width: of all hidden layers.
            heads: of the attention; they divide the width.
            seed: of the weights.
            xavier: False: last layers are 0 instead, so that there is no change.

        Raises:
            UsageError: an MLP is asked for whose tokens attend to each other, or heads do not divide width.
        """
        super().__init__()
        if block == "mlp" and tokens != "self":
            raise UsageError(
                f"an MLP in the place of the block has no attention; use tokens self, not {tokens}"
            )
        if min(features, width, heads) < 1 or width % heads:
            raise UsageError(
                f"deformation decoder: heads ({heads}) must divide width ({width}), features ({features}) "
                "must be at least 1"
            )
        self.embed = nn.Linear(features, width)
        self.pre, self.post = Adaptation(width), Adaptation(width)
        self.attention = Attention(width, heads, tokens)
        self.mlp = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Linear(width, width))
        gate = 1.0 if block == "mlp" else INITIAL_GATE
        self.gamma_1 = nn.Parameter(torch.full((width,), gate))
        self.gamma_2 = nn.Parameter(torch.full((width,), gate))
        self.head_in = nn.Linear(width, len(HEADS) * width)  # the first layers of all heads side by side
        self.head_out = nn.ParameterList(torch.zeros(count, width) for count in HEADS.values())
        self.head_bias = nn.Parameter(torch.zeros(sum(HEADS.values())))
        self._most = MAX_NODES if tokens == "nodes" else None
        generator = torch.Generator().manual_seed(seed)
        for name, parameter in self.named_parameters():
            if name.endswith("bias"):
                nn.init.zeros_(parameter)
            elif name.endswith("weight") or (xavier and name.startswith("head_out")):
                limit = (6.0 / (parameter.shape[1] + width)) ** 0.5
                nn.init.uniform_(parameter, -limit, limit, generator=generator)
        adapts = [self.pre, self.post]
        still: dict[str, list[nn.Module]]
        still = {"adaptive": [], "mlp": [*adapts], "none": [*adapts, self.attention, self.mlp]}
        for module in still[block]:
            module.requires_grad_(False)
        for gamma in (self.gamma_1, self.gamma_2):
            gamma.requires_grad_(block == "adaptive")

    def awaken(self, seed: int) -> None:
        """Give the last layers weights other than 0, so that a model of differences between two times begins
        to learn. While all times have the same features, its gradient by the weights is 0; while the weights
        are 0, its gradient by the features is, too. At first nothing changes, as the times do not differ."""
        generator = torch.Generator().manual_seed(seed)
        for weights in self.head_out.parameters():
            nn.init.uniform_(weights, -FIRST_HEAD, FIRST_HEAD, generator=generator)

    def forward(self, features: Tensor) -> Tensor:
        """Decode features [N, F]. UsageError: too many nodes."""
        if self._most is None:
            part = PART if features.device.type == "cpu" else max(1, len(features))
            decode = self._folded()
            return torch.cat([decode(each) for each in torch.split(features, part)])
        if len(features) > self._most:
            raise UsageError(
                f"{len(features)} control nodes are too many to attend to each other; "
                f"use at most {self._most}"
            )
        return self._decode(features)

    def _decode(self, features: Tensor) -> Tensor:
        x = gelu(self.embed(features))
        y = self._mixed(x)
        y = gelu(y + self.gamma_2 * self.mlp(y) + x)
        return linear(gelu(self.head_in(y)), self._last(), self.head_bias)

    def _mixed(self, x: Tensor) -> Tensor:
        """A_post(y') of tokens x."""
        adapted = self.pre(x)
        mixed: Tensor = self.post(adapted + self.gamma_1 * self.attention(adapted))
        return mixed

    def _last(self) -> Tensor:
        """The last layers of all heads, [14, heads * width]."""
        last: Tensor = torch.block_diag(*self.head_out)  # type: ignore[no-untyped-call]
        return last

    def _folded(self) -> Callable[[Tensor], Tensor]:
        """`_decode` of tokens that attend to themselves alone: the affine maps between two GELUs are
        multiplied once, instead of for every token. Their values at unit vectors and at 0 determine them."""
        unit = self.gamma_1.new_zeros(len(self.gamma_1) + 1, len(self.gamma_1)).fill_diagonal_(1)
        mixed = self._mixed(unit)
        first, second, skip = self.mlp[0](mixed), self.gamma_2 * self.mlp[2](unit), mixed + unit
        into, out, along = (each[:-1] - each[-1] for each in (first, second, skip))
        bias, last = second[-1] + skip[-1], self._last().T

        def decode(features: Tensor) -> Tensor:
            x = gelu(self.embed(features))
            y = torch.addmm(bias, x, along).addmm(gelu(torch.addmm(first[-1], x, into)), out)
            return torch.addmm(self.head_bias, gelu(self.head_in(gelu(y))), last)

        return decode
