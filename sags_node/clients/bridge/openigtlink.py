"""`sags bridge openigtlink`: images, surface, anchors and camera for 3D Slicer, PLUS and others.

Lengths are millimetres. Directions are those of Slicer (RAS): an optical frame with x right, y down and z
forward is turned to R = -x, A = -y, S = z, so that Slicer's axial view shows an image upright. This holds
for the world and for the camera; they are no directions of a patient.
"""

import importlib.util
import logging
import math
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pyigtl.messages import MessageBase

from sags_node.clients.bridge import igtl
from sags_node.clients.bridge.compressed import over_black
from sags_node.clients.bridge.igtl_peers import MOST_PEERS, Peers
from sags_node.clients.bridge.pins import MOST, Pin, Pins
from sags_node.clients.bridge.relay import Outlet, Output, Relay, ServerOptions, Source
from sags_node.clients.bridge.requests import Requests
from sags_node.clients.overlay.draw import over
from sags_node.confidence import SURE, is_sure_in_space
from sags_node.errors import UsageError
from sags_node.geometry import unproject
from sags_node.messaging.received import (
    Frame,
    ReceivedCameraInfo,
    ReceivedCloud,
    ReceivedImage,
    ReceivedRos,
    TopicName,
)
from sags_node.messaging.wire import WireError
from sags_node.types import F32, F64, U8, Camera

STEEPEST = math.radians(75)  # rad from facing the camera; a steeper edge joins two surfaces

PICTURE = TopicName("left/image_rect_color", ReceivedImage)
RENDER = TopicName("left/render/image", ReceivedImage)
DEPTH = TopicName("left/render/depth", ReceivedImage)
CONFIDENCE = TopicName("left/render/depth_confidence", ReceivedImage)
INFO = TopicName("left/camera_info", ReceivedCameraInfo)
POSE = TopicName("tf", ReceivedRos)
ANCHORS = TopicName("anchors", ReceivedCloud)
OVERLAY = TopicName("left/overlay/image", ReceivedImage)

RAS = np.diag([-1.0, -1.0, 1.0, 1.0])  # of an optical frame; its own inverse
PLANE = 100.0  # mm before the camera: where an image lies in 3D
SEEN, UNSURE, HIDDEN = (60, 220, 60, 255), (240, 160, 40, 255), (230, 60, 60, 255)  # RGBA of anchors
LEAST_SEEN = 0.5  # of an anchor's visibility
STATE, ANSWER, PIN, REQUEST = "SagsState", "SagsAnswer", "SagsPin", "SagsRequest"

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class IgtlOptions(ServerOptions):
    """How `sags bridge openigtlink` runs."""

    port: int = 18944  # Slicer's default
    send: tuple[str, ...] = ()  # names of outputs; default: all
    rate: float = 10.0  # Hz
    surface_rate: float = 2.0  # Hz
    surface_step: int = 16  # px


def outputs(options: IgtlOptions) -> list[Output]:
    """Return what peers get, one device each, named "Sags" and the output's name.

    Raises:
        UsageError: `send` names something else.
    """
    node, overlay = options.node.ns, options.overlay.ns

    def of_node(*names: str) -> tuple[Source, ...]:
        return tuple(Source(node, name) for name in names)

    often, seldom = 1 / options.rate, 1 / options.surface_rate
    overlaid = (Source(overlay, OVERLAY), *of_node(PICTURE, INFO))
    surface = of_node(DEPTH, CONFIDENCE, INFO, POSE)
    offered = {
        "picture": Output("Picture", of_node(PICTURE, INFO), often),
        "render": Output("Render", of_node(RENDER, INFO), often),
        "overlay": Output("Overlay", overlaid, often, optional=True),
        "surface": Output("Surface", surface, seldom, pulse=Source(node, POSE), lengths=True),
        "anchors": Output("Anchors", of_node(ANCHORS), often, lengths=True),
        "camera": Output("LeftCamera", of_node(POSE), often, lengths=True),
    }
    unknown = [name for name in options.send if name not in offered]
    if unknown:
        raise UsageError(f"--send {unknown[0]}: there is {', '.join(offered)}")
    return [offered[name] for name in options.send or offered]


def run_openigtlink(options: IgtlOptions, ready: Callable[[str, int], None], stop: threading.Event) -> None:
    """Serve OpenIGTLink peers until `stop` is set. The node may come later and be restarted.

    Args:
        ready: called with the host and the port once peers can connect.

    Raises:
        UsageError: wrong keys, or something that cannot be sent.
        SagsError: the port cannot be bound, or an endpoint is malformed.
    """
    offered = outputs(options)
    if importlib.util.find_spec("crcmod._crcfunext") is None:
        log.warning(
            "crcmod was installed without a C compiler: images take seconds; install gcc, then crcmod anew"
        )
    with (
        closing(OpenIgtLink(options)) as bridge,
        closing(Relay((options.node, options.overlay), offered, bridge, options.max_age)) as relay,
    ):
        ready(options.host, bridge.port)
        relay.run(stop)


