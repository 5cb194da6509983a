"""Publishes a bag on the wire again, as a node would: same sockets, same messages, stamped as if live."""

import logging
import struct
import threading
import time
import uuid
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sags_node.bags.bag import BagMessage, read_messages, recorded_namespace, recorded_topics
from sags_node.bags.pictures import decompressed, header_stamp
from sags_node.config.schema import PublishConfig
from sags_node.errors import SagsError, UsageError
from sags_node.files import check_name
from sags_node.messaging import cdr, topics
from sags_node.messaging.cdr import Content
from sags_node.messaging.freshness import STALE_AFTER
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.wire import Buffer
from sags_node.wall_clock import WallClock

log = logging.getLogger(__name__)

POLL_SECONDS = 0.02  # how soon pause and stop are noticed
STAMPS_KEPT = 1024
SAME_CLOCK = round(STALE_AFTER * 1e9)  # ns between stamp and receipt; beyond it another clock stamped
DAMAGED = 3600 * 1_000_000_000  # ns between stamp and receipt; beyond it the stamp is damaged
STRETCHED = 100_000_000  # ns by which slow playing may change the latency of a message
CLOCK_TOPIC = topics.PLAYER_TOPICS[0].name
STAMPED = (topics.IMAGE, cdr.COMPRESSED, topics.POINT_CLOUD, topics.CAMERA_INFO, topics.DIAGNOSTICS)
COMPRESSED_SUFFIX = "/compressed"
_HEADER_AT = 4  # after the four bytes that say how a CDR message is encoded
_FIRST_TRANSFORM_AT = 8  # after the length of the sequence too
_STAMP = struct.Struct("<iI")
FRAME_TYPES = (topics.IMAGE, cdr.COMPRESSED, topics.POINT_CLOUD, topics.CAMERA_INFO, topics.TF)


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """The flags of `ros2 bag play`. Seconds are those of the recording, except for `delay`.

    Attributes:
        topics, exclude: as the bag has them, or without `/compressed`, leading slash or namespace; no topics:
            all.
        remap: from old names, written as for `topics`, to new ones without a namespace.
        clock_hz: how often to publish the recording's time; None: never.
    """

    rate: float = 1.0
    loop: bool = False
    delay: float = 0.0
    start_offset: float = 0.0
    playback_duration: float | None = None
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    remap: dict[str, str] = field(default_factory=dict)
    clock_hz: float | None = None


class PlayClock:
    """Runs from `first_ns` of the recording on, `rate` times as fast as the wall clock.

    `at` is a time of `time.monotonic`, s.
    """

    def __init__(self, first_ns: int, rate: float, wall_ns: Callable[[], int]) -> None:
        self._first_ns, self._rate, self._wall_ns = first_ns, rate, wall_ns
        self._started, self._wall = time.monotonic(), WallClock()

    def pause(self, seconds: float) -> None:
        """Leave the last `seconds` out, in which it was paused."""
        self._started += seconds

    def until(self, recorded_ns: int, at: float) -> float:
        """Return the seconds from `at` until a moment of the recording is due; negative: it was."""
        return self._started + (recorded_ns - self._first_ns) * 1e-9 / self._rate - at

    def wall_ns(self, recorded_ns: int) -> int:
        """Return the wall clock time (ns) at which a moment of the recording is due."""
        began_ns = self._wall.at(self._started, wall_ns=self._wall_ns)
        return began_ns + round((recorded_ns - self._first_ns) / self._rate)

    def stamp_ns(self, log_ns: int, original_ns: int) -> int:
        """The stamp, on the wall clock, of a message that was captured and received at these moments of the
        recording. Slow playing adds at most `STRETCHED` to its latency, and keeps the order of stamps."""
        stamp_ns = self.wall_ns(original_ns)
        if self._rate >= 1:
            return stamp_ns
        as_late = self.wall_ns(log_ns) - (log_ns - original_ns)
        return min(max(stamp_ns, as_late - STRETCHED), as_late + STRETCHED)

    def moment_ns(self, at: float) -> int:
        """The moment of the recording that is due at `at`."""
        return self._first_ns + round((at - self._started) * self._rate * 1e9)


