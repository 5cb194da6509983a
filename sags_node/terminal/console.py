"""Output of the command line for people and programs: results on stdout, everything else on stderr."""

from __future__ import annotations

import json
import logging
import re
import signal
import sys
import threading
import time
from _thread import start_new_thread
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from types import FrameType
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

WIDE = 10_000  # columns of a table for a file or another program, which is not fitted to a screen

SAY_EVERY = 10.0  # s between two lines of progress, if no terminal shows a bar
SAME_SIGNAL = 0.5  # s in which a repeated signal counts as the same
LOOK_AGAIN = 0.02  # s until a Ctrl-C that would have been lost is sent again
LONGEST_WAIT = 10.0  # s after which `KeyboardInterrupt` is raised even where it may be lost
_IMPORT = "<frozen importlib._bootstrap>"  # file name of the stack frames of an import
# Functions that lose exceptions: finalisers, the callbacks of LLVM after it has compiled or loaded a kernel
# (the first Python code for long), and the hook below that sends a lost Ctrl-C again.
_LOSING = {"__del__", "_raw_object_cache_notify", "_raw_object_cache_getbuffer", "unraisable"}

_CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x80-\x9f]")  # all but the end of a line


def visible(said: str) -> str:
    r"""Escape control characters (tab and ESC as `\t` and `\x1b`): names of files and topics may hold some,
    and a terminal would obey them."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), said)


class _Console(Console):
    def render_str(self, text: str, **options: Any) -> Text:
        """Make text visible. All text comes through here: lines, and the cells of tables."""
        return super().render_str(visible(text), **options)


console = _Console(stderr=True, highlight=False, emoji=False)  # a name or a key may hold ":x:"
log = logging.getLogger(__name__)


class _Json(logging.Formatter):
    """Formats each log record as one JSON object in a line."""

    def format(self, record: logging.LogRecord) -> str:
        said = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            said["traceback"] = self.formatException(record.exc_info)
        return json.dumps(said)


class _Lines(logging.Handler):
    """Prints the log for people, in the form of `tell`."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            _print(f"{record.levelname.lower()}: {self.format(record)}")
        except OSError:  # the terminal is gone, which must not end the thread that logs
            self.handleError(record)


def log_handler() -> logging.Handler:
    """Return a log handler for people, or, if the console is quiet, for programs."""
    if not console.quiet:
        return _Lines()
    handler = logging.StreamHandler()
    handler.setFormatter(_Json())
    return handler


def tell(line: str) -> None:
    """Tell a person something: a line, or a log record if the console is quiet."""
    if console.quiet:
        log.warning("%s", line)
    _print(line)


def _print(line: str) -> None:
    """Print a line; outside a terminal with its time, since nobody saw when it came."""
    when = "" if console.is_terminal else datetime.now().astimezone().isoformat(" ", "seconds") + " "
    console.print(when + line, markup=False, soft_wrap=True)


class _TimeLeft(TimeRemainingColumn):
    """The estimate that the work gave, or else that of its count."""

    def render(self, task: Task) -> Text:
        left = task.fields.get("left")
        return super().render(task) if left is None else Text(f"about {time_text(left)} left")


@contextmanager
def progress(what: str, now: Callable[[], float] = time.monotonic) -> Iterator[Callable[..., None]]:
    """Show a progress bar, which appears at the first advance(done, total=None, description=None, left=None).
    `left`: s until all ends, where that is known better. Without a terminal, print a line every `SAY_EVERY` s
    instead."""
    described = TextColumn("{task.description}", markup=False)
    columns = (described, BarColumn(), MofNCompleteColumn(), _TimeLeft())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None, visible=False)
        said = began = now()
        first, last, count = 0, 0, 0  # start, present value and total of the running count

        def advance(
            done: int, total: int | None = None, description: str | None = None, left: float | None = None
        ) -> None:
            nonlocal said, began, first, last, count
            shown = visible(description or what)
            bar.update(task, completed=done, total=total, description=shown, visible=True, left=left)
            if console.is_terminal:
                return
            moment, of = now(), total or 0
            if of != count or done < last:
                began, first, count = moment, done, of
            last = done
            if moment - said >= SAY_EVERY:
                said = moment
                rest = ""
                if left is None and of and done > first + 1:  # the first step may have compiled kernels
                    left = (moment - began) / (done - first) * (of - done)
                if left is not None:
                    rest = f", about {time_text(left)} left"
                _print(f"{description or what}: {done}" + ("" if total is None else f" of {total}{rest}"))

        yield advance


