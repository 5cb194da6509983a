"""Points of a model that were written in other axes or another unit than its file."""

from __future__ import annotations

from itertools import product

import numpy as np

from sags_node.clients.registration.surfaces import Shape
from sags_node.types import F64

UNITS = {1000: "mm for m", 100: "cm for m", 10: "mm for cm", 25.4: "mm for inch"}
ON = 0.003  # m: so near to a surface a point is picked on it
# Times nearer than they were, and than they lie apart: neither chance nor a scale that draws all of them
# together brings them there.
CLEARLY, APART = 3.0, 10.0
LPS = "-x, -y, z"

_TURNED = {
    ", ".join(("-" if sign < 0 else "") + axis for sign, axis in zip(signs, "xyz", strict=True)): signs
    for signs in product((1.0, -1.0), repeat=3)
}
_SCALED = {
    f"x, y, z times {times:.3g}": (times, times, times) for unit in UNITS for times in (unit, 1 / unit)
}


def farthest(model: Shape, at: F64) -> float:
    """How far the farthest of points [k, 3] (m) lies from a model's surface, m."""
    return float(np.linalg.norm(model.nearest(at)[0] - at, axis=1).max())


def misread(model: Shape, at: F64) -> str | None:
    """Say how points [k, 3] (m) that lie aside of a model's surface would all lie on it; None: they do lie on
    it, or they may be meant so, as those inside of a model or on an organ around it."""
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
