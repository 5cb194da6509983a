"""How an object follows the tissue that bends: its vertices move with anchors on the surface above them.

The object's own anchors hold it rigidly. `FOLLOWERS` more are pinned where the tissue is seen over it. Each
tells how far its tissue has moved from where the rigid motion would have it. Kriging (a Gaussian process with
mean zero; C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, 2.2)
interpolates that over the surface, by how sure each anchor's depth is. A vertex moves with the surface in
front of it on its ray, the less the deeper it lies below. Rays and depths are those of the pinning's frame.

Anchors are used, since the image corrects them, they tell how sure they are, and they come back after they
were lost. Control nodes and Gaussians do none of that, and are replaced over time.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.clients.overlay.frame import Anchor, TissueFrame
from sags_node.clients.overlay.pinner import Pinner, Request
from sags_node.clients.registration.surfaces import NINE_OF_TEN
from sags_node.confidence import SURE, SURE_OF_ANCHOR, error_of
from sags_node.errors import SagsError
from sags_node.geometry import Array, invert, project, transform
from sags_node.types import F32, F64, I64, Bool

FOLLOWERS = 64  # a quarter of a node's anchors; 32 leave twice the error on the phantom
LEAST_FOLLOWERS = 3
RIM = 25  # px, of the image and of instruments: an anchor needs 12 px of tissue on each side
STILL = 0.5e-3  # m; an anchor wanders by this much on tissue that is still
LEAST_ERROR = 0.3e-3  # m, of an anchor's depth
LEAST_SHARE = 1e-3  # the least weight of an anchor, by its confidence above `SURE_OF_ANCHOR`
BENT = 5e-3  # m; prior standard deviation of the bending
AGAIN = 1.0  # s from a refusal to the next try
PINNING = "the tissue over it is being pinned"
UNKNOWN = Anchor(np.full(3, np.nan), 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class _Field:
    """Carries the followers' displacements to the vertices."""

    points: F64  # [k, 3] m, of the object: where the followers were pinned
    reach: float  # m, length scale of the kernel: the followers' spacing
    rows: I64  # [n] vertices that are near enough to the surface
    carried: F32  # [n, k] kernel between each vertex' place on the surface and the followers, faded


class Deformation:
    """Bends one object that is pinned.

    Attributes:
        doubt: why the object is rigid; None: it is bent.
        ids: of the followers; empty: nothing was bent yet.

    Args:
        vertices: [V, 3] m, of the object.
        depth: m below the surface; what lies deeper moves rigidly.
        asked: further arguments of `add_anchor` for every anchor.
    """

    def __init__(self, vertices: F64, depth: float, pinner: Pinner, worker: Executor, asked: Request) -> None:
        import open3d  # noqa: F401  it takes a second: not while frames wait

        self.doubt: str | None = PINNING
        self._vertices, self._depth = vertices, depth
        self._pinner, self._worker, self._asked = pinner, worker, asked
        self._beginning: Future[tuple[_Field, list[int]]] | None = None
        self._begun_ns = -math.inf
        self._field: _Field | None = None
        self.ids: list[int] = []
        self._rest = np.zeros((0, 3))  # [k, 3] m, of the object: where each was seen first; NaN: not yet
        self._pulling = 0

    def release(self, give_back: Callable[[list[int]], object]) -> None:
        """Give the followers back, those that are being pinned, too."""
        give_back(self.ids)
        if self._beginning is not None:
            self._beginning.add_done_callback(lambda it: it.exception() or give_back(it.result()[1]))

    def status(self) -> dict[str, dict[str, int]]:
        """Return for people and programs how many followers there are, and how many are sure."""
        return {"deform": {"anchors": len(self.ids), "pulling": self._pulling}}

    def move(self, frame: TissueFrame, T: F64) -> F64 | None:
        """Return the vertices [V, 3] (m, of the object) as bent, at its rigid pose T [4, 4]; None: rigid."""
        if self._field is None:
            self._begin(frame, T)
            return None
        states = [frame.anchors.get(each, UNKNOWN) for each in self.ids]
        now = np.asarray(transform(invert(T), np.stack([state.place for state in states])))
        self._rest = np.where(np.isnan(self._rest), now, self._rest)
        ways = now - self._rest
        sure = [state.is_sure and state.depth_confidence >= SURE for state in states]
        pulls = np.flatnonzero(np.isfinite(ways).all(1) & np.array(sure))
        self._pulling = len(pulls)
        if len(pulls) < LEAST_FOLLOWERS:
            self.doubt = f"{len(pulls)} of its {len(states)} anchors on the tissue over it are sure"
            return None
        self.doubt = None
        weights = np.zeros(ways.shape, np.float32)
        weights[pulls] = _weights(self._field, pulls, ways[pulls], [states[i] for i in pulls])
        vertices = self._vertices.copy()
        vertices[self._field.rows] += self._field.carried @ weights
        return vertices

    def _begin(self, frame: TissueFrame, T: F64) -> None:
        """Choose and pin the followers in the background; again after a while where that is refused."""
        if self._beginning is None and abs(frame.stamp_ns - self._begun_ns) >= AGAIN * 1e9:
            self._begun_ns = frame.stamp_ns
            self._beginning = self._worker.submit(self._pinned, frame, T)
        elif self._beginning is not None and self._beginning.done():
            try:
                self._field, self.ids = self._beginning.result()
                self._rest = np.full((len(self.ids), 3), np.nan)
            except SagsError as error:
                self.doubt = str(error)
            self._beginning = None

    def _pinned(self, frame: TissueFrame, T: F64) -> tuple[_Field, list[int]]:
        field = _field(self._vertices, self._depth, frame, T)
        places = transform(T, field.points).tolist()
        asked = [dict(zip("xyz", place, strict=True)) | self._asked for place in places]
        return field, self._pinner.pin(asked).result()


