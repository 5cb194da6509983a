"""`sags export`: the model at one moment as files that other programs open.

A file appears, or replaces the one that stood there, only when it is complete.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sags_node.errors import UsageError
from sags_node.files import check_file
from sags_node.model.ply import write_ply
from sags_node.tools.export.orbit import write_orbit
from sags_node.tools.export.scene import Advance, Scene
from sags_node.tools.export.surface import write_mesh, write_points

KINDS = {
    "splats": (".ply",),
    "points": (".ply", ".pcd"),
    "mesh": (".ply", ".obj", ".stl"),
    "orbit": (".mp4",),
}


@dataclass(frozen=True, slots=True)
class Orbit:
    """How the camera goes around."""

    degrees: float  # how far it tilts from where it was
    seconds: float  # for a whole circle


def check_targets(targets: Mapping[str, Path], force: bool) -> None:
    """Check, before any work, that each kind of `KINDS` can be written to its file.

    Raises:
        UsageError: none is asked for, an ending does not fit, two are the same file, there is no such folder,
            or a file exists and `force` is not given.
        SagsError: a folder cannot be written to.
    """
    if not targets:
        raise UsageError(
            "nothing to export; give --splats, --points, --mesh or --orbit and a file; of a recording also "
            "--sequence, --depth, --render or --tracks"
        )
    if len({path.resolve() for path in targets.values()}) < len(targets):
        raise UsageError("two exports would write the same file; give each a name of its own")
    for kind, path in targets.items():
        if path.suffix.lower() not in KINDS[kind]:
            raise UsageError(f"--{kind} {path}: the name must end in {' or '.join(KINDS[kind])}")
        if not path.parent.is_dir():
            raise UsageError(f"--{kind} {path}: there is no folder {path.parent}")
        check_file(path, force)


def export(scene: Scene, targets: Mapping[str, Path], orbit: Orbit, advance: Advance) -> list[dict[str, Any]]:
    """Write the files that `check_targets` accepted.

    Returns:
        For each: `file`, `kind`, `holds` (Gaussians, points, triangles or images) and `bytes`.

    Raises:
        SagsError: the model shows nothing there, or a file cannot be written.
    """
    rows = []
    for kind, path in targets.items():
        advance(0, None, f"writing {path.name}")
        match kind:
            case "splats":
                holds = write_ply(path, scene.gaussians, force=True)  # `check_targets` has asked
            case "points":
                holds = write_points(path, scene)
            case "mesh":
                holds = write_mesh(path, scene)
            case _:
                holds = write_orbit(path, scene, orbit.degrees, orbit.seconds, advance)
        rows.append({"file": str(path), "kind": kind, "holds": holds, "bytes": path.stat().st_size})
    return rows
