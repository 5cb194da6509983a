"""The arithmetic of the HexPlane field, forward and backward; `hexplane` says what it computes.

One point on one level takes 12 rows of cells (four corners on each of three planes in space) and 6 rows of
the lines (two nodes on each axis). The planes that hold time have become lines before: all points share one
time.

The gradient of a cell is a sum over the points around it. To add in an order that does not depend on the
number of threads, without atomics, a cell's row has one writer: each plane is cut into stretches of `LANES`
channels, and a task adds all points, in order, to one stretch of one plane. The lines are short: each chunk
of points adds to lines of its own, and these are summed in the order of the chunks.

Inner loops pass arrays to intrinsics only: a Numba function that branches counts the references of the arrays
it is given, inlined or not, with an atomic instruction of some 5 ns each.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from sags_node.engine.field.lanes import make_add_lanes, read_input, write_output
from sags_node.kernels.jit import inlined, kernel, parallel_kernel
from sags_node.types import F32, I64, U8

f4 = np.float32
u8 = np.uint64
ZERO, ONE = f4(0.0), f4(1.0)

LANES = 16  # channels that an inner loop takes: a constant length leaves no remainder loop
CHUNK = 256  # points that add to lines of their own
BLOCK = 2048  # points whose gradients are kept at a time: more would leave the cache
RECORDS = (
    BLOCK * LANES + LANES
)  # floats from one task's records to the next; streams 4 KiB apart evict each other
X, Y, Z = 0, 1, 2
XY, XZ, YZ = 0, 1, 2
OUTER, INNER = (Y, X, Y), (X, Z, Z)  # axes along which these planes' rows and columns are counted

# origin [3] m; then all [levels, 3]: nodes per metre, nodes, first row of each plane in space, first row
# within a slot of each axis' line
Tables = tuple[F32, F32, I64, I64, I64]


_add_lanes = make_add_lanes(LANES)


@inlined
def _place(coordinate: Any, origin: Any, per_metre: Any, nodes: Any) -> Any:
    """Cell that holds a coordinate, and the fraction of the way through it; outside or NaN: at the border."""
    u = (coordinate - origin) * per_metre
    u = u if u > ZERO else ZERO
    last = f4(nodes - 1)
    u = u if u < last else last
    cell = min(np.int64(u), nodes - 2)
    return cell, u - f4(cell)


@inlined
def _slope(coordinate: Any, origin: Any, per_metre: Any, nodes: Any) -> Any:
    """Derivative of cell + fraction; 0 from the border outwards."""
    u = (coordinate - origin) * per_metre
    return per_metre if u > ZERO and u < f4(nodes - 1) else ZERO


@inlined
def _linear(cells: F32, at: Any, step: Any, fraction: Any) -> Any:
    a, b = read_input(cells, at), read_input(cells, at + step)
    return a + fraction * (b - a), b - a


@kernel
def _sample(
    points: F32, first: int, last: int, cells: F32, lines: F32, channels: int, tables: Tables, features: F32
) -> None:
    """Features of the points first..last - 1."""
    origin, per_metre, nodes, plane_rows, line_rows = tables
    levels = len(nodes)
    step = u8(channels)
    for i in range(first, last):
        for level in range(levels):
            nx, nz = nodes[level, X], nodes[level, Z]
            x, fx = _place(points[i, X], origin[X], per_metre[level, X], nx)
            y, fy = _place(points[i, Y], origin[Y], per_metre[level, Y], nodes[level, Y])
            z, fz = _place(points[i, Z], origin[Z], per_metre[level, Z], nz)
            xy = u8((plane_rows[level, XY] + y * nx + x) * channels)
            xz = u8((plane_rows[level, XZ] + x * nz + z) * channels)
            yz = u8((plane_rows[level, YZ] + y * nz + z) * channels)
            xt = u8((line_rows[level, X] + x) * channels)
            yt = u8((line_rows[level, Y] + y) * channels)
            zt = u8((line_rows[level, Z] + z) * channels)
            xy_up, z_up = u8(nx * channels), u8(nz * channels)
            out = u8((i * levels + level) * channels)
            for block in range(channels // LANES):
                for lane in range(LANES):
                    c = u8(block * LANES) + u8(lane)
                    low, _ = _linear(cells, xy + c, step, fx)
                    high, _ = _linear(cells, xy + xy_up + c, step, fx)
                    value = low + fy * (high - low)
                    low, _ = _linear(cells, xz + c, step, fz)
                    high, _ = _linear(cells, xz + z_up + c, step, fz)
                    value *= low + fx * (high - low)
                    low, _ = _linear(cells, yz + c, step, fz)
                    high, _ = _linear(cells, yz + z_up + c, step, fz)
                    value *= low + fy * (high - low)
                    at_x, _ = _linear(lines, xt + c, step, fx)
                    at_y, _ = _linear(lines, yt + c, step, fy)
                    at_z, _ = _linear(lines, zt + c, step, fz)
                    write_output(features, out + c, value * at_x * at_y * at_z)


@parallel_kernel
def sample(points: F32, cells: F32, lines: F32, channels: int, tables: Tables, features: F32) -> None:
    """Write features [N * levels * C] of points [N, 3]. `cells` [M * C] and `lines` [R * C] are flat."""
    count = len(points)
    for chunk in numba.prange((count + CHUNK - 1) // CHUNK):
        _sample(
            points, chunk * CHUNK, min((chunk + 1) * CHUNK, count), cells, lines, channels, tables, features
        )


@kernel
def _open(rows: F32, touched: U8, row: int, to: Any, length: int) -> None:
    """Mark a row as touched and clear it: its first addend must not find what an earlier call left there."""
    touched[row] = 1
    for c in range(length):
        rows[to + u8(c)] = ZERO


@kernel
def _differentiate(
    points: F32, first: int, last: int, cells: F32, lines: F32, channels: int, tables: Tables,
    v_features: F32, records: F32, v_lines: F32, touched: U8, active: U8, v_points: F32,
) -> None:  # fmt: skip
    """Points first..last - 1: their own gradient, what each plane in space has to add to its cells
    (`records`), and the sums over these points for the lines, whose last three rows are scratch."""
    origin, per_metre, nodes, plane_rows, line_rows = tables
    levels, blocks = len(nodes), channels // LANES
    step, plane = u8(channels), u8(blocks * RECORDS)
    scratch = u8(len(touched) * channels)
    for i in range(first, last):
        size = ZERO
        for k in range(levels * channels):
            size += abs(read_input(v_features, u8(i * levels * channels) + u8(k)))
        active[i] = size != ZERO
        v_x = v_y = v_z = ZERO
        if size != ZERO:
            for level in range(levels):
                nx, ny, nz = nodes[level, X], nodes[level, Y], nodes[level, Z]
                x, fx = _place(points[i, X], origin[X], per_metre[level, X], nx)
                y, fy = _place(points[i, Y], origin[Y], per_metre[level, Y], ny)
                z, fz = _place(points[i, Z], origin[Z], per_metre[level, Z], nz)
                xy = u8((plane_rows[level, XY] + y * nx + x) * channels)
                xz = u8((plane_rows[level, XZ] + x * nz + z) * channels)
                yz = u8((plane_rows[level, YZ] + y * nz + z) * channels)
                xt = u8((line_rows[level, X] + x) * channels)
                yt = u8((line_rows[level, Y] + y) * channels)
                zt = u8((line_rows[level, Z] + z) * channels)
                xy_up, z_up = u8(nx * channels), u8(nz * channels)
                g = u8((i * levels + level) * channels)
                by_x = by_y = by_z = ZERO
                for block in range(blocks):
                    to_xy = u8((level * 3 * blocks + block) * RECORDS + i * LANES)
                    for lane in range(LANES):
                        c = u8(block * LANES) + u8(lane)
                        low, right = _linear(cells, xy + c, step, fx)
                        high, right_up = _linear(cells, xy + xy_up + c, step, fx)
                        xy_y = high - low
                        xy_x = right + fy * (right_up - right)
                        at_xy = low + fy * xy_y
                        low, right = _linear(cells, xz + c, step, fz)
                        high, right_up = _linear(cells, xz + z_up + c, step, fz)
                        xz_x = high - low
                        xz_z = right + fx * (right_up - right)
                        at_xz = low + fx * xz_x
                        low, right = _linear(cells, yz + c, step, fz)
                        high, right_up = _linear(cells, yz + z_up + c, step, fz)
                        yz_y = high - low
                        yz_z = right + fy * (right_up - right)
                        at_yz = low + fy * yz_y
                        at_x, xt_x = _linear(lines, xt + c, step, fx)
                        at_y, yt_y = _linear(lines, yt + c, step, fy)
                        at_z, zt_z = _linear(lines, zt + c, step, fz)
                        in_time = read_input(v_features, g + c) * at_x * at_y * at_z
                        v_xy = in_time * at_xz * at_yz
                        v_xz = in_time * at_xy * at_yz
                        v_yz = in_time * at_xy * at_xz
                        in_space = read_input(v_features, g + c) * at_xy * at_xz * at_yz
                        v_xt = in_space * at_y * at_z
                        v_yt = in_space * at_x * at_z
                        v_zt = in_space * at_x * at_y
                        by_x += v_xy * xy_x + v_xz * xz_x + v_xt * xt_x
                        by_y += v_xy * xy_y + v_yz * yz_y + v_yt * yt_y
                        by_z += v_xz * xz_z + v_yz * yz_z + v_zt * zt_z
                        write_output(records, to_xy + u8(lane), v_xy)
                        write_output(records, to_xy + plane + u8(lane), v_xz)
                        write_output(records, to_xy + plane + plane + u8(lane), v_yz)
                        write_output(v_lines, scratch + c, v_xt)
                        write_output(v_lines, scratch + step + c, v_yt)
                        write_output(v_lines, scratch + step + step + c, v_zt)
                v_x += _slope(points[i, X], origin[X], per_metre[level, X], nx) * by_x
                v_y += _slope(points[i, Y], origin[Y], per_metre[level, Y], ny) * by_y
                v_z += _slope(points[i, Z], origin[Z], per_metre[level, Z], nz) * by_z
                for end in range(6):  # the two nodes around the point on the lines of x, y and z
                    axis, side = end // 2, end % 2
                    row = line_rows[level, axis] + side + (x if axis == X else y if axis == Y else z)
                    weight = fx if axis == X else fy if axis == Y else fz
                    weight = weight if side == 1 else ONE - weight
                    if weight != ZERO:
                        line, values = u8(row) * step, scratch + u8(axis) * step
                        if touched[row] == 0:
                            _open(v_lines, touched, row, line, channels)
                        for first_lane in range(0, channels, LANES):
                            c = u8(first_lane)
                            _add_lanes(v_lines, line + c, weight, v_lines, values + c)
        v_points[i, X], v_points[i, Y], v_points[i, Z] = v_x, v_y, v_z


@kernel
def _add_plane(
    points: F32, active: U8, level: int, plane: int, block: int, blocks: int, records: F32, tables: Tables,
    v_cells: F32, touched: U8,
) -> None:  # fmt: skip
    """Add the points' records to the cells of one plane, `LANES` of the channels."""
    origin, per_metre, nodes, plane_rows = tables[0], tables[1], tables[2], tables[3]
    outer, inner = OUTER[plane], INNER[plane]
    columns = nodes[level, inner]
    for i in range(len(points)):
        if active[i]:
            v, fv = _place(points[i, outer], origin[outer], per_metre[level, outer], nodes[level, outer])
            u, fu = _place(points[i, inner], origin[inner], per_metre[level, inner], columns)
            first = plane_rows[level, plane] + v * columns + u
            at = u8(((level * 3 + plane) * blocks + block) * RECORDS + i * LANES)
            for corner in range(4):
                row = first + corner % 2 + (columns if corner >= 2 else 0)
                weight = (fu if corner % 2 == 1 else ONE - fu) * (fv if corner >= 2 else ONE - fv)
                if weight != ZERO:
                    to = u8((row * blocks + block) * LANES)
                    if touched[row] == 0:
                        _open(v_cells, touched, row, to, LANES)
                    _add_lanes(v_cells, to, weight, records, at)


