"""Adds to each frame the scope's pose as the robot reports it: by ROS 2, by another program, or in a bag."""

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from sags_node.bags.bag import read_messages
from sags_node.config.schema import BagRobot, BagSource, LaunchConfig, LiveSource, PushRobot, Ros2Robot
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import invert, rigid
from sags_node.messaging.inbox import Inbox
from sags_node.messaging.security import RateLimitedLog
from sags_node.messaging.topics import TF
from sags_node.messaging.wire import Message
from sags_node.rig.hand_eye import FILE, read_hand_eye
from sags_node.ros.graph import Delivery, Graph, Reader
from sags_node.sources.pose_track import KEPT, POSE_TYPES, NoPoseError, PoseTrack
from sags_node.sources.ros2 import absolute
from sags_node.sources.source import Source, findings_of
from sags_node.types import F64, Finding, StereoFrame, StereoRig, ToolPose
from sags_node.workers import go_on

log = logging.getLogger(__name__)

WAIT_S = 0.1  # s to wait for a pose; robots send theirs sooner than cameras their images
POLL_S = 0.1
CLOSE_S = 5.0
STATIC = "/tf_static"
WHOLE = 10_000_000  # samples kept of a bag: all
TOOL_PROBLEMS = {  # why a tool's pose is not known
    "pose_missing": "no pose of the image's time has come",
    "pose_stopped": "its newest pose is older than the image",
    "pose_jumped": "its pose jumped within the last second",
    "pose_too_far": "it is over 10 m from its base: its lengths must be in metres",
}


class Robot:
    """A source of poses. It receives them from its construction to `close`."""

    def __init__(self, config: BagRobot | PushRobot | Ros2Robot, kept: int = KEPT) -> None:
        self.track = PoseTrack(config.base, config.hand, kept)
        self.tools = {absolute(tool.topic): PoseTrack(kept=kept) for tool in config.tools}

    def add(self, topic: str, data: bytes | memoryview, kind: str) -> None:
        """Take in a message of one of `POSE_TYPES`: of a tool if the topic is a tool's, else of the scope.

        Raises:
            SagsError: see `PoseTrack.add`; or a tool's topic holds a tree of frames.
        """
        track = self.tools.get(topic)
        if track is not None and kind == TF:
            raise SagsError(f"{topic} holds a tree of frames: a tool needs a topic of PoseStamped")
        (track or self.track).add(data, kind, fixed=topic == STATIC)

    def close(self) -> None:
        """Stop receiving poses."""


class _BagPoses(Robot):
    """All poses of a bag.

    Raises:
        UsageError: the source is no bag, or the topic is missing or holds no poses.
        SagsError: the file is damaged.
    """

    def __init__(self, config: BagRobot, source: object) -> None:
        if not isinstance(source, BagSource):
            raise UsageError("robot.kind bag takes poses from the bag of the images: set source.kind:=bag")
        super().__init__(config, WHOLE)
        wanted = {absolute(config.topic), *self.tools}
        seen: dict[str, str] = {}
        wrong, first_wrong = 0, ""  # invalid poses: left out, as in tf2
        for message in read_messages(source.path, wanted=lambda topic, kind: kind in POSE_TYPES):
            topic = absolute(message.topic)
            seen[topic] = message.type
            if topic in {*wanted, STATIC} and message.type in POSE_TYPES:
                try:
                    self.add(topic, message.data, message.type)
                except SagsError as error:
                    wrong += 1
                    first_wrong = first_wrong or f"{topic} at {message.log_ns * 1e-9:.3f} s: {error}"
        if wrong:
            said = "%s: %d messages are no pose and are left out, the first is %s; was the robot homed?"
            log.warning(said, source.path, wrong, first_wrong)
        for topic in wanted:
            if seen.get(topic) not in POSE_TYPES:
                there = ", ".join(sorted(name for name, kind in seen.items() if kind in POSE_TYPES)) or "none"
                key = "robot.tools" if topic in self.tools else "robot.topic"
                raise UsageError(
                    f"{source.path} has no poses on {topic}; topics with poses: {there}; set {key}"
                )


