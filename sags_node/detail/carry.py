"""Look an image up where the tissue of each pixel was, and blend what is there into a view.

A view's pixel at depth z is a point of tissue. Less its motion since the source's moment, in the source's
camera, that point falls on a pixel of the source's image. It counts where the source showed tissue, and
where the surface that it showed was as deep. That place changes slowly over a view: it is computed for every
fourth pixel along both axes (`trace`) and interpolated linearly between. What the image shows there is
looked up for each pixel that has no detail yet (`carry`): in a left view these are few.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import prange
from numpy.typing import NDArray

from sags_node.detail.seen import SAME, SeenFrame
from sags_node.geometry import resized_camera, scale_intrinsics
from sags_node.kernels.jit import inlined, kernel, parallel_kernel, read_only
from sags_node.types import F32, I32, I64, U8, Camera

EVERY = 4  # px of the view from one coarse pixel to the next
EVERYWHERE = np.ones((1, 1), np.uint8)
WHOLLY = np.ones((1, 1), np.float32)
NO_GAIN = np.ones(3, np.float32)
NEAREST = 1e-3  # m: no tissue is nearer
AROUND = (9, 9)  # coarse pixels: the window from which a hole is filled
LEAST_KNOWN = 0.5  # share of that window whose depth must be known to fill a hole
COVERED = 0.3  # least coverage by Gaussians whose motion is known
NOWHERE = -1e6  # px: the place of what is not in the source's image
FINDINGS = 3  # steps of the search for a ray's place in the source, each from the surface that the last met
CLOSE = 1e-3  # of the depth: the search ends this close to that surface
LITTLE = 3.0  # px of motion: below it a steady view's depths are not compared, which differ at edges anyway
_STILL = np.zeros((4, 1, 1), np.float32)
f4 = np.float32
u8 = np.uint64
ONE, BYTE = u8(1), u8(255)
G, B = u8(32), u8(16)  # bits at which their lanes begin
LANES, HALVES = u8(0x00FF00FF00FF00FF), u8(0x0080008000800080)


def coarse_camera(camera: Camera) -> Camera:
    """The camera with one pixel for each 4 x 4 block of another's; the last blocks may exceed its edge."""
    width, height = -(-camera.width // EVERY), -(-camera.height // EVERY)
    whole = Camera(EVERY * width, EVERY * height, camera.K, camera.T_world_cam)
    return resized_camera(whole, width, height)


@dataclass(frozen=True, slots=True)
class Trace:
    """Where a view's tissue was in a source's image: for the pixels of `coarse_camera`, and one more
    on each side."""

    places: F32  # [m + 2, n + 2, 2] u and v, px of `SeenFrame.lent`; `NOWHERE`: not in it
    share: U8  # [m + 2, n + 2] 0..255 of the image in the view


def every_fourth(depth: F32, small: Camera) -> F32:
    """Return the depth [h, w] of a view at its coarse camera's pixels. Small holes are filled from around:
    even where few Gaussians are drawn there is tissue."""
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
    """Find where the tissue of a view was in a source's image.

    Args:
        depth: [m, n] m, the view's depth from `every_fourth`; 0 unknown.
        small: the coarse camera of the view.
        lent: the image from `SeenFrame.lent`.
        motion: [4, m, n] from `SmallDrawings.motion`; None: nothing has moved.
        tiles: [rows, columns] 0..1 over the source's image: how far each tile of it is trusted.
        unsure: the doubt for each px that the tissue has moved: the share falls by 1 / (1 + doubt^2).
        steady: the source is a moment ago. If the camera is also the same, depths are not compared where the
            tissue moved little, and where the model tells no depth or motion the image is taken unmoved.
        wanted: [m, n] 0 where nothing is to be carried.
    """
    T = source.camera.viewmat @ small.T_world_cam
    size = lent.shape[1] - 2, lent.shape[0] - 2
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
            places[x, 0], places[x, 1] = eye[0] * ray_x + eye[1] + f4(1), eye[2] * ray_y + eye[3] + f4(1)
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
            was = source_depth[u8(row), u8(column)]
            off = _between(source_depth, across, down) - c
            if was == f4(0) or not f4(CLOSE) * c < abs(off) < f4(SAME) * c:
                break
            z += off  # the source's depth is finer: look again from where the ray meets it
        if not near:
            u = v = f4(NOWHERE)
        elif (unmoved and lag < f4(LITTLE)) or was == f4(0) or abs(was - c) < f4(SAME) * c:
            doubt = unsure * lag
            part = _between(tiles, across, down) / (f4(1) + doubt * doubt)
        places[x, 0], places[x, 1] = u + f4(1), v + f4(1)
        share[x] = np.uint8(np.int64(f4(255) * part + f4(0.5)))


@inlined
def _between(tiles: F32, across: Any, down: Any) -> Any:
    """The value of a map at a place 0..1 of its width and height, bilinear between the cells' middles."""
    rows, columns = tiles.shape
    x = min(max(across * f4(columns) - f4(0.5), f4(0)), f4(columns - 1))
    y = min(max(down * f4(rows) - f4(0.5), f4(0)), f4(rows - 1))
    i, j = np.int64(y), np.int64(x)
    s, t, k, n = x - f4(j), y - f4(i), min(i + 1, rows - 1), min(j + 1, columns - 1)
    a, b, c, d = tiles[u8(i), u8(j)], tiles[u8(i), u8(n)], tiles[u8(k), u8(j)], tiles[u8(k), u8(n)]
    above = a + s * (b - a)
    return above + t * (c + s * (d - c) - above)


def carry(
    shown: U8, taken: U8, traced: Trace, lent: U8, gain: F32 = NO_GAIN, tint: F32 | None = None
) -> None:
    """Blend a source's image into a view, where most of what a pixel is interpolated from is tissue.

    Args:
        shown: [H, W, 3] RGB of the view; written.
        taken: [H, W] the share that each pixel got, 0..255; written. Pixels that have one already stay.
        lent: the image from `SeenFrame.lent`.
        gain: [3] factor that brings the source's light to that of the view, at most 100.
        tint: [m, n, 3] for the coarse camera: added to the image's colours 0..1.
    """
    _, row, _, rows = cv2.boundingRect(traced.share)
    if not rows:
        return
    planes: list[NDArray[Any]] = [traced.places, traced.share[..., None]]
    if tint is not None:
        planes.append(f4(255) * np.pad(tint, ((1, 1), (1, 1), (0, 0)), mode="edge"))
    coarse = np.rint(256 * np.concatenate(planes, axis=2, dtype=f4)).astype(np.int32)
    first, end = EVERY * (row - 1) - EVERY // 2, EVERY * (row + rows) - EVERY // 2  # rows reached
    _carry(
        shown, taken, read_only(coarse), read_only(lent).view(np.uint32)[..., 0],
        np.rint(256 * gain).astype(np.int64), max(first, 0), min(end, len(shown)),
    )  # fmt: skip


@parallel_kernel
def _carry(shown: U8, taken: U8, coarse: I32, lent: Any, gain: I64, first: Any, end: Any) -> None:
    for number in prange(end - first):
        y = np.int64(first + number)
        row = (y + EVERY // 2) // EVERY  # the upper of the two coarse rows that y lies between
        down = 2 * (y + EVERY // 2 - EVERY * row) + 1  # eighths of the way to the lower one
        _carry_row(shown[y].reshape(-1), taken[y], coarse[row], coarse[row + 1], down, lent, gain)


@kernel
def _carry_row(shown: U8, taken: U8, above: I32, below: I32, down: Any, lent: Any, gain: I64) -> None:
    """Carry one row. In each group of four pixels, between two coarse ones, the place u, v, the share and the
    tint grow by constant steps, in units of 2**-14. Integers make the result the same on every machine."""
    wide, high = (lent.shape[1] - 1) << 14, (lent.shape[0] - 1) << 14
    tinted, red, green, blue = above.shape[1] > 3, gain[0], gain[1], gain[2]
    lit = red != 256 or green != 256 or blue != 256
    r = g = b = more_r = more_g = more_b = 0
    for group in range(len(above) - 1):
        c = u8(group)
        if max(above[c, u8(2)], above[c + ONE, u8(2)], below[c, u8(2)], below[c + ONE, u8(2)]) == 0:
            continue
        u, more_u = _growing(above, below, c, u8(0), down)
        v, more_v = _growing(above, below, c, u8(1), down)
        share, more_share = _growing(above, below, c, u8(2), down)
        if tinted:
            r, more_r = _growing(above, below, c, u8(3), down)
            g, more_g = _growing(above, below, c, u8(4), down)
            b, more_b = _growing(above, below, c, u8(5), down)
        u, v = u + 32, v + 32  # to round to the nearest 256th of a pixel
        for x in range(EVERY * group - EVERY // 2, EVERY * group + EVERY // 2):
            if 0 <= x < len(taken) and taken[u8(x)] == 0 and 0 <= u < wide and 0 <= v < high:
                i, j, right, under = u8(v >> 14), u8(u >> 14), u8(u >> 6) & BYTE, u8(v >> 6) & BYTE
                found = _mixed(
                    _mixed(_lanes(lent[i, j]), _lanes(lent[i, j + ONE]), right),
                    _mixed(_lanes(lent[i + ONE, j]), _lanes(lent[i + ONE, j + ONE]), right),
                    under,
                )
                if found >> u8(55):  # more than half is tissue
                    if tinted:
                        found = _rgb(_tinted(found, r), _tinted(found >> G, g), _tinted(found >> B, b))
                    if lit:
                        found = _rgb(_lit(found, red), _lit(found >> G, green), _lit(found >> B, blue))
                    part, at = u8((share + 8192) >> 14), u8(3 * x)
                    taken[u8(x)] = np.uint8(part)
                    was = _rgb(u8(shown[at]), u8(shown[at + ONE]), u8(shown[at + u8(2)]))
                    found = _mixed(was, found, part + (part >> u8(7)))  # 255 of 255 is 256 of 256
                    shown[at], shown[at + ONE] = np.uint8(found), np.uint8(found >> G)
                    shown[at + u8(2)] = np.uint8(found >> B)
            u, v, share = u + more_u, v + more_v, share + more_share
            r, g, b = r + more_r, g + more_g, b + more_b


@inlined
def _growing(above: I32, below: I32, c: Any, plane: Any, down: Any) -> Any:
    """A coarse plane's value at a group's first pixel, and its step from pixel to pixel, both times 64."""
    before = np.int64(above[c, plane]) * (8 - down) + np.int64(below[c, plane]) * down
    after = np.int64(above[c + ONE, plane]) * (8 - down) + np.int64(below[c + ONE, plane]) * down
    return 7 * before + after, 2 * (after - before)


@inlined
def _lanes(pixel: Any) -> Any:
    """The four bytes of RGBA in lanes of 16 bits: R, B, G, A from the lowest on."""
    bits = u8(pixel)
    return (bits | bits << u8(24)) & LANES


@inlined
def _mixed(a: Any, b: Any, part: Any) -> Any:
    """The mix of `a` and `b`, lane by lane: `part` / 256 of it is `b`."""
    return ((a * (u8(256) - part) + b * part + HALVES) >> u8(8)) & LANES


@inlined
def _rgb(r: Any, g: Any, b: Any) -> Any:
    return r | g << G | b << B


@inlined
def _tinted(lane: Any, tint: Any) -> Any:
    """The lowest lane plus a tint in units of 2**-14."""
    return u8(min(max(np.int64(lane & BYTE) + ((tint + 8192) >> 14), 0), 255))


@inlined
def _lit(lane: Any, gain: Any) -> Any:
    """The lowest lane times a gain in units of 2**-8."""
    return u8(min((np.int64(lane & BYTE) * gain + 128) >> 8, 255))


def paste(picture: U8, share: U8, shown: U8) -> None:
    """Blend an image [H, W, 3] into `shown` [H, W, 3], which is written, by `share` [H, W] 0..255."""
    _paste(read_only(picture), read_only(share), shown)


@parallel_kernel
def _paste(picture: U8, share: U8, shown: U8) -> None:
    for row in prange(len(picture)):
        y = np.int64(row)
        _paste_row(picture[y].reshape(-1), share[y], shown[y].reshape(-1))


@kernel
def _paste_row(picture: U8, share: U8, shown: U8) -> None:
    half, eight = np.int32(128), np.int32(8)
    for x in range(u8(len(share))):
        part = np.int32(share[x])
        part += part >> np.int32(7)  # 255 of 255 is 256 of 256
        for c in range(u8(3)):
            at = u8(3) * x + c
            was = np.int32(shown[at])
            shown[at] = np.uint8(was + (((np.int32(picture[at]) - was) * part + half) >> eight))
