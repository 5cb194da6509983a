"""Whether a live feed has frozen: one picture again and again, under new stamps.

A camera never gives the same picture twice: its noise differs. A capture card or a scope's processor that
lost its input repeats the last one. Where both eyes take that way, neither tells of the other
(`vision.pair_watch`). Recordings may repeat pictures: nobody takes them for the present.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sags_node.types import U8, Finding, StereoFrame
from sags_node.vision.judgement import Evidence, Judgement

LONGEST_NS = 300_000_000  # what converts frame rates repeats a picture for 0.1 s at most (10 Hz given as 30)

_FROZEN = Finding(
    "picture_frozen",
    "the same picture comes again and again, under new stamps: see to the camera, the scope's processor and "
    "the capture card",
)


class FreezeWatch:
    """Compares every live frame with the one before, as they came.

    Attributes:
        findings: what is wrong, and how to fix it. May be read from any thread.
    """

    def __init__(self) -> None:
        self.findings: tuple[Finding, ...] = ()
        self._last: StereoFrame | None = None
        self._unchanged_ns = 0  # for so long, by the stamps

    def judge(self, evidence: Evidence, judged: Judgement) -> Judgement:
        """A picture that came for too long is held."""
        frame = evidence.frame
        last, self._last = self._last, frame
        is_live = frame.t_arrival_ns > 0
        if last is not None and is_live and _equal(frame.left, last.left) and _equal(frame.right, last.right):
            self._unchanged_ns += max(0, frame.t_capture_ns - last.t_capture_ns)  # clocks may be set back
        else:
            self._unchanged_ns = 0
        self.findings = (_FROZEN,) if self._unchanged_ns >= LONGEST_NS else ()
        return replace(judged, hold=judged.hold or _FROZEN.text) if self.findings else judged


def _equal(picture: U8 | None, other: U8 | None) -> bool:
    """In every bit. One row shows that nearly all are not."""
    if picture is None or other is None:
        return picture is other
    middle = len(picture) // 2
    return np.array_equal(picture[middle], other[middle]) and np.array_equal(picture, other)
