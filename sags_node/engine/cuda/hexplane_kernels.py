"""Kernels of `hexplane`, forward and backward. They compute on tiles [points, channels]: a point's channels
lie side by side.

The gradient of a cell is a sum over the points around it. Atomic additions would be the shortest way, but
they add in another order every time, so no run could be repeated; and tissue is a sheet: a few cells of the
coarse planes and of the lines hold most of its points, and additions to one address wait for each other. So
each sum has one writer:

- Planes in space: `differentiate` writes down what each point has to add, and in which cell it lies. Torch
  sorts the points by cell, stably. `add_planes` goes, for each row of cells, through the points in the four
  cells around it.
- Lines in time: a node's weight for a point is a hat function of their distance, so a line's gradient is a
  matrix product of hats [nodes, points] and what the points have to add [points, channels]. `add_lines` does
  that for chunks of points, whose sums torch adds up in order.
"""

from __future__ import annotations

import triton
import triton.language as tl

from sags_node.engine.cuda.signatures import Compiled

POINTS = 8  # of a program, or that it takes at a time; more need more registers than there are
CHUNK = 128  # points whose sums for the lines one program makes
PART = 32  # of them, multiplied at a time
NODES = 64  # of a line, of one program
INFINITY = tl.constexpr(float("inf"))

# Columns of `places` [levels, PLACES], int32: number of nodes along x, y, z; first row of the planes xy, xz,
# yz; first row within a slot of the lines of x, y, z.
X, Y, Z = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2)
NODE_COUNTS, PLANE_ROWS, LINE_ROWS = tl.constexpr(0), tl.constexpr(3), tl.constexpr(6)
PLACES = tl.constexpr(9)


@triton.jit
def _place(coordinate: tl.tensor, origin: tl.tensor, per_metre: tl.tensor, nodes: tl.tensor) -> tl.tuple:
    """Cell that holds a coordinate and the fraction of the way through it (outside or NaN: at the border),
    and the derivative of their sum, 0 from the border outwards."""
    u = (coordinate - origin) * per_metre
    last = (nodes - 1).to(tl.float32)
    slope = tl.where((u > 0.0) & (u < last), per_metre, 0.0)
    u = tl.where(u > 0.0, tl.minimum(u, last), 0.0)
    cell = tl.minimum(u.to(tl.int32), nodes - 2)
    return cell, u - cell.to(tl.float32), slope


@triton.jit
def _along(
    points: tl.tensor,
    box: tl.tensor,
    places: tl.tensor,
    level: tl.tensor,
    AXIS: tl.constexpr,
    point: tl.tensor,
    ok: tl.tensor,
) -> tl.tuple:
    """`_place` of points on one axis of a level, and that axis' number of nodes."""
    nodes = tl.load(places + PLACES * level + NODE_COUNTS + AXIS)
    coordinate = tl.load(points + 3 * point + AXIS, ok, other=0.0)
    cell, fraction, slope = _place(
        coordinate, tl.load(box + AXIS), tl.load(box + 3 + 3 * level + AXIS), nodes
    )
    return cell, fraction, slope, nodes


@triton.jit
def _on_plane(
    cells: tl.tensor,
    row: tl.tensor,
    columns: tl.tensor,
    fu: tl.tensor,
    fv: tl.tensor,
    ok: tl.tensor,
    channel: tl.tensor,
    C: tl.constexpr,
) -> tl.tuple:
    """Bilinear values [points, channels], and their slopes along the columns (u) and along the rows (v)."""
    at = cells + row[:, None].to(tl.int64) * C + channel
    fu, fv = fu[:, None], fv[:, None]
    low, high = tl.load(at, ok, other=0.0), tl.load(at + columns * C, ok, other=0.0)
    right = tl.load(at + C, ok, other=0.0) - low
    right_up = tl.load(at + columns * C + C, ok, other=0.0) - high
    low += fu * right
    by_v = high + fu * right_up - low
    return low + fv * by_v, right + fv * (right_up - right), by_v


