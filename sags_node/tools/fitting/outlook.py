"""How long a fit still takes: told as early as it can be known, and corrected while it runs."""

import time
from collections import deque
from collections.abc import Callable, Mapping
from statistics import median

LAST, LEAST = 25, 3  # steps whose times count; and from how many on they do


class Outlook:
    """What is left of work in stages, each of many steps, whose prices are expected.

    What the last steps took, in the median, is the price of the present stage. By as much as it was expected
    wrongly, later ones are corrected. The median passes over a pause (Ctrl-Z), a checkpoint and a compiler.
    """

    def __init__(
        self, steps: Mapping[str, int], prices: Mapping[str, float], now: Callable[[], float] = time.monotonic
    ) -> None:
        """
        Args:
            steps: of each stage, in their order.
            prices: of a step of each, only in proportion to each other.
            now: the clock, s.
        """
        self._steps, self._prices, self._now = steps, prices, now
        self._factor: float | None = None  # from prices to seconds
        self._took: deque[float] = deque(maxlen=LAST)  # s, each of the last steps
        self._last = "", 0, 0.0  # stage, steps done, when

    def expect(self, prices: Mapping[str, float]) -> None:
        """Take prices in seconds from now on."""
        self._prices, self._factor = prices, 1.0

    def left(self, stage: str, done: int) -> float | None:
        """Note that `done` steps of a stage are done; return the seconds left in all, None if not known."""
        (last, before, since), moment = self._last, self._now()
        self._last = stage, done, moment
        if stage != last:
            self._took.clear()
        elif done > before:
            self._took.append((moment - since) / (done - before))
        if len(self._took) >= LEAST:
            self._factor = median(self._took) / self._prices[stage]
        if self._factor is None:
            return None
        stages = list(self._steps)
        later = stages[stages.index(stage) + 1 :]
        rest = {stage: self._steps[stage] - done, **{name: self._steps[name] for name in later}}
        return self._factor * sum(count * self._prices[name] for name, count in rest.items() if count)
