"""Warnings on a terminal: a line when one begins, and one when it is over."""

import time
from collections.abc import Callable, Mapping


class Notices:
    """Tells which warnings began or ended since the last update."""

    def __init__(self, tell: Callable[[str], object]) -> None:
        self._tell = tell
        self._since: dict[str, float] = {}  # code -> when it began

    def update(self, warnings: Mapping[str, str]) -> None:
        """Tell the changes; `warnings`: all that hold now, code -> what is wrong and how to fix it."""
        now = time.monotonic()
        for code in [code for code in self._since if code not in warnings]:
            self._tell(f"over after {now - self._since.pop(code):.1f} s: {code}")
        for code, said in warnings.items():
            if code not in self._since:
                self._since[code] = now
                self._tell(f"warning: {said} ({code}, see docs/warnings.md)")
