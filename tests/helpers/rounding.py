"""How far a result may be off because its arithmetic rounds: the bounds of tests, whatever the processor.

How many additions run side by side, and whether a product and a sum are rounded once or twice, is up to the
compiler and the processor. A bound must hold for all of them, so it is worked out from the number of
roundings and the conditioning of what is computed, never read off one machine.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import DTypeLike, NDArray

U = 2.0**-24  # relative error of one rounding to float32
STEPS = (
    8  # what some 60 roundings on the way from an input to a result come to: sqrt(60), they are independent
)


def after(roundings: int, dtype: DTypeLike = np.float32) -> float:
    """Relative error after so many roundings one on top of the other.

    None is larger than U, so it cannot be more than `roundings` U. Roundings are independent enough to add up
    like a random walk: 6 sqrt(roundings) U is passed once in ten million times (Higham and Mary, SIAM J. Sci.
    Comput. 2019, theorem 2.4). The sum of n numbers has n - 1 roundings in any order; this is then the error
    as a share of the sum of their absolute values.
    """
    unit = U if np.dtype(dtype) == np.float32 else float(np.finfo(dtype).eps) / 2
    return unit * min(roundings, 6 * math.sqrt(roundings))


@dataclass(frozen=True)
class Exact:
    """A result of a float64 twin, and how near to it float32 comes."""

    value: NDArray[np.float64]
    within: float  # norm of all errors together

    def check(self, found: Any, label: object = "", times: float = 1.0) -> None:
        """`times`: 2 for the difference of two results that are both as near as this."""
        error = float(np.linalg.norm(np.asarray(found, np.float64) - self.value))
        assert error <= times * self.within, (label, error, times * self.within)


def exact(
    twin: Callable[..., Sequence[Any]],
    arrays: Mapping[str, Any],
    additions: int = 1,
    cancelled: float = 1.0,
    rough: tuple[Any, str] | None = None,
    moves: int = 3,
) -> list[Exact]:
    """What a float64 twin makes of float32 arrays.

    An algorithm that is not to blame for its errors has those of inputs that are a little off (Higham,
    Accuracy and Stability of Numerical Algorithms, 1.6). What they come to here the twin says itself: it
    computes `moves` times more, with each number off by `STEPS` roundings, up or down at random.

    Args:
        twin: of the arrays by their names; every result is a number or an array.
        additions: how many float32 numbers a result is the sum of.
        cancelled: their absolute values' sum, as a multiple of that of the numbers themselves.
        rough: where in the twin (module, name) a function stands whose results are rounded, too, before
            something is subtracted from them.
    """
    results = [np.asarray(result, np.float64) for result in twin(**arrays)]
    off = [0.0] * len(results)
    for move in range(moves):
        rng = np.random.default_rng(move)
        with pytest.MonkeyPatch.context() as patch:
            if rough is not None:
                patch.setattr(*rough, roughly(getattr(*rough), rng))
            near = twin(**{name: moved(array, rng) for name, array in arrays.items()})
        for k, (result, other) in enumerate(zip(results, near, strict=True)):
            off[k] = max(off[k], float(np.linalg.norm(np.asarray(other, np.float64) - result)))
    added = cancelled * after(additions)
    return [
        Exact(result, moved_by + added * float(np.linalg.norm(result)))
        for result, moved_by in zip(results, off, strict=True)
    ]


def roughly(
    function: Callable[..., torch.Tensor], rng: np.random.Generator, off: float = STEPS * U
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
