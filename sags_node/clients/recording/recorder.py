"""Records what a running node publishes. It can lose messages, never slow the node.

The calling thread receives; a second one compresses and writes. What does not fit between them is dropped and
counted, and so is what never arrived (gaps in `seq`).
"""

import logging
import shlex
import shutil
import threading
import time
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path
from typing import Any

from sags_node.clients.recording.backlog import Arrived, Backlog, Ring
from sags_node.clients.recording.bag_writer import NO_LIMITS, Limits
from sags_node.clients.recording.message_writer import Compression, MessageWriter, is_latched
from sags_node.errors import SagsError, UsageError
from sags_node.files import check_folder
from sags_node.messaging import cdr, topics
from sags_node.messaging.address import THE_NODE, NodeAddress
from sags_node.messaging.freshness import TWO_NODES, Freshness
from sags_node.messaging.stream import listen_to

log = logging.getLogger(__name__)

FLUSH_PERIOD = 0.5  # s; what a killed recorder loses at most, if the disk keeps up
TAKE_SECONDS = 0.1  # s that the writing thread waits for a message
TELL_PERIOD = 1.0  # s between two reports of progress
HIGH_WATER = 10 * len(topics.TOPICS)  # queued messages: ten whole frames, while the writer holds the GIL
DEFAULT_CACHE_MB = 256.0

