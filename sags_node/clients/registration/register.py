"""A model placed by pairs of points and by its surface, with the errors to expect and a plain verdict."""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal

import numpy as np

from sags_node.clients.registration.rigid import kabsch, nine_of_ten, of_pairs, on_a_line, picking_error
from sags_node.clients.registration.surface_fit import fit_surface
from sags_node.clients.registration.surfaces import MIRROR, Shape, Surface
from sags_node.geometry import Array, invert, transform
from sags_node.types import F64, Bool

LEAST_PAIRS, MOST_PAIRS = 3, 20
OTHER_UNIT = 1.3  # times too large or too small: beyond it the unit is wrong, as no picking is so inexact
MATCHED = 0.003  # m; the measured surface that is nearer to the model belongs to it
NEAR = 0.010  # m; what is farther from the model is something else

# The limit (mm, or %) beyond which a registration is doubtful, the one beyond which it is refused, and why.
LIMITS = (
    (4.0, 10.0, "the pairs fit each other to {:.1f} mm only: pick the worst of them again"),
    # Five picked pairs hold it better than a surface on which it slides that far.
    (0.6, 1.0, "its shape is even (a plane, ball or tube), it slides by {:.1f} mm: show more, with an edge"),
    (40.0, 70.0, "{:.0f} % of the surface before it do not match: is the organ deformed or covered?"),
    (1.5, 4.0, "the surface is {:.1f} mm off: is the organ deformed, or another one?"),
    (5.0, 15.0, "errors up to {:.1f} mm are expected: add pairs, farther apart"),
)
FREELY = 0.1  # m; a longer slide is given as this one: no organ slides farther
MIRRORED = (
    "it fits as its mirror image only, so the file has the other handedness: turn one of its axes round"
)
ASIDE = "a point `at` lies {:.3g} mm from the model: are these points of this file, in its unit and its axes?"
UNSEEN = "no surface was measured where the pairs put the model: check them, and that it is in sight"
UNITS = {1000: "mm for m", 100: "cm for m", 10: "mm for cm", 25.4: "mm for inch"}
ON = 0.003  # m; a point that is so near to a surface was picked on it
# In another reading, points must come so many times nearer to the surface than they were, and must be so many
# times nearer than they lie apart: neither chance nor a scale that shrinks them together does that.
CLEARLY, APART = 3.0, 10.0
LPS = "-x, -y, z"

_TURNED = {
    ", ".join(("-" if sign < 0 else "") + axis for sign, axis in zip(signs, "xyz", strict=True)): signs
    for signs in product((1.0, -1.0), repeat=3)
}
_SCALED = {
    f"x, y, z times {times:.3g}": (times, times, times) for unit in UNITS for times in (unit, 1 / unit)
}
Verdict = Literal["good", "doubtful", "refused"]


@dataclass(frozen=True, slots=True)
class Registration:
    """Where the model lies. Lengths in m; None: not known, as the registration was refused before."""

    verdict: Verdict
    reason: str = ""  # why it is not good, and the remedy; empty: it is good
    T_world_model: F64 | None = None  # [4, 4]
    fiducials: F64 | None = None  # [k] error of each pair after the fit to the pairs alone
    expected_by_pairs: F64 | None = None  # [t] bound of nine of ten errors at each target, by the pairs alone
    expected: F64 | None = None  # [t] the same after the surface fit
    moved: F64 | None = None  # [t] how far the surface fit moved each target
    residual: tuple[float, float] | None = None  # distance of surface and model: median, 90 % quantile
    share: float = 0.0  # part of the surface in line with the model that lies within `MATCHED` of it
    matched: Bool | None = None  # [N] which points of the surface these are

    def figures(self, targets: F64) -> dict[str, Any]:
        """Return it in mm for people and programs, without what is not known. `targets` [t, 3] are copied."""
        said: dict[str, Any] = {"verdict": self.verdict, "reason": self.reason or None}
        if self.fiducials is not None:
            said["fiducial_mm"] = _in_mm(_rms(self.fiducials))
            said["pairs_mm"] = [_in_mm(each) for each in self.fiducials]
        if self.residual is not None:
            told = [self.expected_by_pairs, self.expected, self.moved]
            rows: Any = zip(targets.tolist(), *told, strict=True)
            keys = "at", "expected_by_pairs_mm", "expected_mm", "moved_mm"
            said["targets"] = [dict(zip(keys, [at, *map(_in_mm, row)], strict=True)) for at, *row in rows]
            said["residual_median_mm"], said["residual_p90_mm"] = map(_in_mm, self.residual)
            said["share"] = round(self.share, 3)
        return said


