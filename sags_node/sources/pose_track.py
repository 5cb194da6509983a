"""The poses that a robot reports over time: a tree of frames (as tf) whose transforms are interpolated.

A pose is given only between two samples that are close together in time. Nothing is extrapolated beyond the
newest one.
"""

import threading
import time
from bisect import bisect_left, bisect_right, insort
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from sags_node.errors import SagsError
from sags_node.geometry import invert, quat_to_matrix, rigid
from sags_node.messaging import cdr, topics
from sags_node.types import F64, Finding

TRANSFORM = "geometry_msgs/msg/TransformStamped"
POSE_TYPES = (topics.TF, cdr.POSE, TRANSFORM)
BASE, HAND = "base", "hand"  # names of the two frames if a topic holds the pose itself, not a tree

# ns between two samples. A hand accelerates a scope by about 1 m/s^2, so that over this time a straight line
# is wrong by less than 2 mm (a t^2 / 8).
LARGEST_GAP_NS = 120_000_000
IN_VAIN_NS = 4 * LARGEST_GAP_NS  # ns: if the newest pose is older than this, no newer one is waited for
FASTEST = 1.0  # m/s: faster is a jump; a person pulls a scope out of a trocar more slowly
FASTEST_TURN = 2 * np.pi  # rad/s
SMALLEST_JUMP = 0.002  # m, and 1 degree: smaller steps are jitter, not jumps
SMALLEST_TURN = np.radians(1)
LATE_NS = 1_000_000_000  # ns: a stamp that goes back by more means a restarted robot; by less, wrong order
JUMP_HELD_NS = 1_000_000_000  # ns after a jump during which no poses are given
FARTHEST = 10.0  # m from the base: no robot reaches so far; poses in mm seem to
KEPT = 20_000  # samples of each frame, for a live robot
MOST_FRAMES = 1000  # of a tf tree


