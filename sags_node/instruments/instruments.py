"""The instruments as they are published to consumers: looked for in some frames a second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from sags_node.confidence import confidence_of, error_of
from sags_node.geometry import invert, project, transform, unproject
from sags_node.instruments.depths import Disparities, Eyes, disparities, eyes
from sags_node.instruments.kinematics import NINE_OF_TEN, Arm, seen_as
from sags_node.instruments.outlines import Outline, outlines
from sags_node.types import F32, F64, I64, U8, Bool, Camera, InstrumentStates, RenderedView, ToolPose

PERIOD_NS = 100_000_000  # no hand and no reader of a distance is quicker; each look takes time from mapping
NEAREST, FARTHEST = 0.02, 0.2  # m, depths at which an instrument may be
HALF = 0.75  # of the spread of its end: the error of the tip of open jaws or of a hook
ENTANGLED = 1.5  # factor on the error where another instrument lies over it
AXIS_ERROR = np.radians(25.0)  # rad: an axis is given if nine of ten are expected to be off by less
AXIS_BIAS = np.radians(8.0)  # rad: nine of ten graspers of the phantom are off by less: jaws are not in line
AHEAD, STEP = 0.15, 5e-4  # m, along the axis: how far tissue is looked for, and how finely
EVERY = 4  # px between the pixels of the tissue among which the nearest is sought
KEPT = 0.5  # s for which the number of an instrument that is not found is kept
SAME = 0.2  # of the image's width: an instrument that is farther from where it was is another
BY_PICTURE, BY_ROBOT, CORRECTED = 1, 2, 3  # what tells of an instrument


@dataclass(frozen=True, slots=True)
class _One:
    """One row of `InstrumentStates` without its number; NaN: not known."""

    end: F64  # [2] px, where the mask ends
    tip: F64 = field(default_factory=lambda: np.full(3, np.nan))
    axis: F64 = field(default_factory=lambda: np.full(3, np.nan))
    others: tuple[F64, ...] = ()  # axes at the limits of its error
    pixel: F64 = field(default_factory=lambda: np.full(2, np.nan))
    error: float = np.inf  # m, of the tip
    distance: float = np.nan
    distance_error: float = np.inf
    clearance: float = np.nan
    clearance_error: float = np.inf
    nearest: F64 = field(default_factory=lambda: np.full(3, np.nan))  # m, of the tissue
    source: int = BY_PICTURE
    tilt: float = AXIS_BIAS  # rad, error of its axis; nine of ten are below


class _Tissue(NamedTuple):
    """The model as the left eye sees it, prepared once for all instruments of a frame."""

    camera: Camera
    depth: F32  # [H, W] m, 0: none
    confidence: F32 | None
    at: I64  # [N, 2] row and column of some of its pixels
    places: F32  # [N, 3] m, world, of these

    @classmethod
    def of(cls, view: RenderedView) -> _Tissue:
        at = EVERY * np.argwhere(view.depth[::EVERY, ::EVERY])
        places = unproject(view.camera, at[:, ::-1].astype(np.float32), view.depth[at[:, 0], at[:, 1]])
        return cls(view.camera, view.depth, view.confidence, at, np.asarray(places, np.float32))

    def error(self, row: int, column: int) -> float:
        """Return the error of its depth at a pixel, m."""
        return 0.0 if self.confidence is None else float(error_of(self.confidence[row, column]))


class Instruments:
    """The instruments of one node. No number is given to a second instrument.

    Args:
        usable: as in `TissueMask`.
    """

    def __init__(self, usable: Bool) -> None:
        self._usable = usable
        self._known: dict[int, tuple[F64, int]] = {}  # number -> px, and when it was there
        self._arms: dict[str, Arm] = {}  # by the robot's name for them
        self._next = 1
        self._due_ns = 0

    def update(
        self, tools: Bool | None, left: U8, right: U8 | None, camera: Camera, baseline: float,
        tissue: RenderedView, row_error: float = 0.0, robot: Sequence[ToolPose] = (),
    ) -> InstrumentStates | None:  # fmt: skip
        """Return the instruments of one frame; None: the last look was less than `PERIOD_NS` ago, on average.

        Args:
            tools: [H, W] True: the pixel shows an instrument; None: nobody looks for any.
            left, right: gray images [H, W]; right is None where it must not be used.
            tissue: the model as the left eye sees it.
            row_error: by how much the right image is too low, px.
            robot: where it says that its tools are.
        """
        if not self._is_due(tissue.t_capture_ns):
            return None
        shown = [] if tools is None else outlines(tools, self._usable)
        both = None
        if shown and tools is not None and right is not None:
            both = eyes(left, right, tools, row_error)
        found = [_placed(outline, both, camera, baseline) for outline in shown]
        arms = self._moved(robot, tissue.t_capture_ns)
        numbers = dict[int, int]()  # by row of `found`, where the robot tells which instrument it is
        seen = seen_as(arms, shown, camera)
        for place, arm in enumerate(arms):
            row = seen.get(place)
            if row is not None and np.isfinite(found[row].tip[0]):
                tip = np.asarray(transform(invert(camera.T_world_cam), found[row].tip), np.float64)
                arm.learn(tip, found[row].error)
            one = _told(arm, camera, None if row is None else found[row].end)
            if row is None:
                row = len(found)
                found.append(self._doubted(one, arm, tissue) if tools is not None else one)
            else:
                found[row] = one
            numbers[row] = arm.number
        if any(np.isfinite(one.tip[0]) for one in found):
            surface = _Tissue.of(tissue)
            found = [one if np.isnan(one.tip[0]) else _beside_tissue(one, surface) for one in found]
        return _states(self._numbers([one.end for one in found], numbers, tissue.t_capture_ns), found)

    def _is_due(self, now_ns: int) -> bool:
        """Tell whether to look now. Keeps the mean rate if the period is not a whole number of frames."""
        late = now_ns - self._due_ns
        if -PERIOD_NS <= late < 0:  # earlier still: the clock was set back
            return False
        self._due_ns = now_ns + PERIOD_NS - (late if 0 <= late < PERIOD_NS else 0)
        return True

    def _moved(self, robot: Sequence[ToolPose], now_ns: int) -> list[Arm]:
        """The arms whose poses the robot tells now, moved there."""
        arms = []
        for tool in robot:
            if tool.T_cam_tool is None:
                continue
            if tool.name not in self._arms:
                self._arms[tool.name] = Arm(self._next, tool.error)
                self._next += 1
            self._arms[tool.name].move(tool.T_cam_tool, now_ns)
            arms.append(self._arms[tool.name])
        return arms

    def _doubted(self, one: _One, arm: Arm, tissue: RenderedView) -> _One:
        """An instrument that only the robot tells of. Where it should be in sight, but no mask shows it, its
        error is at least the robot's: the correction is not believed."""
        if not _is_inside(one.pixel, tissue.camera):
            return one
        u, v = np.rint(one.pixel).astype(int)
        hidden = 0 < tissue.depth[v, u] < project(tissue.camera, one.tip)[1]
        seen = self._usable[v, u] and not hidden
        return replace(one, error=max(one.error, arm.error)) if seen else one

    def _numbers(self, ends: list[F64], given: dict[int, int], now_ns: int) -> list[int]:
        """The number of each instrument: the given one, else that of the nearest before, else a new one."""
        gate = SAME * self._usable.shape[1]
        self._known = {k: v for k, v in self._known.items() if 0 <= now_ns - v[1] < 1e9 * KEPT}
        pairs = sorted(
            (float(np.hypot(*(end - at))), row, number)
            for row, end in enumerate(ends)
            for number, (at, _) in self._known.items()
        )
        numbers = dict(given)
        for apart, row, number in pairs:
            if apart <= gate and row not in numbers and number not in numbers.values():
                numbers[row] = number
        for row in range(len(ends)):
            if row not in numbers:
                numbers[row], self._next = self._next, self._next + 1
        self._known |= {numbers[r]: (end, now_ns) for r, end in enumerate(ends) if np.isfinite(end[0])}
        return [numbers[row] for row in range(len(ends))]


