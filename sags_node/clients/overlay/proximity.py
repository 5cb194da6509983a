"""How near instruments come to forbidden zones and to tissue. It warns of some; it makes nothing safe.

Tips, and how far the tissue is, come from the node's topic `instruments`. The zones are known here only: they
are objects of the scene with a `margin`, where their anchors hold them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from sags_node.clients.overlay.draw import Body, Placed
from sags_node.clients.overlay.frame import TissueFrame
from sags_node.clients.overlay.mesh import rod
from sags_node.clients.overlay.scene import ALARM, ObjectSpec, SceneSpec
from sags_node.clients.registration.surfaces import Shape
from sags_node.confidence import SURE, confidence_of, error_of
from sags_node.geometry import invert, rigid, transform
from sags_node.messaging.received import ReceivedCloud, TopicName
from sags_node.types import F32, F64

INSTRUMENTS = TopicName("instruments", ReceivedCloud)
FIELDS = (
    *("x", "y", "z", "id", "zone", "distance", "margin", "closing", "contact", "confidence"),
    *("near_x", "near_y", "near_z"),
)
NEEDED = {
    "id", "x", "y", "z", "confidence", "clearance", "clearance_confidence", "near_x", "near_y", "near_z",
}  # fmt: skip
MOST = 32  # instruments; a node tells of 8
TISSUE = 0  # in the column zone; others are numbers of objects in the scene file, from 1
LINE = (255, 255, 255)  # RGB, of a distance that is larger than the margin
UNKNOWN = -1  # in the column zone: the tip's place is not known
MAX_AGE = 0.5  # s; older results are not told any more
HELD = 0.2  # s for which the last result is drawn: two periods of the node's topic
RECENT = 0.5  # s of distances from which the speed is estimated
FEWEST = 3  # distances that a speed needs
SLOWEST = 0.002  # m/s: tips are off by 1 mm, so half a second tells no slower approach
SHORTEST = 1e-4  # m, of a line
NOWHERE = np.full(3, np.nan)
UNSURE = 0.98 * SURE  # the most confidence of a distance to a zone whose own place is not sure


@dataclass(frozen=True, slots=True)
class Near:
    """A tip, and the nearest place of a zone or of the tissue."""

    instrument: int
    zone: int  # `TISSUE`, or the object's number
    name: str
    tip: F64  # [3] m, world
    place: F64  # [3] m, world; NaN: not told
    distance: float  # m; 0: it touches, or is inside
    margin: float  # m
    confidence: float  # 0..1, of the distance
    closing: float = np.nan  # m/s; NaN: not known yet
    contact: float = np.nan  # s until the distance is 0 at that speed; NaN: it does not come nearer

    @property
    def is_too_near(self) -> bool:
        return self.distance < self.margin

    @property
    def is_sure(self) -> bool:
        return self.confidence >= SURE

    def status(self) -> dict[str, Any]:
        """Return it for people and programs."""
        error = float(error_of(np.array(self.confidence, np.float32)))  # nine of ten are meant to be smaller
        told = {"distance_mm": 1e3 * self.distance, "margin_mm": 1e3 * self.margin}
        told |= {"error_mm": 1e3 * error, "closing_mm_s": 1e3 * self.closing, "contact_s": self.contact}
        figures = {name: round(value, 2) if np.isfinite(value) else None for name, value in told.items()}
        return {"instrument": self.instrument, "zone": self.name, **figures, "sure": self.is_sure}


class _Zone:
    """An object that no tip is to come near to."""

    def __init__(self, number: int, spec: ObjectSpec, margin: float, body: Body) -> None:
        self.number, self.name, self.margin = number, spec.name, margin
        stated = spec.registration and spec.registration.residual_p90_mm
        self.error = 1e-3 * (stated or 0.0)  # m
        self._vertices, self._triangles = body.vertices, body.triangles
        self._shape = Shape(self._vertices, self._triangles)
        self._shape.nearest(np.zeros((1, 3)))  # builds its tree now, not while frames wait

    def nearest(self, put: Placed, tips: F64) -> F64:
        """Return its nearest places [T, 3] to tips [T, 3] (m, world): for a tip inside, the tip itself."""
        vertices = put.body.vertices if put.vertices is None else put.vertices
        if vertices is not self._vertices:  # it is bent
            self._vertices, self._shape = vertices, Shape(vertices, self._triangles)
        local = np.asarray(transform(invert(put.T_world_body), tips))
        places = np.where(self._shape.contains(local)[:, None], local, self._shape.nearest(local)[0])
        return np.asarray(transform(put.T_world_body, places))


class Proximity:
    """Watches the tips of one scene."""

    def __init__(self, scene: SceneSpec, bodies: Sequence[Body]) -> None:
        self._tissue_margin = scene.tissue_margin
        self._zones = [
            _Zone(number, spec, spec.margin, body)
            for number, (spec, body) in enumerate(zip(scene.objects, bodies, strict=True), 1)
            if spec.margin is not None
        ]
        self._source: tuple[str, int] | None = None  # session and epoch of the node
        self._stamp_ns: int | None = None  # of the tips that were looked at last
        self._past: dict[tuple[int, int], list[tuple[float, float]]] = {}  # times (s) and distances (m)
        self._found: list[Near] = []
        self._unknown: list[Near] = []  # tips, and zones without a place
        self.reason: str | None = "no instruments came yet"  # why nothing is told; None: it is

    def look(self, said: ReceivedCloud, frame: TissueFrame, placed: Sequence[Placed | None]) -> F32 | None:
        """Return the rows [N, FIELDS] of the topic `proximity`, once per message of instruments, else None.

        Args:
            placed: every object of the scene, at the time of the frame or some ms off.
        """
        source = frame.session, frame.epoch
        if source != self._source:
            self._source, self._stamp_ns = source, None
            self._past, self._found, self._unknown = {}, [], []
        if (said.meta.session, said.meta.epoch) != source or said.stamp_ns == self._stamp_ns:
            return None
        self.reason = _unusable(said)
        if self.reason is not None:
            return None
        rows = said.points[:MOST]
        self._stamp_ns = said.stamp_ns
        known = rows[np.isfinite(said.xyz()[:MOST]).all(1)]
        lost = sorted(set(rows["id"].tolist()) - set(known["id"].tolist()))
        unplaced = [zone for zone in self._zones if placed[zone.number - 1] is None]
        self._unknown = [Near(each, UNKNOWN, "", NOWHERE, NOWHERE, np.nan, np.nan, 0.0) for each in lost]
        self._unknown += [
            Near(0, zone.number, zone.name, NOWHERE, NOWHERE, np.nan, zone.margin, 0.0) for zone in unplaced
        ]
        now = 1e-9 * said.stamp_ns
        self._past = {
            key: kept
            for key, past in self._past.items()
            if (kept := [each for each in past if 0 < now - each[0] <= RECENT])
        }
        found = [*self._to_tissue(known), *self._to_zones(known, placed)] if len(known) else []
        self._found = [self._approach(near, now) for near in found]
        return _rows([*(near for near in self._found if near.is_too_near), *self._unknown])

    def status(self, now_ns: int) -> dict[str, Any]:
        """Return which tips are too near to what, and which tips and zones are not known."""
        is_old = self._stamp_ns is None or now_ns - self._stamp_ns > 1e9 * MAX_AGE
        reason = self.reason or ("none came lately" if is_old else None)
        near, unknown = ([], []) if reason else (self._found, self._unknown)
        return {
            "reason": reason,
            "near": [each.status() for each in near if each.is_too_near],
            "unknown_tips": [each.instrument for each in unknown if each.zone == UNKNOWN],
            "unplaced_zones": [each.name for each in unknown if each.zone != UNKNOWN],
        }

    def shown(self, frame: TissueFrame, placed: Sequence[Placed | None]) -> list[Placed]:
        """Return what is to be drawn: the objects, zones in `ALARM` where a tip is too near, and distances
        to the tissue."""
        drawn = dict(enumerate(placed, 1))
        fresh = self._stamp_ns is not None and abs(frame.stamp_ns - self._stamp_ns) <= 1e9 * HELD
        lines: list[Placed] = []
        for near in self._found if fresh and self.reason is None else ():
            put = None if near.zone == TISSUE else placed[near.zone - 1]
            if near.zone == TISSUE:
                lines += _line(near)
            elif put is not None and near.is_too_near:
                text = f"{near.name} {1e3 * near.distance:.0f} mm"
                is_sure = put.is_sure and near.is_sure
                drawn[near.zone] = Placed(
                    put.body.painted(ALARM, text), put.T_world_body, is_sure, put.vertices
                )
        return [each for each in drawn.values() if each is not None] + lines

    def _to_tissue(self, known: Any) -> list[Near]:
        if self._tissue_margin is None:
            return []
        return [
            Near(
                int(row["id"]), TISSUE, "tissue", _place(row, ""), _place(row, "near_"),
                float(row["clearance"]), self._tissue_margin, float(row["clearance_confidence"]),
            )
            for row in known
            if np.isfinite(row["clearance"])
        ]  # fmt: skip

    def _to_zones(self, known: Any, placed: Sequence[Placed | None]) -> list[Near]:
        tips, found = np.stack([_place(row, "") for row in known]), []
        for zone in self._zones:
            put = placed[zone.number - 1]
            if put is None:
                continue
            own = np.hypot(error_of(np.array(put.depth_confidence, np.float32)), zone.error)
            errors = np.hypot(error_of(known["confidence"]), own)
            sure = np.minimum(confidence_of(errors), 1.0 if put.is_sure else UNSURE).tolist()
            for row, tip, place, each in zip(known, tips, zone.nearest(put, tips), sure, strict=True):
                off = float(np.linalg.norm(tip - place))
                found.append(Near(int(row["id"]), zone.number, zone.name, tip, place, off, zone.margin, each))
        return sorted(found, key=lambda near: -near.distance)  # the nearest tip is the one that is shown

    def _approach(self, near: Near, now: float) -> Near:
        """The distance with its speed: the median slope between any two recent distances (Theil-Sen), since
        a tip may be wrong in one frame."""
        past = self._past.setdefault((near.instrument, near.zone), [])
        past.append((now, near.distance))
        if len(past) < FEWEST:
            return near
        closing = float(np.median([(d1 - d2) / (t2 - t1) for (t1, d1), (t2, d2) in combinations(past, 2)]))
        contact = near.distance / closing if closing > SLOWEST else np.nan
        return replace(near, closing=closing, contact=contact)


def _unusable(said: ReceivedCloud) -> str | None:
    """Why a message of instruments cannot be used; None: it can."""
    if not said.metric:
        return "nobody has calibrated the eyes: lengths have no unit"
    if not set(said.points.dtype.names or ()) >= NEEDED:
        return "the node is older: its instruments do not tell the nearest tissue"
    return None


def _place(row: Any, name: str) -> F64:
    return np.array([row[f"{name}{axis}"] for axis in "xyz"], np.float64)


def _rows(found: Sequence[Near]) -> F32:
    rows = np.empty((len(found), len(FIELDS)), np.float32)
    for row, near in zip(rows, found, strict=True):
        row[:3], row[4:9], row[10:] = (
            near.tip, (near.zone, near.distance, near.margin, near.closing, near.contact), near.place
        )  # fmt: skip
        row[9] = near.confidence
        row[3:4].view(np.uint32)[0] = near.instrument
    return rows


def _line(near: Near) -> list[Placed]:
    """A line from the tip to the tissue, labelled with its length."""
    if not np.isfinite(near.place).all():
        return []
    color = ALARM if near.is_too_near else LINE
    at_place = rigid(np.eye(3), near.place)
    drawn = [Placed(Body(None, 1.0, f"{1e3 * near.distance:.0f} mm"), at_place, near.is_sure)]
    if near.distance > SHORTEST:
        drawn.append(Placed(Body(rod(near.tip, near.place, color), 1.0, None), np.eye(4), near.is_sure))
    return drawn
