"""Live stereo from a ROS 2 graph: two image topics, paired by their stamps, or one that shows both eyes."""

import logging
import threading
import time
from collections.abc import Iterator, Mapping
from functools import partial

from sags_node.bags.camera_info import read_eye, same, topic_of
from sags_node.bags.pictures import IMAGE_TYPES, decode_picture, header_stamp
from sags_node.config.schema import Ros2Source
from sags_node.errors import SagsError, UsageError
from sags_node.messaging.security import RateLimitedLog
from sags_node.messaging.topics import CAMERA_INFO
from sags_node.rig import accept_rig, already_rectified
from sags_node.ros.graph import Graph, Reader, receive_buffer
from sags_node.sources.layout import refuse_turned
from sags_node.sources.sent import SentPictures
from sags_node.types import Eye as Calibrated
from sags_node.types import Finding, Side, StereoRig
from sags_node.workers import go_on

log = logging.getLogger(__name__)

POLL_S = 0.1  # s until the reading thread notices `stop` or a new topic
CLOSE_S = 5.0  # s to wait for the reading thread
QUIET_S = 3.0  # s without an image, after which a warning says which topics there are
MUCH_LOST = 0.1  # share of lost images; a strict `read` of our client allows as much
INFO_S = 10.0  # s to wait for the calibration: cameras may just be starting
ZEROS_S = 2.0  # s to wait once an empty one came: drivers may start before they have loaded it


