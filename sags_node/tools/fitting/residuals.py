"""Residuals of single Gaussians beyond the field: deltas for each at some times, linear in between.

The field is smooth in space, so it carries what neighbours share. What a Gaussian does alone (a texture that
does not quite follow, a colour that turns as light moves over wet tissue, tissue that appears) stands here.
Not part of SAGS; Deform3DGS (MICCAI 2024) also gives each Gaussian curves of its own.
"""

from dataclasses import dataclass

import numpy as np

from sags_node.engine.adam import AdamState, adam_step
from sags_node.errors import SagsError
from sags_node.kernels.jit import aligned
from sags_node.model import columns
from sags_node.types import F32, I64

BETAS = (0.5, 0.99)  # low momentum: a slot is stepped on rarely, and by another frame each time
LEAST_CONTRIBUTION = 1e-3  # px: Gaussians that contribute less are left unchanged
EPS = 1e-12
COLOR_DAMPING = 0.3  # px: a barely seen Gaussian changes its colour slowly
MAX_BYTES = 1 << 29  # of the values; their optimiser's state takes twice as much again


def room(times: int) -> int:
    """The number of Gaussians that may have residuals at `times` times."""
    return MAX_BYTES // (times * columns.COUNT * 4)


def check_size(times: int, count: int) -> None:
    """
    Raises:
        SagsError: residuals of that many Gaussians at that many times take more memory than they may.
    """
    if count > room(times):
        raise SagsError(
            f"residuals of {count} Gaussians at {times} times take more than the {MAX_BYTES / 1e6:.0f} MB "
            "that they may: take fewer frames (source.frames, source.stride) or a smaller --max-gaussians"
        )


def slots_around(times_ns: I64, t_ns: int) -> list[tuple[int, float]]:
    """The indices of the ascending times [K] around a time, with their weights in linear interpolation. One
    of weight 0 is left out; before the first time and after the last there is one slot."""
    after = int(np.searchsorted(times_ns, t_ns, side="right"))
    if after in {0, len(times_ns)}:
        return [(max(after - 1, 0), 1.0)]
    first, last = int(times_ns[after - 1]), int(times_ns[after])
    share = (t_ns - first) / (last - first)
    return [(after - 1, 1.0)] if share == 0 else [(after - 1, 1 - share), (after, share)]


@dataclass(frozen=True, slots=True)
class Steps:
    """The step lengths of one `Residuals.refine`."""

    geometry: F32  # [14] of Adam; 0 for colours
    colors: F32  # [3] of SIRT, for colours before exposure; converges from 0 to 2 / gain


class Residuals:
    """The deltas `values` [K, N, 14] (`columns`) at `times_ns` [K], and their optimiser's state."""

    def __init__(self, times_ns: I64, count: int) -> None:
        """Set all to zero, for `count` Gaussians.

        Args:
            times_ns: [K] ascending; outside of them the nearest one's values hold.
            count: N.

        Raises:
            SagsError: they take more memory than they may.
        """
        check_size(len(times_ns), count)
        self.times_ns = times_ns
        self.values: F32 = aligned((len(times_ns), count, columns.COUNT))
        self.adam = [AdamState.new(count, columns.COUNT) for _ in times_ns]

    def at(self, t_ns: int) -> F32:
        """The deltas [N, 14] at one time."""
        (slot, share), *rest = slots_around(self.times_ns, t_ns)
        deltas: F32 = np.float32(share) * self.values[slot]
        for slot, share in rest:
            deltas += np.float32(share) * self.values[slot]
        return deltas

    def refine(self, t_ns: int, v_rows: F32, v_colors: F32, contribution: F32, steps: Steps) -> None:
        """Improve both slots around a time: Adam on the geometry, one SIRT step on the colours (each colour
        moves by the mean residual of the pixels it covers, weighted by its share in them).

        Args:
            t_ns: the time.
            v_rows: [N, 14] gradient of half the squared colour residuals by the deltas at that time.
            v_colors: [N, 3] the same by the colours as drawn.
            contribution: [N] px, the weight of each Gaussian in the image.
            steps: their lengths.
        """
        seen = np.flatnonzero(contribution > LEAST_CONTRIBUTION)
        colors = v_colors[seen] * (steps.colors / (contribution[seen, None] + COLOR_DAMPING))
        parts = slots_around(self.times_ns, t_ns)
        norm = sum(share * share for _, share in parts)
        for slot, share in parts:
            values = self.values[slot]
            adam_step(
                values, v_rows * np.float32(share), self.adam[slot], steps.geometry, rows=seen,
                betas=BETAS, eps=EPS,
            )  # fmt: skip
            # the smallest change of both slots whose blend is the step
            values[seen, columns.COLOR] -= np.float32(share / norm) * colors
