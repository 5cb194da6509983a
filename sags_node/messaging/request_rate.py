"""How many requests a client may send: each has a bucket of tokens that fills again at a steady rate."""

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
        self._buckets: dict[bytes, tuple[float, float]] = {}  # tokens in it, and when that was

    def wait(self, client: bytes) -> float:
        """Take a token; 0. Where there is none: s until there is one."""
        now = self._clock()
        tokens = self._tokens(client, now)
        if tokens < 1:
            return (1 - tokens) / self._rate
        if len(self._buckets) >= FORGET_ABOVE:
            known = self._buckets
            self._buckets = {one: known[one] for one in known if self._tokens(one, now) < self._burst}
        self._buckets[client] = tokens - 1, now
        return 0.0

    def _tokens(self, client: bytes, now: float) -> float:
        tokens, at = self._buckets.get(client, (float(self._burst), now))
        return min(self._burst, tokens + (now - at) * self._rate)
