"""Measure a distance, a path or an area on tissue by anchors, with the error that follows from theirs.

with Subscriber(MEASURING) as subscriber:
    newest = subscriber.wait(ANCHORS, timeout=3.0)
    frame = newest and subscriber.aligned(MEASURING, newest.stamp_ns, timeout=0.2)
    if frame and subscriber.ok(ANCHORS):
        print(measure(frame, [1, 2]))

Lines between anchors are straight. They do not follow the surface: pin more anchors along a curve.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sags_node.confidence import SURE, SURE_OF_ANCHOR, error_of
from sags_node.errors import UsageError
from sags_node.geometry import invert, transform
from sags_node.messaging.received import Frame, ReceivedCameraInfo, ReceivedCloud, ReceivedRos, TopicName
from sags_node.messaging.wire import WireError
from sags_node.types import F64, AnchorStates, Bool, Camera

ANCHORS = TopicName("anchors", ReceivedCloud)
POSE = TopicName("tf", ReceivedRos)
INFO = TopicName("left/camera_info", ReceivedCameraInfo)
MEASURING = (ANCHORS, POSE, INFO)

# Share of the image's width. Nine of ten visible anchors are nearer than this to their point in the
# image: 0.7 to 1.4 px of 640 (`off_by_px` in benchmarks/results/tracking_*.json).
SIDEWAYS = 1.5 / 640
NORMAL = 1.645  # standard deviations of a normal distribution, within which nine of ten lie


@dataclass(frozen=True, slots=True)
class Measured:
    """One value of one frame.

    Attributes:
        value: m, or m2 of an area; None: an anchor is lost, or there is none of that number.
        error: nine of ten real ones are smaller, as for a depth; the standard deviation is `error / NORMAL`.
            None: not known.
        unsure: why it must not be shown as sure; None: nothing speaks against it.
        metric: False: the node has no calibration, and the value no unit.
    """

    value: float | None
    error: float | None
    unsure: str | None
    metric: bool = True

    def stretch(self, reference: Measured) -> tuple[float, float] | None:
        """The ratio to an earlier value, and its error; None where either lacks a value or an error.

        Both errors are assumed independent. An error that is the same in both makes the real one smaller.
        """
        if not self.value or not reference.value or self.error is None or reference.error is None:
            return None
        ratio = self.value / reference.value
        return ratio, ratio * math.hypot(self.error / self.value, reference.error / reference.value)


def check_numbers(numbers: Sequence[int], area: bool) -> None:
    """Check that something can be measured between anchors of these numbers.

    Raises:
        UsageError: too few, or the same one where it makes no sense.
    """
    least = 3 if area else 2
    if len(numbers) < least:
        raise UsageError(f"{'an area needs' if area else 'give'} {least} anchors or more (sags anchor list)")
    twice = len(set(numbers)) < len(numbers) if area else any(np.diff(numbers) == 0)
    if twice:
        raise UsageError(
            "the same anchor twice" + ("" if area else " in a row") + ": each is a corner of its own"
        )


def measure(frame: Frame, numbers: Sequence[int], area: bool = False) -> Measured:
    """Measure the length of the path along anchors (of two: their distance), or the area of their polygon.

    Each anchor is moved by its error in depth along its ray, and sideways. The changes of the value are added
    in quadrature. Depth errors are common to all anchors where the calibration is wrong, and independent
    where matches are wrong: the larger of both sums counts.

    Args:
        frame: the messages `MEASURING` of one frame.
        numbers: of the anchors, in order.
        area: measure the area; of a polygon that is not flat, of its projection on its mean plane (Newell).

    Raises:
        UsageError: see `check_numbers`.
    """
    anchors, info = frame[ANCHORS], frame[INFO]
    try:
        T_world_cam = frame[POSE].pose()
    except WireError as problem:
        return Measured(None, None, str(problem), anchors.metric)
    columns = {name: np.ascontiguousarray(anchors.points[name]) for name in anchors.points.dtype.names or ()}
    states = AnchorStates(
        ids=columns["id"].astype(np.int64),
        points=np.stack([columns[axis] for axis in "xyz"], 1),
        pixels=np.stack([columns[axis] for axis in "uv"], 1),
        visibility=columns["visibility"],
        confidence=columns["confidence"],
        ages=columns["age"],
        depth_confidence=columns["depth_confidence"],
    )
    camera = Camera(info.width, info.height, info.K, T_world_cam)
    return measured(states, camera, numbers, area, anchors.metric)


def measured(
    states: AnchorStates, camera: Camera, numbers: Sequence[int], area: bool = False, metric: bool = True
) -> Measured:
    """Measure as `measure` does, from the anchors of a frame and its left camera."""
    check_numbers(numbers, area)
    rows = {int(number): row for row, number in enumerate(states.ids)}
    if missing := [number for number in numbers if number not in rows]:
        listed = ", ".join(map(str, missing))
        return Measured(None, None, f"there is no anchor {listed}", metric)
    distinct = list(dict.fromkeys(numbers))  # a path may return to an anchor, whose error counts once
    order = [distinct.index(number) for number in numbers]
    chosen = [rows[number] for number in distinct]
    points = states.points[chosen].astype(np.float64)
    visibility, confidence = states.visibility[chosen], states.confidence[chosen]
    depth_confidence = states.depth_confidence[chosen]

    def named(which: Bool | np.bool_, of_one: str, of_many: str) -> list[str]:
        listed = [str(number) for number, one in zip(distinct, np.atleast_1d(which), strict=True) if one]
        if len(listed) < 2:
            return [f"anchor {number} {of_one}" for number in listed]
        return [f"anchors {', '.join(listed)} {of_many}"]

    if lost := named(~np.isfinite(points).all(1), "is lost", "are lost"):
        return Measured(None, None, lost[0], metric)
    if area and _crosses(points):
        why = "the polygon crosses itself: name its anchors in the order in which they lie around it"
        return Measured(None, None, why, metric)
    slipped = named(confidence < SURE_OF_ANCHOR, "may be on other tissue", "may be on other tissue")
    unsure = [
        *slipped,
        *named(visibility < 1, "is not wholly in sight", "are not wholly in sight"),
        *named(~(depth_confidence >= SURE), "has a depth that is a guess", "have depths that are guesses"),
    ]

    def value_of(places: F64) -> float:
        return (area_of if area else length_of)(places[order])

    error = _error(value_of, points, error_of(depth_confidence).astype(np.float64), camera)
    known = not slipped and math.isfinite(error)
    return Measured(value_of(points), error if known else None, "; ".join(unsure) or None, metric)


def length_of(points: F64) -> float:
    """The length of the path along points [N, 3]."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def area_of(points: F64) -> float:
    """The area of the polygon with the corners [N, 3]; see `measure`."""
    arms = points - points[0]
    return 0.5 * float(np.linalg.norm(np.cross(arms[:-1], arms[1:]).sum(0)))