Tell = Callable[[dict[str, Any]], None]


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
    dropped: int = 0  # no room in the backlog or the ring
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
        self._why_rejected: str | None = None  # the reason of the first one
        self._refused: set[str] = set()  # thin images that the node cannot make
        self._is_mixed = False  # two nodes are recorded, which was warned of
        self._bytes = 0
        self._free: int | None = None  # free bytes of the disk
        self._kept_s = 0.0  # s from the oldest to the newest message in the ring
        self._began = self._last_came = time.monotonic()
        self._error: SagsError | None = None
        self._progress: Tell = lambda said: None

    def stop(self) -> None:
        """End `run` as soon as everything received is written."""
        self._stopping.set()

    def snapshot(self) -> None:
        """Write what the ring holds; only with `snapshot_seconds`."""
        self._snapshot_wanted.set()

    def run(self, tell: Tell = lambda said: None, progress: Tell = lambda said: None) -> dict[str, Any]:
        """Record until `stop`; returns the summary that `sags bag record --json` prints.

        Args:
            tell: called with `{"recording": folder}` when the file is open, and for every snapshot with
                `{"snapshot": folder, "messages": count, "seconds": held}`, or with `{"error": text}` where it
                failed.
            progress: called with the summary once a second.

        Raises:
            UsageError: something is at the folder already, a topic is unknown, or its numbers would have no
                meaning in a bag.
            SagsError: no node is known, it refuses this client or all that is recorded, the disk is full, or
                what came was not written for another reason.
        """
        for name in (topics.plain_name(self._options.node.ns, each) for each in self._options.topics):
            if name.startswith(topics.THIN) and topics.is_scaled(whole := topics.thin_picture(name)):
                raise UsageError(f"'{name}': a bag cannot say what its numbers mean; record {whole.topic}")
        self._began = self._last_came = time.monotonic()
        self._progress = progress
        if self._options.snapshot_seconds is None:
            self._record(tell)
        else:
            self._keep_last(self._options.snapshot_seconds, tell)
        if self._error is not None:
            raise self._error
        return self.summary()

    def summary(self) -> dict[str, Any]:
        """Return what was recorded until now, see `run`. Any thread may call this."""
        now = time.monotonic()
        recorded = max(self._last_came - self._began, 1e-3)
        rows = {
            name: {"messages": topic.messages, "dropped": topic.dropped, "lost": topic.fresh.lost}
            for name, topic in sorted(self._topics.copy().items())
        }
        totals = {key: sum(row[key] for row in rows.values()) for key in ("messages", "dropped", "lost")}
        return {
            "folder": str(self._options.folder),
            "seconds": round(now - self._began, 3),
            "silent_s": round(now - self._last_came, 3),
            **totals,
            "rejected": self._rejected,
            "rejected_why": self._why_rejected,
            "bytes": self._bytes,
            "mb_per_s": round(self._bytes / 1e6 / recorded, 2),
            "free_bytes": self._free,
            "snapshot_seconds": self._options.snapshot_seconds,
            "kept_s": None if self._options.snapshot_seconds is None else round(self._kept_s, 3),
            "topics": rows,
        }

    def _messages(self) -> Generator[Arrived | None, None, None]:
        """Every new message once, None now and then while nothing comes; ends after `stop`."""
        options = self._options
        thin = topics.full_name(options.node.ns, topics.THIN)
        next_tell = time.monotonic() + TELL_PERIOD
        with closing(listen_to(options.node, options.topics, None, HIGH_WATER, self._refuse)) as heard:
            for arrived in heard:
                if self._stopping.is_set() or self._error is not None:
                    return
                now = time.monotonic()
                if arrived is not None:
                    self._last_came = now
                if now >= next_tell:
                    next_tell = now + TELL_PERIOD
                    self._progress(self.summary())
                if arrived is None:
                    yield None
                    continue
                message, received_ns = arrived
                if not options.topics and message.topic.startswith(thin):  # another client asked for it
                    continue
                if not cdr.knows(message.meta.type):
                    self._reject(f"{message.topic}: unknown type {message.meta.type!r}")
                    continue
                topic = self._topics.setdefault(message.topic, _Topic())
                if topic.fresh.accept(message.meta):  # a last value sent again is nothing new
                    if topic.fresh.is_mixed and not self._is_mixed:
                        log.warning("%s: %s; both are recorded", message.topic, TWO_NODES)
                        self._is_mixed = True
                    yield Arrived(message, received_ns)

    def _refuse(self, topic: str, why: str) -> None:
        """Note that the node cannot make a thin image."""
        self._refused.add(topic)
        if not self._topics and len(self._refused) == len(set(self._options.topics)):
            raise SagsError(why)  # nothing else is recorded
        self._reject(why)

    def _reject(self, why: str) -> None:
        if not self._rejected:
            log.warning("left out: %s", why)
            self._why_rejected = why
        self._rejected += 1

    def _writer(self, folder: Path) -> MessageWriter:
        options = self._options
        return MessageWriter(folder, options.node.ns, options.compression, options.limits)

    # ---- everything ----------------------------------------------------------------------------------

    def _record(self, tell: Tell) -> None:
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
            except SagsError as refusal:
                self._error = refusal
            finally:
                backlog.close()
                thread.join()
            if self._error is not None and not writer.bag.messages:
                writer.bag.discard()

    def _write(self, writer: MessageWriter, backlog: Backlog) -> None:
        """The second thread."""
        try:
            with writer.bag:
                next_flush = time.monotonic()
                while not backlog.finished:
                    arrived = backlog.take(TAKE_SECONDS)
                    if arrived is not None:
                        self._write_one(writer, arrived)
                    if time.monotonic() >= next_flush:
                        writer.bag.flush()
                        self._bytes = writer.bag.bytes
                        with suppress(OSError):  # writing will say it
                            self._free = shutil.disk_usage(self._options.folder).free
                        next_flush = time.monotonic() + FLUSH_PERIOD
        except Exception as error:  # `run` raises it: nothing is lost silently
            self._error = _told(self._options.folder, error)
        self._bytes = writer.bag.bytes

    def _write_one(self, writer: MessageWriter, arrived: Arrived) -> None:
        try:
            writer.write(arrived)
        except SagsError as error:  # of this message alone
            self._reject(str(error))
            return
        self._topics[arrived.message.topic].messages += 1

    # ---- only the last seconds -----------------------------------------------------------------------

    def _keep_last(self, seconds: float, tell: Tell) -> None:
        check_folder(self._options.folder)
        ring = Ring(seconds, self._most_bytes)
        saving: list[threading.Thread] = []
        number = 0
        with closing(self._messages()) as messages:
            first = next(messages, None)
            tell({"recording": str(self._options.folder)})
            for arrived in chain((first,), messages, (None,)):  # at last what is asked for just before `stop`
                if arrived is not None:
                    latched = is_latched(arrived.message.topic, self._options.node.ns)
                    for pushed_out in ring.add(arrived, latched):
                        self._topics[pushed_out.message.topic].dropped += 1
                    self._kept_s = ring.seconds
                if self._snapshot_wanted.is_set():
                    self._snapshot_wanted.clear()
                    number = next(n for n in count(number) if not self._snapshot(n).exists())
                    saved = self._snapshot(number), ring.content(), self._kept_s, tell
                    saving.append(threading.Thread(target=self._save, args=saved, daemon=True))
                    saving[-1].start()
                    number += 1
        for thread in saving:
            thread.join()

    def _snapshot(self, number: int) -> Path:
        return self._options.folder / f"snapshot_{number:03d}"

    def _save(self, folder: Path, messages: list[Arrived], seconds: float, tell: Tell) -> None:
        """A thread for each snapshot, so that receiving goes on. A failure ends nothing: what the ring holds
        can be saved elsewhere."""
        try:
            writer = self._writer(folder)
            with writer.bag:
                for arrived in messages:
                    self._write_one(writer, arrived)
        except Exception as error:  # nothing is lost silently
            tell({"error": str(_told(folder, error))})
            return
        self._bytes += writer.bag.bytes
        tell({"snapshot": str(folder), "messages": writer.bag.messages, "seconds": round(seconds, 3)})


def _told(folder: Path, error: Exception) -> SagsError:
    """The error to raise for a failure of a thread that writes, in words for people."""
    if isinstance(error, SagsError):
        return error
    if isinstance(error, OSError):
        what = error.strerror
    else:
        log.error("writing %s failed", folder, exc_info=error)
        what = f"{type(error).__name__}: {error}"
    return SagsError(
        f"cannot write {folder}: {what}; save what is there with: sags bag recover "
        f"{shlex.quote(str(folder))} -o OUT"
    )