class NoPoseError(SagsError):
    """There is no pose for the requested time."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.finding = Finding(code, text)


class Sample(NamedTuple):
    quat: F64  # [4] wxyz, unit
    position: F64  # [3] m


class _Edge:
    """The poses of one frame in its parent, over time."""

    def __init__(self, parent: str, kept: int) -> None:
        self.parent = parent
        self._kept = kept
        self._stamps: list[int] = []
        self._samples: list[Sample] = []
        self._jumps: list[int] = []

    @property
    def newest(self) -> int:
        return self._stamps[-1]

    def add(self, stamp_ns: int, sample: Sample) -> None:
        if self._stamps and stamp_ns < self._stamps[-1] - LATE_NS:
            self._stamps, self._samples, self._jumps = [], [], []  # the robot restarted
        at = bisect_left(self._stamps, stamp_ns)  # not always at the end: samples may come in the wrong order
        if stamp_ns in self._stamps[at : at + 1]:
            return  # sent twice
        self._stamps.insert(at, stamp_ns)
        self._samples.insert(at, sample)
        for one, other in pairwise(range(max(0, at - 1), min(at + 2, len(self._stamps)))):
            later = self._stamps[other]
            if _jumps(self._samples[one], self._samples[other], later - self._stamps[one]):
                insort(self._jumps, later)
        if len(self._stamps) > 2 * self._kept:
            del self._stamps[: -self._kept], self._samples[: -self._kept]
            self._jumps = [stamp for stamp in self._jumps if stamp >= self._stamps[0]]

    def at(self, t_ns: int) -> F64:
        """Interpolate the pose [4, 4] m.

        Raises:
            NoPoseError: it is not known for this time.
        """
        after = bisect_left(self._stamps, t_ns)
        if after == len(self._stamps):
            age = (t_ns - self._stamps[-1]) * 1e-9
            raise NoPoseError(
                "pose_stopped",
                f"the robot's pose has stopped: the newest is {age:.2f} s older than the image; check "
                "the robot's program, its clock and robot.offset_ms",
            )
        if after == 0 and self._stamps[0] > t_ns:
            raise NoPoseError("pose_missing", "the image is older than all poses of the robot")
        before = after if self._stamps[after] == t_ns else after - 1
        gap = self._stamps[after] - self._stamps[before]
        if gap > LARGEST_GAP_NS:
            raise NoPoseError(
                "pose_missing",
                f"the robot's poses are {gap * 1e-9:.2f} s apart: more than "
                f"{1e9 / LARGEST_GAP_NS:.0f} a second are needed",
            )
        jump = bisect_right(self._jumps, self._stamps[after])
        if jump and self._jumps[jump - 1] > t_ns - JUMP_HELD_NS:
            raise NoPoseError(
                "pose_jumped",
                "the robot's pose jumps faster than a scope can move: are its lengths in metres? Check its "
                "joints' sensors and its base frame",
            )
        share = 0.0 if gap == 0 else (t_ns - self._stamps[before]) / gap
        return between(self._samples[before], self._samples[after], share)


class _Fixed(NamedTuple):
    parent: str
    T: F64
    newest: int = 0

    def at(self, t_ns: int) -> F64:
        return self.T


class PoseTrack:
    """The poses that came so far. Thread-safe.

    Attributes:
        frame: name of the frame in which poses are, by their sender or `base`; empty: not known.

    Args:
        base, hand: the pose of `hand` in `base` is given; None: the topic holds the pose itself.
        kept: number of samples that are kept for each frame.
    """

    def __init__(self, base: str | None = None, hand: str | None = None, kept: int = KEPT) -> None:
        self.frame = _plain(base or "")
        self._base, self._hand = _plain(base or BASE), _plain(hand or HAND)
        self._kept = kept
        self._edges: dict[str, _Edge | _Fixed] = {}
        self._came = threading.Condition()

    def add(self, data: bytes | memoryview, kind: str, fixed: bool = False) -> None:
        """Take in a message of one of `POSE_TYPES`, as CDR; `fixed`: from `tf_static`.

        Raises:
            SagsError: it is damaged, or holds an invalid pose. Valid poses in it are taken in nevertheless.
        """
        message: Any = cdr.decode(data, kind)
        wrong: SagsError | None = None
        with self._came:
            for one in message.transforms if kind == topics.TF else [message]:
                parent, child = BASE, HAND
                if kind == topics.TF:
                    parent, child = _plain(one.header.frame_id), _plain(one.child_frame_id)
                else:
                    self.frame = _plain(one.header.frame_id)
                there = one.pose if kind == cdr.POSE else one.transform
                turn = there.orientation if kind == cdr.POSE else there.rotation
                place = there.position if kind == cdr.POSE else there.translation
                try:
                    self._add(parent, child, one.header, turn, place, fixed)
                except SagsError as error:
                    wrong = error
            self._came.notify_all()
        if wrong is not None:
            raise wrong

    def _add(self, parent: str, child: str, header: Any, turn: Any, place: Any, fixed: bool) -> None:
        quat = np.array([turn.w, turn.x, turn.y, turn.z], np.float64)
        position = np.array([place.x, place.y, place.z], np.float64)
        length = float(np.linalg.norm(quat))
        if not (np.isfinite(position).all() and 0.9 < length < 1.1):
            raise SagsError(
                f"the pose of {child} holds numbers that are no pose (a quaternion of length {length:.3g})"
            )
        if child == parent:
            raise SagsError(f"the pose of {child} is in {child} itself: tf must be a tree")
        if child not in self._edges and len(self._edges) >= MOST_FRAMES:
            raise SagsError(f"tf holds more than {MOST_FRAMES} frames")
        sample = Sample(quat / length, position)
        if fixed:
            self._edges[child] = _Fixed(parent, to_matrix(sample))
            return
        edge = self._edges.get(child)
        if not isinstance(edge, _Edge) or edge.parent != parent:
            edge = self._edges[child] = _Edge(parent, self._kept)
        edge.add(header.stamp.sec * 1_000_000_000 + header.stamp.nanosec, sample)

    def at(self, t_ns: int, timeout: float = 0.0) -> F64:
        """Return the pose of the hand in the base at a time, [4, 4] m. If the newest pose is only a little
        older, wait for a newer one, up to `timeout` seconds.

        Raises:
            NoPoseError: it is not known for this time.
        """
        deadline = time.monotonic() + timeout
        with self._came:
            while True:
                try:
                    return self._at(t_ns)
                except NoPoseError as error:
                    left = deadline - time.monotonic()
                    in_vain = left <= 0 or t_ns - self.newest_ns > IN_VAIN_NS
                    if in_vain or error.finding.code != "pose_stopped":
                        raise
                    self._came.wait(left)

    @property
    def newest_ns(self) -> int:
        """The stamp of the newest sample, ns; 0 before the first."""
        return max((edge.newest for edge in self._edges.values()), default=0)

    def _at(self, t_ns: int) -> F64:
        base, hand = self._chain(self._base), self._chain(self._hand)
        if base[-1] != hand[-1] or len(base) == len(hand) == 1:
            there = ", ".join(sorted(self._edges)) or "none"
            raise NoPoseError(
                "pose_missing",
                f"no pose of '{self._hand}' in '{self._base}' came yet; frames: {there[:200]}; check "
                "robot.topic, robot.base and robot.hand",
            )
        T = invert(self._in_root(base, t_ns)) @ self._in_root(hand, t_ns)
        if (distance := float(np.linalg.norm(T[:3, 3]))) > FARTHEST:
            raise NoPoseError(
                "pose_too_far",
                f"the robot says that '{self._hand}' is {distance:.3g} m from '{self._base}': its lengths "
                "must be in metres",
            )
        return T

    def _chain(self, frame: str) -> list[str]:
        """The frame, its parent and so on, up to the root."""
        chain = [frame]
        while chain[-1] in self._edges and len(chain) <= MOST_FRAMES:
            chain.append(self._edges[chain[-1]].parent)
        return chain

    def _in_root(self, chain: list[str], t_ns: int) -> F64:
        T = np.eye(4)
        for frame in chain[:-1]:
            T = self._edges[frame].at(t_ns) @ T
        return T


def to_matrix(sample: Sample) -> F64:
    return rigid(quat_to_matrix(sample.quat), sample.position)


def between(one: Sample, other: Sample, share: float) -> F64:
    """Interpolate two poses at `share` 0..1: rotation by slerp, position linearly. [4, 4] m."""
    cosine = float(one.quat @ other.quat)
    end = other.quat if cosine >= 0 else -other.quat
    angle = np.arccos(min(abs(cosine), 1.0))
    if angle < 1e-6:
        quat = (1 - share) * one.quat + share * end
    else:
        quat = (np.sin((1 - share) * angle) * one.quat + np.sin(share * angle) * end) / np.sin(angle)
    position = (1 - share) * one.position + share * other.position
    return to_matrix(Sample(quat, position))


def _jumps(one: Sample, other: Sample, ns: int) -> bool:
    seconds = ns * 1e-9
    way = float(np.linalg.norm(other.position - one.position))
    turn = 2 * float(np.arccos(min(abs(float(one.quat @ other.quat)), 1.0)))
    return way > max(FASTEST * seconds, SMALLEST_JUMP) or turn > max(FASTEST_TURN * seconds, SMALLEST_TURN)


def _plain(name: str) -> str:
    """The name of a frame without the leading slash of ROS 1."""
    return name.strip("/")
