"""Training: batches of made pairs, the loss, and where it stands on disk."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from sags_node.errors import UsageError
from sags_node.files import whole
from sags_node.learning.example import Example
from sags_node.learning.material import Material
from sags_node.learning.network import StereoNetwork

SIZE = (224, 160)  # px, of an example
BATCH = 4
RATE = 2e-3  # of learning, at its highest
WARM_UP = 100  # steps, in which it rises
LARGEST_GRADIENT = 1.0
SAVE_EVERY = 100  # steps
SHARPNESS = 0.1  # px: below it an error counts as its square
STAGE_WEIGHT = 0.9  # of a stage, over that of the next one
SLOPE_WEIGHT = 0.5  # of errors of the slope: smooth surfaces are wanted
HELD_OUT = 2**32 - 1  # the random stream of pairs that are never trained on

Advance = Callable[[int, int, str], None]  # steps done, of, what


class Batch(NamedTuple):
    """Examples as tensors."""

    left: Tensor  # [B, 3, H, W] 0..1
    right: Tensor
    disparity: Tensor  # [B, 1, H, W] px; 0 where it is unknown or leads out of the right picture


def draw(material: Material, stream: Sequence[int]) -> Batch:
    """A batch of new examples; the same ones for the same `stream`."""
    rng = np.random.default_rng(stream)
    return to_batch([material.example(rng, SIZE) for _ in range(BATCH)])


def to_batch(examples: Sequence[Example]) -> Batch:
    """Examples of one size."""
    left, right = (
        torch.from_numpy(np.stack([one[eye] for one in examples])).permute(0, 3, 1, 2).contiguous() / 255
        for eye in (0, 1)
    )
    truth = torch.from_numpy(np.stack([one.seen_by_both() for one in examples]))[:, None]
    return Batch(left, right, truth)


def loss(stages: Sequence[Tensor], truth: Tensor) -> Tensor:
    """Of the disparities that follow each other, against the true one [B, 1, H, W]; the last counts most."""
    known = (truth > 0).float()
    level = known[..., 1:] * known[..., :-1] * ((truth[..., 1:] - truth[..., :-1]).abs() < 1).float()
    total = truth.new_zeros(())
    for place, found in enumerate(reversed(stages)):
        off = functional.interpolate(found, truth.shape[2:], mode="bilinear", align_corners=False) - truth
        share = found.shape[3] / truth.shape[3]  # coarse errors count in coarse px
        value = share * _mean(torch.sqrt(off**2 + SHARPNESS**2) - SHARPNESS, known)
        if place == 0:
            bend = off[..., 1:] - off[..., :-1]
            value = value + SLOPE_WEIGHT * _mean(bend.abs().clamp(max=1), level)
        total = total + STAGE_WEIGHT**place * value
    return total


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    return (values * weights).sum() / weights.sum().clamp(min=1)


class Trainer:
    """One network on its way.

    Attributes:
        network: as it is now.
        step: steps done.

    Args:
        steps: the rate of learning falls to nothing until then.
        seed: of the network's first weights and of the pairs.
    """

    def __init__(self, material: Material, steps: int, seed: int = 0) -> None:
        torch.manual_seed(seed)
        self.network = StereoNetwork()
        self.step = 0
        self._material = material
        self._steps = steps
        self._seed = seed
        self._optimizer = torch.optim.AdamW(self.network.parameters(), RATE, weight_decay=1e-4)

    def train(self, advance: Advance, checkpoint: Path | None = None) -> list[float]:
        """All steps that are left; the loss of each. `checkpoint` is kept up to date.

        Raises:
            SagsError: the checkpoint cannot be written.
        """
        losses: list[float] = []
        with ThreadPoolExecutor(1, "sags-pairs") as pool:
            waiting = pool.submit(draw, self._material, (self._seed, self.step))
            while self.step < self._steps:
                batch = waiting.result()
                self.step += 1
                waiting = pool.submit(draw, self._material, (self._seed, self.step))
                losses.append(self._learn(batch))
                if checkpoint is not None and (self.step % SAVE_EVERY == 0 or self.step == self._steps):
                    self.save(checkpoint)
                lately = losses[-SAVE_EVERY:]
                advance(self.step, self._steps, f"training, loss {sum(lately) / len(lately):.3f}")
        return losses

    def _learn(self, batch: Batch) -> float:
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        self._optimizer.zero_grad()
        value = loss(self.network.stages(batch.left, batch.right), batch.disparity)
        value.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), LARGEST_GRADIENT)
        self._optimizer.step()
        return value.item()

    def _rate(self) -> float:
        falling = 0.5 * (1 + math.cos(math.pi * self.step / self._steps))
        return RATE * falling * min(1.0, self.step / WARM_UP)

    def save(self, file: Path) -> None:
        """Keep the state, whole or not at all.

        Raises:
            SagsError: it cannot be written.
        """
        state = {
            "network": self.network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "step": self.step,
        }
        data = BytesIO()  # torch itself says of a full disk what nobody understands
        torch.save(state, data)
        with whole(file) as partial:
            partial.write_bytes(data.getvalue())

    def resume(self, file: Path) -> None:
        """Go on from what was kept.

        Raises:
            UsageError: it is no state of this network.
        """
        try:
            state = torch.load(file, weights_only=True)
            self.network.load_state_dict(state["network"])
            self._optimizer.load_state_dict(state["optimizer"])
            self.step = int(state["step"])
        except Exception as error:  # torch raises many kinds
            raise UsageError(
                f"{file} is no state of this training: {str(error).splitlines()[0]}; remove it to begin anew"
            ) from None


def errors(network: StereoNetwork, material: Material, batches: int) -> tuple[float, float]:
    """Median and 90th percentile of the error (px) on pairs that were not trained on."""
    sizes = []
    with torch.no_grad():
        for number in range(batches):
            batch = draw(material, (HELD_OUT, number))
            off = (network(batch.left, batch.right) - batch.disparity).abs()
            sizes.append(off[batch.disparity > 0])
    together = torch.cat(sizes).numpy()
    return float(np.median(together)), float(np.percentile(together, 90))