@triton.jit
def _on_line(
    lines: tl.tensor, row: tl.tensor, fraction: tl.tensor, ok: tl.tensor, channel: tl.tensor, C: tl.constexpr
) -> tl.tuple:
    """Linear values [points, channels], and their slope."""
    at = lines + row[:, None] * C + channel
    a = tl.load(at, ok, other=0.0)
    step = tl.load(at + C, ok, other=0.0) - a
    return a + fraction[:, None] * step, step


@triton.jit(do_not_specialize=("count",))
def sample(
    points: tl.tensor,  # [N, 3]
    cells: tl.tensor,  # [M, C]
    lines: tl.tensor,  # [R, C]
    box: tl.tensor,  # [1 + levels, 3] origin; nodes per metre
    places: tl.tensor,  # [levels, PLACES]
    features: tl.tensor,  # [N, levels, C] written
    count: tl.tensor,
    LEVELS: tl.constexpr,
    C: tl.constexpr,
    CHANNELS: tl.constexpr,  # C, or the next power of 2
    POINTS: tl.constexpr,
) -> None:
    point, level = tl.program_id(0) * POINTS + tl.arange(0, POINTS), tl.program_id(1)
    known = point < count
    channel = tl.arange(0, CHANNELS)[None, :]
    ok = known[:, None] & (channel < C)
    x, fx, _, nx = _along(points, box, places, level, X, point, known)
    y, fy, _, _ = _along(points, box, places, level, Y, point, known)
    z, fz, _, nz = _along(points, box, places, level, Z, point, known)
    planes, line = places + PLACES * level + PLANE_ROWS, places + PLACES * level + LINE_ROWS
    value, _, _ = _on_plane(cells, tl.load(planes) + y * nx + x, nx, fx, fy, ok, channel, C)
    at, _, _ = _on_plane(cells, tl.load(planes + 1) + x * nz + z, nz, fz, fx, ok, channel, C)
    value *= at
    at, _, _ = _on_plane(cells, tl.load(planes + 2) + y * nz + z, nz, fz, fy, ok, channel, C)
    value *= at
    at, _ = _on_line(lines, tl.load(line) + x, fx, ok, channel, C)
    value *= at
    at, _ = _on_line(lines, tl.load(line + 1) + y, fy, ok, channel, C)
    value *= at
    at, _ = _on_line(lines, tl.load(line + 2) + z, fz, ok, channel, C)
    to = (point[:, None].to(tl.int64) * LEVELS + level) * C + channel
    tl.store(features + to, value * at, ok)