def _field(vertices: F64, depth: float, frame: TissueFrame, T: F64) -> _Field:
    """Choose where to pin the followers of an object at T [4, 4], and how its vertices follow them."""
    import open3d as o3d

    if frame.confidence is None:
        raise SagsError("the node does not say how sure its depth is")
    edges = np.pad(frame.tissue, 1).view(np.uint8)  # of the image, too
    room = cv2.erode(edges, np.ones((RIM, RIM), np.uint8))[1:-1, 1:-1] > 0
    free = transform(invert(T), frame.surface(room & (frame.confidence >= SURE)).points).astype(np.float32)
    if len(free):
        free = free[cv2.batchDistance(free, vertices.astype(np.float32), cv2.CV_32F, K=1)[0][:, 0] < depth]
    if len(free) < LEAST_FOLLOWERS:
        raise SagsError("too little of the tissue over it is seen with a sure depth")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(free.astype(np.float64)))
    points = np.asarray(cloud.farthest_point_down_sample(min(FOLLOWERS, len(free))).points)
    apart = np.sort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)[:, 1]
    pixels, z = project(frame.camera, transform(T, vertices))
    columns, rows = np.clip(np.rint(np.nan_to_num(pixels)), 0, np.subtract(frame.depth.shape[::-1], 1)).T
    surface = filled(frame.depth, (frame.depth > 0) & frame.tissue)[
        rows.astype(np.intp), columns.astype(np.intp)
    ]
    near = np.flatnonzero((z > 0) & (z - surface < depth))
    z, surface = z[near], surface[near]
    eye = transform(invert(T), frame.camera.T_world_cam[:3, 3])
    above = eye + (vertices[near] - eye) * np.minimum(1, surface / z)[:, None]  # of each, on the surface
    faded, reach = np.maximum(0, z - surface) / depth, float(np.median(apart))
    carried = _kernel(above, points, reach) * (1 - faded**2 * (3 - 2 * faded))[:, None]
    return _Field(points, reach, near, carried.astype(np.float32))


def filled(depth: F32, known: Bool) -> F32:
    """The depth [H, W] (m) where it is known, elsewhere that of the nearest pixel that has one."""
    unknown = ~known
    _, nearest = cv2.distanceTransformWithLabels(
        unknown.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    depths = np.zeros(nearest.max() + 1, np.float32)
    depths[nearest[known]] = depth[known]
    found: F32 = depths[nearest]
    return found


def _weights(field: _Field, pulls: I64, ways: F64, states: Sequence[Anchor]) -> F64:
    """The kriging weights [k, 3] of the followers `pulls` [k], by their displacements [k, 3] (m)."""
    # What is small is noise, what is large counts as it is (the garrote of L. Breiman, Technometrics 1995).
    lengths = np.linalg.norm(ways, axis=1, keepdims=True)
    ways = ways * (1 - (STILL / np.maximum(lengths, STILL)) ** 2)
    errors = error_of(np.array([state.depth_confidence for state in states], np.float32)) / NINE_OF_TEN
    # One that becomes unsure lets go little by little.
    shares = np.array([(state.confidence - SURE_OF_ANCHOR) / (1 - SURE_OF_ANCHOR) for state in states])
    noise = np.square(np.maximum(errors, LEAST_ERROR) / BENT) / np.maximum(shares, LEAST_SHARE)
    points = field.points[pulls]
    return np.asarray(np.linalg.solve(_kernel(points, points, field.reach) + np.diag(noise), ways))


def _kernel(these: Array, others: F64, reach: float) -> F64:
    """The Gaussian kernel [n, k] between places [n, 3] and [k, 3], 0..1."""
    squares = np.square(these).sum(1)[:, None] + np.square(others).sum(1) - 2 * these @ others.T
    return np.asarray(np.exp(-0.5 * squares / reach**2), np.float64)
