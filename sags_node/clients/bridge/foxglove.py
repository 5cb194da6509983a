"""`sags bridge foxglove`: every topic of a node, live in Foxglove, by its WebSocket.

The messages are the node's own: ROS 2 CDR, byte for byte, stamped with the time of capture. Images are
offered as H.264 too, for thin links.
"""

import importlib.util
import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import foxglove
import numpy as np
from foxglove.channels import CompressedVideoChannel
from foxglove.messages import CompressedVideo, Timestamp
from foxglove.websocket import Capability, ChannelView, Client, ClientChannel, ServerListener, WebSocketServer

from sags_node.clients.bridge.relay import Outlet, Output, Relay, ServerOptions, Source, silent
from sags_node.clients.bridge.requests import Requests
from sags_node.errors import SagsError
from sags_node.messaging import cdr, topics
from sags_node.messaging.received import Frame, Received, ReceivedCloud, ReceivedImage, ReceivedText
from sags_node.types import U8

VIDEO = "/h264"
FIGURES = "/figures"  # the node's status as JSON, for plots
PROBLEM = "missing"  # the status of what does not come
CLICKED = "/clicked_point"  # where Foxglove's 3D panel publishes the point that was clicked
SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class FoxgloveOptions(ServerOptions):
    """How `sags bridge foxglove` runs."""

    port: int = 8765  # Foxglove's default
    rate: float | None = None  # Hz of each topic; default: all that come
    pin: bool = False  # let peers pin anchors


def outputs(options: FoxgloveOptions) -> list[Output]:
    """Return a channel for each topic of the node and of an overlay, and another for images as H.264."""
    period = 0.0 if options.rate is None else 1 / options.rate
    has_video, channels = importlib.util.find_spec("av") is not None, []
    for ns, offered in ((options.node.ns, topics.TOPICS), (options.overlay.ns, topics.OVERLAY_TOPICS)):
        for topic in offered:
            name, sources = f"/{topics.full_name(ns, topic.name)}", (Source(ns, topic.name),)
            channels.append(Output(name, sources, period, lengths=topic.in_metres))
            if has_video and topic.type == topics.IMAGE and topic.content.startswith("rgb"):
                channels.append(Output(f"{name}{VIDEO}", sources, period))
    return [*channels, Output(f"/{options.node.ns}{FIGURES}", (Source(options.node.ns, "status"),))]


def run_foxglove(options: FoxgloveOptions, ready: Callable[[str, int], None], stop: threading.Event) -> None:
    """Serve Foxglove until `stop` is set. The node may come later and be restarted.

    Args:
        ready: called with the host and the port once peers can connect.

    Raises:
        UsageError: wrong keys.
        SagsError: the port cannot be bound, or an endpoint is malformed.
    """
    offered = outputs(options)
    with (
        closing(Foxglove(options, offered)) as bridge,
        closing(Relay((options.node, options.overlay), offered, bridge, options.max_age)) as relay,
    ):
        ready(options.host, bridge.port)
        relay.run(stop)


