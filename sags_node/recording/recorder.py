"""Records what a running node publishes. It can lose messages, never slow the node.

The calling thread receives; a second one compresses and writes. What does not fit between them is dropped and
counted, and so is what never arrived (gaps in `seq`).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from sags_node.errors import SagsError, UsageError
from sags_node.messaging import cdr, topics
from sags_node.messaging.address import THE_NODE, NodeAddress
from sags_node.messaging.freshness import Freshness
from sags_node.messaging.stream import listen_to
from sags_node.messaging.wire import WireError
from sags_node.recording.backlog import Arrived, Backlog
from sags_node.recording.bag_writer import NO_LIMITS, Limits
from sags_node.recording.message_writer import Compression, MessageWriter
from sags_node.recording.ring import Ring

FLUSH_PERIOD = 0.5  # s; what a killed recorder loses at most, if the disk keeps up
TAKE_SECONDS = 0.1
HIGH_WATER = 10 * len(topics.TOPICS)  # messages: ten whole frames, while the writer holds the interpreter
DEFAULT_CACHE_MB = 256.0


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """What to record, and how.

    Attributes:
        topics: with or without the namespace; empty: all.
        snapshot_seconds: keep only the last seconds in memory, and write them when asked to.
        limits: of each file in the bag.
    """

    folder: Path
    topics: tuple[str, ...] = ()
    compression: Compression = "none"
    max_cache_mb: float = DEFAULT_CACHE_MB
    snapshot_seconds: float | None = None
    limits: Limits = NO_LIMITS
    node: NodeAddress = THE_NODE


@dataclass(slots=True)
class _Topic:
    messages: int = 0  # written
    dropped: int = 0  # no room in the backlog
    fresh: Freshness = field(default_factory=Freshness)


class Recorder:
    """Call `run` once. `stop` and `snapshot` may be called from any thread or signal handler."""

    def __init__(self, options: RecordOptions) -> None:
        self._options = options
        self._most_bytes = int(options.max_cache_mb * 1e6)
        self._stopping = threading.Event()
        self._snapshot_wanted = threading.Event()
        self._topics: dict[str, _Topic] = {}
        self._rejected = 0
        self._bytes = 0
        self._began = time.monotonic()
        self._error: SagsError | None = None

    def stop(self) -> None:
        """End `run` as soon as everything received is written."""
        self._stopping.set()

    def snapshot(self) -> None:
        """Write what the ring holds; only with `snapshot_seconds`."""
        self._snapshot_wanted.set()

    def run(self, tell: Callable[[dict[str, Any]], None] = lambda said: None) -> dict[str, Any]:
        """Record until `stop`; returns the summary that `sags bag record --json` prints.

        Args:
            tell: called with `{"recording": folder}` when the file is open, and with
                `{"snapshot": folder, "messages": count}` for every snapshot.

        Raises:
            UsageError: something is at the folder already, or an unknown topic.
            SagsError: no node is known, it refuses this client, or the disk is full.
        """
        self._began = time.monotonic()
        if self._options.snapshot_seconds is None:
            self._record(tell)
        else:
            self._keep_last(self._options.snapshot_seconds, tell)
        if self._error is not None:
            raise self._error
        return self.summary()

    def summary(self) -> dict[str, Any]:
        """What was recorded until now, see `run`. Any thread may call this."""
        seconds = time.monotonic() - self._began
        rows = {
            name: {"messages": topic.messages, "dropped": topic.dropped, "lost": topic.fresh.lost}
            for name, topic in sorted(self._topics.items())
        }
        totals = {key: sum(row[key] for row in rows.values()) for key in ("messages", "dropped", "lost")}
        return {
            "folder": str(self._options.folder),
            "seconds": round(seconds, 3),
            **totals,
            "rejected": self._rejected,
            "bytes": self._bytes,
            "mb_per_s": round(self._bytes / 1e6 / seconds, 2),
            "topics": rows,
        }

    def _messages(self) -> Generator[Arrived | None, None, None]:
        """Every new message once, None now and then while nothing comes; ends after `stop`."""
        options = self._options
        thin = topics.full_name(options.node.ns, topics.THIN)
        with closing(listen_to(options.node, options.topics, None, HIGH_WATER)) as heard:
            for arrived in heard:
                if self._stopping.is_set() or self._error is not None:
                    return
                if arrived is None:
                    yield None
                    continue
                message, received_ns = arrived
                if not options.topics and message.topic.startswith(thin):  # another's, of a whole one
                    continue
                if not cdr.knows(message.meta.type):
                    self._rejected += 1
                    continue
                topic = self._topics.setdefault(message.topic, _Topic())
                if topic.fresh.accept(message.meta):  # a last value sent again is nothing new
                    yield Arrived(message, received_ns)

    def _writer(self, folder: Path) -> MessageWriter:
        options = self._options
        return MessageWriter(folder, options.node.ns, options.compression, options.limits)

    # ---- everything ----------------------------------------------------------------------------------

    def _record(self, tell: Callable[[dict[str, Any]], None]) -> None:
        options = self._options
        backlog = Backlog(self._most_bytes)
        with closing(self._messages()) as messages:
            first = next(messages, None)  # connects: without a node there will be no folder
            writer = self._writer(options.folder)
            # A daemon: a second Ctrl-C ends the process also while the disk hangs.
            thread = threading.Thread(target=self._write, args=(writer, backlog), daemon=True)
            thread.start()
            try:
                tell({"recording": str(options.folder)})
                for arrived in chain((first,), messages):
                    if arrived is not None and not backlog.put(arrived):
                        self._topics[arrived.message.topic].dropped += 1
            finally:
                backlog.close()
                thread.join()

    def _write(self, writer: MessageWriter, backlog: Backlog) -> None:
        """The second thread."""
        try:
            with writer.bag:
                next_flush = time.monotonic() + FLUSH_PERIOD
                while not backlog.finished:
                    arrived = backlog.take(TAKE_SECONDS)
                    if arrived is not None:
                        self._write_one(writer, arrived)
                    if time.monotonic() >= next_flush:
                        writer.bag.flush()
                        next_flush = time.monotonic() + FLUSH_PERIOD
        except OSError as error:
            self._error = _disk_error(self._options.folder, error)
        self._bytes += writer.bag.bytes

    def _write_one(self, writer: MessageWriter, arrived: Arrived) -> None:
        try:
            writer.write(arrived)
        except (WireError, UsageError):
            self._rejected += 1
            return
        self._topics[arrived.message.topic].messages += 1

    # ---- only the last seconds -----------------------------------------------------------------------

    def _keep_last(self, seconds: float, tell: Callable[[dict[str, Any]], None]) -> None:
        ring = Ring(seconds, self._most_bytes)
        saving: list[threading.Thread] = []
        with closing(self._messages()) as messages:
            first = next(messages, None)
            tell({"recording": str(self._options.folder)})
            for arrived in chain((first,), messages):
                if arrived is not None:
                    for pushed_out in ring.add(arrived, self._is_latched(arrived)):
                        self._topics[pushed_out.message.topic].dropped += 1
                if self._snapshot_wanted.is_set():
                    self._snapshot_wanted.clear()
                    folder = self._options.folder / f"snapshot_{len(saving):03d}"
                    content = ring.content()
                    saving.append(
                        threading.Thread(target=self._save, args=(folder, content, tell), daemon=True)
                    )
                    saving[-1].start()
        for thread in saving:
            thread.join()

    def _is_latched(self, arrived: Arrived) -> bool:
        known = topics.BY_NAME.get(arrived.message.topic.removeprefix(f"{self._options.node.ns}/"))
        return known is not None and known.cached

    def _save(self, folder: Path, messages: list[Arrived], tell: Callable[[dict[str, Any]], None]) -> None:
        """A thread for each snapshot, so that receiving goes on."""
        try:
            writer = self._writer(folder)
            with writer.bag:
                for arrived in messages:
                    self._write_one(writer, arrived)
        except OSError as error:
            self._error = _disk_error(folder, error)
            return
        except SagsError as error:
            self._error = error
            return
        self._bytes += writer.bag.bytes
        tell({"snapshot": str(folder), "messages": writer.bag.messages})


def _disk_error(folder: Path, error: OSError) -> SagsError:
    return SagsError(
        f"cannot write {folder}: {error.strerror}; save what is there with: sags bag recover {folder} -o OUT"
    )
