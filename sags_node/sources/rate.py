"""How often the frames of a live source come. What a camera, a capture card or a program says of that is
often wrong, and a camera takes longer pictures in the dark."""

from __future__ import annotations

from collections import deque
from statistics import median

from sags_node.types import StereoFrame

MEASURED = 30  # periods behind the rate
OTHER = 0.1  # share by which it must be another one to count


class FrameRate:
    """Of one source, by the stamps and numbers of the frames that are taken.

    Attributes:
        hz: frames a second.
    """

    def __init__(self, nominal_hz: float) -> None:
        self.hz = nominal_hz
        self._periods: deque[float] = deque(maxlen=MEASURED)  # s
        self._last: StereoFrame | None = None

    def add(self, frame: StereoFrame) -> bool:
        """A frame was taken; True: `hz` has changed."""
        last, self._last = self._last, frame
        if last is None or frame.epoch != last.epoch or frame.frame_id <= last.frame_id:
            return False
        seconds = (frame.t_capture_ns - last.t_capture_ns) * 1e-9
        self._periods.append(seconds / (frame.frame_id - last.frame_id))
        measured = 1 / max(median(self._periods), 1e-3)
        if len(self._periods) < MEASURED or abs(measured / self.hz - 1) < OTHER:
            return False
        self.hz = measured
        return True
