"""Scene flow: where each seen Gaussian went, from optical flow and the new depth."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from sags_node.engine.interface import BEHIND_SURFACE
from sags_node.engine.pinhole import pack, to_camera, to_pixel
from sags_node.kernels.jit import PIECE, inlined, kernel, parallel_kernel
from sags_node.types import F32, Bool, Observation, RenderedView
from sags_node.vision.flow import OpticalFlow
from sags_node.vision.margin import ClearOfInstruments
from sags_node.vision.pyramid import pyramid_of

DEPTH_GATE = 0.13  # of the depth: a larger innovation is another surface, not this one
SEEN_ALPHA = 0.3  # coverage below which a Gaussian counts as not seen
HALVINGS = 1  # how often the masks' size is halved: they stay finer than the flow that they guard
DEPTH_PULL = 0.4  # share of the depth innovation taken per frame; measured best 0.3-0.5
FINE_FLOW, COARSE_FLOW = 4, 6  # px between patches
MOST_FRAMES = 4  # frames without depth, after which the pull does not grow any more


def depth_pull(frames: int) -> float:
    """The share of the depth innovation to take after `frames` frames, as if depth was known in each."""
    return float(1 - (1 - DEPTH_PULL) ** min(frames, MOST_FRAMES))


@dataclass(frozen=True, slots=True)
class Drawn:
    """A frame and the model drawn for it: what the next frame's motion starts from."""

    observation: Observation
    view: RenderedView


class Tracks(NamedTuple):
    """Where Gaussians are found in a frame."""

    pixels: F32  # [N, 2], also beyond the image's edges; NaN: not seen, or covered by an instrument now
    seconds: float  # from the frame that the model shows to this one


class SurfaceTracker:
    """Finds the Gaussians of one frame in the next, by optical flow."""

    def __init__(self) -> None:
        self._clear = ClearOfInstruments(HALVINGS)
        self.pace(False)

    def pace(self, unhurried: bool) -> None:
        """Set how fine the flow is: finer if `unhurried`, when there is time."""
        self._flow = OpticalFlow(FINE_FLOW if unhurried else COARSE_FLOW)

    def track(self, means: F32, last: Drawn, observation: Observation, guess: F32 | None = None) -> Tracks:
        """Find the Gaussians of an earlier frame in this one.

        Args:
            means: [N, 3] m, world, at the earlier frame.
            last: that frame, and the model drawn for it, to know what was hidden.
            guess: [rows, columns, 2] px, flow of square cells over the image to start the search from.
        """
        before = last.observation
        flow = self._flow(pyramid_of(before), pyramid_of(observation), guess)
        clear = self._clear(before.tissue), self._clear(observation.tissue)
        seconds = max(0.0, (observation.t_capture_ns - before.t_capture_ns) * 1e-9)
        return Tracks(found(means, last.view, clear[0], flow, clear[1]), seconds)


def found(means: F32, before: RenderedView, clear_before: Bool, flow: F32, clear_after: Bool) -> F32:
    """Find where in the later image each Gaussian of the earlier one is, as `Tracks.pixels`.

    Args:
        means: [N, 3] m, world, at the earlier frame.
        before: the model drawn at the earlier frame, to know what was hidden.
        clear_before, clear_after: [h, w] tissue far enough from instruments, halved in size `HALVINGS` times.
        flow: [h, w, 2] px of the whole images, from the earlier to the later one, at any size.
    """
    pixels = np.full((len(means), 2), np.float32(np.nan))
    _find(means, pack(before.camera), before.depth, before.alpha, clear_before, flow, clear_after, pixels)
    return pixels


def scene_flow(means: F32, pixels: F32, after: Observation, pull: float) -> tuple[F32, F32]:
    """Return the displacement of each Gaussian to where it was found.

    Args:
        means: [N, 3] m, world, at the earlier frame.
        pixels: [N, 2] in the later one, as `Tracks.pixels`.
        after: the later frame; its depth pulls the Gaussian along the ray.
        pull: share of the difference in depth that is taken; see `depth_pull`.

    Returns:
        displacements [N, 3] m, world, and seen [N]: 1 where the displacement was observed, else 0.
    """
    displacements = np.zeros_like(means)
    seen = np.zeros(len(means), np.float32)
    _advect(means, pixels, pack(after.camera), after.depth, np.float32(pull), displacements, seen)
    return displacements, seen


