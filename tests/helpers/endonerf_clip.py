"""A clip of one eye in the layout of EndoNeRF."""

from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL = 160, 128, 150.0


def write_clip(folder: Path, count: int) -> None:
    """A flat texture 60 mm away that moves right by a pixel a frame, and a bar that grows as much."""
    rows, across = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    for number in range(count):
        waves = np.sin((across - number) / 5) * np.sin(rows / 7)
        mask, depth = np.zeros((HEIGHT, WIDTH), np.uint8), np.full((HEIGHT, WIDTH), 60, np.uint8)
        mask[40:60, : 20 + number] = 255
        image = np.stack([150 + 40 * waves, 80 + 20 * waves, 70 - 15 * waves], -1)
        for name, picture in (("images", image), ("masks", mask), ("depth", depth)):
            (folder / name).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(folder / name / f"{number:06d}.png"), picture)
    matrix = np.column_stack([np.eye(3), np.zeros(3), [HEIGHT, WIDTH, FOCAL]])
    np.save(folder / "poses_bounds.npy", np.tile(np.concatenate([matrix.ravel(), [60, 80]]), (count, 1)))