class Foxglove(Outlet):
    """The outlet: one channel for each output.

    Raises:
        SagsError: the port cannot be bound.
    """

    def __init__(self, options: FoxgloveOptions, offered: Sequence[Output]) -> None:
        self._requests = Requests(options.node)
        self._missing: dict[str, str] = {}
        self._server: WebSocketServer | None = None
        self._shown: dict[str, Received] = {}  # by output
        self._audience = _Audience(self._welcome, self._pin if options.pin else None)
        self._context = foxglove.Context()  # channels vanish with the last reference to it
        self._ways = {output.name: _way(output, self._context) for output in offered}
        self._server = _served(options, self._context, self._audience, backlog=len(offered))

        self.port = self._server.port

    def close(self) -> None:
        if self._server is not None:
            self._server.stop()
        self._requests.close()

    # ---- out -----------------------------------------------------------------------------------------------

    def wants(self, output: Output) -> bool:
        return self._audience.looks_at(output.name)

    def send(self, output: Output, frame: Frame) -> bool:
        received = frame[output.sources[0].topic]
        self._shown[output.name] = received
        self._ways[output.name].show(received, self._audience.has_grown(output.name))
        return True

    def blank(self, output: Output, reason: str) -> None:
        """Send something empty, as Foxglove goes on showing what came last."""
        self._ways[output.name].blank(self._shown.pop(output.name), reason)

    def report(self, missing: Mapping[str, str], shows: bool) -> None:
        if self._server is not None and not missing:
            self._server.remove_status([PROBLEM])
        self._missing = dict(missing)
        self._welcome()

    # ---- in ------------------------------------------------------------------------------------------------

    def _pin(self, data: bytes) -> None:
        """Pin what was clicked in the 3D panel; on a thread of the server."""
        place = clicked(data)
        if place is None:
            self._say(None, "a clicked point must be a JSON PointStamped in the frame 'world'")
        else:
            self._requests.ask("add_anchor", dict(zip("xyz", place, strict=True)), self._say)

    def _say(self, result: dict[str, Any] | None, words: str) -> None:
        self._publish(words, is_problem=result is None, about="request")

    def _welcome(self) -> None:
        """Tell all clients what is missing, as new ones have not heard it. All in one status: the server
        queues no more messages than there are channels, and disconnects a client that has one more."""
        words = "; ".join(f"{name}: {reason}" for name, reason in self._missing.items())
        if words:
            self._publish(words, is_problem=True, about=PROBLEM)

    def _publish(self, words: str, is_problem: bool, about: str) -> None:
        level = foxglove.StatusLevel.Warning if is_problem else foxglove.StatusLevel.Info
        if self._server is not None:
            self._server.publish_status(words, level, about)


class _Audience(ServerListener):
    """Who looks at what; called from threads of the server.

    Args:
        welcome: called when a client looks at something for the first time, or again.
        pin: called with what clients publish on `CLICKED`; None: they may not.
    """

    def __init__(self, welcome: Callable[[], None], pin: Callable[[bytes], None] | None) -> None:
        self._welcome, self._pin = welcome, pin
        self._lock = threading.Lock()
        self._looking: set[tuple[int, str]] = set()  # client and topic
        self._grown: set[str] = set()
        self._clicks: set[tuple[int, int]] = set()  # client and channel

    def looks_at(self, topic: str) -> bool:
        with self._lock:
            return any(topic == looked_at for _, looked_at in self._looking)

    def has_grown(self, topic: str) -> bool:
        """Tell whether somebody has begun to look since this was asked last."""
        with self._lock:
            grown = topic in self._grown
            self._grown.discard(topic)
            return grown

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        with self._lock:
            is_new = all(client.id != looker for looker, _ in self._looking)
            self._looking.add((client.id, channel.topic))
            self._grown.add(channel.topic)
        if is_new:
            self._welcome()

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        with self._lock:
            self._looking.discard((client.id, channel.topic))

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        if channel.topic == CLICKED and channel.encoding == "json":
            self._clicks.add((client.id, channel.id))

    def on_client_unadvertise(self, client: Client, client_channel_id: int) -> None:
        self._clicks.discard((client.id, client_channel_id))

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        if self._pin is not None and (client.id, client_channel_id) in self._clicks:
            self._pin(data)


@dataclass(frozen=True, slots=True)
class _Messages:
    """One message for each that comes: the node's own, or its status as JSON."""

    channel: foxglove.Channel
    made_of: Callable[[Received], bytes | str]
    empty_of: Callable[[Received, int, str], bytes | str | None]

    def show(self, received: Received, grown: bool) -> None:
        """Send it; `grown`: somebody has begun to look."""
        self.channel.log(self.made_of(received), log_time=received.stamp_ns)

    def blank(self, shown: Received, reason: str) -> None:
        """Send something empty in its place, where it is something to look at."""
        now_ns = time.time_ns()
        if (empty := self.empty_of(shown, now_ns, reason)) is not None:
            self.channel.log(empty, log_time=now_ns)


