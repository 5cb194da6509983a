"""What all bridges share: their options, and the loop that passes on the newest of what peers ask for.

What has become too old is taken back, with the reason. The node never waits for a bridge, and the loop never
waits for a peer.
"""

import json
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from sags_node.errors import SagsError, UsageError
from sags_node.messaging import topics
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.received import Frame, Received
from sags_node.messaging.subscriber import SILENT_AFTER, Subscriber
from sags_node.messaging.wire import Meta

MAX_AGE = 0.4  # s since capture: with `LOOK` and the way to a peer, what stops is gone within 0.5 s
LOOK = 0.04  # s; how soon it is noticed that something has become too old
LEAD = 0.2  # s by which a rare output's topics are asked for early: a subscription takes up to 0.1 s
NO_UNIT = "its lengths have no unit, as nobody has calibrated the eyes; docs/calibration.md"
GRACE = 0.5  # s for the first message of what was asked for, before it is said that none comes
LEAST_HZ = 0.5  # Hz; a bridge passes on the newest message, so lost ones are no fault; old ones are
AGAIN = 1.0  # s until a report with other reasons only: the ages in them grow all the time
EVERY_SECOND = ("status", "diagnostics")


@dataclass(frozen=True, slots=True)
class BridgeOptions:
    """How a bridge runs; the defaults are those of the command."""

    node: NodeAddress
    overlay: NodeAddress
    max_age: float = MAX_AGE


@dataclass(frozen=True, slots=True)
class ServerOptions(BridgeOptions):
    """How a bridge runs that peers connect to."""

    host: str = "127.0.0.1"
    port: int = 0  # 0: any free one

    def listen(self, backlog: int) -> socket.socket:
        """Bind the address.

        Raises:
            SagsError: it cannot be bound.
        """
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            return socket.create_server((self.host, self.port), family=family, backlog=backlog)
        except OSError as error:
            raise SagsError(self.not_bound(error.strerror)) from None

    def not_bound(self, why: object) -> str:
        """The error of an address that cannot be bound."""
        return f"cannot listen on {self.host} port {self.port}: {why}; choose another --port (0: any)"


class Source(NamedTuple):
    """A topic of one sender."""

    ns: str
    topic: str


@dataclass(frozen=True, slots=True)
class Output:
    """One thing that a bridge offers to its peers.

    Attributes:
        name: by which peers know it.
        sources: the topics that it is made of, all of one frame. The first one leads.
        period: s between two, at least.
        pulse: for an output with a long period: a small topic of the same sender that comes with every frame.
            Between two of this output only that is asked for, and tells that the sender goes on.
        optional: it is not reported as missing before it has come once.
        lengths: it holds lengths, which peers take for metres: it is not passed on while they have no unit.
    """

    name: str
    sources: tuple[Source, ...]
    period: float = 0.0
    pulse: Source | None = None
    optional: bool = False
    lengths: bool = False


class Outlet(Protocol):
    """The side of a bridge that speaks to peers, with defaults; all is called from the loop's thread."""

    def wants(self, output: Output) -> bool:
        """Tell whether any peer asks for it."""
        return True

    def send(self, output: Output, frame: Frame) -> bool:
        """Pass on a new frame to the peers that ask for the output; False: it holds nothing for them."""
        ...

    def blank(self, output: Output, reason: str) -> None:
        """Take back what was sent: it is not new any more."""
        return None

    def started_anew(self, ns: str) -> None:
        """Take note that a sender was replaced: what the old one numbered, such as anchors, is gone."""
        return None

    def report(self, missing: Mapping[str, str], shows: bool) -> None:
        """Take note of wanted outputs that do not come (output -> reason), and whether any output does;
        called when that changes."""
        return None


@dataclass(slots=True)
class _Course:
    """How one output that peers ask for is doing."""

    since: float  # monotonic s; when peers began to ask
    due: float = 0.0  # monotonic s; of the next one
    sent: Meta | None = None  # of the leading message
    shown_ns: int | None = None  # capture time of what is shown; None: nothing is
    reason: str | None = None  # why nothing is shown


