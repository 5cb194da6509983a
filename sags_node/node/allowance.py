"""The share of a core that drawing for consumers may use, so that the mapping goes first.

A low thread priority would not do: threads share the interpreter lock, and one that is kept from the
processor while it holds the lock keeps all others waiting.
"""

SHARE = 0.25  # of one core
LEAST_SHARE = 0.05  # of one core, if the mapping is late with every frame: less than its rate varies anyway
BEHIND = 0.05  # share of late frames above which the mapping is behind
LATE = 0.005  # s that a frame waits for the mapping, above which it is late
FORGETTING = 0.03  # share of a new frame in the running mean of late ones: about a second
SAVED_UP = 0.1  # s: time left unused for longer than this is lost


class Allowance:
    """The mapping thread reports how late frames are; other threads read their share."""

    def __init__(self) -> None:
        self._late = 0.0  # running share of the frames

    def frame(self, waited: float, missed: bool) -> None:
        """Note a frame that was taken `waited` s after it came; `missed`: others were left out before it."""
        self._late += FORGETTING * ((missed or waited > LATE) - self._late)

    @property
    def is_behind(self) -> bool:
        return self._late > BEHIND

    @property
    def share(self) -> float:
        """The share of one core that drawing may use: the less, the more frames are late."""
        return SHARE - self._late * (SHARE - LEAST_SHARE)


class Pace:
    """When one thread may work again, so that it takes no more than its allowance."""

    def __init__(self, allowance: Allowance) -> None:
        self._allowance = allowance
        self._due = 0.0

    def is_due(self, now: float) -> bool:
        return now >= self._due

    def worked(self, now: float, seconds: float) -> None:
        """Note that it worked until `now` for `seconds` of processor time."""
        self._due = max(self._due, now - SAVED_UP) + seconds / self._allowance.share
