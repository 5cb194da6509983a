"""The node's sockets: results and health out, subscriptions and requests in. All from one thread."""

import logging
import os
import re
import resource
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import zmq

from sags_node.config.schema import NAMESPACE, PublishConfig
from sags_node.errors import SagsError, UsageError
from sags_node.messaging import cdr, content, control, topics
from sags_node.messaging.cdr import Content, type_hash
from sags_node.messaging.node_clock import stamps
from sags_node.messaging.peers import Peers
from sags_node.messaging.requests import without_args
from sags_node.messaging.rundir import Connection, RunDirectory
from sags_node.messaging.security import Gate, RateLimitedLog, authenticated, check_endpoint
from sags_node.messaging.sockets import Closes, bind, limit, waiting
from sags_node.messaging.wire import PROTOCOL, Message, Meta, encode
from sags_node.types import DrawnView, FrameResult, NodeHealth, RectifiedPair

log = logging.getLogger(__name__)

# Messages per slow peer, all topics together: two whole frames, so that the burst of one frame fits.
SEND_HIGH_WATER = 2 * len(topics.TOPICS)
MAX_SUBSCRIPTIONS_AT_ONCE = 200
MAX_SUBSCRIPTION_BYTES = 512  # also the longest step of a CURVE handshake
MAX_SUBSCRIPTIONS_BYTES = 16384  # of one peer, all together: ZeroMQ remembers them until the peer goes
MAX_PREFIXES = 1024  # at most noted: a view may be subscribed to before it is opened, so any name may come
SUBSCRIPTIONS_HIGH_WATER = 64  # messages of one peer that may wait
MAX_THIN = 8  # thin images made at once, as many as views
MAX_THIN_NAME = 120  # characters; a longer name gets no answer
PENDING_POLL_MS = 10  # between looks for the result of a handler's future
EARLY_PICTURE = "left/image_rect_color"
LOOK_SECONDS = 1.0  # between checks that clients can still find this node
ENOUGH_FILES = 512  # files open at once: 64 peers of two sockets take 256
FEWEST_FILES = 64  # of them a node takes 25 before its first client; libzmq aborts the process without them
LAST_WORDS_MS = 200  # longest wait at the end for what is still on its way to a peer


@dataclass(frozen=True, slots=True)
class _Value:
    """The value of a topic: sent once, and if it is kept, again to those who subscribe later."""

    body: Content
    stamp_ns: int
    frame_id: int = -1
    epoch: int | None = None  # None: that of the last frame
    ahead_ns: int = 0