class OpenIgtLink(Outlet):
    """The outlet: packs each message once, for all peers.

    Raises:
        SagsError: the port cannot be bound.
    """

    def __init__(self, options: IgtlOptions) -> None:
        self._step, self._max_age = options.surface_step, options.max_age
        # Of images that are shown: a black one of that size, and its pose.
        self._shapes: dict[str, tuple[U8, F64]] = {}
        self._pins = Pins()
        self._answers: deque[Callable[[], list[int]]] = deque()  # for the peers' thread
        self._ns, self._now_ns = options.node.ns, options.node.now_ns
        listener = options.listen(MOST_PEERS)
        self.port = int(listener.getsockname()[1])
        self._requests = Requests(options.node)
        self._peers = Peers(listener, self._hear, self._idle)
        self._peers.start()

    def close(self) -> None:
        self._peers.close()
        self._requests.close()

    # ---- out -----------------------------------------------------------------------------------------------

    def wants(self, output: Output) -> bool:
        """Tell whether anybody is connected: without subscriptions in OpenIGTLink, all peers get all."""
        return len(self._peers) > 0

    def send(self, output: Output, frame: Frame) -> bool:
        stamp_ns = frame[output.sources[0].topic].stamp_ns
        try:
            made = self._made(output.name, frame)
        except WireError:
            made = None
        if made is not None:
            device, age = f"Sags{output.name}", (self._now_ns() - stamp_ns) * 1e-9
            self._peers.send(device, igtl.packed(made, device, stamp_ns * 1e-9), valid=self._max_age - age)
        return made is not None

    def blank(self, output: Output, reason: str) -> None:
        nothing, device = np.empty((0, 3)), f"Sags{output.name}"
        if output.name in self._shapes:
            dark, T = self._shapes.pop(output.name)
            self._send_now(device, igtl.image(_written(dark, reason), T))
        elif output.name == "Surface":
            self._send_now(device, igtl.surface(nothing, nothing.astype(np.int64)))
        elif output.name == "Anchors":
            self._send_now(device, igtl.points(nothing))

    def started_anew(self, ns: str) -> None:
        if ns == self._ns:
            self._answers.append(self._forget)

    def report(self, missing: Mapping[str, str], shows: bool) -> None:
        words = "; ".join(f"{name}: {reason}" for name, reason in missing.items())
        if missing or not shows:
            code, words = igtl.NOT_READY, words or "waiting for the node's first message"
        else:
            code, words = igtl.OK, "all is new"
        self._peers.greet(STATE, igtl.packed(igtl.Status(code, words), STATE, time.time()))

    def _send_now(self, device: str, message: MessageBase) -> None:
        self._peers.send(device, igtl.packed(message, device, time.time()))

    def _made(self, name: str, frame: Frame) -> MessageBase | None:
        """The message of an output; None when what came does not fit together."""
        if name == "Anchors":
            return _anchors(frame[ANCHORS])
        if name == "LeftCamera":
            T = frame[POSE].pose()
            T[:3, 3] *= 1e3  # mm
            return igtl.transform(RAS @ T @ RAS)
        if name == "Surface":
            return self._surface(frame)
        (channels, draw), info = PICTURES[name], frame[INFO]
        if any(frame[topic].array.shape != (info.height, info.width, n) for topic, n in channels.items()):
            return None
        picture, T = draw(frame), _before_camera(info.K)
        self._shapes[name] = (np.zeros_like(picture), T)
        return igtl.image(picture, T)

    def _surface(self, frame: Frame) -> MessageBase | None:
        depth, confidence, info = frame[DEPTH].array, frame[CONFIDENCE].array, frame[INFO]
        if not depth.shape == confidence.shape == (info.height, info.width):
            return None
        camera = Camera(info.width, info.height, info.K, frame[POSE].pose())
        places, triangles = surface_of(camera, depth, confidence, self._step)
        return igtl.surface(_ras(places), triangles)

    # ---- in, on the peers' thread --------------------------------------------------------------------------

    def _hear(self, said: igtl.Said) -> None:
        if said.kind == "POINT" and said.device == PIN:
            if len(said.points) > MOST:
                self._say(
                    f"the last {len(said.points) - MOST} points are left out: {MOST} at most are pinned"
                )
            self._release(self._pins.hear(said.points, time.monotonic()))
        elif said.kind == "STRING" and said.device == REQUEST:
            request = request_of(said.text)
            if request is None:
                self._say("say: pin U V, or: remove NUMBER")
            else:
                self._requests.ask(*request, lambda _, words: self._say(words))

    def _idle(self) -> None:
        """Pin what has come to rest, and take in what was answered, or told by the relay."""
        for pin in self._pins.due(time.monotonic()):
            place = (RAS[:3, :3] @ pin.place) * 1e-3
            args = dict(zip("xyz", place.tolist(), strict=True))
            self._requests.ask("add_anchor", args, partial(self._pinned, pin))
        while self._answers:
            self._release(self._answers.popleft()())

    def _pinned(self, pin: Pin, result: dict[str, Any] | None, words: str) -> None:
        """Take in an answer; runs on the thread of the requests."""
        self._say(f"{pin.name}: {words}")
        if result is not None:
            self._answers.append(partial(self._pins.pinned, pin, int(result["id"])))

    def _forget(self) -> list[int]:
        if self._pins.forget():
            self._say("the node was started anew: its anchors are gone; move a point to pin it again")
        return []

    def _release(self, anchors: Sequence[int]) -> None:
        for anchor in anchors:
            self._requests.ask("remove_anchor", {"id": anchor}, lambda _, words: self._say(words))

    def _say(self, words: str) -> None:
        self._send_now(ANSWER, igtl.string(words))


