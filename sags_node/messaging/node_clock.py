"""The wall clock of another machine: how far it is ahead of this one's, and how sure that is.

with NodeClock("tcp://node:5557") as clock, Subscriber(names, "tcp://node:5556", clock=clock) as subscriber:
    subscriber.ok("left/render/depth")  # it is new enough, by the node's clock
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

from sags_node.errors import SagsError
from sags_node.messaging.address import ClientKeys, NodeAddress
from sags_node.messaging.control import ControlClient
from sags_node.messaging.sockets import Closes
from sags_node.workers import go_on

DRIFT = 500e-6  # s/s between two clocks, at most: NTP slews by no more (RFC 5905), quartz drifts by a tenth
PERIOD = 1.0  # s between two rounds of exchanges
EXCHANGES = 8  # in a round: where delays vary, some are short, and only those give tight bounds
PATIENCE = 1.0  # s for an answer
KNOWN_FOR = 5.0  # s after the last answer; later, a clock may have been set unnoticed


@dataclass(frozen=True, slots=True)
class Offset:
    """How far another clock is ahead: within `seconds` +- `bound`."""

    seconds: float
    bound: float


class Exchange(NamedTuple):
    """The four stamps of one question and its answer, ns (RFC 5905, section 8)."""

    asked: int  # by the clock here
    received: int  # by the clock there
    answered: int  # by the clock there
    came: int  # by the clock here


class OffsetEstimate:
    """The offset that agrees with every exchange.

    A message takes time, so each exchange bounds the offset: it is at least `answered - came` and at most
    `received - asked`. Nothing is assumed about how the delay divides between both ways. The interval is
    widened with time, by `DRIFT`, and intersected with that of each new exchange. If the intersection is
    empty, one of the clocks was set, and only the newest exchange counts.

    Attributes:
        jumps: how often a clock was set.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._between: tuple[float, float] | None = None  # s
        self._at = 0.0  # s, when `_between` held

    def add(self, exchange: Exchange, now: float) -> None:
        """Add an exchange that was made at `now`, s of a monotonic clock."""
        asked, received, answered, came = exchange
        low, high = 1e-9 * (answered - came), 1e-9 * (received - asked)
        if low > high:  # a clock was set meanwhile
            return
        if self._between is not None:
            least, most = self._widened(now)
            if max(low, least) > min(high, most):
                self.jumps += 1
            else:
                low, high = max(low, least), min(high, most)
        self._between, self._at = (low, high), now

    def at(self, now: float) -> Offset | None:
        """The offset `now`; None: nothing is known of it."""
        if self._between is None:
            return None
        low, high = self._widened(now)
        return Offset((low + high) / 2, (high - low) / 2)

    def _widened(self, now: float) -> tuple[float, float]:
        assert self._between is not None
        drifted = DRIFT * (now - self._at)
        return self._between[0] - drifted, self._between[1] + drifted


class NodeClock(Closes):
    """Follows the clock of a node's machine, from a thread of its own. Any thread may ask.

    Args:
        control: the node's control socket; default: from the connection file of `ns`.
        keys: for a node that wants them.

    Raises:
        SagsError: no endpoint is known, or it is malformed.
        UsageError: the node wants keys that are not given, or the other way round.
    """

    def __init__(
        self,
        control: str | None = None,
        ns: str = "sags",
        run_dir: Path | None = None,
        keys: ClientKeys | None = None,
    ) -> None:
        self._client = ControlClient(control, ns, run_dir, keys)
        self._ask = partial(self._client.request, "get_clock", timeout=PATIENCE)
        self._estimate = OffsetEstimate()
        self._lock = threading.Lock()
        self._answered = -float("inf")  # s, when the last answer came
        self._why = "it has not answered yet"
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="sags-node-clock", daemon=True)
        self._thread.start()

    @classmethod
    def at(cls, node: NodeAddress) -> Self:
        """Follow the clock of this node; see the class."""
        return cls(node.control, node.ns, node.run_dir, node.keys)

    @property
    def offset(self) -> Offset | None:
        """How far the node's clock is ahead; None: it is not known, see `problem`."""
        with self._lock:
            now = time.monotonic()
            return self._estimate.at(now) if now - self._answered < KNOWN_FOR else None

    @property
    def problem(self) -> str | None:
        """Why the offset is not known; None: it is."""
        if self.offset is not None:
            return None
        return f"how far the node's clock is off is not known: {self._why}"

    @property
    def jumps(self) -> int:
        """How often one of the clocks was set since the start."""
        with self._lock:
            return self._estimate.jumps

    def latest_ns(self) -> int:
        """Return the latest time (ns) that the node's clock may show now, so that no age is underestimated.
        If the offset is not known, return the time here."""
        offset = self.offset
        return time.time_ns() + (0 if offset is None else round(1e9 * (offset.seconds + offset.bound)))

    def status(self) -> dict[str, Any]:
        """Return for a status message: `offset_ms`, `bound_ms`, `jumps`, `problem`."""
        offset = self.offset
        return {
            "offset_ms": None if offset is None else round(1e3 * offset.seconds, 3),
            "bound_ms": None if offset is None else round(1e3 * offset.bound, 3),
            "jumps": self.jumps,
            "problem": self.problem,
        }

    def _follow(self) -> None:
        go_on(self._look, self._stopping, "the node's clock")
        self._client.close()

    def _look(self) -> None:
        try:
            for _ in range(EXCHANGES):
                if self._stopping.is_set():
                    break
                exchanged = exchange(self._ask)
                with self._lock:
                    self._answered = time.monotonic()
                    self._estimate.add(exchanged, self._answered)
        except SagsError as error:
            self._why = str(error)
        self._stopping.wait(PERIOD)

    def close(self) -> None:
        """End the thread."""
        self._stopping.set()
        self._thread.join()


def stamps() -> dict[str, int]:
    """The node's answer to `get_clock`."""
    received = time.time_ns()
    return {"received_ns": received, "answered_ns": max(received, time.time_ns())}


def exchange(ask: Callable[[], Any]) -> Exchange:
    """Ask once, and return the four stamps.

    Raises:
        SagsError: no answer came, or it holds no stamps.
    """
    asked, began = time.time_ns(), time.monotonic_ns()
    answer = ask()
    came = asked + time.monotonic_ns() - began  # right even if the clock here is set meanwhile
    try:
        received, answered = int(answer["received_ns"]), int(answer["answered_ns"])
    except (KeyError, TypeError, ValueError, OverflowError):
        raise SagsError("the node's answer to get_clock holds no stamps") from None
    return Exchange(asked, received, answered, came)
