"""Look a picture up where the tissue of each pixel was, and blend what is there into a view.

A view's pixel at depth z is a point of tissue. Less its motion since the source's moment, in the source's
camera, that point falls on a pixel of the source's picture. It counts where the source showed tissue, and
where the surface that it showed was as deep. That place changes slowly over a view: it is worked out for
every fourth pixel along both axes (`trace`), and lies on straight lines between. What the picture shows there
is looked up for each pixel (`carry`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import prange

from sags_node.detail.seen import SAME, SeenFrame
from sags_node.geometry import resized_camera, scale_intrinsics
from sags_node.kernels.jit import inlined, kernel, parallel_kernel, read_only
from sags_node.types import F32, U8, U32, Camera

EVERY = 4  # px of the view
EVERYWHERE = np.ones((1, 1), np.uint8)
WHOLLY = np.ones((1, 1), np.float32)
NO_GAIN = np.ones(3, np.float32)
NEAREST = 1e-3  # m: no tissue is nearer
AROUND = (9, 9)  # of the places, from which a hole is filled
LEAST_KNOWN = 0.5  # of them, to fill it
COVERED = 0.3  # by Gaussians whose motion is known
NOWHERE = -1e6  # px
FINDINGS = 3  # of a ray's place in the source, each from where the last one met its surface
LITTLE = 3.0  # px of motion from one frame to the next: depths at edges differ by more than SAME all the same
ONE, HALF = 1 << 16, 1 << 15
TISSUE = np.uint32(0xFF000000)
_LANES = np.uint64(0x00FF00FF00FF00FF)
_ROUND = np.uint64(0x0080008000800080)
_STILL = np.zeros((4, 1, 1), np.float32)
f4 = np.float32
u8 = np.uint64


def coarse_camera(camera: Camera) -> Camera:
    """The camera whose pixels are the middles of 4 x 4 pixels of another's, also across its far edges."""
    width, height = -(-camera.width // EVERY), -(-camera.height // EVERY)
    whole = Camera(EVERY * width, EVERY * height, camera.K, camera.T_world_cam)
    return resized_camera(whole, width, height)


@dataclass(frozen=True, slots=True)
class Trace:
    """Where a view's tissue was in a source's picture: for the pixels of `coarse_camera`, and one more
    on each side."""

    places: F32  # [m + 2, n + 2, 2] u and v, px of the picture; `NOWHERE`: not in it
    share: U8  # [m + 2, n + 2] 0..255 of the picture in the view


def every_fourth(depth: F32, small: Camera) -> F32:
    """Depth [h, w] of a view for its coarse camera, small holes filled from around: where few Gaussians show,
    tissue shows all the same."""
    height, width = depth.shape
    rows = ((2 * np.arange(small.height) + 1) * height) // (2 * small.height)
    columns = ((2 * np.arange(small.width) + 1) * width) // (2 * small.width)
    found: F32 = depth[rows[:, None], columns]
    if found.all():
        return found
    known = (found > 0).astype(f4)
    sums, counts = (cv2.blur(plane, AROUND) for plane in (found, known))
    np.divide(sums, counts, out=found, where=(found <= 0) & (counts > LEAST_KNOWN))
    return found


def trace(
    depth: F32, small: Camera, source: SeenFrame, lent: U8, motion: F32 | None, tiles: F32 = WHOLLY,
    unsure: float = 0.0, steady: bool = False, wanted: U8 = EVERYWHERE,
) -> Trace:  # fmt: skip
    """Find where the tissue of a view was in a source's picture.

    Args:
        depth: [m, n] m of the view, as `every_fourth` has it; 0 unknown.
        small: the coarse camera of the view.
        lent: [H', W', 4] of `SeenFrame.lent`.
        motion: [4, m, n] of `SmallDrawings.motion`; None: nothing has moved.
        tiles: [rows, columns] 0..1 over the source's picture: the share that it deserves.
        unsure: of each pixel that the tissue has moved, so many are doubtful: the share falls with them.
        steady: it is a moment ago. If the cameras are one, too, the surface is the same where tissue moved
            little, and where the model tells no depth or motion the picture is taken unmoved.
        wanted: [m, n] 0 where nothing is to be carried, nor beside it.
    """
    T = source.camera.viewmat @ small.T_world_cam
    size = lent.shape[1::-1]
    K = scale_intrinsics(source.camera.K, (source.camera.width, source.camera.height), size)
    rays = np.array([1 / small.K[0, 0], small.K[0, 2], 1 / small.K[1, 1], small.K[1, 2]], f4)
    eye = np.array([K[0, 0], K[0, 2], K[1, 1], K[1, 2], *size], f4)
    unmoved = bool(steady and np.abs(T - np.eye(4)).max() < 1e-7)
    places = np.empty((small.height + 2, small.width + 2, 2), f4)
    share = np.empty(places.shape[:2], np.uint8)
    surface = source.depth if unmoved else source.surface
    _trace(
        read_only(depth), rays, T.astype(f4), eye, _STILL if motion is None else motion, motion is not None,
        unmoved, read_only(surface), read_only(tiles), f4(unsure), read_only(wanted), places, share,
    )  # fmt: skip
    return Trace(places, share)


@parallel_kernel
def _trace(
    depth: F32, rays: F32, T: F32, eye: F32, motion: F32, moved: Any, unmoved: Any, source_depth: F32,
    tiles: F32, unsure: Any, wanted: U8, places: F32, share: U8,
) -> None:  # fmt: skip
    for row in prange(len(places)):
        y = np.int64(row)
        _trace_row(
            y, depth, rays, T, eye, motion, moved, unmoved, source_depth, tiles, unsure,
            wanted[min(max(y - 1, np.int64(0)), np.int64(len(wanted) - 1))], places[y], share[y],
        )  # fmt: skip


@kernel
def _trace_row(
    y: Any, depth: F32, rays: F32, T: F32, eye: F32, motion: F32, moved: Any, unmoved: Any, source_depth: F32,
    tiles: F32, unsure: Any, wanted: U8, places: F32, share: U8,
) -> None:  # fmt: skip
    rows, columns = source_depth.shape
    i = min(max(y - 1, 0), len(depth) - 1)
    ray_y, wide, high = (f4(y - 1) - rays[3]) * rays[2], eye[4], eye[5]
    for x in range(len(places)):
        j = min(max(x - 1, 0), depth.shape[1] - 1)
        ray_x, z = (f4(x - 1) - rays[1]) * rays[0], depth[i, j]
        if wanted[min(j, np.int64(len(wanted) - 1))] == np.uint8(0):
            places[x, 0], places[x, 1] = eye[0] * ray_x + eye[1], eye[2] * ray_y + eye[3]
            share[x] = np.uint8(0)
            continue
        part, lag, told, near = f4(0), f4(0), True, False
        across, down, was, c = f4(0), f4(0), f4(0), f4(0)
        for _ in range(1 if unmoved else FINDINGS):
            a = z * (T[0, 0] * ray_x + T[0, 1] * ray_y + T[0, 2]) + T[0, 3]
            b = z * (T[1, 0] * ray_x + T[1, 1] * ray_y + T[1, 2]) + T[1, 3]
            c = z * (T[2, 0] * ray_x + T[2, 1] * ray_y + T[2, 2]) + T[2, 3]
            told = z > f4(0) and c > f4(NEAREST)
            u, v = eye[0] * a / c + eye[1], eye[2] * b / c + eye[3]
            if told and moved:
                told = motion[3, i, j] > f4(COVERED) and c - motion[2, i, j] > f4(NEAREST)
                c -= motion[2, i, j]
                was_u = eye[0] * (a - motion[0, i, j]) / c + eye[1]
                was_v = eye[2] * (b - motion[1, i, j]) / c + eye[3]
                lag = max(abs(was_u - u), abs(was_v - v))
                u, v = was_u, was_v
            if not told:
                u, v = eye[0] * ray_x + eye[1], eye[2] * ray_y + eye[3]
            near = (told or unmoved) and abs(u) < f4(-NOWHERE) and abs(v) < f4(-NOWHERE)
            if not near:
                break
            across, down = (u + f4(0.5)) / wide, (v + f4(0.5)) / high
            row = min(max(np.int64(down * f4(rows)), 0), rows - 1)
            column = min(max(np.int64(across * f4(columns)), 0), columns - 1)
            was = source_depth[row, column]
            surface = _between(source_depth, across, down)
            if was == f4(0) or not abs(surface - c) < f4(SAME) * c:
                break
            z += surface - c  # the source knows its surface finer: look again where the ray meets that
        if not near:
            u = v = f4(NOWHERE)
        elif (unmoved and lag < f4(LITTLE)) or was == f4(0) or abs(was - c) < f4(SAME) * c:
            doubt = unsure * lag
            part = _between(tiles, across, down) / (f4(1) + doubt * doubt)
        places[x, 0], places[x, 1] = u, v
        share[x] = np.uint8(np.int64(f4(255) * part + f4(0.5)))


@inlined
def _between(tiles: F32, across: Any, down: Any) -> Any:
    """A map at a place 0..1 of it, on straight lines between the middles of its cells."""
    rows, columns = tiles.shape
    x = min(max(across * f4(columns) - f4(0.5), f4(0)), f4(columns - 1))
    y = min(max(down * f4(rows) - f4(0.5), f4(0)), f4(rows - 1))
    i, j = np.int64(y), np.int64(x)
    s, t, k, n = x - f4(j), y - f4(i), min(i + 1, rows - 1), min(j + 1, columns - 1)
    above = tiles[i, j] + s * (tiles[i, n] - tiles[i, j])
    return above + t * (tiles[k, j] + s * (tiles[k, n] - tiles[k, j]) - above)


def carry(
    shown: U8, taken: U8, traced: Trace, lent: U8, gain: F32 = NO_GAIN, tint: F32 | None = None
) -> None:
    """Blend the picture of a source into a view.

    Args:
        shown: [H, W, 3] RGB of the view; written.
        taken: [H, W] the share that each pixel got, 0..255; written. Pixels that have one already stay.
        lent: [H', W', 4] of `SeenFrame.lent`.
        gain: [3] factor that brings the source's light to that of the view.
        tint: [m, n, 3] for the coarse camera: added to what is carried, in the place of colours 0..1.
    """
    pixels, more = lent.view(np.uint32)[..., 0], np.zeros((*traced.share.shape, 3), f4)
    if tint is not None:
        more += np.pad(tint, ((1, 1), (1, 1), (0, 0)), mode="edge") * f4(255)
    lit = tint is not None or bool((gain != 1).any())
    _carry(
        shown, taken, read_only(traced.places), read_only(traced.share), read_only(pixels), lit, gain,
        read_only(more),
    )  # fmt: skip


@parallel_kernel
def _carry(shown: U8, taken: U8, places: F32, share: U8, lent: U32, lit: Any, gain: F32, more: F32) -> None:
    for row in prange(len(taken)):
        y = np.int64(row)
        _carry_row(y, shown[y].reshape(-1), taken[y], places, share, lent, lit, gain, more)


@kernel
def _carry_row(
    y: Any, shown: U8, taken: U8, places: F32, share: U8, lent: U32, lit: Any, gain: F32, more: F32
) -> None:
    width, few = len(taken), share.shape[1]
    high, wide = lent.shape
    pixels = lent.reshape(-1)
    above = (y + 2) // EVERY
    part = f4(y - EVERY * above + 2.5) * f4(1 / EVERY)
    line = np.empty((6, few), f4)
    for n in range(few):
        line[0, n] = f4(share[above, n]) + part * (f4(share[above + 1, n]) - f4(share[above, n]))
        for k in range(2):
            line[1 + k, n] = places[above, n, k] + part * (places[above + 1, n, k] - places[above, n, k])
        if lit:
            for k in range(3):
                line[3 + k, n] = more[above, n, k] + part * (more[above + 1, n, k] - more[above, n, k])
    for j in range(few - 1):
        if line[0, j] <= f4(0) and line[0, j + 1] <= f4(0):
            continue
        begin, end = max(EVERY * j - 2, 0), min(EVERY * j + 2, width)
        t = f4(begin - EVERY * j + 2.5) * f4(1 / EVERY)
        # In steps of 1/65536 px, so that a pixel costs additions only.
        u, slope_u = _steps(line[1, j], line[1, j + 1], t)
        v, slope_v = _steps(line[2, j], line[2, j + 1], t)
        w, slope_w = _steps(line[0, j], line[0, j + 1], t)
        for i in range(begin, end):
            x = u8(i)
            if (
                taken[x] == np.uint8(0) and w >= ONE
                and u > -HALF and v > -HALF and u < wide * ONE - HALF and v < high * ONE - HALF
            ):  # fmt: skip
                across, down = min(max(u, 0), (wide - 1) * ONE), min(max(v, 0), (high - 1) * ONE)
                left, top = min(across >> 16, wide - 2), min(down >> 16, high - 2)
                s, r = u8((across - left * ONE + 128) >> 8), u8((down - top * ONE + 128) >> 8)
                at = u8(top * wide + left)
                a, b, c, d = pixels[at], pixels[at + u8(1)], pixels[at + u8(wide)], pixels[at + u8(wide + 1)]
                nearest = (b if s > u8(128) else a) if r <= u8(128) else (d if s > u8(128) else c)
                if nearest >= TISSUE:
                    # Weights of 256 in all, so that there is one rounding.
                    last = (s * r + u8(128)) >> u8(8)
                    first = u8(256) - s - r + last
                    there = (
                        _lanes(a) * first + _lanes(b) * (s - last) + _lanes(c) * (r - last) + _lanes(d) * last
                    )
                    there = ((there + _ROUND) >> u8(8)) & _LANES
                    if lit:
                        t = f4(i - EVERY * j + 2.5) * f4(1 / EVERY)
                        red = _lit(there, u8(0), gain[0], line[3, j], line[3, j + 1], t)
                        green = _lit(there, u8(32), gain[1], line[4, j], line[4, j + 1], t)
                        blue = _lit(there, u8(16), gain[2], line[5, j], line[5, j + 1], t)
                        there = red | blue << u8(16) | green << u8(32)
                    own = u8(w >> 16)
                    taken[x] = np.uint8(own)
                    to = u8(3) * x
                    drawn = u8(shown[to]) | u8(shown[to + u8(1)]) << u8(32) | u8(shown[to + u8(2)]) << u8(16)
                    drawn = _mix(drawn, there, own + (own >> u8(7)))  # 255 of 255 is 256 of 256
                    shown[to] = np.uint8(drawn & u8(255))
                    shown[to + u8(1)] = np.uint8((drawn >> u8(32)) & u8(255))
                    shown[to + u8(2)] = np.uint8((drawn >> u8(16)) & u8(255))
            u, v, w = u + slope_u, v + slope_v, w + slope_w


@inlined
def _steps(first: Any, second: Any, t: Any) -> Any:
    """The value at t between two places, and its slope by pixel, in steps of 1/65536."""
    slope = second - first
    return np.int64((first + t * slope) * f4(ONE)), np.int64(slope * f4(ONE / EVERY))


@inlined
def _lanes(pixel: Any) -> Any:
    """Four bytes in 16 bits each: red, blue, green, tissue. One multiplication weighs all of them."""
    wide = u8(pixel)
    return (wide | wide << u8(24)) & _LANES


@inlined
def _mix(first: Any, second: Any, part: Any) -> Any:
    """`part` 0..256 of the second, the rest of the first, in all lanes."""
    return ((first * (u8(256) - part) + second * part + _ROUND) >> u8(8)) & _LANES


@inlined
def _lit(pixel: Any, lane: Any, gain: Any, first: Any, second: Any, t: Any) -> Any:
    """A colour 0..255 in other light."""
    level = f4(np.int64((pixel >> lane) & u8(255))) * gain + first + t * (second - first)
    return u8(np.int64(min(max(level, f4(0)), f4(255)) + f4(0.5)))