def request_of(text: str) -> tuple[str, dict[str, float]] | None:
    """The operation and arguments that a STRING asks for: `pin U V` or `remove NUMBER`."""
    number = r"-?\d{1,5}(?:\.\d{1,6})?"
    if (pin := re.fullmatch(rf"\s*pin\s+({number})\s+({number})\s*", text)) is not None:
        return "add_anchor", {"u": float(pin[1]), "v": float(pin[2])}
    if (remove := re.fullmatch(r"\s*remove\s+(\d{1,9})\s*", text)) is not None:
        return "remove_anchor", {"id": int(remove[1])}
    return None


# ---- what is sent ----------------------------------------------------------------------------------------


def _anchors(cloud: ReceivedCloud) -> MessageBase | None:
    """The anchors whose place is known, by number. Orange: not sure there; red: hidden."""
    rows = cloud.points
    if not {"id", "visibility", "confidence", "depth_confidence"} <= set(rows.dtype.names or ()):
        return None
    places = cloud.xyz().astype(np.float64)
    known = np.isfinite(places).all(axis=1)
    names = [f"anchor {number}" for number in rows["id"][known]]
    colors = [
        HIDDEN if row["visibility"] < LEAST_SEEN else SEEN if is_sure_in_space(row) else UNSURE
        for row in rows[known]
    ]
    return igtl.points(_ras(places[known]), names, colors)


# Of each IMAGE: the images that it is made of, with their channels, and how.
PICTURES: dict[str, tuple[dict[TopicName[ReceivedImage], int], Callable[[Frame], U8]]] = {
    "Picture": ({PICTURE: 3}, lambda frame: frame[PICTURE].array),
    "Render": ({RENDER: 4}, lambda frame: over_black(frame[RENDER].array)),
    "Overlay": ({PICTURE: 3, OVERLAY: 4}, lambda frame: over(frame[PICTURE].array, frame[OVERLAY].array)),
}


def _ras(places: F64) -> F64:
    """World coordinates [N, 3] in m as Slicer's, in mm."""
    turned: F64 = 1e3 * places @ RAS[:3, :3]
    return turned


def _before_camera(K: F64) -> F64:
    """The pose of an image [4, 4]: from (column, row, 0, 1) to mm in the camera's RAS axes, at `PLANE`."""
    T = np.eye(4)
    T[0, 0], T[1, 1] = PLANE / K[0, 0], PLANE / K[1, 1]
    T[:3, 3] = [-PLANE * K[0, 2] / K[0, 0], -PLANE * K[1, 2] / K[1, 1], PLANE]
    placed: F64 = RAS @ T
    return placed


def _written(dark: U8, reason: str) -> U8:
    """A black image with the reason written on it."""
    scale = max(dark.shape[0] / 1000, 0.4)
    written = dark.copy()
    place, font = (8, dark.shape[0] // 2), cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(written, reason, place, font, scale, (255, 170, 0), 1, cv2.LINE_AA)
    return written


def surface_of(camera: Camera, depth: F32, confidence: F32, step: int) -> tuple[F64, NDArray[np.int64]]:
    """Corners [N, 3] (m, world) and triangles [M, 3] of every `step`-th pixel whose depth is sure to 3 mm.

    A POLYDATA surface carries no confidence, so what is less sure is a hole.
    """
    rows = np.arange(step // 2, depth.shape[0], step)
    columns = np.arange(step // 2, depth.shape[1], step)
    z = depth[np.ix_(rows, columns)].astype(np.float64)
    known = np.isfinite(z) & (confidence[np.ix_(rows, columns)] >= SURE)
    u, v = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
    places = unproject(camera, np.stack([u, v], axis=-1), np.where(known, z, np.nan))
    corner = np.arange(z.size).reshape(z.shape)
    above, below = corner[:-1], corner[1:]
    # Two triangles of each four neighbours; the corners go round so that normals look at the camera.
    triangles = np.concatenate(
        [
            np.stack([above[:, :-1], below[:, :-1], above[:, 1:]], axis=-1).reshape(-1, 3),
            np.stack([above[:, 1:], below[:, :-1], below[:, 1:]], axis=-1).reshape(-1, 3),
        ]
    )
    corners = np.where(known, z, np.nan).ravel()[triangles]  # NaN: unknown, and so in no comparison
    nearest, farthest = corners.min(axis=1), corners.max(axis=1)
    across = step * nearest / float(camera.K[0, 0])
    triangles = triangles[farthest - nearest <= math.tan(STEEPEST) * across]
    used, numbers = np.unique(triangles, return_inverse=True)
    return places.reshape(-1, 3)[used], numbers.reshape(-1, 3).astype(np.int64)
