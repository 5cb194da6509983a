"""Tell whether a topic's content is new enough to be shown, from stamps and sequence numbers alone."""

import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from statistics import median

from sags_node.errors import SagsError
from sags_node.messaging.wire import Meta

WINDOW = 20  # messages from which the period and the rate are computed
STALE_PERIODS = 10  # an age of more periods is too old
STALE_AFTER = 0.5  # s, at most, for content that shows a frame; a grasper pulls tissue 10 mm meanwhile
MIN_RATE = 0.9  # of what the sender sends, or of the declared rate
ENOUGH = 6  # messages from which the period is known
UNKNOWN_PERIOD = 0.1  # s, the longest period assumed until then: a slow start must not allow old content
SESSIONS = 8  # remembered, of earlier nodes; each start of a node has a new one
TWO_NODES = "two nodes send under this name; stop one of them, or give it another ns"
MAX_CLOCK_AHEAD = 1.0  # s; of a stamp that is further ahead, the age says nothing


class StaleError(SagsError):
    """The newest content of a topic is too old or not valid: do not show it as new."""


class Freshness:
    """Follows one topic's messages.

    Args:
        rate_hz: what the topic must keep; default: every message that its sender sends.
        periodic: False for a topic that sends only when something changes: it cannot be too old.
        clock: monotonic, s. It measures silence, which stamps that are ahead would hide.
    """

    def __init__(
        self, rate_hz: float | None = None, periodic: bool = True, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.lost = 0  # messages of this sender that never came
        self.last: Meta | None = None
        self._rate_hz = rate_hz
        self._periodic = periodic
        self._clock = clock
        self._came = 0.0  # when the last message did
        self._window: deque[Meta] = deque(maxlen=WINDOW)
        self._followed: deque[str] = deque(maxlen=SESSIONS)
        self._mixed = 0  # messages of one node still needed until it counts as the only one
        self._asked_anew = False

    def ask_anew(self) -> None:
        """Begin again with the next message: those between were not subscribed to, so they are not lost."""
        self._asked_anew = True

    def accept(self, meta: Meta) -> bool:
        """Note a message; False when it is not newer than the last one (a last value sent again)."""
        last = self.last
        if last is not None and meta.session == last.session:
            if meta.seq <= last.seq or meta.epoch < last.epoch:
                return False
            if not self._asked_anew:
                self.lost += meta.seq - last.seq - 1
        if last is not None and meta.session != last.session:
            if meta.session in self._followed:  # a restarted node has a new session: the old one still sends
                self._mixed = WINDOW
            self._followed.append(last.session)
        elif self._mixed:
            self._mixed -= 1
        if last is None or self._asked_anew or meta.session != last.session or meta.epoch != last.epoch:
            self._window.clear()
        self._asked_anew = False
        self.last, self._came = meta, self._clock()
        self._window.append(meta)
        return True

    @property
    def is_mixed(self) -> bool:
        """Tell whether two nodes send: one came back after another had followed it."""
        return self._mixed > 0

    @property
    def period(self) -> float:
        """Seconds between two messages of the sender: declared, or the median of the capture stamps."""
        if self._rate_hz is not None:
            return 1 / self._rate_hz
        steps = [
            (after.stamp_ns - before.stamp_ns) * 1e-9 / (after.seq - before.seq)
            for before, after in pairwise(self._window)
        ]
        return max(median(steps), 1e-3) if steps else UNKNOWN_PERIOD

    @property
    def rate(self) -> float:
        """The share of the messages due that came, in the window."""
        if len(self._window) < 2:
            return 1.0
        first, last = self._window[0], self._window[-1]
        came = len(self._window) - 1
        if self._rate_hz is None:
            return came / (last.seq - first.seq)
        span = (last.stamp_ns - first.stamp_ns) * 1e-9
        return came / (span * self._rate_hz) if span > 0 else 1.0

    def age(self, now_ns: int) -> float:
        """Seconds since what the last message shows was captured; infinite before the first."""
        return float("inf") if self.last is None else (now_ns - self.last.stamp_ns) * 1e-9

    def problem(self, now_ns: int, max_age: float | None = None) -> str | None:
        """Why the last message must not be shown as new; None when it may be.

        `max_age` (s) takes the place of `STALE_AFTER`; the limit of ten periods stays.
        """
        if self.last is None:
            return "nothing received yet"
        if self._mixed:
            return TWO_NODES
        return self._untimely(self.last, now_ns, max_age) if self._periodic else None

    def _untimely(self, last: Meta, now_ns: int, max_age: float | None) -> str | None:
        sure = self._rate_hz is not None or len(self._window) >= ENOUGH
        limit = STALE_PERIODS * (self.period if sure else min(self.period, UNKNOWN_PERIOD))
        if max_age is None:
            max_age = STALE_AFTER if last.frame_id >= 0 else limit
        limit = min(limit, max_age)
        age = self.age(now_ns)
        if age < -MAX_CLOCK_AHEAD:
            return f"stamped {-age:.2f} s ahead of this machine's clock; set both clocks"
        if age > limit:
            return f"too old: {age:.2f} s, the limit is {limit:.2f} s"
        silence = self._clock() - self._came
        if silence > limit:
            return f"nothing has come for {silence:.2f} s, the limit is {limit:.2f} s"
        if self.rate < MIN_RATE:
            return f"too few messages: {100 * self.rate:.0f} % of those due"
        return None
