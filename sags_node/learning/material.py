"""What pairs are made of: rendered phantoms, and pictures to paint surfaces with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sags_node.learning.example import Example
from sags_node.learning.faults import photographed
from sags_node.learning.made_up import make_up
from sags_node.learning.rendered import Advance, crop, render
from sags_node.sources.pictures import list_pictures, read_picture
from sags_node.types import U8

RENDERED = 0.4  # share of the examples
MOST_TEXTURES = 500


@dataclass(frozen=True, slots=True)
class Material:
    """Makes examples, without end."""

    rendered: Sequence[Example]  # whole pictures of phantoms
    textures: Sequence[U8]  # [H, W, 3] RGB

    def example(self, rng: np.random.Generator, size: tuple[int, int]) -> Example:
        """A pair, `size` px wide and high, with all faults of cameras; another one in each call."""
        if rng.random() < RENDERED:
            clean = crop(rng, self.rendered[int(rng.integers(len(self.rendered)))], size)
        else:
            clean = make_up(rng, self.textures, size)
        return photographed(rng, clean)


def gather(tissues: int, folder: Path | None, seed: int, advance: Advance) -> Material:
    """Render phantoms, and read the pictures of a folder; phantoms are painted with as well.

    Raises:
        UsageError: the folder has no pictures.
        SagsError: a picture is damaged.
    """
    files = [] if folder is None else list_pictures(folder)
    textures = [read_picture(file) for file in files[:: 1 + len(files) // MOST_TEXTURES]]
    rendered = render(np.random.default_rng(seed), tissues, advance)
    return Material(rendered, [*textures, *(one.left for one in rendered)])
