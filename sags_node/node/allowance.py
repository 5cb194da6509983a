"""What drawing for consumers may take of a core, so that the mapping goes first.

It is not a low priority: threads of one process share the interpreter, and one that is kept from the
processor while it holds that keeps all others waiting.
"""

SHARE = 0.25  # of one core
LEAST_SHARE = 0.05  # while the mapping is behind: less than its own rate varies by
BEHIND = 0.05  # share of late frames from which on it is
LATE = 0.005  # s that a frame waited for the mapping
FORGETTING = 0.03  # share of a new frame in the running mean of late ones: about a second
SAVED_UP = 0.1  # s: what was not used for longer is lost


class Allowance:
    """The mapping thread says how late frames are; others ask what they may take."""

    def __init__(self) -> None:
        self._late = 0.0  # running share of the frames

    def frame(self, waited: float, missed: bool) -> None:
        """A frame was taken, `waited` s after it came; `missed`: others were left out before it."""
        self._late += FORGETTING * ((missed or waited > LATE) - self._late)

    @property
    def is_behind(self) -> bool:
        return self._late > BEHIND

    @property
    def share(self) -> float:
        """The share of one core."""
        return LEAST_SHARE if self.is_behind else SHARE


class Pace:
    """When one thread may work again, so that it takes no more than its allowance."""

    def __init__(self, allowance: Allowance) -> None:
        self._allowance = allowance
        self._due = 0.0

    def is_due(self, now: float) -> bool:
        return now >= self._due

    def worked(self, now: float, seconds: float) -> None:
        """It has, for so much processor time."""
        self._due = max(self._due, now - SAVED_UP) + seconds / self._allowance.share