class RosCameras(SentPictures):
    """A `Source` of live stereo frames from a ROS 2 graph.

    Images come raw or compressed, as their sender publishes them. The sender may restart. While the cameras
    publish another calibration than `rig`, no images are given: depth would be wrong.

    Args:
        size: width and height that images must have, px; None: those of the first.
        rig: the calibration that the cameras published at the start (`read_rig`); None: it is not theirs.

    Raises:
        UsageError, SagsError: see `Graph`.
    """

    def __init__(
        self, config: Ros2Source, size: tuple[int, int] | None = None, rig: StereoRig | None = None
    ) -> None:
        super().__init__(config, size)
        self._graph = Graph(config)
        self._rig = rig
        self._infos = None if rig is None else _CameraInfos(self._graph, config)
        self._damaged = RateLimitedLog()
        self._changed: dict[Side, str] = {}
        self._names = picture_topics(config)
        self._readers: dict[Side, Reader] = {}
        self._left_out: Mapping[Side, RateLimitedLog] = {"left": RateLimitedLog(), "right": RateLimitedLog()}
        self._silent: Mapping[Side, RateLimitedLog] = {"left": RateLimitedLog(), "right": RateLimitedLog()}
        self._heard: dict[Side, float] = {}
        turn = self._read, self.stopped, "ros2"
        self._thread = threading.Thread(target=go_on, args=turn, name="ros2", daemon=True)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what is wrong with the cameras, and how to fix it. Thread-safe."""
        changed = ", ".join(self._changed.copy().values())
        if not changed:
            return ()
        said = f"{changed}: zoom, focus or image size was changed, and nothing is shown"
        return (Finding("calibration_changed", f"{said}; set it back, or restart the node to take it over"),)

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
        self._follow_calibration()
        for eye, reader in self._readers.items():
            for data in reader.take():
                self._heard[eye] = time.monotonic()
                if not self._changed:
                    self._put(eye, reader.kind, data)
        for eye, last in self._heard.items():
            if time.monotonic() - last > QUIET_S and self._silent[eye].due():
                log.warning("%s", self._silence(eye))

    def _subscribe(self) -> None:
        """Subscribe to topics that have a publisher: before, it is not known whether they are compressed."""
        if len(self._readers) == len(self._names):
            return
        there = self._graph.publications()
        for eye, name in self._names.items():
            kinds = there.get(name, set()) & set(IMAGE_TYPES)
            if eye not in self._readers and kinds:
                self._readers[eye] = self._graph.reader(name, min(kinds))

    def _follow_calibration(self) -> None:
        if self._infos is None or self._rig is None:
            return
        try:
            for eye, said in self._infos.take():
                if said is not None:
                    self._compare(eye, said)
        except SagsError as error:
            if self._damaged.due():
                log.warning("%s", error)

    def _compare(self, eye: Side, said: Calibrated) -> None:
        assert self._infos is not None and self._rig is not None
        taken = self._rig.left if eye == "left" else self._rig.right
        rectified = already_rectified(StereoRig("ros2", said, said)).left  # `rig` may be either of them
        if same(taken, said) or same(taken, rectified):
            self._changed.pop(eye, None)
            return
        before, after = taken.P[0, 0], said.P[0, 0]
        self._changed[eye] = f"{self._infos.names[eye]} has changed (f {before:.1f} to {after:.1f} px)"

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
            return f"{name} is {', '.join(sorted(there[name]))}, not an image topic; set source.{eye}"
        if name in there:
            return (
                f"no image comes on {name} ({where}), though somebody publishes it; does it run, and does "
                "no firewall stop its packets?"
            )
        topics = ", ".join(sorted(topic for topic, kinds in there.items() if kinds & set(IMAGE_TYPES)))
        return (
            f"nobody publishes {name} in {where}; image topics there: {topics or 'none'}. Set "
            f"source.{eye}, source.domain (ROS_DOMAIN_ID of the camera) or source.interface"
        )


def picture_topics(config: Ros2Source) -> dict[Side, str]:
    """Return the image topic of each eye; only that of the left one if its images show both."""
    if config.geometry.layout != "separate":
        return {"left": absolute(config.left)}
    return {"left": absolute(config.left), "right": absolute(config.right)}


def absolute(name: str) -> str:
    """Return a topic with a leading slash, as the graph names it."""
    return "/" + name.lstrip("/")


def _explained(name: str, share: float) -> str:
    return (
        f"{name}: {share:.0%} of the images are lost on the way. The kernel grants a receive buffer of "
        f"{receive_buffer() / 1e6:.1f} MB; more: sudo sysctl -w net.core.rmem_max=16777216, then start anew. "
        "Or send CompressedImage, or fewer or smaller images"
    )


def read_rig(config: Ros2Source, seconds: float = INFO_S) -> StereoRig | None:
    """Read the calibration that the cameras publish; None if it is empty.

    Raises:
        UsageError: no camera_info comes within `seconds`, one eye's is empty, the images are flipped, or
            the calibration is implausible.
        SagsError: a message is damaged.
    """
    graph = Graph(config)
    infos = _CameraInfos(graph, config)
    found: dict[Side, Calibrated] = {}
    zeros: set[Side] = set()
    deadline = time.monotonic() + seconds
    while len(found) < len(infos.names):
        if zeros | found.keys() == infos.names.keys():
            deadline = min(deadline, time.monotonic() + ZEROS_S)
        if time.monotonic() > deadline:
            if zeros | found.keys() == infos.names.keys():
                break
            missing = " and ".join(name for eye, name in infos.names.items() if eye not in found)
            raise UsageError(
                f"no camera_info on {missing} in {seconds:g} s ({graph.where()}): start the cameras first, "
                "name the topics in source.left_info and source.right_info, or set rig"
            )
        graph.wait(POLL_S)
        for eye, said in infos.take():
            if said is None:
                zeros.add(eye)
            else:
                found[eye] = said
    if not found:
        return None
    for eye in infos.names.keys() - found.keys():
        raise UsageError(f"{infos.names[eye]} says that its eye is not calibrated; set rig")
    refuse_turned(config.geometry, graph.where())
    return accept_rig(StereoRig("ros2", found["left"], found["right"]), graph.where())


class _CameraInfos:
    """Receives the calibrations that both eyes' cameras publish.

    Attributes:
        names: the topic of each eye.
    """

    def __init__(self, graph: Graph, config: Ros2Source) -> None:
        self.names: Mapping[Side, str] = {
            "left": absolute(config.left_info or topic_of(config.left)),
            "right": absolute(config.right_info or topic_of(config.right)),
        }
        self._readers = {eye: graph.reader(name, CAMERA_INFO) for eye, name in self.names.items()}

    def take(self) -> Iterator[tuple[Side, Calibrated | None]]:
        """Yield the calibrations that have come since, by eye; None: not calibrated.

        Raises:
            SagsError: see `read_eye`.
        """
        for eye, reader in self._readers.items():
            for data in reader.take():
                yield eye, read_eye(data, self.names[eye])