class _PushedPoses(Robot):
    """Poses that another program pushes; see `Inbox`."""

    def __init__(self, config: PushRobot) -> None:
        super().__init__(config)
        self._named = config.topic is not None
        # The topic of the scope's pose; None: the first pose that is no tool's names it.
        self._scope = None if config.topic is None else absolute(config.topic)
        self._inbox = Inbox(config.endpoint, config, "robot", self._take, about=self._pose_of)
        self.endpoint = self._inbox.endpoint

    def _take(self, message: Message, arrival_ns: int) -> None:
        if message.meta.type not in POSE_TYPES:
            raise SagsError(
                f"{message.topic}: {message.meta.type} is no pose; known: {', '.join(POSE_TYPES)}"
            )
        topic = self._topic_of(message)
        if topic not in {STATIC, *self.tools} and (self._named or message.meta.type != TF):
            if self._scope not in (None, topic):
                listed = ", ".join(self.tools) or "none are listed"
                raise SagsError(
                    f"{topic} is none of robot.tools ({listed}), and the scope's pose comes on "
                    f"{self._scope}; list it there, set robot.topic, or do not send it"
                )
            self._scope = topic
        self.add(topic, message.cdr(), message.meta.type)

    def _topic_of(self, message: Message) -> str:
        """The known topic (scope, tool, tf_static) that is meant; else the sent one without its namespace."""
        sent, name = absolute(message.topic), absolute(message.topic.partition("/")[2])
        if self._scope is not None and self._scope in {sent, name}:
            return self._scope
        # A namespace may itself contain slashes.
        return max((known for known in (STATIC, *self.tools) if sent.endswith(known)), key=len, default=name)

    def _pose_of(self, message: Message) -> list[str]:
        """What only one program may send: a pose. Transforms of a tree may come from several."""
        topic = self._topic_of(message)
        whose = f"the pose of {topic}" if topic in self.tools else "the robot's pose"
        return [] if message.meta.type == TF else [whose]

    @property
    def findings(self) -> tuple[Finding, ...]:
        return self._inbox.findings

    def close(self) -> None:
        self._inbox.close()


class _RosPoses(Robot):
    """Poses of a ROS 2 graph; see `Graph`."""

    def __init__(self, config: Ros2Robot) -> None:
        super().__init__(config)
        self._topics = {absolute(config.topic), STATIC, *self.tools}
        self._graph = Graph(config)
        self._readers: dict[str, Reader] = {}
        self._seldom = RateLimitedLog()
        self._stopping = threading.Event()
        self._thread = threading.Thread(
            target=go_on, args=(self._read, self._stopping, "ros2-poses"), name="ros2-poses", daemon=True
        )
        self._thread.start()

    def _read(self) -> None:
        self._subscribe()
        self._graph.wait(POLL_S)
        for topic, reader in self._readers.items():
            while messages := list(reader.take()):
                for data in messages:
                    self._add(topic, reader.kind, data)

    def _subscribe(self) -> None:
        """Subscribe to topics that have a publisher: only then their type is known."""
        if self._topics <= self._readers.keys():
            return
        there = self._graph.publications()
        for topic in self._topics - self._readers.keys():
            kinds = there.get(topic, set()) & set(POSE_TYPES)
            if kinds:
                fixed = topic == STATIC
                delivery = Delivery(reliable=fixed, kept=fixed, depth=100)
                self._readers[topic] = self._graph.reader(topic, min(kinds), delivery)

    def _add(self, topic: str, kind: str, data: bytes) -> None:
        try:
            self.add(topic, data, kind)
        except SagsError as error:
            if self._seldom.due():
                log.warning("%s: left out: %s", topic, error)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(CLOSE_S)


def open_robot(config: LaunchConfig) -> Robot:
    """Open the source of poses that a launch file names.

    Raises:
        UsageError: it names none, there are no poses, or see `Inbox`.
        SagsError: the poses cannot be read.
    """
    match config.robot:
        case BagRobot():
            return _BagPoses(config.robot, config.source)
        case PushRobot():
            return _PushedPoses(config.robot)
        case Ros2Robot():
            return _RosPoses(config.robot)
    raise UsageError("there is no robot in the launch file: set robot.kind to ros2, push or bag")


