"""Which instruments there are in each frame, as consumers are told of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sags_node.confidence import confidence_of, error_of
from sags_node.geometry import project, unproject
from sags_node.instruments.depths import Disparities, Eyes, disparities, eyes
from sags_node.instruments.outlines import Outline, outlines
from sags_node.types import F32, F64, U8, Bool, Camera, InstrumentStates, RenderedView

NEAREST, FARTHEST = 0.02, 0.2  # m, that an instrument may be away
NINE_OF_TEN = 1.645  # standard deviations
HALF = 0.75  # of the spread of its end, by which the tip of open jaws or of a hook is uncertain
ENTANGLED = 1.5  # times the error, where another one lies over it
AXIS_ERROR = np.radians(25.0)  # nine of ten are smaller, or there is no axis
AXIS_BIAS = np.radians(8.0)  # nine of ten of the phantom's graspers are below: jaws are not in line
AHEAD, STEP = 0.15, 5e-4  # m, along the axis: how far tissue is looked for, and how finely
EVERY = 4  # px, of the surface of which the nearest point is sought
KEPT = 0.5  # s, that a number is kept for an instrument that is not found
SAME = 0.2  # of the picture's width: farther from where it was it is another


@dataclass(frozen=True, slots=True)
class _One:
    """One row of `InstrumentStates`, but for its number; NaN where it is not known."""

    end: F64  # [2] px, where the mask ends
    tip: F64 = field(default_factory=lambda: np.full(3, np.nan))
    axis: F64 = field(default_factory=lambda: np.full(3, np.nan))
    others: tuple[F64, ...] = ()  # axes that may be as well
    pixel: F64 = field(default_factory=lambda: np.full(2, np.nan))
    error: float = np.inf  # m, of the tip
    distance: float = np.nan
    distance_error: float = np.inf
    clearance: float = np.nan
    clearance_error: float = np.inf


class Instruments:
    """All instruments of one node; their numbers are never used again.

    Args:
        usable: as of `TissueMask`.
    """

    def __init__(self, usable: Bool) -> None:
        self._usable = usable
        self._known: dict[int, tuple[F64, int]] = {}  # number -> px, and when it was there
        self._next = 1

    def update(
        self, tools: Bool | None, left: U8, right: U8 | None, camera: Camera, baseline: float,
        tissue: RenderedView, row_error: float = 0.0,
    ) -> InstrumentStates:  # fmt: skip
        """Those of one frame.

        Args:
            tools: [H, W] what shows an instrument; None: nobody looks for any.
            left, right: gray pictures [H, W]; no right one: it must not be used.
            tissue: the model as the left eye sees it.
            row_error: by how much the right picture is too low, px.
        """
        found = []
        if tools is not None:
            both = None if right is None else eyes(left, right, tools, row_error)
            for outline in outlines(tools, self._usable):
                one = _placed(outline, both, camera, baseline)
                found.append(one if np.isnan(one.tip[0]) else _beside_tissue(one, tissue))
        return _states(self._numbers([one.end for one in found], tissue.t_capture_ns), found)

    def _numbers(self, ends: list[F64], now_ns: int) -> list[int]:
        """Each keeps the number of the one that was the nearest before."""
        gate = SAME * self._usable.shape[1]
        self._known = {k: v for k, v in self._known.items() if 0 <= now_ns - v[1] < 1e9 * KEPT}
        pairs = sorted(
            (float(np.hypot(*(end - at))), row, number)
            for row, end in enumerate(ends)
            for number, (at, _) in self._known.items()
        )
        numbers: dict[int, int] = {}
        for apart, row, number in pairs:
            if apart <= gate and row not in numbers and number not in numbers.values():
                numbers[row] = number
        for row in range(len(ends)):
            if row not in numbers:
                numbers[row], self._next = self._next, self._next + 1
        self._known |= {numbers[row]: (end, now_ns) for row, end in enumerate(ends)}
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


def _tip_and_axis(camera: Camera, ends: F64, depths: F64) -> tuple[F64, F64]:
    """The tip [3] and the unit vector [3] that points out of it, of two pixels [2, 2] at depths [2]."""
    tip, back = np.asarray(unproject(camera, ends, depths), np.float64)
    return tip, (tip - back) / np.linalg.norm(tip - back)


def _others(camera: Camera, ends: F64, scale: float, found: Disparities) -> tuple[F64, ...]:
    """The axes at the edge of what both disparities may be; none: they may be anything."""
    spreads, directions = np.linalg.eigh(found.covariance)
    steps = NINE_OF_TEN * np.sqrt(spreads) * directions
    others = [found.tip_and_back + sign * step for step in steps.T for sign in (-1, 1)]
    if min(other.min() for other in others) <= 0:
        return ()
    return tuple(_tip_and_axis(camera, ends, scale / other)[1] for other in others)


def _beside_tissue(one: _One, tissue: RenderedView) -> _One:
    """How far the tissue is from a tip, and how sure that is."""
    camera, sure = tissue.camera, tissue.confidence
    errors = np.zeros_like(tissue.depth) if sure is None else error_of(sure)
    rows, columns = np.nonzero(tissue.depth[::EVERY, ::EVERY])
    rows, columns = EVERY * rows, EVERY * columns
    if len(rows) == 0:
        return one
    pixels = np.stack([columns, rows], -1).astype(np.float32)
    surface = unproject(camera, pixels, tissue.depth[rows, columns])
    apart = np.linalg.norm(surface - one.tip.astype(np.float32), axis=1)
    nearest = int(apart.argmin())
    u, v = np.clip(np.rint(one.pixel), 0, [camera.width - 1, camera.height - 1]).astype(int)
    if tissue.depth[v, u] > 0:  # what lies behind the tissue is hidden by it, or is not there
        behind = max(0.0, float(project(camera, one.tip)[1]) - float(tissue.depth[v, u]))
        one = replace(one, error=float(np.hypot(one.error, behind)))
    error = float(np.hypot(one.error, errors[rows[nearest], columns[nearest]]))
    one = replace(one, clearance=float(apart[nearest]), clearance_error=error)
    if np.isnan(one.axis[0]):
        return one
    met = _met(one.tip, one.axis, camera, tissue.depth)
    if met is None:
        return one
    distance, place = met
    apart_by_axis = 0.0
    for other in (*one.others, *_tilted(one.axis)):
        met = _met(one.tip, other, camera, tissue.depth)
        apart_by_axis = max(apart_by_axis, np.inf if met is None else abs(met[0] - distance))
    error = float(np.linalg.norm([one.error, errors[place], apart_by_axis]))
    return replace(one, distance=distance, distance_error=error)


def _tilted(axis: F64) -> list[F64]:
    """An axis turned by `AXIS_BIAS` to four sides."""
    sides = np.linalg.svd(axis[None])[2][1:]
    turned = [axis + sign * np.tan(AXIS_BIAS) * side for side in sides for sign in (-1, 1)]
    return [each / np.linalg.norm(each) for each in turned]


def _met(tip: F64, axis: F64, camera: Camera, depth: F32) -> tuple[float, tuple[int, int]] | None:
    """How far along an axis the tissue [H, W] is (m), and in which row and column; None: it meets none."""
    along = np.arange(0, AHEAD, STEP)
    pixels, depths = project(camera, tip + along[:, None] * axis)
    columns, rows = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.intp).T
    inside = (columns >= 0) & (rows >= 0) & (columns < depth.shape[1]) & (rows < depth.shape[0])
    surface = np.where(inside, depth[np.where(inside, rows, 0), np.where(inside, columns, 0)], 0)
    behind = np.nonzero((surface > 0) & (depths >= surface))[0]
    if len(behind) == 0:
        return None
    first = int(behind[0])
    return float(along[first]), (int(rows[first]), int(columns[first]))


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
    )
