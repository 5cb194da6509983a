"""Live stereo from a ROS 2 graph: two picture topics, paired by their stamps, or one that shows both eyes."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from functools import partial

from sags_node.config.schema import Ros2Source
from sags_node.errors import SagsError, UsageError
from sags_node.messaging.security import RateLimitedLog
from sags_node.messaging.topics import CAMERA_INFO
from sags_node.recording.camera_info import read_eye
from sags_node.recording.pictures import IMAGE_TYPES, decode_picture, header_stamp
from sags_node.rig import accept_rig
from sags_node.ros.endpoints import Reader
from sags_node.ros.graph import Graph, receive_buffer
from sags_node.sources.sent import SentPictures
from sags_node.types import Eye as Calibrated
from sags_node.types import Side, StereoRig
from sags_node.workers import go_on

log = logging.getLogger(__name__)

POLL_S = 0.1  # how soon the reading thread notices `stop`, and a topic that is new
CLOSE_S = 5.0
QUIET_S = 3.0  # without a picture: it is said what is there instead
MUCH_LOST = 0.1  # of the pictures; as much as a strict reader of ours allows
INFO_S = 10.0  # longest wait for the calibration: cameras may just be starting
ZEROS_S = 2.0  # longest wait where they say that they have none: drivers start before they have read it


class RosCameras(SentPictures):
    """A `Source` of live stereo frames from a ROS 2 graph.

    Pictures come raw or compressed, as their sender publishes them. Its process may end and come again.

    Args:
        size: width and height that pictures must have, px; None: those of the first.

    Raises:
        UsageError, SagsError: see `Graph`.
    """

    def __init__(self, config: Ros2Source, size: tuple[int, int] | None = None) -> None:
        super().__init__(config, size)
        self._graph = Graph(config)
        self._names = picture_topics(config)
        self._readers: dict[Side, Reader] = {}
        self._left_out: Mapping[Side, RateLimitedLog] = {"left": RateLimitedLog(), "right": RateLimitedLog()}
        self._silent: Mapping[Side, RateLimitedLog] = {"left": RateLimitedLog(), "right": RateLimitedLog()}
        self._heard: dict[Side, float] = {}
        turn = self._read, self.stopped, "ros2"
        self._thread = threading.Thread(target=go_on, args=turn, name="ros2", daemon=True)

    def start(self) -> None:
        self._heard = dict.fromkeys(self._names, time.monotonic())
        self._thread.start()

    def close(self) -> None:
        if self._thread.ident is not None:
            self._thread.join(CLOSE_S)

    # ---- the reading thread ----------------------------------------------------------------------------

    def _read(self) -> None:
        self._subscribe()
        self._graph.wait(POLL_S)
        for eye, reader in self._readers.items():
            for data in reader.take():
                self._heard[eye] = time.monotonic()
                self._put(eye, reader.kind, data)
        for eye, last in self._heard.items():
            if time.monotonic() - last > QUIET_S and self._silent[eye].due():
                log.warning("%s", self._silence(eye))

    def _subscribe(self) -> None:
        """As soon as somebody publishes: only then it is known whether the pictures are compressed."""
        if len(self._readers) == len(self._names):
            return
        there = self._graph.publications()
        for eye, name in self._names.items():
            kinds = there.get(name, set()) & set(IMAGE_TYPES)
            if eye not in self._readers and kinds:
                self._readers[eye] = self._graph.reader(name, min(kinds))

    def _put(self, eye: Side, kind: str, data: bytes) -> None:
        name, arrival_ns = self._names[eye], time.time_ns()
        decode = partial(decode_picture, data, kind, name)
        put = partial(self.put, eye) if len(self._names) == 2 else self.put_both
        try:
            put(header_stamp(data), arrival_ns, decode)
        except SagsError as error:
            if self._left_out[eye].due():
                log.warning("%s: left out: %s", name, str(error).removeprefix(f"{name}: "))
        arrivals = self.arrivals[eye]
        if arrivals.share_lost > MUCH_LOST and self._left_out[eye].due():
            log.warning("%s", _explained(name, arrivals.share_lost))

    def _silence(self, eye: Side) -> str:
        name, there = self._names[eye], self._graph.publications()
        where = self._graph.where()
        if name in there and not there[name] & set(IMAGE_TYPES):
            return f"{name} is {', '.join(sorted(there[name]))}, not a picture topic; set source.{eye}"
        if name in there:
            return (
                f"no picture comes on {name} ({where}), though somebody publishes it; does it run, and does "
                "no firewall stop its packets?"
            )
        topics = ", ".join(sorted(topic for topic, kinds in there.items() if kinds & set(IMAGE_TYPES)))
        return (
            f"nobody publishes {name} in {where}; picture topics there: {topics or 'none'}. Set "
            f"source.{eye}, source.domain (ROS_DOMAIN_ID of the camera) or source.interface"
        )


def picture_topics(config: Ros2Source) -> dict[Side, str]:
    """Of each eye; of the left one only where its pictures show both."""
    if config.geometry.layout != "separate":
        return {"left": absolute(config.left)}
    return {"left": absolute(config.left), "right": absolute(config.right)}


def absolute(name: str) -> str:
    """A topic as the graph spells it."""
    return "/" + name.lstrip("/")


def _explained(name: str, share: float) -> str:
    return (
        f"{name}: {share:.0%} of the pictures are lost on the way. The kernel grants a receive buffer of "
        f"{receive_buffer() / 1e6:.1f} MB; more: sudo sysctl -w net.core.rmem_max=16777216, then start anew. "
        "Or send CompressedImage, or fewer or smaller pictures"
    )


def read_rig(config: Ros2Source, seconds: float = INFO_S) -> StereoRig | None:
    """The calibration that the cameras publish; None where they publish an empty one.

    Raises:
        UsageError: no camera_info comes within `seconds`, one eye's is empty, or they are implausible.
        SagsError: a message is damaged.
    """
    graph = Graph(config)
    named: Mapping[Side, str] = {
        "left": absolute(config.left_info or _beside(config.left)),
        "right": absolute(config.right_info or _beside(config.right)),
    }
    readers = {eye: graph.reader(name, CAMERA_INFO) for eye, name in named.items()}
    found: dict[Side, Calibrated] = {}
    zeros: set[Side] = set()
    deadline = time.monotonic() + seconds
    while len(found) < len(named):
        if zeros | found.keys() == named.keys():
            deadline = min(deadline, time.monotonic() + ZEROS_S)
        if time.monotonic() > deadline:
            if zeros | found.keys() == named.keys():
                break
            missing = " and ".join(name for eye, name in named.items() if eye not in found)
            raise UsageError(
                f"no camera_info on {missing} in {seconds:g} s ({graph.where()}): start the cameras first, "
                "name the topics in source.left_info and source.right_info, or set rig"
            )
        graph.wait(POLL_S)
        for eye, reader in readers.items():
            for data in reader.take():
                said = read_eye(data, named[eye])
                if said is None:
                    zeros.add(eye)
                else:
                    found[eye] = said
    if not found:
        return None
    for eye in named.keys() - found.keys():
        raise UsageError(f"{named[eye]} says that its eye is not calibrated; set rig")
    return accept_rig(StereoRig("ros2", found["left"], found["right"]), graph.where())


def _beside(topic: str) -> str:
    return topic.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"
