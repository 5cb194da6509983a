"""How far a registered object lies from the surface that is measured now: once a second, beside the frames.

What counts as measured is `left/render/depth` on tissue where its confidence is `SURE`: the surface that the
registration was stated for, without what is borrowed, old or hidden by an instrument. `left/depth` has no
confidence, and some frames have none of it.

As when it was registered, points that the eye sees before or behind the object count. Their distance is to
the plane of the triangle that their ray meets: a kernel finds that without the interpreter's lock, which
Open3D's search for the nearest place holds for a tenth of a second. A slide along the surface is not noticed.
"""

import math
from concurrent.futures import Executor, Future

import numpy as np

from sags_node.clients.overlay.draw import Placed
from sags_node.clients.overlay.frame import TissueFrame
from sags_node.clients.registration.surface_fit import LEAST_POINTS
from sags_node.clients.registration.surfaces import evenly
from sags_node.confidence import SURE, error_of
from sags_node.types import Camera

PERIOD = 1.0  # s
NINE_OF_TEN = 0.9


Found = tuple[float, float]  # m, the residual and the error of depths: see `look`


class Residual:
    """Watches one object that is pinned.

    It is doubted when its residual exceeds the stated one by more than the error of measured depths: by that
    much it may grow although nothing has moved.

    Args:
        stated: m, 90 % quantile of the residual when it was registered.
        share: of the surface in line with it that matched then.
    """

    def __init__(self, stated: float, share: float, worker: Executor) -> None:
        self._stated, self._share, self._worker = stated, share, worker
        self._found: Found | None = None
        self._doubt: str | None = None
        self._looking: Future[Found | None] | None = None
        self._stamp_ns = -math.inf  # of the last frame that was looked at

    def status(self) -> dict[str, float | None]:
        """Return the residual and its limit, mm; None: nothing was looked at yet, or too little of it is
        measured now."""
        told = (None, None) if self._found is None else (self._found[0], self._stated + self._found[1])
        named = zip(("residual_mm", "residual_limit_mm"), told, strict=True)
        return {name: None if each is None else round(1e3 * each, 2) for name, each in named}

    def look(self, frame: TissueFrame, placed: Placed, again: bool = True) -> str | None:
        """Return why the object is not sure, by the last look; look `again` in the background if it is due.

        The last doubt stays while nothing can be measured.
        """
        if self._looking is not None and self._looking.done():
            self._found, self._looking = self._looking.result(), None
            if self._found is not None:
                off, error = self._found
                said = f"the surface is {1e3 * off:.1f} mm off, {1e3 * self._stated:.1f} were stated"
                why = "the organ is bent or covered, or the object has slipped"
                self._doubt = f"{said}: {why}" if off > self._stated + error else None
        due = abs(frame.stamp_ns - self._stamp_ns) >= PERIOD * 1e9
        if again and due and self._looking is None and frame.confidence is not None:
            self._stamp_ns = frame.stamp_ns
            self._looking = self._worker.submit(look, placed, frame, self._share)
        return self._doubt


def look(placed: Placed, frame: TissueFrame, share: float = 1.0) -> Found | None:
    """Return the residual (m) that nine of ten points before or behind an object stay below, of the `share`
    that matched, and the bound (m) of nine of ten errors of their depths. None: too few points."""
    assert frame.confidence is not None
    every, at = evenly(frame.depth.shape)
    depth, confidence = frame.depth[at], frame.confidence[at]
    known = (depth > 0) & frame.tissue[at] & (confidence >= SURE)
    K, triangles = frame.camera.K.copy(), placed.body.triangles
    K[:2, 2] -= every // 2
    K[:2] /= every
    camera = Camera(depth.shape[1], depth.shape[0], K, frame.camera.T_world_cam)
    z, met = np.full(known.shape, np.inf, np.float32), np.zeros((*known.shape, 4), np.uint8)
    numbers = np.arange(len(triangles), dtype=np.uint32).view(np.uint8).reshape(-1, 4)  # in place of colours
    local = placed.draw(camera, z, met, numbers)
    rows, columns = np.nonzero(known & np.isfinite(z))
    if len(rows) < LEAST_POINTS:
        return None
    corners = local[triangles[met.view(np.uint32)[rows, columns, 0]]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rays = np.stack([columns, rows, np.ones(len(rows))], 1) @ np.linalg.inv(K).T
    points = rays * depth[rows, columns][:, None]
    off = np.abs(np.einsum("nc,nc->n", normals, points - corners[:, 0]))
    error = np.median(error_of(confidence[rows, columns]))
    return float(np.quantile(off, NINE_OF_TEN * share)), float(error)
