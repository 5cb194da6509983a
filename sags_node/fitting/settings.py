"""What can be chosen about a fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from sags_node.engine.losses.photometric import LossWeights
from sags_node.model.field import FieldRates

Tokens = Literal["self", "planes", "nodes"]
Schedule = Literal["paper", "online"]


STEREO = LossWeights(coverage=0.1)
MONOCULAR = LossWeights(inverse_depth=0.0, correlation=1e-3, coverage=0.1)  # depth up to scale and shift


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Defaults are the paper's where it says (arXiv 2510.27318), the released code's where it does not."""

    schedule: Schedule = "online"  # how it starts: see `fitting.start`
    warm_up: int = 1000  # iterations on the first frame without deformation; only with schedule = paper
    iterations: int = 3000  # on all training frames, with deformation
    tokens: Tokens = "nodes"
    adaptive: bool = True  # False: without the self-adaptive block, as EndoGaussian
    antialias: bool = True  # both filters
    max_gaussians: int = 60_000
    seed: int = 0
    levels: int = 2  # of the HexPlane
    cells: int = 64  # along each axis, coarsest level
    slots: int = 25  # of time
    channels: int = 32
    mean_px: float = 0.08  # learning rate of canonical means, in px at the tissue's median depth
    decay: float = 0.01  # learning rates fall to this share of their first values
    field_rates: FieldRates = field(default_factory=FieldRates)
    weights: LossWeights = STEREO  # only with schedule = paper
