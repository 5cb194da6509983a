"""One moment of a running node as a file."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from sags_node.types import Camera, Gaussians


def file_of(gaussians: Gaussians, camera: Camera, t_capture_ns: int, kind: str) -> bytes:
    """Write the model as `sags export` does: a mesh, points or splats, in metres.

    Raises:
        SagsError: it shows nothing.
    """
    from sags_node.tools.export.export import Orbit, export  # torch comes along, which few need
    from sags_node.tools.export.scene import Scene

    with TemporaryDirectory(prefix="sags-view-") as folder:
        file = Path(folder, "model.ply")
        scene = Scene(gaussians, camera, t_capture_ns)
        export(scene, {kind: file}, Orbit(0.0, 0.0), lambda *progress: None)
        return file.read_bytes()