@parallel_kernel
def differentiate(
    points: F32,  # [N, 3]
    cells: F32,  # [M * C]
    lines: F32,  # [R * C]
    channels: int,
    tables: Tables,
    v_features: F32,  # [N, levels * C]
    records: F32,  # [levels * 3 * C / LANES * RECORDS] scratch
    active: U8,  # [BLOCK] scratch
    v_lines: F32,  # [BLOCK / CHUNK, (R + 3) * C] sums of chunks, left in the rows that are touched
    lines_touched: U8,  # [BLOCK / CHUNK, R] set
    v_cells: F32,  # [M * C] the planes in space, written where touched
    touched: U8,  # [C / LANES, M] set
    v_points: F32,  # [N, 3] written
) -> None:
    levels, blocks = len(tables[2]), channels // LANES
    for first in range(0, len(points), BLOCK):
        count = min(BLOCK, len(points) - first)
        part, v_part = points[first : first + count], v_features[first : first + count].reshape(-1)
        for chunk in numba.prange((count + CHUNK - 1) // CHUNK):
            _differentiate(
                part, chunk * CHUNK, min((chunk + 1) * CHUNK, count), cells, lines, channels, tables, v_part,
                records, v_lines[chunk], lines_touched[chunk], active, v_points[first : first + count],
            )  # fmt: skip
        for task in numba.prange(levels * 3 * blocks):
            _add_plane(
                part, active, task // (3 * blocks), task // blocks % 3, task % blocks, blocks, records,
                tables, v_cells, touched[task % blocks],
            )  # fmt: skip


@kernel
def _share_line(
    v_lines: F32, lines_touched: U8, row: int, slot_rows: I64, weights: F32, channels: int, v_cells: F32,
    touched: U8,
) -> None:  # fmt: skip
    at = u8(row * channels)
    for chunk in range(1, len(v_lines)):
        if lines_touched[chunk, row]:
            if not lines_touched[0, row]:
                _open(v_lines[0], lines_touched[0], row, at, channels)
            for c in range(0, channels, LANES):
                _add_lanes(v_lines[0], at + u8(c), ONE, v_lines[chunk], at + u8(c))
    for side in range(2):
        if lines_touched[0, row] and weights[side] != ZERO:
            to = slot_rows[side] + row
            touched[to] = 1
            for c in range(channels):
                v_cells[u8(to * channels) + u8(c)] = weights[side] * v_lines[0, at + u8(c)]


@parallel_kernel
def share_lines(
    v_lines: F32,  # [chunks, (R + 3) * C] of `differentiate`
    lines_touched: U8,  # [chunks, R]
    slot_rows: I64,  # [2] first row of the two slots; for a weight of 0 it does not matter
    weights: F32,  # [2] of the slots
    channels: int,
    v_cells: F32,  # [M * C] written in the two slots
    touched: U8,  # [M] set there
) -> None:
    """Sum the chunks' lines and share the sums between the slots."""
    for row in numba.prange(lines_touched.shape[1]):
        _share_line(v_lines, lines_touched, row, slot_rows, weights, channels, v_cells, touched)


@kernel
def list_touched(touched: U8, rows: I64) -> int:
    """Write the rows that are touched, in order, and clear the marks; returns how many."""
    count = 0
    for row in range(len(touched)):
        rows[count] = row  # overwritten by the next if this one is not touched: no branch to mispredict
        count += touched[row]
    touched[:] = 0
    return count