class Player:
    """Call `play` once. `stop` and `toggle_pause` may be called from any thread or signal handler."""

    def __init__(
        self, path: Path, options: PlayOptions, config: PublishConfig, ns: str = "sags", paused: bool = False,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:  # fmt: skip
        self._path, self._wall_ns = path, wall_ns
        self._options = options
        self._config = config
        self._ns = self._recorded_ns = ns
        self._stopping = threading.Event()
        self._paused = paused
        self._sent = 0
        self._clock_due = 0.0
        self._epoch = (
            0  # newest one that was published; grows with each pass, and where the wall clock is set back
        )
        self._frames: OrderedDict[int, tuple[int, int]] = OrderedDict()  # original stamp -> see `_frame_at`
        self._frame_count = 0
        self._same_clock: dict[str, bool] = {}  # by topic: the recorder's clock stamped its first message
        self._session = ""  # the recorded session of the last message
        self._unknown = set[str]()  # topics that are left out, which was warned of
        self._is_unsorted = False  # the file is not in the order of time, which was warned of

    def stop(self) -> None:
        self._stopping.set()

    def toggle_pause(self) -> None:
        self._paused = not self._paused

    def play(self, ready: Callable[[Sequence[str]], None] = lambda endpoints: None) -> dict[str, Any]:
        """Publish until the bag ends or `stop`; returns messages, passes and seconds.

        Args:
            ready: called once with the endpoints, when clients can connect.

        Raises:
            UsageError: there is no bag, its name is no text, it has no topic of a name that was given, or an
                endpoint is open to others without keys.
            SagsError: the bag is damaged, an endpoint is taken, or nothing in the bag was asked for.
        """
        began = time.monotonic()
        passes = 0
        offered = (*topics.TOPICS, *topics.PLAYER_TOPICS)
        session, recording = uuid.uuid4().hex, self._path.absolute()
        check_name(recording)
        self._recorded_ns = recorded_namespace(self._path) or self._ns
        said, plain = self._options, self._name
        self._options = replace(
            said,
            topics=tuple(map(plain, said.topics)),
            exclude=tuple(map(plain, said.exclude)),
            remap={plain(old): new.removesuffix(COMPRESSED_SUFFIX) for old, new in said.remap.items()},
        )
        self._check_names()
        with Publisher(self._config, self._ns, session, offered=offered, recording=recording) as publisher:
            ready(publisher.connection.data)
            self._delay(publisher)
            while not self._stopping.is_set():
                self._play_once(publisher)
                passes, self._epoch = passes + 1, self._epoch + 1
                if not self._sent and not self._stopping.is_set():
                    raise SagsError(f"{self._path} holds no message that was asked for; see sags bag info")
                if not self._options.loop:
                    break
        return {"messages": self._sent, "passes": passes, "seconds": round(time.monotonic() - began, 3)}

    def _play_once(self, publisher: Publisher) -> None:
        options = self._options
        first_ns, newest_ns, began_ns, first_epoch = 0, 0, 0, self._epoch
        self._frames.clear()
        clock = PlayClock(0, options.rate, self._wall_ns)
        for message in read_messages(self._path, wanted=self._is_wanted):
            if not first_ns:
                first_ns = message.log_ns + round(options.start_offset * 1e9)
                clock = PlayClock(first_ns, options.rate, self._wall_ns)
            after = (message.log_ns - first_ns) * 1e-9
            if after < 0 or not self._is_wanted(message.topic, message.type):
                continue
            if options.playback_duration is not None and after > options.playback_duration:
                return
            self._wait_for(message.log_ns, clock, publisher)
            if self._stopping.is_set():
                return
            if message.log_ns < newest_ns - SAME_CLOCK and not self._is_unsorted:
                self._is_unsorted = True
                behind = (
                    f"{message.topic} lies {(newest_ns - message.log_ns) * 1e-9:.1f} s behind what is later"
                )
                log.warning("%s: %s, and comes late: sort it by time (ros2 bag convert)", self._path, behind)
            newest_ns = max(newest_ns, message.log_ns)
            if message.session != self._session:
                if self._session:  # the node was started anew; a session that comes back is a second node
                    publisher.start_anew(uuid.uuid4().hex)
                self._session = message.session
            before_ns, began_ns = began_ns, clock.wall_ns(first_ns)
            first_epoch += began_ns < before_ns
            epoch = first_epoch + message.epoch
            self._epoch = max(self._epoch, epoch)
            number, stamp_ns = self._frame_at(message, clock)
            name, content = outgoing(message, stamp_ns)
            name, content = self._plain(name), replace(content, relative=message.relative)
            name = options.remap.get(self._name(message.topic), name)
            ahead_ns = round(message.ahead_ns / options.rate)
            publisher.publish_content(name, content, number, stamp_ns, epoch, ahead_ns)
            self._sent += 1

    def _delay(self, publisher: Publisher) -> None:
        """Serve subscriptions before playing begins."""
        began = time.monotonic()
        while not self._stopping.is_set():
            left = began + self._options.delay - time.monotonic()
            if left <= 0:
                return
            publisher.poll(int(min(POLL_SECONDS, left) * 1e3))

    def _wait_for(self, recorded_ns: int, clock: PlayClock, publisher: Publisher) -> None:
        """Serve subscriptions until a moment of the recording is due, and playing is not paused."""
        before = time.monotonic()
        while not self._stopping.is_set():
            now = time.monotonic()
            if self._paused:
                clock.pause(now - before)
            before = now
            self._tell_time(now, clock, publisher)
            left = clock.until(recorded_ns, now)
            if left <= 0 and not self._paused:
                return
            wait = POLL_SECONDS if self._paused else min(POLL_SECONDS, left)
            if self._options.clock_hz is not None:
                wait = min(wait, self._clock_due - now)
            publisher.poll(int(max(wait, 0.0) * 1e3))

    def _tell_time(self, now: float, clock: PlayClock, publisher: Publisher) -> None:
        """Publish the clock when that is due, also while playing is paused."""
        hz = self._options.clock_hz
        if hz is None or now < self._clock_due:
            return
        self._clock_due += 1 / hz
        if self._clock_due < now:  # the first time, or this machine is too busy for so many
            self._clock_due = now + 1 / hz
        moment_ns = clock.moment_ns(now)
        stamp_ns = clock.wall_ns(moment_ns)
        publisher.publish_content(CLOCK_TOPIC, cdr.clock(moment_ns), -1, stamp_ns, self._epoch)

    def _check_names(self) -> None:
        """Refuse names that the bag does not have, as far as it says which it has."""
        options, there = self._options, set(map(self._name, recorded_topics(self._path)))
        named = {*options.topics, *options.exclude, *options.remap} - {CLOCK_TOPIC}
        if there and (unknown := named - there):
            raise UsageError(
                f"{self._path} holds no message that was asked for as {', '.join(sorted(unknown))}; it has "
                f"{', '.join(sorted(there))}"
            )

    def _is_wanted(self, topic: str, kind: str) -> bool:
        name = self._name(topic)
        options = self._options
        if options.clock_hz is not None and name == CLOCK_TOPIC:
            return False  # there is one clock
        if (options.topics and name not in options.topics) or name in options.exclude:
            return False
        if not cdr.knows(kind):  # it could not be described to anybody
            if topic not in self._unknown:
                log.warning("%s is left out: its type %s is not one of ROS 2's own", topic, kind or "-")
                self._unknown.add(topic)
            return False
        return True

    def _name(self, topic: str) -> str:
        """The name under which a topic of the bag is published."""
        return self._plain(topic.removesuffix(COMPRESSED_SUFFIX))

    def _plain(self, name: str) -> str:
        """A topic of the bag without the namespace that was recorded: ours takes its place."""
        return topics.plain_name(self._recorded_ns, name)

    def _frame_at(self, message: BagMessage, clock: PlayClock) -> tuple[int, int]:
        """The frame number (-1: no frame) and the new stamp, equal for messages with equal stamps."""
        log_ns, original_ns = message.log_ns, _original_stamp(message)
        apart = abs(log_ns - original_ns)
        same = self._same_clock.setdefault(message.topic, apart <= SAME_CLOCK) and apart <= DAMAGED
        stamp_ns = clock.stamp_ns(log_ns, original_ns if same else log_ns)
        if message.type not in FRAME_TYPES:
            return -1, stamp_ns
        if original_ns not in self._frames:
            self._frames[original_ns] = self._frame_count, stamp_ns
            self._frame_count += 1
            if len(self._frames) > STAMPS_KEPT:
                self._frames.popitem(last=False)
        return self._frames[original_ns]


# ---- from a bag's message back to what goes over the wire: bulk data as a part of its own, a new stamp -----


def _original_stamp(message: BagMessage) -> int:
    """The stamp in the message itself, ns; without one, or if it is 0, the time at which it was published.

    Raises:
        SagsError: it is too short.
    """
    stamp_ns = header_stamp(message.data) if message.type in STAMPED else 0
    return stamp_ns or message.publish_ns


def outgoing(message: BagMessage, stamp_ns: int) -> tuple[str, Content]:
    """Return the topic (without leading slash) and the content to send, stamped `stamp_ns`.

    A compressed image becomes a raw one on the topic it was made of, as consumers of a node know it.

    Raises:
        SagsError: the message is damaged.
    """
    name = message.topic.lstrip("/")
    if message.type == cdr.COMPRESSED and name.endswith(COMPRESSED_SUFFIX):
        return name.removesuffix(COMPRESSED_SUFFIX), _raw_picture(message, stamp_ns)
    if message.type == topics.IMAGE and (picture := _picture(message, stamp_ns)) is not None:
        return name, picture
    if message.type == topics.POINT_CLOUD:
        return name, _cloud(message, stamp_ns)
    stamped = bytearray(message.data)
    if message.type in STAMPED:
        _restamp(stamped, _HEADER_AT, stamp_ns)
    elif message.type == topics.TF and len(stamped) > _FIRST_TRANSFORM_AT:
        _restamp(stamped, _FIRST_TRANSFORM_AT, stamp_ns)
    return name, Content(message.type, (bytes(stamped),))


def _restamp(data: bytearray, at: int, stamp_ns: int) -> None:
    little_endian = data[1] & 1
    if little_endian and len(data) >= at + _STAMP.size:
        _STAMP.pack_into(data, at, *divmod(stamp_ns, 1_000_000_000))


def _parts(message: BagMessage, bulk: int, after: int, stamp_ns: int) -> tuple[Buffer, ...]:
    """The CDR, cut around its bulk data, which is not copied."""
    data = memoryview(message.data)
    start = bytearray(data[: len(data) - bulk - after])
    _restamp(start, _HEADER_AT, stamp_ns)
    parts: tuple[Buffer, ...] = (bytes(start), data[len(start) : len(start) + bulk])
    return (*parts, bytes(data[len(data) - after :])) if after else parts


def _picture(message: BagMessage, stamp_ns: int) -> Content | None:
    """The content of an image; None: it is valid, but this protocol has no such encoding or layout."""
    ros = cdr.decode(message.data, topics.IMAGE)
    dtype, channels = cdr.IMAGE_ENCODINGS.get(ros.encoding, ("uint8", 0))
    row_bytes = ros.width * channels * np.dtype(dtype).itemsize
    if not row_bytes or ros.step != row_bytes or ros.data.size != row_bytes * ros.height or ros.is_bigendian:
        return None
    shape = (ros.height, ros.width, channels) if channels > 1 else (ros.height, ros.width)
    return Content(topics.IMAGE, _parts(message, ros.data.size, 0, stamp_ns), ros.encoding, shape, dtype)


def _cloud(message: BagMessage, stamp_ns: int) -> Content:
    ros = cdr.decode(message.data, topics.POINT_CLOUD)
    parts = _parts(message, ros.data.size, 1, stamp_ns)  # one byte follows: is_dense
    words = ros.point_step // 4
    if ros.point_step % 4 or len(ros.fields) != words or ros.data.size != ros.width * ros.height * 4 * words:
        return Content(topics.POINT_CLOUD, (b"".join(parts),))
    names = ",".join(field.name for field in ros.fields)
    return Content(topics.POINT_CLOUD, parts, names, (ros.width * ros.height, words), "float32")


def _raw_picture(message: BagMessage, stamp_ns: int) -> Content:
    ros: Any = cdr.decode(message.data, cdr.COMPRESSED)
    picture, encoding = decompressed(ros, message.topic)
    return cdr.image(picture, encoding, stamp_ns, ros.header.frame_id)