def _placed(outline: Outline, both: Eyes | None, camera: Camera, baseline: float) -> _One:
    """Find where an instrument is, as far as the eyes tell."""
    one = _One(outline.far)
    scale = float(camera.K[0, 0]) * baseline
    if both is None or outline.is_outside:
        return one
    found = disparities(both, outline, (scale / FARTHEST, scale / NEAREST))
    if found is None or not np.all(scale / FARTHEST < found.tip_and_back):
        return one
    ends = np.stack([outline.far, outline.back])
    tip, axis = _tip_and_axis(camera, ends, scale / found.tip_and_back)
    z = scale / found.tip_and_back[0]
    by_depth = NINE_OF_TEN * np.sqrt(found.covariance[0, 0]) * z * z / scale
    by_end = HALF * outline.spread * z / float(camera.K[0, 0])
    others = _others(camera, ends, scale, found)
    if min((other @ axis for other in others), default=-1.0) < np.cos(AXIS_ERROR):
        axis = np.full(3, np.nan)
    error = (1.0 if outline.is_alone else ENTANGLED) * float(np.hypot(by_depth, by_end))
    return replace(one, tip=tip, axis=axis, others=others, pixel=outline.far, error=error)


def _told(arm: Arm, camera: Camera, end: F64 | None) -> _One:
    """An instrument where the robot says it is, with the learnt correction; `end` [2] px of its mask."""
    tip = np.asarray(transform(camera.T_world_cam, arm.tip), np.float64)
    axis, tilt = camera.T_world_cam[:3, :3] @ arm.axis, arm.axis_error
    pixel = np.asarray(project(camera, tip)[0], np.float64)
    return _One(
        pixel if end is None else end, tip, axis if tilt < AXIS_ERROR else np.full(3, np.nan), (), pixel,
        arm.tip_error, source=CORRECTED if arm.is_corrected else BY_ROBOT, tilt=tilt,
    )  # fmt: skip


