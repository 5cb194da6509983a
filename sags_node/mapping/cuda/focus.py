"""Where in the picture another refinement step pays most, found on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton
import triton.language as tl

from sags_node.engine.cuda.signatures import Compiled
from sags_node.engine.rasterizer.rasterize import TILE_HEIGHT, TILE_WIDTH

if TYPE_CHECKING:
    from torch import Tensor


@triton.jit(do_not_specialize=("height", "width"))
def _sum_residuals(
    planes: tl.tensor,  # [5, H, W]
    image: tl.tensor,  # [H, W, 3]
    tissue: tl.tensor,  # [H, W]
    sums: tl.tensor,  # [rows, columns] written
    height: tl.tensor,
    width: tl.tensor,
    least_coverage: tl.tensor,
    EVERY: tl.constexpr,  # px between the pixels that are looked at
    DOWN: tl.constexpr,  # of them in a tile
    ACROSS: tl.constexpr,
) -> None:
    """One program is one tile; it adds up in one order, always the same."""
    row, column = tl.program_id(1), tl.program_id(0)
    y = (row * DOWN + tl.arange(0, DOWN)[:, None]) * EVERY
    x = (column * ACROSS + tl.arange(0, ACROSS)[None, :]) * EVERY
    inside = (y < height) & (x < width)
    pixel, pixels = y * width + x, height * width
    coverage = tl.load(planes + 4 * pixels + pixel, inside, other=0.0)
    counts = (tl.load(tissue + pixel, inside, other=0) != 0) & (coverage > least_coverage)
    total = tl.zeros([DOWN, ACROSS], tl.float32)
    for k in tl.static_range(3):
        drawn = tl.load(planes + k * pixels + pixel, counts, other=0.0) / coverage
        residual = drawn - tl.load(image + 3 * pixel + k, counts, other=0.0)
        total += tl.where(counts & (tl.abs(residual) < 1.0), residual * residual, 0.0)
    tl.store(sums + row * tl.num_programs(0) + column, tl.sum(total))


def worst_tiles(
    planes: Tensor, image: Tensor, tissue: Tensor, share: float, *, every: int, least_coverage: float
) -> Tensor:
    """The rasteriser's tiles [rows, columns] of a picture with the largest squared colour residuals, bool.

    Nothing is read back to the host. Tiles that tie at the edge of the choice are chosen in no fixed order.

    Args:
        planes: [5, H, W] of the rasteriser.
        image: [H, W, 3] RGB 0..1, what they should show.
        tissue: [H, W] bool, the pixels that count.
        share: of all tiles, 0..1; at least one is chosen.
        every: px, a power of 2: which pixels are looked at, along both axes.
        least_coverage: where less is drawn, the colour means nothing.
    """
    height, width = tissue.shape
    rows, columns = triton.cdiv(height, TILE_HEIGHT), triton.cdiv(width, TILE_WIDTH)
    sums = torch.empty((rows, columns), device=planes.device)
    _sum_residuals[(columns, rows)](
        planes, image, tissue, sums, height, width, least_coverage,
        EVERY=every, DOWN=TILE_HEIGHT // every, ACROSS=TILE_WIDTH // every,
    )  # fmt: skip
    worst = torch.topk(sums.flatten(), max(1, round(share * sums.numel())), sorted=False).indices
    chosen = torch.zeros(sums.numel(), dtype=torch.bool, device=planes.device)
    chosen.index_fill_(0, worst, True)
    return chosen.reshape(rows, columns)


SIGNATURES = (
    Compiled(
        _sum_residuals,
        {
            **dict.fromkeys(("planes", "image"), "*fp32"),
            "tissue": "*i1",
            "sums": "*fp32",
            **dict.fromkeys(("height", "width"), "i32"),
            "least_coverage": "fp32",
        },
        {"EVERY": 2, "DOWN": TILE_HEIGHT // 2, "ACROSS": TILE_WIDTH // 2},
    ),
)