class Publisher(Closes):
    """Publishes frames and health, and answers control requests.

    A topic is encoded only while somebody subscribes to it. Nothing here ever waits for a peer: one that
    does not keep up loses messages and sees the gap in `seq`.

    Args:
        handlers: control op -> function of its args, see `control.ControlServer`; `ping` is always there.
        offered: what may be subscribed to, beside views.
        thins: whether somebody makes the thin images of `thin`.
        recording: what `sags bag play` plays here; None: this is a node.
        metric: False: lengths have no unit, as nobody has calibrated the eyes; every message says so.

    Attributes:
        thin: thin images that somebody subscribes to, by topic.

    Raises:
        UsageError: an endpoint open to other machines without keys, a key file that cannot be used, a run
            directory open to others, or a process that may open too few files.
        SagsError: an endpoint is taken, or another node holds the same namespace.
    """

    def __init__(
        self,
        config: PublishConfig,
        ns: str,
        session: str,
        handlers: Mapping[str, control.Handler] | None = None,
        offered: Sequence[topics.Topic] = topics.TOPICS,
        thins: bool = False,
        recording: Path | None = None,
        metric: bool = True,
    ) -> None:
        for endpoint in (*config.data, *([config.control] if config.control else [])):
            check_endpoint(endpoint, config)
        self.ns = ns
        self.session = session
        self._names = {
            topics.full_name(ns, t.name): t for t in offered if config.right is not False or not t.right
        }
        self._seq = dict.fromkeys((t.name for t in self._names.values()), 0)
        self._subscribed: set[str] = set()  # prefixes, only those of our topics and of views
        self._any_view = False  # more view topics were subscribed to than are noted: any view may be wanted
        self.thin: Mapping[str, topics.ThinPicture] = {}
        self._thins = thins
        self._recording = recording
        self._metric = metric
        self._thin_seq = self._view_seq = 0  # where the `seq` of the next one begins
        self._last: FrameResult | None = None
        self._dropped = 0
        self._pictured = -1  # the newest frame whose image went before its result
        self._kept: dict[str, _Value] = {}  # last values that no `FrameResult` holds
        self._peers: dict[str, Peers] = {}
        self._resources = ExitStack()
        if not re.fullmatch(NAMESPACE, ns):
            raise UsageError(f"'{ns}' is no namespace: letters, digits and _, parts of it separated by /")
        self._run = RunDirectory(config.run_dir, ns)
        self._has_ipc = config.ipc
        self._next_look = 0.0  # at the run directory
        self._seldom = RateLimitedLog()
        if (most := resource.getrlimit(resource.RLIMIT_NOFILE)[0]) < FEWEST_FILES:
            raise UsageError(f"only {most} files may be open, not {FEWEST_FILES}: ulimit -n 1024 first")
        if most < ENOUGH_FILES:
            log.warning("only %d files may be open: many clients would end this; ulimit -n 1024 first", most)
        self._context = zmq.Context()
        try:
            gate = self._resources.enter_context(authenticated(self._context, config))
            always = {"ping": without_args(lambda: "pong"), "get_clock": without_args(stamps)}
            self._bind(config, gate, {**always, **(handlers or {})})
        except BaseException:
            self.close()
            raise

    def _bind(self, config: PublishConfig, gate: Gate, handlers: Mapping[str, control.Handler]) -> None:
        keys = gate.keys
        self._data = self._context.socket(zmq.XPUB)
        limit(self._data, SEND_HIGH_WATER, SUBSCRIPTIONS_HIGH_WATER, MAX_SUBSCRIPTION_BYTES)
        self._poller = zmq.Poller()
        self._watch("data", self._data, MAX_SUBSCRIPTIONS_BYTES, gate)
        self._data.setsockopt(
            zmq.XPUB_VERBOSE, 1
        )  # reports the subscription of every new peer, which then gets the last values
        endpoints = [bind(self._data, self._run.ipc_endpoint, "publish.ipc", keys)] if config.ipc else []
        option = "publish.data" if self._recording is None else "--endpoint"
        endpoints += [bind(self._data, endpoint, option, keys) for endpoint in config.data]
        self._control: control.ControlServer | None = None
        control_endpoint = None
        if config.control:
            router = self._context.socket(zmq.ROUTER)
            limit(router, control.SEND_HIGH_WATER, control.RECEIVE_HIGH_WATER, control.MAX_REQUEST_BYTES)
            self._watch("control", router, control.MAX_UNANSWERED_BYTES, gate)
            control_endpoint = bind(router, config.control, "publish.control", keys)
            self._control = control.ControlServer(router, handlers, self._peers["control"].waiting, gate)
        self.connection = Connection(
            protocol=PROTOCOL,
            ns=self.ns,
            session=self.session,
            pid=os.getpid(),
            data=endpoints,
            control=control_endpoint,
            public_key=None if keys is None else keys.public.decode(),
            recording=None if self._recording is None else str(self._recording),
        )
        self._run.write_connection(self.connection)

    def _watch(self, name: str, socket: zmq.Socket[bytes], max_untaken: int, gate: Gate) -> None:
        self._peers[name] = Peers(socket, name, max_untaken, gate.revocations)
        self._poller.register(socket, zmq.POLLIN)

    @property
    def connections(self) -> dict[str, dict[str, int]]:
        """The numbers of connections of each socket, open and refused (`Peers.counts`); of the control socket
        also of refused requests."""
        counts = {name: peers.counts() for name, peers in self._peers.items()}
        if self._control is not None:
            counts["control"] |= self._control.refused
        return counts

    def start_anew(self, session: str) -> None:
        """Go on as a newly started node: last values of the session before are not sent again."""
        self.session = session
        self._kept.clear()

    # ---- out -------------------------------------------------------------------------------------------

    def publish_picture(self, pair: RectifiedPair, epoch: int) -> None:
        """Send a frame's left image before its result, which then comes without it."""
        self._pictured = pair.frame_id
        self._seq[EARLY_PICTURE] += 1
        if self.wanted(EARLY_PICTURE):
            picture = content.picture(pair, "left")
            self._send(EARLY_PICTURE, _Value(picture, pair.t_capture_ns, pair.frame_id, epoch))

    def publish_result(self, result: FrameResult, dropped: int) -> None:
        """Send one frame's topics to those who asked; `dropped` counts the frames the node left out."""
        self._last = result
        self._dropped = dropped
        sent = {EARLY_PICTURE} if result.pair.frame_id <= self._pictured else set()
        for name in content.FRAME_CONTENT:
            if name in self._seq and name not in sent and content.tells_of(result, name):
                self._seq[name] += 1
                if self.wanted(name):
                    self._send_frame_topic(name)

    def publish_health(self, health: NodeHealth) -> None:
        """Send `status` and `diagnostics`, stamped now."""
        now = time.time_ns()
        self._publish_text("status", content.json_text(content.status(health, self._last)), now)
        self._publish_text("diagnostics", content.diagnostics(health, now), now)

    def publish_parameters(self, parameters: Mapping[str, Any]) -> None:
        """Send the configuration in force; it is kept for those who subscribe later."""
        self._publish_text("parameters", content.json_text(parameters), time.time_ns())

    def publish_content(
        self, name: str, body: Content, frame_id: int, stamp_ns: int, epoch: int, ahead_ns: int = 0
    ) -> None:
        """Send content made elsewhere, e.g. recorded, on any topic `name` (without namespace)."""
        self._seq[name] = self._seq.get(name, 0) + 1
        topic, value = topics.find(name), _Value(body, stamp_ns, frame_id, epoch, ahead_ns)
        if topic is not None and topic.cached:
            self._kept[name] = value
        self._send(name, value)

    def publish_view(self, name: str, drawn: DrawnView) -> None:
        """Send the topics of the view `name` to those who asked for them."""
        shown, ahead_ns = next(iter(drawn.eyes.values())), round(drawn.ahead_s * 1e9)
        said = content.view(name, drawn)
        for topic in [kept for kept in self._kept if kept.startswith(f"view/{name}/") and kept not in said]:
            del self._kept[topic]  # from before the view was opened anew with other eyes or without depth
        for topic, body in said.items():
            self._seq[topic] = self._seq.get(topic, self._view_seq) + 1
            value = _Value(body, shown.t_capture_ns, shown.frame_id, drawn.epoch, ahead_ns)
            if drawn.still or body.type == topics.CAMERA_INFO:
                self._kept[topic] = value
            else:
                self._kept.pop(topic, None)  # from when it was drawn only once
            if self.wanted(topic):
                self._send(topic, value)

    def publish_thin(self, result: FrameResult, pictures: Mapping[str, Content]) -> None:
        """Send thin images of a frame, by topic, to those who still ask for them."""
        for name in pictures.keys() & self.thin.keys():
            pair = result.pair
            self.publish_content(name, pictures[name], pair.frame_id, pair.t_capture_ns, result.epoch)

    def forget_view(self, name: str) -> None:
        """Forget the last values of a closed view. No `seq` of it is used again."""
        for topic in [topic for topic in self._seq if topic.startswith(f"view/{name}/")]:
            self._view_seq = max(self._view_seq, self._seq.pop(topic))
            self._kept.pop(topic, None)

    def watches_view(self, name: str) -> bool:
        """True while somebody subscribes to a topic of the view `name`."""
        start = topics.full_name(self.ns, f"view/{name}/")
        noted = any(start.startswith(prefix) or prefix.startswith(start) for prefix in self._subscribed)
        return noted or self._any_view

    def wanted(self, name: str) -> bool:
        """True while somebody subscribes to the topic `name` (without the namespace)."""
        full = topics.full_name(self.ns, name)
        noted = any(full.startswith(prefix) for prefix in self._subscribed)
        return noted or (self._any_view and name.startswith("view/"))

    def looked_at(self, picture: str) -> bool:
        """Tell whether somebody subscribes to the topic `picture`, or to a thin form of it."""
        return self.wanted(picture) or any(thin.topic == picture for thin in self.thin.values())

    def _publish_text(self, name: str, text: Content, stamp_ns: int) -> None:
        self._seq[name] += 1
        value = self._kept[name] = _Value(text, stamp_ns)
        if self.wanted(name):
            self._send(name, value)

    def _send_frame_topic(self, name: str) -> None:
        assert self._last is not None
        pair = self._last.pair
        self._send(name, _Value(content.FRAME_CONTENT[name](self._last), pair.t_capture_ns, pair.frame_id))

    def _send(self, name: str, value: _Value) -> None:
        body, last, epoch = value.body, self._last, value.epoch
        if epoch is None:
            epoch = 0 if last is None else last.epoch
        recorded_s = None if last is None or last.pair.frame_id != value.frame_id else last.recorded_s
        meta = Meta(
            type=body.type,
            type_hash=type_hash(body.type),
            seq=self._seq.get(name, 0),
            frame_id=value.frame_id,
            stamp_ns=value.stamp_ns,
            publish_ns=time.time_ns(),
            session=self.session,
            epoch=epoch,
            step=0 if last is None else last.snapshot.step,
            encoding=body.encoding,
            shape=list(body.shape),
            dtype=body.dtype,
            dropped=self._dropped,
            ahead_ns=value.ahead_ns or msgspec.UNSET,
            detail_age_ns=msgspec.UNSET if body.detail_age_ns is None else body.detail_age_ns,
            scale=body.scale or msgspec.UNSET,
            window=list(body.window) or msgspec.UNSET,
            recorded_s=msgspec.UNSET if recorded_s is None else recorded_s,
            units="relative" if body.relative or not self._metric else msgspec.UNSET,
        )
        frames = encode(Message(topics.full_name(self.ns, name), meta, body.parts))
        # An XPUB socket drops for a full peer instead of blocking. Arrays are never written again, so
        # they are sent from where they lie.
        self._data.send_multipart(frames, zmq.NOBLOCK, copy=False)

    # ---- in --------------------------------------------------------------------------------------------

    def poll(self, timeout_ms: int, wake_fd: int | None = None) -> bool:
        """Serve subscriptions and requests for up to `timeout_ms`, at least once.

        Returns early, with True, when the file descriptor `wake_fd` has something to read.
        """
        if wake_fd is not None:
            self._poller.register(wake_fd, zmq.POLLIN)
        try:
            deadline = time.monotonic() + timeout_ms / 1000
            while True:
                left_ms = max(0, int((deadline - time.monotonic()) * 1000))
                owed = self._control is not None and self._control.pending
                events = dict(self._poller.poll(min(left_ms, PENDING_POLL_MS) if owed else left_ms))
                self._serve_subscriptions()
                if self._control is not None:
                    self._control.serve()
                self._stay_findable()
                if wake_fd in events:
                    return True
                if left_ms == 0:
                    return False
        finally:
            if wake_fd is not None:
                self._poller.unregister(wake_fd)

    def _serve_subscriptions(self) -> None:
        """Note who wants what, and send the last values once for all who have just asked."""
        resend: set[str] = set()
        for frames in waiting(self._data, MAX_SUBSCRIPTIONS_AT_ONCE, 1):
            self._subscription(frames[0].bytes, resend)
        for name in sorted(resend):
            if name in self._kept:
                self._send(name, self._kept[name])
            elif self._last is not None and name in content.FRAME_CONTENT:
                if content.tells_of(self._last, name):
                    self._send_frame_topic(name)

    def _subscription(self, message: bytes, resend: set[str]) -> None:
        """`\\x01prefix` subscribes and `\\x00prefix` ends it; anything else is ignored."""
        try:
            prefix = message[1:].decode()
        except UnicodeError:
            return
        if prefix.startswith(topics.full_name(self.ns, topics.THIN)):
            self._thin_subscription(prefix.removeprefix(f"{self.ns}/"), message[:1] == b"\x01")
            return
        matching = [topic for full, topic in self._names.items() if full.startswith(prefix)]
        views = topics.full_name(self.ns, "view/")
        of_views = prefix.startswith(views) or views.startswith(prefix)
        if message[:1] == b"\x01" and (matching or of_views):
            if matching or len(self._subscribed) < MAX_PREFIXES:
                self._subscribed.add(prefix)
            else:
                self._any_view = True
            resend.update(topic.name for topic in matching if topic.cached)
            if of_views:
                kept = [name for name in self._kept if name.startswith("view/")]
                resend.update(name for name in kept if topics.full_name(self.ns, name).startswith(prefix))
        elif message[:1] == b"\x00":
            self._subscribed.discard(prefix)

    def _thin_subscription(self, name: str, begins: bool) -> None:
        """Begin or end a thin image. If it cannot be made, the reason is sent on its topic."""
        if not begins:
            if name in self.thin:  # names come and go without limit, and no `seq` may be used again
                self.thin = {asked: thin for asked, thin in self.thin.items() if asked != name}
                self._thin_seq = max(self._thin_seq, self._seq.pop(name))
            return
        try:
            asked = topics.thin_picture(name)
            if not self._thins:
                raise UsageError("thin images are made by a running node only")
            if asked.topic not in self._seq:
                raise UsageError(f"'{name}': {asked.topic} is not published; {topics.NO_RIGHT_EYE}")
            if name not in self.thin and len(self.thin) >= MAX_THIN:
                raise UsageError(f"'{name}': {MAX_THIN} thin images are made already, the most at once")
        except UsageError as error:
            if len(name) <= MAX_THIN_NAME:
                self._send(name, _Value(cdr.string(str(error)), time.time_ns()))
        else:
            self.thin = {**self.thin, name: asked}
            self._seq.setdefault(name, self._thin_seq)

    def _stay_findable(self) -> None:
        """Put back what somebody has removed from the run directory. Connected peers stay connected."""
        if time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + LOOK_SECONDS
        run = self._run
        without_ipc = self._has_ipc and not run.ipc_path.exists()
        if run.is_held and run.connection_file.exists() and not without_ipc:
            return
        try:
            run.take_again()
            if without_ipc:
                bind(self._data, run.ipc_endpoint, "publish.ipc", None)
            run.write_connection(self.connection)
        except (SagsError, OSError) as error:
            if self._seldom.due():
                log.warning("%s was removed and cannot be made again: %s", run.folder, error)
        else:
            log.warning("%s was removed and is there again", run.folder)

    def close(self) -> None:
        """Close the sockets and remove the connection file."""
        for peers in self._peers.values():
            peers.close()
        self._resources.close()
        self._context.destroy(linger=LAST_WORDS_MS)
        self._run.close()