def _is_inside(pixel: F64, camera: Camera) -> bool:
    return bool(np.all((np.rint(pixel) >= 0) & (np.rint(pixel) < [camera.width, camera.height])))


def _tip_and_axis(camera: Camera, ends: F64, depths: F64) -> tuple[F64, F64]:
    """The tip [3] and the unit vector [3] out of it, from pixels [2, 2] and depths [2] of tip and back."""
    tip, back = np.asarray(unproject(camera, ends, depths), np.float64)
    return tip, (tip - back) / np.linalg.norm(tip - back)


def _others(camera: Camera, ends: F64, scale: float, found: Disparities) -> tuple[F64, ...]:
    """The axes at the limits of error of both disparities; empty: the axis may be any."""
    spreads, directions = np.linalg.eigh(found.covariance)
    steps = NINE_OF_TEN * np.sqrt(spreads) * directions
    others = [found.tip_and_back + sign * step for step in steps.T for sign in (-1, 1)]
    if min(other.min() for other in others) <= 0:
        return ()
    return tuple(_tip_and_axis(camera, ends, scale / other)[1] for other in others)


def _beside_tissue(one: _One, tissue: _Tissue) -> _One:
    """The instrument with its distances from the tissue and their errors."""
    beyond = one.source != BY_PICTURE and not _is_inside(one.pixel, tissue.camera)
    if len(tissue.at) == 0 or beyond:  # tissue there is not seen
        return one
    apart = np.linalg.norm(tissue.places - one.tip.astype(np.float32), axis=1)
    nearest = int(apart.argmin())
    u, v = np.clip(np.rint(one.pixel), 0, [tissue.camera.width - 1, tissue.camera.height - 1]).astype(int)
    if tissue.depth[v, u] > 0:  # a tip behind the tissue would be hidden: its depth is wrong
        behind = max(0.0, float(project(tissue.camera, one.tip)[1]) - float(tissue.depth[v, u]))
        one = replace(one, error=float(np.hypot(one.error, behind)))
    error = float(np.hypot(one.error, tissue.error(*tissue.at[nearest])))
    one = replace(one, clearance=float(apart[nearest]), clearance_error=error, nearest=tissue.places[nearest])
    if np.isnan(one.axis[0]):
        return one
    met, place = _met(one.tip, np.stack([one.axis, *one.others, *_tilted(one.axis, one.tilt)]), tissue)
    if np.isinf(met[0]):
        return one
    error = float(np.linalg.norm([one.error, tissue.error(*place), np.abs(met[1:] - met[0]).max()]))
    return replace(one, distance=float(met[0]), distance_error=error)


def _tilted(axis: F64, tilt: float) -> list[F64]:
    """An axis tilted by an angle (rad) to each of four sides."""
    sides = np.linalg.svd(axis[None])[2][1:]
    turned = [axis + sign * np.tan(tilt) * side for side in sides for sign in (-1, 1)]
    return [each / np.linalg.norm(each) for each in turned]


def _met(tip: F64, axes: F64, tissue: _Tissue) -> tuple[F64, I64]:
    """The distances along axes [A, 3] to the tissue ([A] m; inf: the axis meets none), and the row and column
    where the first axis meets it."""
    along = np.arange(0, AHEAD, STEP)
    pixels, depths = project(tissue.camera, tip + along[:, None] * axes[:, None])
    at = np.rint(np.nan_to_num(pixels, nan=-1.0))[..., ::-1].astype(np.intp)
    inside = np.all((at >= 0) & (at < tissue.depth.shape), axis=-1)
    at[~inside] = 0
    surface = np.where(inside, tissue.depth[at[..., 0], at[..., 1]], 0)
    behind = (surface > 0) & (depths >= surface)
    first = behind.argmax(1)
    return np.where(behind.any(1), along[first], np.inf), at[0, first[0]]


def _states(numbers: list[int], found: list[_One]) -> InstrumentStates:
    def column(values: list[F64] | list[float], *shape: int) -> F32:
        return np.array(values, np.float32).reshape(-1, *shape)

    return InstrumentStates(
        ids=np.array(numbers, np.int64),
        tips=column([one.tip for one in found], 3),
        axes=column([one.axis for one in found], 3),
        pixels=column([one.pixel for one in found], 2),
        confidence=confidence_of(column([one.error for one in found])),
        distance=column([one.distance for one in found]),
        distance_confidence=confidence_of(column([one.distance_error for one in found])),
        clearance=column([one.clearance for one in found]),
        clearance_confidence=confidence_of(column([one.clearance_error for one in found])),
        nearest=column([one.nearest for one in found], 3),
        sources=np.array([one.source for one in found], np.int64),
    )
