"""How far a result may be off because its arithmetic rounds: the bounds of tests, whatever the processor.

How many additions run side by side, and whether a product and a sum are rounded once or twice, is up to the
compiler and the processor. A bound must hold for all of them, so it is worked out from the number of
roundings and the conditioning of what is computed, never read off one machine.

An algorithm that is not to blame for its errors has those of inputs that are a little off (Higham, Accuracy
and Stability of Numerical Algorithms, 1.6). What they come to a float64 twin says itself: it computes some
times more, with each number `moved`.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

U = 2.0**-24  # relative error of one rounding to float32
STEPS = 8  # sqrt(60): what some 60 independent roundings on the way from an input to a result come to


def after(roundings: int) -> float:
    """Relative error after so many roundings one on top of the other.

    None is larger than U, so it cannot be more than `roundings` U. Roundings are independent enough to add up
    like a random walk: 6 sqrt(roundings) U is passed once in ten million times (Higham and Mary, SIAM J. Sci.
    Comput. 2019, theorem 2.4). The sum of n numbers has n - 1 roundings in any order; this is then the error
    as a share of the sum of their absolute values.
    """
    return U * min(roundings, 6 * math.sqrt(roundings))


def roughly(
    function: Callable[..., torch.Tensor], rng: np.random.Generator, off: float
) -> Callable[..., torch.Tensor]:
    """The same with each number of its results a little off."""

    def rough(*arguments: Any) -> torch.Tensor:
        result = function(*arguments)
        return result * torch.tensor(moved(np.ones(tuple(result.shape)), rng, off))

    return rough


def moved(array: Any, rng: np.random.Generator, off: float = STEPS * U) -> Any:
    """Each number a little larger or smaller, at random; what is no array of floats stays."""
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f":
        return array
    return array * (1 + off * rng.choice([-1.0, 1.0], array.shape))