def register(  # noqa: PLR0911, one return per reason
    model: Shape, at: F64, places: F64, surface: Surface, targets: F64
) -> Registration:
    """Place a model on the tissue.

    Args:
        at: [k, 3] points of the model (m), that lie at `places` [k, 3] (m, world).
        targets: [t, 3] points of the model (m) whose error is told.
    """
    if not LEAST_PAIRS <= len(at) <= MOST_PAIRS:
        return Registration("refused", f"{len(at)} pairs: give {LEAST_PAIRS} to {MOST_PAIRS}, far apart")
    if on_a_line(at) or on_a_line(places):
        return Registration("refused", "the points lie on a line, about which it could turn: add one aside")
    other = misread(model, at)
    if other is not None:
        return Registration("refused", other)
    apart, there = (float(np.linalg.norm(points - points.mean(0))) for points in (at, places))
    off = farthest(model, at)
    aside = ASIDE.format(1e3 * off) if off > NEAR * max(1.0, apart / there) else None
    if not 1 / OTHER_UNIT < apart / there < OTHER_UNIT:
        return Registration("refused", aside or _wrong_unit(apart / there))
    found = _placed(model, at, places, surface, targets)
    if found.verdict == "good":
        return found
    if _placed(model.mirrored(), at * MIRROR, places, surface, targets * MIRROR).verdict == "good":
        return replace(found, verdict="refused", reason=MIRRORED)
    return found if aside is None else replace(found, verdict="refused", reason=aside)


def _wrong_unit(factor: float) -> str:
    """The reason to refuse a model that is `factor` times as large as the tissue where it was picked."""
    times, verb = (factor, "divide") if factor > 1 else (1 / factor, "multiply")
    said = f"the model is {times:.3g} times too {'large' if factor > 1 else 'small'} for where its points lie"
    unit = min(UNITS, key=lambda each: abs(np.log(times / each)))
    if not 1 / OTHER_UNIT < times / unit < OTHER_UNIT:
        return f"{said}: the pairs do not belong together, or --scale is wrong"
    return f"{said}, as {UNITS[unit]}: {verb} --scale by {unit:g}"


def _placed(model: Shape, at: F64, places: F64, surface: Surface, targets: F64) -> Registration:
    T, centre = kabsch(at, places, np.full(len(at), 1 / len(at))), places.mean(0)
    residuals, before = places - transform(T, at), transform(T, targets)
    picked = picking_error(residuals)
    pairs = of_pairs(transform(T, at) - centre, picked)
    told = _expected(pairs, before - centre, np.zeros(3))
    found = Registration("good", "", T, np.linalg.norm(residuals, axis=1), told)
    fit = fit_surface(model, surface, at, places, picked, T)
    if fit is None:
        return replace(found, verdict="refused", reason=UNSEEN)
    T, counted = fit
    after, view = transform(T, targets), centre - surface.eye
    bias = float(np.median(counted.errors)) * view / np.linalg.norm(view)
    eye, local = transform(invert(T), surface.eye), transform(invert(T), surface.points)
    side = model.facing(eye)
    distances = np.linalg.norm(side.nearest(local)[0] - local, axis=1)
    in_line = side.hides(eye, local)
    near = distances[in_line & (distances < NEAR)]
    matched = in_line & (distances < MATCHED)
    if not matched.any():
        return replace(found, verdict="refused", reason=UNSEEN)
    found = replace(
        found,
        T_world_model=T,
        expected=_expected(pairs + counted.information(), after - centre, bias),
        moved=np.linalg.norm(after - before, axis=1),
        residual=(float(np.median(near)), float(np.quantile(near, 0.9))),
        share=float(matched.sum() / in_line.sum()),
        matched=matched,
    )
    return _judged(found, counted.slide())


def _expected(information: F64, arms: Array, bias: F64) -> F64:
    """The bounds (m) of nine of ten errors at targets [t, 3]; `bias` [3] (m) is common to all depths."""
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    return np.array([nine_of_ten(covariance, arm, bias) for arm in arms])


def _judged(found: Registration, slide: float) -> Registration:
    """The registration with the worst verdict that a limit gives; of equal ones, the first."""
    assert found.fiducials is not None and found.expected is not None and found.residual is not None
    slide = min(slide, FREELY)
    lengths = _rms(found.fiducials), slide, 0.1 * (1 - found.share), found.residual[0], found.expected.max()
    verdict: Verdict
    for number, verdict in ((1, "refused"), (0, "doubtful")):
        for value, (*limits, said) in zip(1e3 * np.array(lengths), LIMITS, strict=True):
            if value > limits[number]:
                return replace(found, verdict=verdict, reason=said.format(value))
    return found


def _rms(lengths: F64) -> float:
    return float(np.sqrt(np.mean(np.square(lengths))))


def _in_mm(metres: float) -> float:
    return round(1e3 * float(metres), 2)


# ---- points of a model that were written in other axes or another unit than its file ----------------------


def farthest(model: Shape, at: F64) -> float:
    """Return how far the farthest of points [k, 3] (m) lies from a model's surface, m."""
    return float(np.linalg.norm(model.nearest(at)[0] - at, axis=1).max())


def misread(model: Shape, at: F64) -> str | None:
    """Return the axes or unit in which points [k, 3] (m) off a model's surface would all lie on it. None:
    they lie on it, or no axes or unit bring them there: they may be meant to lie inside or around it."""
    off = farthest(model, at)
    if off <= ON:
        return None
    others = {said: at * factors for said, factors in (_TURNED | _SCALED).items()}
    left = {
        said: near
        for said, points in others.items()
        if (near := farthest(model, points)) <= min(ON, off / CLEARLY, np.ptp(points, axis=0).max() / APART)
    }
    if not left:
        return None
    said = min(left, key=lambda each: left[each])
    usual = " (one is RAS, the other LPS)" if said == LPS else ""
    far = f"`at` lies up to {1e3 * off:.3g} mm from the file's surface"
    return f"{far}, but on it as {said}{usual}: write each so"