class Posed:
    """A `Source` whose frames hold the pose of the left rectified camera, as the robot reports it.

    No frame is delivered before the first pose. A later frame without a pose gets the last one, and says why
    (`StereoFrame.pose_problem`). Poses of tools are added where they are known (`StereoFrame.tools`).

    Args:
        source: of the images.
        config: its `robot` says where the poses come from.

    Raises:
        UsageError: there is no hand-eye calibration, or see `open_robot`.
        SagsError: the poses cannot be read.
    """

    def __init__(self, source: Source, config: LaunchConfig, rig: StereoRig) -> None:
        assert config.robot is not None
        hand_eye = read_hand_eye(hand_eye_file(config))
        self._T_hand_cam = rectified(hand_eye.T_hand_cam, rig)
        self._offset_ns = hand_eye.offset_ns
        if config.robot.offset_ms is not None:
            self._offset_ns = round(config.robot.offset_ms * 1e6)
        if isinstance(config.source, LiveSource):  # the offset is to the stamp, latency included
            self._offset_ns += round(config.source.latency_ms * 1e6)
        self.robot = open_robot(config)
        self._tools = config.robot.tools
        self._recorded = isinstance(config.robot, BagRobot)
        self._source = source
        self._without = 0  # frames before the first pose
        self._seldom = RateLimitedLog()

    @property
    def rate(self) -> float:
        return self._source.rate

    @property
    def frame_count(self) -> int | None:
        return self._source.frame_count

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what is wrong with the senders of images or poses, and how to fix it."""
        return findings_of(self._source) + findings_of(self.robot)

    @property
    def dropped(self) -> int:
        """The frames that the images' source dropped, and those before the first pose."""
        return self._source.dropped + self._without

    def __enter__(self) -> Self:
        self._source.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._source.__exit__(*error)
        self.robot.close()

    def stop(self) -> None:
        self._source.stop()

    def __iter__(self) -> Iterator[StereoFrame]:
        last: F64 | None = None
        for frame in self._source:
            t_ns = frame.t_device_ns if self._recorded else frame.t_capture_ns
            problem = None
            tools: tuple[ToolPose, ...] = ()
            deadline = time.monotonic() + WAIT_S
            try:
                T_base_hand = self.robot.track.at(t_ns + self._offset_ns, WAIT_S)
                last = T_base_hand @ self._T_hand_cam
                tools = self._told(t_ns + self._offset_ns, T_base_hand, deadline)
            except NoPoseError as error:
                problem = error.finding
            if last is None:
                self._without += 1
                if self._seldom.due():
                    log.warning("no frame is taken before the first pose: %s", problem and problem.text)
                continue
            yield replace(frame, T_world_cam=last, pose_problem=problem, tools=tools)

    def _told(self, t_ns: int, T_base_hand: F64, deadline: float) -> tuple[ToolPose, ...]:
        """The tools' poses in the camera; wait for those that are missing until `deadline` (monotonic, s)."""
        T_cam_base, told = invert(T_base_hand @ self._T_hand_cam), []
        for tool in self._tools:
            track = self.robot.tools[absolute(tool.topic)]
            T = np.array(tool.T_base)
            T_cam = T_cam_base @ (T_base_hand @ T if tool.on_hand else T)
            T_cam_tool, problem = None, ""
            try:
                left = max(0.0, deadline - time.monotonic())
                T_cam_tool = T_cam @ track.at(t_ns, left)
            except NoPoseError as error:
                problem = f"{tool.topic}: {TOOL_PROBLEMS[error.finding.code]}"
            frames = track.frame, self.robot.track.frame
            if all(frames) and frames[0] != frames[1] and not tool.model_fields_set & {"T_base", "on_hand"}:
                T_cam_tool = None
                problem = (
                    f"{tool.topic}: its poses are in '{frames[0]}', the scope's in '{frames[1]}', and "
                    "nothing says how these lie: set T_base or on_hand"
                )
            told.append(ToolPose(tool.topic, 1e-3 * tool.error_mm, T_cam_tool, problem))
        return tuple(told)


def rectified(T_hand_cam: F64, rig: StereoRig) -> F64:
    """Convert the raw left camera's pose on the hand [4, 4] to that of the left rectified camera."""
    return T_hand_cam @ rigid(rig.left.R.T, np.zeros(3))


def hand_eye_file(config: LaunchConfig) -> Path:
    """Return the file of the hand-eye calibration.

    Raises:
        UsageError: the launch file names none.
    """
    assert config.robot is not None
    if config.robot.hand_eye is not None:
        return config.robot.hand_eye
    if config.rig is None or not config.rig.is_dir():
        raise UsageError(
            "robot.hand_eye is missing: name the file of sags calib hand-eye, or set rig to its folder"
        )
    return config.rig / FILE
