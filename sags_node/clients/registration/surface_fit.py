"""The pose in which a model's surface lies best on the measured one, near where pairs of points put it.

Iterated closest points to planes (Y. Chen and G. Medioni, "Object modelling by registration of multiple range
images", IVC 1992), trimmed (D. Chetverikov et al., "The trimmed iterative closest point algorithm", ICPR
2002), with the weights of Geman and McClure. The pairs stay in the least squares, weighted by their accuracy:
where the model could slide on the surface, they hold it. Open3D's own ICP has neither weights of points nor
pairs; its search for the nearest place on a mesh is used (`Shape`).

Depth errors are almost the same all over a patch of `PATCH`, so a patch counts as one measurement.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.clients.registration.rigid import motion_rows, of_pairs
from sags_node.clients.registration.surfaces import Shape, Surface
from sags_node.geometry import invert, rigid, transform
from sags_node.types import F64, I64

GATES = (0.010, 0.005, 0.003)  # m, one after the other: points farther from the model do not count
STEPS = 20  # iterations for each gate, at most
KEPT = 0.9  # share of the points within the gate that counts: the nearest
ASIDE = 0.5e-3  # m, plus half of the distance: points farther beside the normal are beyond the rim
PATCH = 0.005  # m, the side of a patch
STILL = 1e-6  # m and rad; a smaller step ends the iteration
LEAST_POINTS = 50


@dataclass(frozen=True, slots=True)
class Counted:
    """The measured points that count: how a motion moves the model at them, and how far it is off there."""

    rows: F64  # [N, 6], see `motion_rows`; about the middle of the pairs
    off: F64  # [N] m
    errors: F64  # [N] m, one standard deviation, enlarged where the points fit worse
    weights: F64  # [N] m^-2
    patches: I64  # [N]

    def information(self) -> F64:
        """Return the information [6, 6] from the mean row of each patch: it averages out facets and noise of
        the model's normals, so that a plane made of small triangles still slides."""
        weights = np.bincount(self.patches, self.weights)
        sums = np.stack([np.bincount(self.patches, self.weights * column) for column in self.rows.T], 1)
        means = sums / np.where(weights > 0, weights, 1)[:, None]
        return means.T @ (weights[:, None] * means)

    def slide(self) -> float:
        """Return how far (m) the model could slide on the surface, one standard deviation; inf: freely."""
        arms = np.linalg.norm(self.rows[:, :3], axis=1)
        per_metre = np.array([1 / np.sqrt(np.mean(arms**2))] * 3 + [1.0] * 3)
        least = np.linalg.eigvalsh(self.information() * np.outer(per_metre, per_metre))[0]
        return float(1 / np.sqrt(least)) if least > 0 else np.inf


def fit_surface(
    model: Shape, surface: Surface, at: F64, places: F64, picked: float, T: F64
) -> tuple[F64, Counted] | None:
    """Return the pose [4, 4] of a model and the points that give it; None: too little surface is near it.

    Args:
        at: [k, 3] m, of the model, picked at `places` [k, 3] (m, world) with error `picked` (m, each axis).
        T: [4, 4] to start from, within some millimetres.
    """
    centre = places.mean(0)
    patches = np.unique(np.floor(surface.points / PATCH), axis=0, return_inverse=True)[1].reshape(-1)
    for gate in GATES:
        side = model.facing(transform(invert(T), surface.eye))
        for _ in range(STEPS):
            counted = _counted(side, surface, patches, centre, T, gate)
            if counted is None:
                return None
            there = transform(T, at)
            arms, off = np.repeat(there - centre, 3, axis=0), (places - there).reshape(-1)
            pull = motion_rows(arms, np.tile(np.eye(3), (len(at), 1))).T @ off / picked**2
            pull += counted.rows.T @ (counted.weights * counted.off)
            seen = counted.rows.T @ (counted.weights[:, None] * counted.rows)
            twist = np.linalg.solve(seen + of_pairs(there - centre, picked), pull)
            R = cv2.Rodrigues(twist[:3])[0]
            T = rigid(R, centre + twist[3:] - R @ centre) @ T
            if np.abs(twist).max() < STILL:
                break
    assert counted is not None  # there are gates
    return T, counted


def _counted(side: Shape, surface: Surface, patches: I64, centre: F64, T: F64, gate: float) -> Counted | None:
    near, normals = side.nearest(transform(invert(T), surface.points))
    near, normals = np.asarray(transform(T, near), np.float64), normals @ T[:3, :3].T
    offsets = surface.points - near
    off, distances = np.einsum("nc,nc->n", offsets, normals), np.linalg.norm(offsets, axis=1)
    aside = np.linalg.norm(offsets - off[:, None] * normals, axis=1)
    kept = (distances < gate) & (aside < ASIDE + 0.5 * distances)
    if kept.sum() < LEAST_POINTS:
        return None
    kept &= distances <= np.quantile(distances[kept], KEPT)
    off, patches, errors = off[kept], patches[kept], surface.errors[kept]
    errors = errors * max(1.0, 1.4826 * float(np.median(np.abs(off) / errors)))
    counts = np.bincount(patches)
    counts = np.maximum(counts, np.median(counts[counts > 0]))  # a mere corner of a patch counts less
    weights = 1 / (1 + np.square(off / (2 * errors))) ** 2 / (np.square(errors) * counts[patches])
    return Counted(motion_rows(near[kept] - centre, normals[kept]), off, errors, weights, patches)
