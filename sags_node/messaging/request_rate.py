"""How many requests a client may send: a bucket of tokens that fills again at a steady rate.

Of each bucket one number is kept: when it will be full again (GCRA, ITU-T I.371).
"""

from __future__ import annotations

import time
from collections.abc import Callable

# As many views as there may be, each moved as often as it is drawn, are 480 a second.
RATE = 500.0  # requests/s
BURST = 300  # at once: all anchors and views there may be, and some more
FORGET_ABOVE = 1000  # clients remembered, before those with a full bucket are forgotten


class RequestRate:
    """The buckets of all clients; each is full at first.

    Args:
        clock: s.
    """

    def __init__(
        self, rate: float = RATE, burst: int = BURST, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._full: dict[bytes, float] = {}  # by client: when its bucket is full again

    def wait(self, client: bytes) -> float:
        """Take a token; 0. Where there is none: s until there is one."""
        now = self._clock()
        full = max(now, self._full.get(client, now)) + 1 / self._rate
        wait = full - now - self._burst / self._rate
        if wait > 1e-9:  # more than rounding
            return wait
        if len(self._full) >= FORGET_ABOVE:
            self._full = {one: when for one, when in self._full.items() if when > now}
        self._full[client] = full
        return 0.0