def _error(of: Callable[[F64], float], points: F64, depth_errors: F64, camera: Camera) -> float:
    """The error of the value `of(points)`, for points [N, 3] whose depths have these errors [N] (m)."""
    T_world_cam = camera.T_world_cam
    depths = transform(invert(T_world_cam), points)[:, 2]
    along = (points - T_world_cam[:3, 3]) * (depth_errors / depths)[:, None]
    beside = SIDEWAYS * camera.width / camera.K[0, 0] * depths
    value = of(points)

    def change(moves: F64) -> float:
        return max(abs(of(points + moves) - value), abs(of(points - moves) - value))

    def each(moves: F64) -> float:
        """The changes by moving one anchor at a time, added in quadrature."""
        return math.hypot(*(change(one) for one in np.eye(len(points))[:, :, None] * moves))

    sideways = math.hypot(*(each(beside[:, None] * T_world_cam[:3, axis]) for axis in (0, 1)))
    return math.hypot(max(each(along), change(along)), sideways)


def _crosses(points: F64) -> bool:
    """Tell whether two sides of a polygon [N, 3] cross, seen along the normal of its mean plane."""
    normal = np.linalg.svd(points - points.mean(0))[2][-1]
    count = len(points)

    def side(a: int, b: int, c: int) -> float:
        arms = points[[b, c]] - points[a]
        return float(np.sign(normal @ np.cross(arms[0], arms[1])))

    sides = [(i, (i + 1) % count) for i in range(count)]
    return any(
        side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0
        for number, (a, b) in enumerate(sides)
        for c, d in sides[number + 1 :]
    )