def time_text(seconds: float) -> str:
    """A duration as text, rounded as an estimate."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def show(result: Table | str | dict[str, Any] | list[dict[str, Any]]) -> None:
    """Print a result: tables and text for people, anything else as JSON."""
    if isinstance(result, Table):
        click.echo(_drawn(result))
    else:
        click.echo(visible(result) if isinstance(result, str) else json_text(result))


def json_text(value: Any, indent: int | None = None) -> str:
    """Return JSON, in one line without `indent`. Numbers that are not finite become null: JSON has no NaN."""
    return json.dumps(json.loads(json.dumps(value), parse_constant=lambda name: None), indent=indent)


def _drawn(table: Table) -> str:
    screen = _Console(width=None if sys.stdout.isatty() else WIDE, highlight=False, markup=False, emoji=False)
    for column in table.columns:
        column.overflow = "fold"  # a path or a command that is cut off is of no use
    with screen.capture() as captured:
        screen.print(table)
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


class _Interrupt:
    """Handler of Ctrl-C: raises `KeyboardInterrupt` as soon as it cannot get lost.

    During an import C code may turn it into an `ImportError`; finalisers and callbacks of C code lose
    it.
    """

    def __init__(self) -> None:
        self._waits_until: float | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if _loses_exceptions(frame) and (self._waits_until is None or now < self._waits_until):
            self._waits_until = self._waits_until or now + LONGEST_WAIT
            self._again(number)
            return
        self._waits_until = None
        raise KeyboardInterrupt

    def unraisable(self, lost: sys.UnraisableHookArgs) -> None:
        """Send a Ctrl-C again that was lost all the same, e.g. in ZeroMQ; a `sys.unraisablehook`."""
        if lost.exc_type is KeyboardInterrupt:
            self._again(signal.SIGINT)
        else:
            sys.__unraisablehook__(lost)

    def _again(self, number: int) -> None:
        """Send the signal again to this thread, the main one: if it waits by then, it must wake."""
        again = threading.Timer(LOOK_AGAIN, signal.pthread_kill, (threading.get_ident(), number))
        again.daemon = True
        again.start()


def _loses_exceptions(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == _IMPORT or frame.f_code.co_name in _LOSING:
            return True
        frame = frame.f_back
    return False


interrupt = _Interrupt()


def on_stop_signals(stop: Callable[[], None]) -> None:
    """Call `stop` at Ctrl-C, a service manager's stop or the end of the terminal; a second signal interrupts.

    Long-running work needs this: an exception that is raised in a finaliser is lost. A signal within
    `SAME_SIGNAL` s of the first is the same one: a wrapper or a shell that passes it on sends it twice.
    """
    first: dict[int, float] = {}

    def handle(number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if now - first.setdefault(number, now) > SAME_SIGNAL:
            interrupt(number, frame)
        else:
            start_new_thread(stop, ())  # here it could wait for a lock that what it interrupts holds

    signal.signal(signal.SIGINT, handle)
    signal.signal(signal.SIGTERM, handle)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # it is ignored under nohup
        signal.signal(signal.SIGHUP, handle)


@contextmanager
def stop_signals() -> Iterator[threading.Event]:
    """Give an event that is set by the signals of `on_stop_signals`, during the block.

    For work with threads: an exception amid its start or end would leave threads and sockets behind.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    stop = threading.Event()
    on_stop_signals(stop.set)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
