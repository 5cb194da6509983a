"""From splats to depth-sorted lists of splats per tile.

Splats are sorted by depth once; then every splat writes the tiles of its box, in that order, and a stable
sort by tile leaves each tile's splats from near to far. That sorts 32 bits twice, once per splat and once per
pair; one sort of packed (tile, depth) keys would move 64 bits of every pair.

Pairs of one splat are neighbours at their slots, where their gradients are summed later. A tile of the box
that the ellipse misses keeps its slot and is sorted behind all others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from sags_node.engine.cuda.layout import (
    BOX_COLUMNS,
    BOX_INTS,
    BOX_LEFT,
    BOX_TOP,
    DEPTH,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    SPLAT_FLOATS,
    TILE_HEIGHT,
    TILE_HEIGHT_BITS,
    TILE_WIDTH,
    WHITEN_XX,
    WHITEN_XY,
    WHITEN_YY,
)
from sags_node.engine.cuda.projection import LOG2_MIN_ALPHA, hold, radii
from sags_node.engine.cuda.signatures import Compiled

BLOCK = 256  # pairs per program
ROW_SLACK = tl.constexpr(0.001)  # px: rounding must not lose a row


@triton.jit(do_not_specialize=["pairs", "tiles_x", "tiles"])
def find_tiles(
    splats: tl.tensor,  # [N, SPLAT_FLOATS]
    boxes: tl.tensor,  # [N, BOX_INTS]
    first_slots: tl.tensor,  # [N] slot of a splat's first pair
    owners: tl.tensor,  # [pairs] the splat of each slot
    active: tl.tensor,  # [tiles] 1: this tile is drawn
    found: tl.tensor,  # [pairs] written: the tile; `tiles` where the ellipse misses it
    pairs: tl.tensor,
    tiles_x: tl.tensor,  # columns of tiles
    tiles: tl.tensor,  # of the picture
    BLOCK: tl.constexpr,
) -> None:
    """The ellipse on which alpha is 1/255 against the tiles of its box."""
    slots = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = slots < pairs
    owner = tl.load(owners + slots, mask=inside, other=0).to(tl.int64)
    nth = (slots - tl.load(first_slots + owner, mask=inside, other=0)).to(tl.int32)
    box = boxes + owner * BOX_INTS
    columns = tl.load(box + BOX_COLUMNS, mask=inside, other=1)
    column = tl.load(box + BOX_LEFT, mask=inside, other=0) + nth % columns
    row = tl.load(box + BOX_TOP, mask=inside, other=0) + nth // columns

    splat = splats + owner * SPLAT_FLOATS
    mean_x = tl.load(splat + MEAN_X, mask=inside, other=0.0)
    mean_y = tl.load(splat + MEAN_Y, mask=inside, other=0.0)
    a = tl.load(splat + WHITEN_XX, mask=inside, other=1.0)
    b = tl.load(splat + WHITEN_XY, mask=inside, other=0.0)
    c = tl.load(splat + WHITEN_YY, mask=inside, other=1.0)
    extent = tl.load(splat + LOG2_OPACITY, mask=inside, other=0.0) - LOG2_MIN_ALPHA

    # u^2 + v^2 <= extent with u = a dx + b dy, v = c dy: the largest and smallest dy over the tile's columns
    radius_x, radius_y = radii((a, b, c), extent)
    from_left = (column * TILE_WIDTH).to(tl.float32) + 0.5 - mean_x
    low, high = tl.maximum(from_left, -radius_x), tl.minimum(from_left + (TILE_WIDTH - 1), radius_x)
    bb_cc = b * b + c * c
    lowest_dx = -b / a * radius_y  # where the ellipse reaches dy = radius_y
    dx = hold(lowest_dx, low, high)
    below = (tl.sqrt(tl.maximum(bb_cc * extent - a * a * c * c * dx * dx, 0.0)) - a * b * dx) / bb_cc
    dx = hold(-lowest_dx, low, high)
    above = -(tl.sqrt(tl.maximum(bb_cc * extent - a * a * c * c * dx * dx, 0.0)) + a * b * dx) / bb_cc
    from_top = (row << TILE_HEIGHT_BITS).to(tl.float32) + 0.5 - mean_y
    touched = (above - ROW_SLACK <= from_top + (TILE_HEIGHT - 1)) & (below + ROW_SLACK >= from_top)

    tile = row * tiles_x + column
    touched &= tl.load(active + tile, mask=inside, other=0) != 0
    tl.store(found + slots, tl.where(touched, tile, tiles), mask=inside)


@dataclass(frozen=True, slots=True)
class Bins:
    """Pairs of splats and tiles, P of them."""

    first_slots: Tensor  # [N] int32, slot of a splat's first pair
    counts: Tensor  # [N] int32, its number of slots
    splats: Tensor  # [P] int32, tile after tile, near to far in each
    slots: Tensor  # [P] int64, of these pairs
    tile_starts: Tensor  # [tiles + 1] int32


def bin_splats(
    splats: Tensor,
    boxes: Tensor,
    counts: Tensor,
    active: Tensor,
    check: Callable[[int], None],
) -> Bins:
    """Sort splats [N, SPLAT_FLOATS] of `project` into the active tiles [rows, columns].

    The number of pairs is read back: the one time in a drawing that the host waits for the device. A buffer
    of fixed size would spare that wait, but would be sorted in full in every drawing, and what does not fit
    would be lost without a word.

    Args:
        check: is told that number before memory is taken; raises where it is too large.
    """
    tiles = active.numel()
    order = torch.argsort(splats[:, DEPTH.value], stable=True)
    sorted_counts = counts[order]
    ends = torch.cumsum(sorted_counts, 0)  # int64
    pairs = int(ends[-1]) if len(ends) else 0
    check(pairs)
    first_slots = torch.empty_like(counts)
    first_slots[order] = (ends - sorted_counts).to(torch.int32)
    owners = torch.repeat_interleave(order.to(torch.int32), sorted_counts, output_size=pairs)
    found = torch.empty(pairs, dtype=torch.int32, device=splats.device)
    find_tiles[(triton.cdiv(pairs, BLOCK),)](
        splats, boxes, first_slots, owners, active, found, pairs, active.shape[1], tiles, BLOCK=BLOCK
    )  # fmt: skip
    found, slots = torch.sort(found, stable=True)
    borders = torch.arange(tiles + 1, dtype=torch.int32, device=splats.device)
    tile_starts = torch.searchsorted(found, borders, out_int32=True)
    return Bins(first_slots, counts, owners[slots], slots, tile_starts)


SIGNATURES = (
    Compiled(
        find_tiles,
        {
            "splats": "*fp32", "boxes": "*i32", "first_slots": "*i32", "owners": "*i32", "active": "*i32",
            "found": "*i32", "pairs": "i32", "tiles_x": "i32", "tiles": "i32",
        },
        {"BLOCK": BLOCK},
    ),
)  # fmt: skip