class Relay:
    """Passes topics on to one outlet.

    Args:
        senders: a node, and others such as an overlay.
        max_age: s since capture; what is older is taken back.

    Raises:
        UsageError: a sender's keys do not fit.
        SagsError: an endpoint is malformed.
    """

    def __init__(
        self,
        senders: Sequence[NodeAddress],
        outputs: Sequence[Output],
        outlet: Outlet,
        max_age: float = MAX_AGE,
    ) -> None:
        self._outputs, self._outlet, self._max_age = outputs, outlet, max_age
        self._arrived = threading.Event()
        self._courses: dict[str, _Course] = {}
        self._reported: tuple[dict[str, str], bool | None] = {}, None
        self._tell_again = 0.0  # monotonic s
        self._senders = {sender.ns: sender for sender in senders}
        self._feeds: dict[str, Feed] = {}
        try:
            for ns, sender in self._senders.items():
                self._feeds[ns] = Feed(self._topics(ns), sender, max_age, self._arrived.set)
        except BaseException:
            self.close()
            raise

    def run(self, stop: threading.Event) -> None:
        """Pass on until `stop` is set."""
        while not stop.is_set():
            self.step()
            self.wait()

    def wait(self) -> None:
        """Wait until something comes, at most for `LOOK`."""
        self._arrived.wait(LOOK)
        self._arrived.clear()

    def step(self) -> None:
        """Ask for what is wanted now, and pass on what is new."""
        now = time.monotonic()
        wanted = [output for output in self._outputs if self._outlet.wants(output)]
        names = {output.name for output in wanted}
        self._courses = {name: course for name, course in self._courses.items() if name in names}
        for output in wanted:
            self._courses.setdefault(output.name, _Course(since=now))
        asked = {source for output in wanted for source in self._asked(output, now)}
        for ns, feed in self._feeds.items():
            if feed.started_anew():
                self._outlet.started_anew(ns)
            feed.ask(source.topic for source in asked if source.ns == ns)
        for output in wanted:
            self._pass_on(output, self._courses[output.name], now)
        missing = {name: course.reason for name, course in self._courses.items() if course.reason is not None}
        shows = any(course.shown_ns is not None for course in self._courses.values())
        told, showed = self._reported
        if missing.keys() != told.keys() or shows != showed or (missing != told and now >= self._tell_again):
            self._reported, self._tell_again = (missing, shows), now + AGAIN
            self._outlet.report(missing, shows)

    def close(self) -> None:
        for feed in self._feeds.values():
            feed.close()

    # ---- one output ----------------------------------------------------------------------------------------

    def _pass_on(self, output: Output, course: _Course, now: float) -> None:
        problem = self._problem(output, course)
        if problem is None and now >= course.due:
            frame = self._frame(output)
            leading = course.sent if frame is None else frame[output.sources[0].topic].meta
            if frame is not None and leading is not None and leading != course.sent:
                course.due = max(course.due + output.period, now)
                course.sent = leading
                if self._outlet.send(output, frame):
                    course.shown_ns, course.reason = leading.stamp_ns, None
        if problem is not None and course.shown_ns is not None:
            course.shown_ns = course.sent = None
            self._outlet.blank(output, problem)
            course.reason = problem
        elif course.shown_ns is None and not output.optional and now - course.since > GRACE:
            course.reason = problem or "no whole frame came"

    def _problem(self, output: Output, course: _Course) -> str | None:
        """Why the output must not be shown now; None: it may be."""
        for source in output.sources if output.pulse is None else (output.pulse,):
            problem = self._feeds[source.ns].problem(source.topic)
            if problem is not None:
                return f"{topics.full_name(*source)}: {problem}"
        first = output.sources[0]
        leading = self._feeds[first.ns].latest(first.topic) if output.lengths else None
        if leading is not None and not leading.metric:
            return f"{topics.full_name(*first)}: {NO_UNIT}"
        if course.shown_ns is None or not _is_periodic(output):
            return None
        seconds = any(source.topic in EVERY_SECOND for source in output.sources)
        limit = output.period + LEAD + (SILENT_AFTER if seconds else self._max_age)
        age = (self._senders[output.sources[0].ns].now_ns() - course.shown_ns) * 1e-9
        return f"no whole frame for {age:.1f} s" if age > limit else None

    def _frame(self, output: Output) -> Frame | None:
        """The newest frame of which everything came and is new."""
        first = output.sources[0]
        leading = self._feeds[first.ns].latest(first.topic)
        if leading is None:
            return None
        whole = Frame()
        for ns, feed in self._feeds.items():
            names = [source.topic for source in output.sources if source.ns == ns]
            part = feed.frame(names, leading.stamp_ns) if names else Frame()
            if part is None or any(feed.problem(name) is not None for name in names):
                return None
            whole.update(part)
        return whole

    def _asked(self, output: Output, now: float) -> tuple[Source, ...]:
        """The topics to ask for now."""
        if output.pulse is None:
            return output.sources
        soon = now >= self._courses[output.name].due - LEAD
        return (output.pulse, *output.sources) if soon else (output.pulse,)

    def _topics(self, ns: str) -> list[str]:
        sources = [
            source
            for output in self._outputs
            for source in (*output.sources, *([] if output.pulse is None else [output.pulse]))
        ]
        return list(dict.fromkeys(source.topic for source in sources if source.ns == ns))


