"""Images of tissue that is hidden now: the newest ones in which it was seen."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sags_node.detail.seen import MatchedDepth, SeenFrame
from sags_node.types import F32, U8, Gaussians

EVERY = 0.2  # s between frames that are kept
HIDDEN = 0.002  # of a frame's pixels were tissue in the frame before, which is kept then...
AT_LEAST = np.ones((9, 9), np.uint8)  # ...in whole squares of so many px: highlights and edges come and go
MOST = 10  # frames kept
OLDEST = 10.0  # s: what nobody has seen for longer is drawn as the model has it
NEARLY = 0.5  # of what the best frame saw: a newer frame that saw more than this is taken instead
WORTH = 0.05  # of the hidden Gaussians: a frame that saw fewer is not used
MATCHED = 0.2  # s for which a measured error of the model's depth is taken to hold
BRIGHTER = 2.0  # largest factor between the light of a source and of the view


class Memory:
    """Keeps frames: recent ones close in time, older ones farther apart, the last before tissue was hidden.

    Attributes:
        frames: the newest first.
    """

    def __init__(self) -> None:
        self.frames: tuple[SeenFrame, ...] = ()
        self._last: SeenFrame | None = None  # kept once the next frame tells whether it hides something

    def forget(self) -> None:
        """Drop all frames: ids now stand for other Gaussians."""
        self.frames, self._last = (), None

    def add(self, frame: SeenFrame) -> None:
        """Take a new frame, and keep the one before it if none was kept for `EVERY`, or if the new one hides
        something that it saw."""
        last, self._last = self._last, frame
        now = frame.t_capture_ns
        kept = [one for one in self.frames if 0 <= now - one.t_capture_ns <= OLDEST * 1e9]
        if last is not None and 0 <= now - last.t_capture_ns <= OLDEST * 1e9:
            due = not kept or last.t_capture_ns - kept[0].t_capture_ns >= EVERY * 1e9
            if due or _hides(frame, last):
                picture = last.picture()  # made now, so that the rest of the frame can be freed
                kept.insert(0, replace(last, picture=lambda: picture, matched=None))
        if len(kept) > MOST:
            ages = [EVERY + (now - one.t_capture_ns) * 1e-9 for one in kept]
            # The frame whose neighbours in time have the smallest ratio of ages is missed least.
            del kept[min(range(1, len(kept) - 1), key=lambda i: ages[i + 1] / ages[i - 1])]
        self.frames = tuple(kept)


def _hides(frame: SeenFrame, last: SeenFrame) -> bool:
    hidden: U8 = cv2.erode(cv2.subtract(last.tissue, frame.tissue), AT_LEAST)
    return bool(cv2.countNonZero(hidden) > HIDDEN * hidden.size)


class Matched:
    """Keeps the depth that stereo measured last, and the model's depth then: not every frame is matched."""

    def __init__(self) -> None:
        self._last: MatchedDepth | None = None
        self._when_ns = 0

    def __call__(self, now_ns: int, drawn: F32, measured: F32) -> MatchedDepth | None:
        """Return the newest pair of both, for `SeenFrame.matched`; None: it is older than `MATCHED`.

        Args:
            drawn, measured: [h, w] m of this frame, 0 unknown.
        """
        if measured.any():
            self._last, self._when_ns = MatchedDepth(drawn, measured), now_ns
        return self._last if 0 <= now_ns - self._when_ns <= MATCHED * 1e9 else None


@dataclass(frozen=True, slots=True)
class HiddenSource:
    """A frame that saw tissue which is hidden now."""

    frame: SeenFrame
    gain: F32  # [3] light now over the light in that frame


def hidden_source(hidden: Gaussians, now_ns: int, frames: Sequence[SeenFrame]) -> HiddenSource | None:
    """Choose the newest frame that saw more than `NEARLY` of what the best one saw of the hidden Gaussians.
    None: none saw enough. A second frame beside it would add less than 0.05 dB.

    Args:
        hidden: the Gaussians there, in the light of now.
        frames: that may be taken, the newest first.
    """
    seen = []
    for frame in frames:
        if len(frame.gaussians) and 0 < now_ns - frame.t_capture_ns <= OLDEST * 1e9:  # also after a pause
            rows, known = frame.rows_of(hidden.ids)
            seen.append((frame, rows, known & frame.shows[rows]))
    counts = [np.count_nonzero(shown) for _, _, shown in seen]
    most = max(counts, default=0)
    if most < max(1.0, WORTH * len(hidden)):
        return None
    frame, rows, shown = seen[next(i for i, count in enumerate(counts) if count > NEARLY * most)]
    before, after = frame.gaussians.colors[rows[shown]], hidden.colors[shown]
    gain = after.sum(0) / np.maximum(before.sum(0), np.float32(1e-6))
    return HiddenSource(frame, np.clip(gain, 1 / BRIGHTER, BRIGHTER).astype(np.float32))
