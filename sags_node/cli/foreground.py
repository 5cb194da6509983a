"""`sags run`: the node in the foreground, with what it does shown live."""

import threading
import time
from collections.abc import Callable

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from sags_node.config.schema import LaunchConfig, PushRobot, PushSource, Ros2Robot, Ros2Source
from sags_node.findings import by_code, in_words
from sags_node.node.health import in_a_line
from sags_node.node.node import Node
from sags_node.ros.graph import domain_of, where
from sags_node.sources.ros2 import absolute, picture_topics
from sags_node.terminal import text
from sags_node.terminal.console import progress, tell
from sags_node.terminal.notices import Notices
from sags_node.types import NodeHealth

REFRESH = 4.0  # per second


def run_node(node: Node, seconds: float | None, console: Console, stop: threading.Event) -> NodeHealth:
    """Run until the source ends, `seconds` have passed or `stop` is set; returns the last health.

    Prints every warning that holds for `1 / REFRESH` s, when it begins and when it ends, and without a
    terminal, now and then, what is published.

    Raises:
        SagsError: what ended the node, if something did.
    """
    deadline = None if seconds is None else time.monotonic() + seconds
    try:
        node.start()
        if console.is_terminal:
            with Live(console=console, refresh_per_second=REFRESH, transient=True) as live:
                _watch(node, deadline, stop, lambda health: live.update(health_table(health)))
        else:
            with progress("") as say:
                what = "{}; frames published".format
                _watch(node, deadline, stop, lambda health: say(node.sent, None, what(in_a_line(health))))
        if stop.is_set():
            console.print("stopping")
    finally:
        health = node.health()
        node.stop()
    return health


def inputs_text(config: LaunchConfig) -> list[str]:
    """Return where the node takes images and poses of other programs, a line each."""
    lines = []
    for what, part in (("images", config.source), ("poses", config.robot)):
        if isinstance(part, PushSource | PushRobot):
            lines.append(f"taking {what} at {part.endpoint}")
        elif isinstance(part, Ros2Source | Ros2Robot):
            names = picture_topics(part).values() if isinstance(part, Ros2Source) else [absolute(part.topic)]
            topics = " and ".join(names)
            lines.append(f"taking {what} from {where(domain_of(part), part.interface)}: {topics}")
    return lines


def _watch(
    node: Node, deadline: float | None, stop: threading.Event, show: Callable[[NodeHealth], None]
) -> None:
    notices = Notices(tell)
    while not (stop.is_set() or node.wait(timeout=1 / REFRESH)):
        health = node.health()
        notices.update(by_code(health.warnings))
        show(health)
        if deadline is not None and time.monotonic() >= deadline:
            return


def ended_text(sent: int, count: int | None) -> str:
    """Return how many frames were published; `count`: frames of the recording, None if it has no end."""
    return f"ended, {sent:,} {'' if count is None else f'of {count:,} '}frames published"


def health_table(health: NodeHealth, state: str | None = None) -> Table:
    """Return a table of a node's health; `state` stands in the place of the node's own."""
    table = text.table()
    table.add_row("state", state or health.state)
    table.add_row("published", f"{health.rate_hz:.1f} Hz")
    p50, p99 = health.latency_ms["p50"], health.latency_ms["p99"]
    table.add_row("latency p50 / p99", f"{p50:.0f} / {p99:.0f} ms" if p50 else "–")
    table.add_row("Gaussians", f"{health.gaussians:,}")
    if health.rung is not None:
        table.add_row("quality", text.rung_text(health.rung))
    if health.clock is not None and health.clock.drift_ppm is not None:
        table.add_row("capture clock", f"drifts by {health.clock.drift_ppm:+.0f} us/s from this machine's")
    table.add_row("stages (ms)", "  ".join(f"{k} {v:.1f}" for k, v in health.stage_ms.items()))
    table.add_row("dropped (frames)", "  ".join(f"{k} {v}" for k, v in health.dropped.items()))
    if health.skipped:
        table.add_row("skipped (frames)", "  ".join(f"{k} {v}" for k, v in health.skipped.items()))
    table.add_row("memory", f"{health.rss_mb:.0f} MB")
    for stage, warning in in_words(health.warnings).items():
        table.add_row(f"warning: {stage}", Text(warning))
    return table