class Feed:
    """Follows one sender; used from one thread.

    Args:
        topics: all that may be asked for, without the namespace.
        max_age: s since capture, after which nothing is new any more.
        wake: called from another thread for each message that comes.

    Raises:
        UsageError: the node wants keys that are not given, or the other way round.
        SagsError: the endpoint is malformed. That nobody is there yet is no error.
    """

    def __init__(
        self, topics: Iterable[str], sender: NodeAddress, max_age: float, wake: Callable[[], None]
    ) -> None:
        self._max_age, self._session = max_age, ""
        rates = dict.fromkeys((*topics, "status"), LEAST_HZ)
        self._subscriber = Subscriber.at(sender, rates, rates=rates, paused=True, may_be_absent=True)
        self._resources = ExitStack()
        self._resources.callback(self._subscriber.close)
        self._resources.enter_context(self._subscriber.notified(wake))

    def ask(self, names: Iterable[str]) -> None:
        """Let the sender make and send these topics, and nothing else but `status`.

        Raises:
            UsageError: the sender has come, and wants keys that are not given, or the other way round.
        """
        if not self._subscriber.endpoint and self._subscriber.refusal is not None:
            raise UsageError(self._subscriber.refusal)
        self._subscriber.ask(names)

    def problem(self, name: str) -> str | None:
        """Return why the newest message of a topic must not be shown as new; None when it may be."""
        limit = SILENT_AFTER if name in EVERY_SECOND else self._max_age
        problem, topic = self._subscriber.problem(name, limit), topics.find(name)
        if problem is not None or topic is None or topic.periodic or self.latest("status") is None:
            return problem
        return self._subscriber.problem("status", SILENT_AFTER)  # nothing else tells that its sender has gone

    def started_anew(self) -> bool:
        """Tell whether the sender is another one than when this was last asked."""
        status, before = self._subscriber.latest("status"), self._session
        self._session = before if status is None else status.meta.session
        return before not in ("", self._session)

    def latest(self, name: str) -> Received | None:
        """The newest message of a topic, however old it is."""
        return self._subscriber.latest(name)

    def frame(self, names: Iterable[str], stamp_ns: int) -> Frame | None:
        """The messages of these topics that show the frame captured at `stamp_ns`, if all have come."""
        return self._subscriber.aligned(names, stamp_ns)

    def close(self) -> None:
        self._resources.close()


def silent(reason: str) -> str:
    """Return the JSON text to send in place of a text that has been taken back."""
    return json.dumps({"state": "silent", "reason": reason})


def _is_periodic(output: Output) -> bool:
    """Tell whether its leading topic repeats, so that silence means stale."""
    topic = topics.find(output.sources[0].topic)
    return topic is None or topic.periodic
