"""Look a picture up where the tissue of each pixel was, and blend what is there into a view.

A view's pixel at depth z is a point of tissue. Less its motion since the source's moment, in the source's
camera, that point falls on a pixel of the source's picture. It counts where the source showed tissue, and
where the surface that it showed was as deep.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numba import prange
from numpy.typing import NDArray

from sags_node.detail.seen import SAME, SeenFrame
from sags_node.geometry import scale_intrinsics
from sags_node.kernels.jit import kernel, parallel_kernel, read_only
from sags_node.types import F32, I32, U8, Camera

EVERYWHERE = np.ones((1, 1), np.uint8)
NO_GAIN = np.ones(3, np.float32)
_NOTHING = np.zeros((4, 1, 1), np.float32)
NEAREST = 1e-3  # m: no tissue is nearer
COARSE = 8  # px
LEAST_KNOWN = 0.5  # coarse pixels of 25 around a hole, to fill it
COVERED = 0.3  # by Gaussians whose motion is known
U32 = NDArray[np.uint32]
f4 = np.float32
u8 = np.uint64


def carry(
    shown: U8,
    depth: F32,
    camera: Camera,
    source: SeenFrame,
    picture: U8,
    motion: F32 | None,
    weight: U8,
    taken: U8,
    unsure: float = 0.0,
    gain: F32 = NO_GAIN,
    wanted: U8 = EVERYWHERE,
    tint: F32 | None = None,
    holes: bool = False,
) -> None:
    """Blend the picture of a source into a view.

    Args:
        shown: [H, W, 3] RGB of the view; written.
        depth: [h, w] m of the view, of any size; 0 unknown: nothing is carried there.
        camera: of the view, with the size of `shown`.
        picture: [H', W', 3] RGB of the source, in any size.
        motion: [4, m, n] of `SmallDrawings.motion`; None: nothing has moved.
        weight: [h', w'] 0..255, of the source's working size: the carried picture's share, 0 where the source
            shows no tissue.
        taken: [H, W] the share that each pixel got, 0..255; written. Pixels that have one already stay.
        unsure: of each pixel that the tissue has moved, so many are doubtful: the share falls with them.
        gain: [3] factor that brings the source's light to that of the view.
        wanted: of any size: 0 where the view is to stay as it is.
        holes: where the model tells no depth or motion, and the cameras are one, take the picture unmoved.
        tint: [4, m, n] of `SmallDrawings`: added to what is carried, in the place of colours 0..1.
    """
    height, width = taken.shape
    T = (source.camera.viewmat @ camera.T_world_cam).astype(f4)
    size = source.camera.width, source.camera.height
    K = scale_intrinsics(source.camera.K, size, (picture.shape[1], picture.shape[0]))
    rays = np.array([1 / camera.K[0, 0], camera.K[0, 2], 1 / camera.K[1, 1], camera.K[1, 2]], f4)
    eye = np.array([K[0, 0], K[0, 2], K[1, 1], K[1, 2]], f4)
    moved, tinted = motion is not None, tint is not None
    same_place = bool(np.abs(T - np.eye(4, dtype=f4)).max() < 1e-7)
    unknown = f4(-1) if same_place and holes else f4(0)
    _carry(
        shown, read_only(_filled(depth)), rays, T, eye, _packed(picture), weight * f4(1 / 255),
        read_only(source.depth),
        _NOTHING if motion is None else motion, moved, unknown,
        _NOTHING if tint is None else tint, tinted,
        gain, f4(unsure), read_only(wanted), taken, height, width,
    )  # fmt: skip


def _packed(picture: U8) -> U32:
    """RGB [H, W, 3] as one number for each pixel [H, W]: one look-up in the place of three."""
    packed = cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA).view(np.uint32)[..., 0]
    return read_only(packed)


def _filled(depth: F32) -> F32:
    """Depth with its small holes filled from around: where few Gaussians show, tissue shows all the same."""
    if depth.all():
        return depth
    size = max(1, depth.shape[1] // COARSE), max(1, depth.shape[0] // COARSE)
    sums = cv2.boxFilter(cv2.resize(depth, size, interpolation=cv2.INTER_AREA), -1, (5, 5), normalize=False)
    known = cv2.resize((depth > 0).astype(f4), size, interpolation=cv2.INTER_AREA)
    counts = cv2.boxFilter(known, -1, (5, 5), normalize=False)
    coarse = np.divide(sums, counts, out=np.zeros_like(sums), where=counts > LEAST_KNOWN)
    around = cv2.resize(coarse, depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.where(depth > 0, depth, around)


@parallel_kernel
def _carry(
    shown: U8, depth: F32, rays: F32, T: F32, eye: F32, picture: U32, weight: F32, source_depth: F32,
    motion: F32, moved: Any, unknown: Any, tint: F32, tinted: Any, gain: F32, unsure: Any, wanted: U8,
    taken: U8, height: Any, width: Any,
) -> None:  # fmt: skip
    for row in prange(height):
        y = np.int64(row)
        _carry_row(
            y, shown[y].reshape(-1), depth, rays, T, eye, picture, weight, source_depth, motion, moved,
            unknown, tint, tinted, gain, unsure, wanted, taken[y], height, width,
        )  # fmt: skip


@kernel
def _carry_row(
    y: Any, shown: U8, depth: F32, rays: F32, T: F32, eye: F32, picture: U32, weight: F32, source_depth: F32,
    motion: F32, moved: Any, unknown: Any, tint: F32, tinted: Any, gain: F32, unsure: Any, wanted: U8,
    taken: U8, height: Any, width: Any,
) -> None:  # fmt: skip
    asked = wanted[y * len(wanted) // height]
    part = np.empty(width, f4)  # whether anything is wanted of a pixel, then the share of the picture
    some, step = f4(0), f4(len(asked)) / f4(width)
    for x in range(u8(width)):
        free = f4(1) if asked[u8(np.int32(f4(np.int32(x)) * step))] > 0 and taken[x] == 0 else f4(0)
        part[x] = free
        some += free
    if some == f4(0):
        return
    depths = depth[y * len(depth) // height]
    columns, rows, deep = np.empty(width, f4), np.empty(width, f4), np.empty(width, f4)
    lag = np.zeros(width, f4)
    _places(y, depths, rays, T, eye, columns, rows, deep, unknown)
    if moved:
        _less_motion(y, motion, eye, columns, rows, deep, lag, unknown, height, width)
    added = np.zeros((3, width), f4)
    if tinted:
        _tints(y, tint, added, height, width)
    cells, corners = np.empty(width, np.int32), np.empty(width, np.int32)
    _look_up(columns, rows, deep, picture.shape, weight.shape, cells, corners, part)
    _weigh(cells, deep, lag, weight.reshape(-1), source_depth.reshape(-1), unsure, part)
    _mix(corners, columns, rows, picture.reshape(-1), picture.shape[1], added, gain, part, shown, taken)


@kernel
def _places(
    y: Any, depths: F32, rays: F32, T: F32, eye: F32, columns: F32, rows: F32, deep: F32, unknown: Any
) -> None:
    """Where the points of a row fall in the source's picture, and how deep they are in its camera; `unknown`
    where the model tells no depth: 0 nothing is carried, -1 it is taken as it is."""
    width = len(columns)
    ray_y, step = (f4(y) - rays[3]) * rays[2], f4(len(depths)) / f4(width)
    for x in range(u8(width)):
        deep[x] = depths[u8(np.int32((f4(np.int32(x)) + f4(0.5)) * step))]
    if unknown < f4(0):
        scale_x, scale_y = eye[0] * rays[0], eye[2] * rays[2]
        v = (f4(y) - rays[3]) * scale_y + eye[3]
        for x in range(u8(width)):
            columns[x] = (f4(np.int32(x)) - rays[1]) * scale_x + eye[1]
            rows[x] = v
            deep[x] = deep[x] if deep[x] > f4(0) else unknown
        return
    for x in range(u8(width)):
        ray_x, z = (f4(np.int32(x)) - rays[1]) * rays[0], deep[x]
        a = z * (T[0, 0] * ray_x + T[0, 1] * ray_y + T[0, 2]) + T[0, 3]
        b = z * (T[1, 0] * ray_x + T[1, 1] * ray_y + T[1, 2]) + T[1, 3]
        c = z * (T[2, 0] * ray_x + T[2, 1] * ray_y + T[2, 2]) + T[2, 3]
        inverse = f4(1) / max(c, f4(NEAREST))
        columns[x] = eye[0] * a * inverse + eye[1]
        rows[x] = eye[2] * b * inverse + eye[3]
        deep[x] = c if z > f4(0) else f4(0)


@kernel
def _between(y: Any, small: Any, height: Any) -> Any:
    """The two of `small` rows between which row y of `height` lies, and the part of the later one."""
    at = min(max((f4(y) + f4(0.5)) * f4(small) / f4(height) - f4(0.5), f4(0)), f4(small - 1))
    first = np.int64(at)
    return first, min(first + 1, small - 1), at - f4(first)


@kernel
def _less_motion(
    y: Any,
    motion: F32,
    eye: F32,
    columns: F32,
    rows: F32,
    deep: F32,
    lag: F32,
    unknown: Any,
    height: Any,
    width: Any,
) -> None:
    """Takes the motion off the places, and says how many px that was; `unknown` as `_places` has it."""
    few = motion.shape[2]
    first, second, part = _between(y, motion.shape[1], height)
    line = np.empty((4, few + 1), f4)
    for k in range(4):
        for n in range(few):
            line[k, n] = motion[k, first, n] + part * (motion[k, second, n] - motion[k, first, n])
        line[k, few] = line[k, few - 1]
    step = f4(few) / f4(width)
    for x in range(u8(width)):
        at = min(max((f4(np.int32(x)) + f4(0.5)) * step - f4(0.5), f4(0)), f4(few - 1))
        i = u8(np.int32(at))
        t = at - f4(np.int32(i))
        j = i + u8(1)
        a = line[0, i] + t * (line[0, j] - line[0, i])
        b = line[1, i] + t * (line[1, j] - line[1, i])
        c = line[2, i] + t * (line[2, j] - line[2, i])
        known = line[3, i] + t * (line[3, j] - line[3, i])
        z = deep[x]
        was = max(z - c, f4(NEAREST))
        says = z > f4(0) and known > f4(COVERED)
        u = ((columns[x] - eye[1]) * z - eye[0] * a) / was + eye[1] if says else columns[x]
        v = ((rows[x] - eye[3]) * z - eye[2] * b) / was + eye[3] if says else rows[x]
        lag[x] = max(abs(u - columns[x]), abs(v - rows[x]))
        columns[x], rows[x] = u, v
        deep[x] = was if says else unknown


@kernel
def _tints(y: Any, tint: F32, added: F32, height: Any, width: Any) -> None:
    few = tint.shape[2]
    first, second, part = _between(y, tint.shape[1], height)
    step = f4(few) / f4(width)
    for k in range(3):
        for x in range(u8(width)):
            at = min(max((f4(np.int32(x)) + f4(0.5)) * step - f4(0.5), f4(0)), f4(few - 1))
            i = np.int64(at)
            j = min(i + 1, few - 1)
            t = at - f4(i)
            above = tint[k, first, i] + t * (tint[k, first, j] - tint[k, first, i])
            below = tint[k, second, i] + t * (tint[k, second, j] - tint[k, second, i])
            added[k, x] = f4(255) * (above + part * (below - above))


@kernel
def _look_up(
    columns: F32, rows: F32, deep: F32, size: Any, few: Any, cells: I32, corners: I32, part: F32
) -> None:
    """The cells of places in the source's working size, and the upper left of the four pixels around them,
    from which `columns` and `rows` count afterwards. Those outside lose their part."""
    high, wide = size
    down, across = f4(few[0]) / f4(high), f4(few[1]) / f4(wide)
    last_x, last_y = f4(wide - 1), f4(high - 1)
    for x in range(u8(len(part))):
        u, v = columns[x], rows[x]
        inside = deep[x] != f4(0) and u > f4(-0.5) and v > f4(-0.5)
        inside = inside and u < last_x + f4(0.5) and v < last_y + f4(0.5)
        part[x] = part[x] if inside else f4(0)
        u, v = u if inside else f4(0), v if inside else f4(0)
        u, v = min(max(u, f4(0)), last_x), min(max(v, f4(0)), last_y)
        i = min(np.int32((v + f4(0.5)) * down), np.int32(few[0] - 1))
        j = min(np.int32((u + f4(0.5)) * across), np.int32(few[1] - 1))
        cells[x] = i * np.int32(few[1]) + j
        left, top = min(np.int32(u), np.int32(wide - 2)), min(np.int32(v), np.int32(high - 2))
        corners[x] = top * np.int32(wide) + left
        columns[x], rows[x] = u - f4(left), v - f4(top)


@kernel
def _weigh(cells: I32, deep: F32, lag: F32, weight: F32, source_depth: F32, unsure: Any, part: F32) -> None:
    """The share of each pixel: by the source, less with doubtful motion, none on another surface."""
    for x in range(u8(len(part))):
        at, z = u8(cells[x]), deep[x]
        was, doubt = source_depth[at], unsure * lag[x]
        same = z < f4(0) or was == f4(0) or abs(was - z) < f4(SAME) * z
        share = part[x] * weight[at] / (f4(1) + doubt * doubt)
        part[x] = share if same and share >= f4(1 / 255) else f4(0)


@kernel
def _mix(
    corners: I32, columns: F32, rows: F32, picture: U32, wide: Any, added: F32, gain: F32, part: F32,
    shown: U8, taken: U8,
) -> None:  # fmt: skip
    below, low = u8(wide), np.uint32(255)
    for x in range(u8(len(part))):
        at, s, t = u8(corners[x]), columns[x], rows[x]
        a, b = picture[at], picture[at + u8(1)]
        c, d = picture[at + below], picture[at + below + u8(1)]
        e, f, g, h = (f4(1) - s) * (f4(1) - t), s * (f4(1) - t), (f4(1) - s) * t, s * t
        red = e * f4(a & low) + f * f4(b & low) + g * f4(c & low) + h * f4(d & low)
        a, b, c, d = a >> np.uint32(8), b >> np.uint32(8), c >> np.uint32(8), d >> np.uint32(8)
        green = e * f4(a & low) + f * f4(b & low) + g * f4(c & low) + h * f4(d & low)
        a, b, c, d = a >> np.uint32(8), b >> np.uint32(8), c >> np.uint32(8), d >> np.uint32(8)
        blue = e * f4(a & low) + f * f4(b & low) + g * f4(c & low) + h * f4(d & low)
        added[0, x] += gain[0] * red
        added[1, x] += gain[1] * green
        added[2, x] += gain[2] * blue
    for x in range(u8(len(part))):
        share = part[x]
        for c in range(u8(3)):
            drawn = f4(shown[u8(3) * x + c])
            mixed = min(max(drawn + share * (added[c, x] - drawn), f4(0)), f4(255))
            shown[u8(3) * x + c] = np.uint8(np.int32(mixed + f4(0.5)))
    for x in range(u8(len(part))):
        own = np.uint8(np.int32(f4(255) * part[x] + f4(0.5)))
        taken[x] = own if own > np.uint8(0) else taken[x]
