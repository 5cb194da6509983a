"""Whether the rows of both eyes still agree while the node runs: a scope that was bumped, refocused or
exchanged no longer fits its calibration, and stereo then fails gradually.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sags_node.types import F32, Bool, Finding

SAMPLES = 40  # across a field, at most
WINDOW = 60  # fields over which medians are taken
FEWEST_FIELDS = 10  # before anything is said
FEWEST_KNOWN = 0.1  # of the samples: if fewer are matched, their spread is not known
LARGEST_MEDIAN = 1.0  # px of the working size
LARGEST_SPREAD = 2.0  # px, from the tenth to the ninetieth percentile: a turn about the axis by 0.25 degrees
BACK_AT = 0.8  # of the limits: a warning ends below it


@dataclass(frozen=True, slots=True)
class Alignment:
    """How well rows agree, over the last fields; px of the working size."""

    median: float  # how far below its row in the left image a point lies in the right one
    spread: float  # of that, between the tenth and the ninetieth percentile; 0 while too little is matched
    warning: str  # empty: they agree


class RowErrors(NamedTuple):
    """Row errors of one frame, sampled evenly over its image."""

    errors: F32  # [h, w] px of the working size
    matched: Bool  # [h, w]
    median: float  # px, of all errors


class RowMonitor:
    """A slow, robust look at the row errors that `match_patches` finds anyway.

    Attributes:
        alignment: None before enough was seen. May be read from any thread.
        newest: of the last field.
    """

    def __init__(self, width: int) -> None:
        """`width`: of the working size, px."""
        self.alignment: Alignment | None = None
        self.newest: RowErrors | None = None
        self._width = width
        self._fields: deque[tuple[float, float]] = deque(maxlen=WINDOW)  # median, and spread or NaN
        self._warns = False

    def update(self, row_error: F32, known: Bool, width: int) -> None:
        """Take the field [h, w] of one frame.

        Args:
            row_error: px of an image that is `width` px wide.
            known: where it matched.
        """
        step = -(-row_error.shape[1] // SAMPLES)
        scale = np.float32(self._width / width)
        errors, matched = (
            scale * row_error[step // 2 :: step, step // 2 :: step],
            known[step // 2 :: step, step // 2 :: step],
        )
        # Errors beyond what can be matched stand at the limit, unmatched: the median must see them.
        every = np.sort(errors, axis=None)
        self.newest = RowErrors(errors, matched, float(every[every.size // 2]))
        some = np.sort(errors[matched])
        enough = some.size >= FEWEST_KNOWN * every.size
        spread = float(some[9 * some.size // 10] - some[some.size // 10]) if enough else math.nan
        self._fields.append((self.newest.median, spread))
        if len(self._fields) >= FEWEST_FIELDS:
            self.alignment = self._judge()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return the warning that the rows differ, with what helps. May be read from any thread."""
        alignment = self.alignment
        return (Finding("rows_differ", alignment.warning),) if alignment and alignment.warning else ()

    def stay(self) -> None:
        """Take a frame in which nothing has moved: its rows are those of the last field."""
        if self._fields:
            self._fields.append(self._fields[-1])
        if len(self._fields) >= FEWEST_FIELDS:
            self.alignment = self._judge()

    def withdraw(self) -> None:
        """Leave the last field out: an eye was late, which tells nothing of the calibration."""
        self._fields.pop()
        if self.alignment is not None:
            self.alignment = self._judge()

    def _judge(self) -> Alignment:
        medians, spreads = np.array(self._fields).T
        median = float(np.median(medians))
        known = spreads[np.isfinite(spreads)]
        spread = float(np.median(known)) if known.size else 0.0
        excess = max(abs(median) / LARGEST_MEDIAN, spread / LARGEST_SPREAD)
        self._warns = excess > (BACK_AT if self._warns else 1.0)
        warning = ""
        if self._warns:
            warning = (
                f"rows of the eyes differ by {median:.1f} px, spread {spread:.1f} px: the calibration no "
                "longer fits; run sags calib check with --session"
            )
        return Alignment(median, spread, warning)
