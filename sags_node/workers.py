"""Threads that read for as long as a program runs: what nobody foresaw ends none of them."""

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)

PAUSE_S = 1.0  # after an error that nobody foresaw


def go_on(turn: Callable[[], object], stopping: threading.Event, who: str) -> None:
    """Call `turn` again and again until `stopping` is set, or until it returns False.

    What it raises is logged, at first with where it comes from, and `turn` is called again after a pause: a
    thread that ended would leave a silence that nothing explains.
    """
    said = ""
    while not stopping.is_set():
        try:
            if turn() is False:
                return
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            log.error("%s: internal error: %s; it is tried again", who, text, exc_info=text != said)
            said = text
            stopping.wait(PAUSE_S)