class _Video:
    """Images in H.264."""

    def __init__(self, output: Output, context: foxglove.Context) -> None:
        from sags_node.clients.bridge.h264 import (
            Encoder,  # PyAV may be missing where there are no such outputs
        )

        self._channel = CompressedVideoChannel(output.name, context=context)
        self._encoder = Encoder()

    def show(self, received: Received, grown: bool) -> None:
        assert isinstance(received, ReceivedImage)
        self._send(received, received.array, received.stamp_ns, grown)

    def blank(self, shown: Received, reason: str) -> None:
        assert isinstance(shown, ReceivedImage)
        self._send(shown, np.zeros_like(shown.array), time.time_ns(), key=True)

    def _send(self, of: Received, picture: U8, stamp_ns: int, key: bool) -> None:
        data = self._encoder.encode(picture, key)
        stamp = Timestamp(*divmod(stamp_ns, SECOND_NS))
        frame = CompressedVideo(timestamp=stamp, frame_id=_frame_of(of), data=data, format="h264")
        self._channel.log(frame, log_time=stamp_ns)


def _way(output: Output, context: foxglove.Context) -> _Messages | _Video:
    if output.name.endswith(VIDEO):
        return _Video(output, context)
    if output.name.endswith(FIGURES):
        channel = foxglove.Channel(output.name, schema={"type": "object"}, context=context)
        return _Messages(channel, _text_of, lambda shown, now_ns, reason: silent(reason))
    topic = topics.find(output.sources[0].topic)
    assert topic is not None  # `outputs` takes them from there
    schema = foxglove.Schema(name=topic.type, encoding="ros2msg", data=cdr.definition(topic.type).encode())
    channel = foxglove.Channel(output.name, schema=schema, message_encoding="cdr", context=context)
    return _Messages(channel, Received.ros, empty_of)


def _text_of(received: Received) -> str:
    assert isinstance(received, ReceivedText)  # so is the topic's type
    return received.text


def _served(
    options: FoxgloveOptions, context: foxglove.Context, audience: _Audience, backlog: int
) -> WebSocketServer:
    """The server; a client that is slow gets at most `backlog` old messages, about those of a frame."""
    try:
        return foxglove.start_server(
            name=f"SAGS {options.node.ns}",
            host=options.host,
            port=options.port,
            context=context,
            server_listener=audience,
            message_backlog_size=backlog,
            capabilities=[Capability.ClientPublish] if options.pin else [],
            supported_encodings=["json"] if options.pin else None,
        )
    except (RuntimeError, OSError) as error:
        raise SagsError(options.not_bound(error)) from None


def empty_of(shown: Received, now_ns: int, reason: str) -> bytes | None:
    """The CDR of a message without content, in place of what is shown; None for what may stand: a pose, or a
    camera, is nothing to look at."""
    if isinstance(shown, ReceivedImage):
        nothing = np.nan if shown.array.dtype == np.float32 else 0
        empty = cdr.image(np.full_like(shown.array, nothing), shown.meta.encoding, now_ns, _frame_of(shown))
    elif isinstance(shown, ReceivedCloud):
        fields = shown.meta.encoding.split(",")
        empty = cdr.point_cloud(np.empty((0, len(fields)), np.float32), fields, now_ns)
    elif isinstance(shown, ReceivedText):
        empty = cdr.string(silent(reason))
    elif shown.meta.type == topics.DIAGNOSTICS:
        empty = cdr.diagnostics([cdr.Status("node", 3, reason, {})], now_ns)
    else:
        return None
    return empty.cdr()


def _frame_of(picture: Received) -> str:
    return cdr.RIGHT_FRAME if "/right/" in picture.topic else cdr.LEFT_FRAME


def clicked(data: bytes) -> tuple[float, float, float] | None:
    """The place (m, world) in a JSON PointStamped from anybody."""
    try:
        said = json.loads(data)
        if said["header"]["frame_id"] != cdr.WORLD_FRAME:
            return None
        x, y, z = (float(said["point"][axis]) for axis in "xyz")
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return (x, y, z) if np.isfinite((x, y, z)).all() else None
