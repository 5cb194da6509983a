"""Files of splats, read by their own header alone."""

from pathlib import Path

import numpy as np

FIELDS = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()


def splats_of(path: Path) -> dict[str, np.ndarray]:
    """A splat PLY, read by its own header."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    named = [line.removeprefix("property float ") for line in lines[3:]]
    assert named[: len(FIELDS)] == list(FIELDS), "what came later stands after what was there"
    count = int(lines[2].removeprefix("element vertex "))
    rows = np.frombuffer(body, "<f4").reshape(count, len(named))
    return dict(zip(named, rows.T, strict=True))