@parallel_kernel
def _find(
    means: F32, cam0: F32, drawn_depth: F32, alpha: F32, tissue0: Bool, flow: F32, tissue1: Bool, pixels: F32
) -> None:
    for piece in prange(-(-len(means) // PIECE)):
        first = np.int64(piece) * PIECE
        _find_rows(
            means, cam0, drawn_depth, alpha, tissue0, flow, tissue1, pixels,
            first, min(first + PIECE, len(means)),
        )  # fmt: skip


@kernel
def _find_rows(
    means: F32, cam0: F32, drawn_depth: F32, alpha: F32, tissue0: Bool, flow: F32, tissue1: Bool, pixels: F32,
    first: Any, end: Any,
) -> None:  # fmt: skip
    """Writes the pixels of what is found; leaves the others as they are."""
    height, width = alpha.shape
    half = np.float32(0.5)
    across, down = np.float32(flow.shape[1] / width), np.float32(flow.shape[0] / height)
    last_row, last_column = tissue0.shape[0] - 1, tissue0.shape[1] - 1
    for i in range(first, end):
        x, y, z = to_camera(cam0, means[i, 0], means[i, 1], means[i, 2])
        if not z > 1e-3:
            continue
        u, v = to_pixel(cam0, x, y, z)
        if not (u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1):
            continue
        px, py = int(u + 0.5), int(v + 0.5)
        if (
            not tissue0[min(py >> HALVINGS, last_row), min(px >> HALVINGS, last_column)]
            or alpha[py, px] < SEEN_ALPHA
        ):
            continue
        if drawn_depth[py, px] > 0 and z - drawn_depth[py, px] > BEHIND_SURFACE * z:
            continue
        fx, fy = across * (u + half) - half, down * (v + half) - half
        du, dv = _bilinear(flow, fx, fy, 0), _bilinear(flow, fx, fy, 1)
        u += du
        v += dv
        if u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1:
            row, column = int(v + 0.5) >> HALVINGS, int(u + 0.5) >> HALVINGS
            if not tissue1[min(row, last_row), min(column, last_column)]:
                continue  # flow into an instrument is the instrument's motion
        pixels[i, 0] = u
        pixels[i, 1] = v


@parallel_kernel
def _advect(
    means: F32, pixels: F32, cam1: F32, depth1: F32, pull: Any, displacements: F32, seen: F32
) -> None:
    for piece in prange(-(-len(means) // PIECE)):
        first = np.int64(piece) * PIECE
        _advect_rows(
            means, pixels, cam1, depth1, pull, displacements, seen, first, min(first + PIECE, len(means))
        )


@kernel
def _advect_rows(
    means: F32, pixels: F32, cam1: F32, depth1: F32, pull: Any, displacements: F32, seen: F32,
    first: Any, end: Any,
) -> None:  # fmt: skip
    """Writes the displacement and 1 where it was observed; leaves the others as they are."""
    height, width = depth1.shape
    for i in range(first, end):
        u, v = pixels[i, 0], pixels[i, 1]
        if np.isnan(u):
            continue
        _, _, z1 = to_camera(cam1, means[i, 0], means[i, 1], means[i, 2])
        if u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1:
            measured = depth1[int(v + 0.5), int(u + 0.5)]
            if measured > 0 and abs(measured - z1) < DEPTH_GATE * z1:
                z1 += pull * (measured - z1)
        # From pixel and depth to the world: the transposed rotation.
        x1 = (u - cam1[14]) * z1 / cam1[12] - cam1[9]
        y1 = (v - cam1[15]) * z1 / cam1[13] - cam1[10]
        z1 -= cam1[11]
        for k in range(3):
            displacements[i, k] = cam1[k] * x1 + cam1[3 + k] * y1 + cam1[6 + k] * z1 - means[i, k]
        seen[i] = 1


@inlined
def _bilinear(flow: F32, u: Any, v: Any, channel: int) -> Any:
    """Flow at a place in the image; beyond the outermost pixel centres it is constant."""
    height, width, _ = flow.shape
    one = np.float32(1)
    u = min(max(u, np.float32(0)), np.float32(width - 1))
    v = min(max(v, np.float32(0)), np.float32(height - 1))
    x, y = min(int(u), width - 2), min(int(v), height - 2)
    a, b = np.float32(u - x), np.float32(v - y)
    upper = (one - a) * flow[y, x, channel] + a * flow[y, x + 1, channel]
    lower = (one - a) * flow[y + 1, x, channel] + a * flow[y + 1, x + 1, channel]
    return (one - b) * upper + b * lower
