"""Threads that read for as long as a program runs: an unforeseen error does not end them."""

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)

PAUSE_S = 1.0  # s, after an unforeseen error


def go_on(turn: Callable[[], object], stopping: threading.Event, who: str) -> None:
    """Call `turn` again and again until `stopping` is set, or until it returns False.

    What it raises is logged, a new error with its traceback, and `turn` is called again after a pause: a
    thread that ended would leave a silence without an explanation.
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