@triton.jit(do_not_specialize=("count", "nowhere"))
def differentiate(
    points: tl.tensor,  # [N, 3]
    cells: tl.tensor,  # [M, C]
    lines: tl.tensor,  # [R, C]
    box: tl.tensor,
    places: tl.tensor,
    v_features: tl.tensor,  # [N, levels, C]
    plane_records: tl.tensor,  # [levels, 3, N, C] written: what points add to the planes in space
    line_records: tl.tensor,  # [levels, 3, N, C] written: and to the lines
    keys: tl.tensor,  # [levels, 3, N] written: row of a point's cell, `nowhere` if it takes no part
    active: tl.tensor,  # [N] written: whether it takes part
    v_points: tl.tensor,  # [N, 3] written
    count: tl.tensor,
    nowhere: tl.tensor,
    LEVELS: tl.constexpr,
    C: tl.constexpr,
    CHANNELS: tl.constexpr,
    POINTS: tl.constexpr,
) -> None:
    point = (tl.program_id(0) * POINTS + tl.arange(0, POINTS)).to(tl.int64)
    known = point < count
    channel = tl.arange(0, CHANNELS)[None, :]
    ok = known[:, None] & (channel < C)
    size = tl.zeros([POINTS], tl.float32)
    for level in range(LEVELS):
        at = v_features + (point[:, None] * LEVELS + level) * C + channel
        size += tl.sum(tl.abs(tl.load(at, ok, other=0.0)), axis=1)
    is_active = size != 0.0
    tl.store(active + point, is_active, known)
    v_x, v_y = tl.zeros([POINTS], tl.float32), tl.zeros([POINTS], tl.float32)
    v_z = tl.zeros([POINTS], tl.float32)
    for level in range(LEVELS):
        x, fx, slope_x, nx = _along(points, box, places, level, X, point, known)
        y, fy, slope_y, _ = _along(points, box, places, level, Y, point, known)
        z, fz, slope_z, nz = _along(points, box, places, level, Z, point, known)
        planes, line = places + PLACES * level + PLANE_ROWS, places + PLACES * level + LINE_ROWS
        xy, xz = tl.load(planes) + y * nx + x, tl.load(planes + 1) + x * nz + z
        yz = tl.load(planes + 2) + y * nz + z
        at_xy, xy_x, xy_y = _on_plane(cells, xy, nx, fx, fy, ok, channel, C)
        at_xz, xz_z, xz_x = _on_plane(cells, xz, nz, fz, fx, ok, channel, C)
        at_yz, yz_z, yz_y = _on_plane(cells, yz, nz, fz, fy, ok, channel, C)
        at_x, xt_x = _on_line(lines, tl.load(line) + x, fx, ok, channel, C)
        at_y, yt_y = _on_line(lines, tl.load(line + 1) + y, fy, ok, channel, C)
        at_z, zt_z = _on_line(lines, tl.load(line + 2) + z, fz, ok, channel, C)
        g = tl.load(v_features + (point[:, None] * LEVELS + level) * C + channel, ok, other=0.0)
        in_time, in_space = g * at_x * at_y * at_z, g * at_xy * at_xz * at_yz
        v_xy, v_xz, v_yz = in_time * at_xz * at_yz, in_time * at_xy * at_yz, in_time * at_xy * at_xz
        v_xt, v_yt, v_zt = in_space * at_y * at_z, in_space * at_x * at_z, in_space * at_x * at_y
        v_x += slope_x * tl.sum(v_xy * xy_x + v_xz * xz_x + v_xt * xt_x, axis=1)
        v_y += slope_y * tl.sum(v_xy * xy_y + v_yz * yz_y + v_yt * yt_y, axis=1)
        v_z += slope_z * tl.sum(v_xz * xz_z + v_yz * yz_z + v_zt * zt_z, axis=1)
        entry = 3 * level * count.to(tl.int64) + point
        tl.store(keys + entry, tl.where(is_active, xy, nowhere), known)
        tl.store(keys + entry + count, tl.where(is_active, xz, nowhere), known)
        tl.store(keys + entry + 2 * count, tl.where(is_active, yz, nowhere), known)
        to, step = entry[:, None] * C + channel, count.to(tl.int64) * C
        tl.store(plane_records + to, v_xy, ok)
        tl.store(plane_records + to + step, v_xz, ok)
        tl.store(plane_records + to + 2 * step, v_yz, ok)
        tl.store(line_records + to, v_xt, ok)
        tl.store(line_records + to + step, v_yt, ok)
        tl.store(line_records + to + 2 * step, v_zt, ok)
    # selected, not multiplied: 0 times what a damaged cell holds is not 0
    tl.store(v_points + 3 * point, tl.where(is_active, v_x, 0.0), known)
    tl.store(v_points + 3 * point + 1, tl.where(is_active, v_y, 0.0), known)
    tl.store(v_points + 3 * point + 2, tl.where(is_active, v_z, 0.0), known)


