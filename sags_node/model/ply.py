"""Gaussians as a PLY file with the field names every splat viewer reads."""

from pathlib import Path

import numpy as np

from sags_node.confidence import confidence_of
from sags_node.files import whole
from sags_node.model.constant_colours import with_constant_colours
from sags_node.types import SH_DEGREE_0, Gaussians

_FIELDS = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
)


def write_ply(path: Path, gaussians: Gaussians, force: bool = False, metric: bool = True) -> int:
    """Write a binary PLY in the layout of 3D Gaussian Splatting (Kerbl et al., 2023): log scales, opacity
    logits, quaternions wxyz, colours as degree-0 spherical harmonics; metres. The 3D filter and slopes are
    folded in (`model.constant_colours`): viewers know neither. Where the errors of depth are known,
    `confidence` comes last, see `sags_node.confidence`; readers take properties by name. Returns how many
    Gaussians the file holds: one with slopes is written as two.

    Args:
        metric: False: lengths have no unit, which a comment says.

    Raises:
        SagsError: the file exists already and `force` is not given, or it cannot be written.
    """
    gaussians = with_constant_colours(gaussians)
    opacities = np.clip(gaussians.opacities, 1e-6, 1 - 1e-6)
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    columns = np.concatenate(
        [
            gaussians.means,
            np.zeros_like(gaussians.means),
            (gaussians.colors - 0.5) / SH_DEGREE_0,
            np.log(opacities / (1 - opacities))[:, None],
            np.log(gaussians.scales),
            quats,
        ],
        axis=1,
    )
    fields = _FIELDS
    if gaussians.depth_errors is not None:
        fields = [*_FIELDS, "confidence"]
        columns = np.column_stack([columns, confidence_of(gaussians.depth_errors)])
    header = ["ply", "format binary_little_endian 1.0", *([] if metric else ["comment units relative"])]
    header += [f"element vertex {len(gaussians)}"]
    header += [f"property float {name}" for name in fields]
    header += ["end_header", ""]
    with whole(path, new=not force) as partial, partial.open("wb") as file:
        file.write("\n".join(header).encode())
        file.write(np.ascontiguousarray(columns, "<f4").tobytes())
    return len(gaussians)
