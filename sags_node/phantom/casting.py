"""The bodies in the scene at one moment, and ray casting at them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sags_node.phantom.instruments import Mesh
from sags_node.phantom.tissue import Tissue, vertex_normals
from sags_node.types import F32, I64, Bool


@dataclass(frozen=True, slots=True)
class Hits:
    """What each ray [...] meets first; a ray that meets nothing has neither `tissue` nor `tool`."""

    distance: F32  # [...] in lengths of the ray's direction, inf = nothing
    tissue: Bool  # [...]
    tool: Bool  # [...]
    face: I64  # [...] of the body that was hit
    barycentric: F32  # [..., 2] weights of the face's second and third corner


class Bodies:
    """Tissue and instruments, posed for one moment."""

    def __init__(self, tissue: Tissue, vertices: F32, tools: Mesh) -> None:
        import open3d.core as o3c
        from open3d.t.geometry import RaycastingScene

        self.tools = tools
        self.normals = vertex_normals(vertices)  # [rows, cols, 3] of the tissue
        self._caster: Any = RaycastingScene()
        self._tissue_id = self._caster.add_triangles(
            o3c.Tensor.from_numpy(vertices.reshape(-1, 3)), o3c.Tensor.from_numpy(tissue.faces)
        )
        self._tool_id = self._caster.add_triangles(
            o3c.Tensor.from_numpy(tools.vertices.astype(np.float32)),
            o3c.Tensor.from_numpy(tools.faces.astype(np.uint32)),
        )

    def cast(self, rays: F32) -> Hits:
        """Return the nearest hits of rays [..., 6]: origin and direction (m, world)."""
        import open3d.core as o3c

        found = self._caster.cast_rays(o3c.Tensor.from_numpy(np.ascontiguousarray(rays)))
        geometry = found["geometry_ids"].numpy()
        return Hits(
            distance=found["t_hit"].numpy(),
            tissue=geometry == self._tissue_id,
            tool=geometry == self._tool_id,
            face=found["primitive_ids"].numpy().astype(np.int64),
            barycentric=found["primitive_uvs"].numpy(),
        )

    def occluded(self, rays: F32) -> Bool:
        """Tell whether something blocks rays [..., 6] before the light, where their directions end; [...]."""
        import open3d.core as o3c

        own_surface = 0.012  # share of the way that is not tested: a surface must not shadow itself
        stopped = self._caster.test_occlusions(o3c.Tensor.from_numpy(rays), own_surface, 1.0)
        return np.asarray(stopped.numpy(), np.bool_)


def grid_position(hits: Hits, cols: int) -> F32:
    """Return column and row [..., 2] on the tissue's vertex grid (`Tissue.faces`); 0, 0 without a hit."""
    face = np.where(hits.tissue, hits.face, 0)
    row, col = np.divmod(face // 2, cols - 1)
    lower = (face % 2).astype(np.float32)[..., None]
    weights = np.where(hits.tissue[..., None], hits.barycentric, np.float32(0))
    inside = lower + (1 - 2 * lower) * weights
    return np.asarray(np.stack([col, row], -1) + inside, np.float32)