@triton.jit(do_not_specialize=("count",))
def add_planes(
    points: tl.tensor,  # [N, 3]
    records: tl.tensor,  # [levels * 3 * N, C] of `differentiate`
    order: tl.tensor,  # [levels * 3 * N] places of the keys when they are sorted
    starts: tl.tensor,  # [S + 1] where the points of each row's cell begin in there
    box: tl.tensor,
    places: tl.tensor,
    v_cells: tl.tensor,  # [M, C] written in the S rows in space
    touched: tl.tensor,  # [M] likewise: whether any point has a weight there
    count: tl.tensor,
    LEVELS: tl.constexpr,
    C: tl.constexpr,
    CHANNELS: tl.constexpr,
    POINTS: tl.constexpr,
) -> None:
    """One program is one row of cells."""
    row = tl.program_id(0)
    plane = 0  # of all levels
    for other in tl.static_range(1, 3 * LEVELS):
        plane += (row >= tl.load(places + other // 3 * PLACES + PLANE_ROWS + other % 3)).to(tl.int32)
    level, kind = plane // 3, plane % 3  # kind: xy, xz or yz
    outer, inner = tl.where(kind == 1, X, Y), tl.where(kind == 0, X, Z)
    nodes_u = tl.load(places + PLACES * level + NODE_COUNTS + inner)
    nodes_v = tl.load(places + PLACES * level + NODE_COUNTS + outer)
    v = (row - tl.load(places + PLACES * level + PLANE_ROWS + kind)) // nodes_u
    channel = tl.arange(0, CHANNELS)[None, :]
    total, weights = tl.zeros([POINTS, CHANNELS], tl.float32), tl.zeros([POINTS], tl.float32)
    for corner in tl.static_range(4):  # of the four cells around the row, those that begin there
        on_right, on_top = corner % 2 == 0, corner // 2 == 0
        cell = row - (0 if on_right else 1) - (0 if on_top else nodes_u)
        # no point's cell begins in the last column of any plane: the cell before the first column is empty
        there = (cell >= 0) & (v >= (0 if on_top else 1))
        first = tl.load(starts + cell, there, other=0)
        end = tl.load(starts + cell + 1, there, other=0)
        for start in range(first, end, POINTS):
            k = start + tl.arange(0, POINTS)
            entry = tl.load(order + k, k < end, other=0)
            point = entry - plane * count.to(tl.int64)
            at_u = tl.load(points + 3 * point + inner, k < end, other=0.0)
            at_v = tl.load(points + 3 * point + outer, k < end, other=0.0)
            _, fu, _ = _place(at_u, tl.load(box + inner), tl.load(box + 3 + 3 * level + inner), nodes_u)
            _, fv, _ = _place(at_v, tl.load(box + outer), tl.load(box + 3 + 3 * level + outer), nodes_v)
            weight = (1.0 - fu if on_right else fu) * (1.0 - fv if on_top else fv)
            weight = tl.where(k < end, weight, 0.0)
            ok = (weight != 0.0)[:, None] & (channel < C)
            total += weight[:, None] * tl.load(records + entry[:, None] * C + channel, ok, other=0.0)
            weights += weight
    channel = tl.arange(0, CHANNELS)
    tl.store(v_cells + row.to(tl.int64) * C + channel, tl.sum(total, axis=0), channel < C)
    tl.store(touched + row, tl.sum(weights) > 0.0)


@triton.jit(do_not_specialize=("count", "slot_rows"))
def add_lines(
    points: tl.tensor,  # [N, 3]
    records: tl.tensor,  # [levels, 3, N, C] of `differentiate`
    active: tl.tensor,  # [N]
    box: tl.tensor,
    places: tl.tensor,
    v_lines: tl.tensor,  # [chunks, R, C] written
    weights: tl.tensor,  # [chunks, R] written: sums of the points' weights
    count: tl.tensor,
    slot_rows: tl.tensor,  # R
    C: tl.constexpr,
    CHANNELS: tl.constexpr,
    CHUNK: tl.constexpr,
    PART: tl.constexpr,
    NODES: tl.constexpr,
) -> None:
    chunk, level, axis = tl.program_id(0), tl.program_id(1) // 3, tl.program_id(1) % 3
    nodes = tl.load(places + PLACES * level + NODE_COUNTS + axis)
    node = tl.program_id(2) * NODES + tl.arange(0, NODES)
    channel = tl.arange(0, CHANNELS)
    total, weight = tl.zeros([NODES, CHANNELS], tl.float32), tl.zeros([NODES], tl.float32)
    for start in range(chunk * CHUNK, tl.minimum((chunk + 1) * CHUNK, count), PART):
        point = (start + tl.arange(0, PART)).to(tl.int64)
        takes_part = tl.load(active + point, point < count, other=0) != 0
        coordinate = tl.load(points + 3 * point + axis, takes_part, other=0.0)
        cell, fraction, _ = _place(
            coordinate, tl.load(box + axis), tl.load(box + 3 + 3 * level + axis), nodes
        )
        offset = node[:, None] - cell[None, :]
        hats = tl.where(offset == 0, 1.0 - fraction[None, :], tl.where(offset == 1, fraction[None, :], 0.0))
        hats = tl.where(takes_part[None, :], hats, 0.0)
        at = records + (tl.program_id(1) * count.to(tl.int64) + point)[:, None] * C + channel[None, :]
        record = tl.load(at, takes_part[:, None] & (channel < C)[None, :], other=0.0)
        # a product takes every point to every node: what is not finite would reach all of them
        record = tl.where(tl.abs(record) < INFINITY, record, 0.0)
        total += tl.dot(hats, record, input_precision="ieee")
        weight += tl.sum(hats, axis=1)
    row = chunk.to(tl.int64) * slot_rows + tl.load(places + PLACES * level + LINE_ROWS + axis) + node
    ok = (node < nodes)[:, None] & (channel < C)[None, :]
    tl.store(v_lines + row[:, None] * C + channel[None, :], total, ok)
    tl.store(weights + row, weight, node < nodes)


_CHANNELS = {"C": 32, "CHANNELS": 32}
_ODD_CHANNELS = {"C": 48, "CHANNELS": 64}
_FIELD = {
    **dict.fromkeys(("points", "cells", "lines", "box"), "*fp32"),
    "places": "*i32",
}
SIGNATURES = (
    Compiled(
        sample,
        {**_FIELD, "features": "*fp32", "count": "i32"},
        {"LEVELS": 2, **_CHANNELS, "POINTS": POINTS},
    ),
    *(
        Compiled(
            differentiate,
            {
                **_FIELD,
                **dict.fromkeys(("v_features", "plane_records", "line_records"), "*fp32"),
                "keys": "*i32",
                "active": "*i1",
                "v_points": "*fp32",
                **dict.fromkeys(("count", "nowhere"), "i32"),
            },
            {"LEVELS": 2, **channels, "POINTS": POINTS},
        )
        for channels in (_CHANNELS, _ODD_CHANNELS)
    ),
    Compiled(
        add_planes,
        {
            **dict.fromkeys(("points", "records"), "*fp32"),
            **dict.fromkeys(("order", "starts"), "*i64"),
            "box": "*fp32",
            "places": "*i32",
            "v_cells": "*fp32",
            "touched": "*i1",
            "count": "i32",
        },
        {"LEVELS": 2, **_CHANNELS, "POINTS": POINTS},
    ),
    Compiled(
        add_lines,
        {
            **dict.fromkeys(("points", "records"), "*fp32"),
            "active": "*i1",
            "box": "*fp32",
            "places": "*i32",
            **dict.fromkeys(("v_lines", "weights"), "*fp32"),
            **dict.fromkeys(("count", "slot_rows"), "i32"),
        },
        {**_CHANNELS, "CHUNK": CHUNK, "PART": PART, "NODES": NODES},
    ),
)
