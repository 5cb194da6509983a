"""The node's Gaussians as a browser draws them, and the tissue that a ray through them meets."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sags_node.geometry import quat_to_matrix
from sags_node.messaging.content import gaussians_of
from sags_node.model.constant_colours import with_constant_colours
from sags_node.types import F32, F64

MAX_SPLATS = 60_000  # that a browser draws smoothly; of more, those that cover most
REACH = 3.0  # standard deviations within which a Gaussian is met
SURFACE = 0.5  # share of the light that is absorbed at the surface, also where the renderer puts the depth


@dataclass(frozen=True, slots=True)
class Splats:
    """Gaussians in metres, world."""

    means: F32  # [N, 3]
    rotations: F32  # [N, 3, 3]
    scales: F32  # [N, 3] standard deviations
    colors: F32  # [N, 3] 0..1
    opacities: F32  # [N]

    def covariances(self, unit: float) -> F32:
        """Return the covariances [N, 3, 3], in squares of a unit of `unit` metres."""
        sides = self.rotations * (self.scales / unit)[:, None, :]
        return np.asarray(np.einsum("nik,njk->nij", sides, sides))

    def hit(self, origin: F64, direction: F64) -> F64 | None:
        """Find where a ray from `origin` (m) along `direction` meets the tissue: half of its light is left.

        Each Gaussian counts where it is densest along the ray, front to back. None when the ray meets nothing
        that is more opaque than clear.
        """
        ray = direction / np.linalg.norm(direction)
        offsets = self.means - origin
        apart = np.linalg.norm(np.cross(offsets, ray), axis=1)
        near = np.flatnonzero((apart < REACH * self.scales.max(axis=1)) & (offsets @ ray > 0))
        scales, rotations = self.scales[near], self.rotations[near]
        # In the frame where a Gaussian is a unit ball, its densest point along the ray is the nearest one.
        start = -np.einsum("nji,nj->ni", rotations, offsets[near]) / scales
        step = np.einsum("nji,j->ni", rotations, ray) / scales
        along = -np.sum(start * step, axis=1) / np.sum(step * step, axis=1)
        square = np.sum((start + along[:, None] * step) ** 2, axis=1)
        order = np.argsort(along)
        alphas = (self.opacities[near] * np.exp(-0.5 * square))[order]
        met = np.flatnonzero(np.cumprod(1 - alphas) < SURFACE)
        if met.size == 0:
            return None
        return np.asarray(origin + ray * along[order[met[0]]], np.float64)


def splats_of(points: NDArray[Any]) -> Splats:
    """The rows of the topic `splats`, in colours that a browser knows; at most `MAX_SPLATS`."""
    gaussians = with_constant_colours(gaussians_of(points))
    rows = np.arange(len(gaussians))
    if len(rows) > MAX_SPLATS:
        scales = np.sort(gaussians.scales, axis=1)
        cover = gaussians.opacities * scales[:, 1] * scales[:, 2]
        rows = np.argpartition(cover, -MAX_SPLATS)[-MAX_SPLATS:]
    return Splats(
        means=gaussians.means[rows],
        rotations=quat_to_matrix(gaussians.quats[rows]),
        scales=gaussians.scales[rows],
        colors=np.clip(gaussians.colors[rows], 0, 1),
        opacities=gaussians.opacities[rows],
    )
