"""A few frames of a run for a person to look at, their depth and error in colours, with the scales."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.types import F32, U8, Bool

EVENLY_SPACED = 3  # frames of a run
TILE_WIDTH = 360  # px
ERROR_AT_TOP = 0.15  # of full scale: the brightest colour of an error image
_UNKNOWN = (60, 60, 60)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, slots=True)
class Picture:
    """One frame: what the camera saw and what was shown, by the model or with the detail of images."""

    frame_id: int
    psnr: float  # dB, tissue
    truth: U8  # [H, W, 3]
    render: U8  # [H, W, 3]
    depth: F32  # [H, W] m, 0 unknown
    tissue: Bool  # [H, W]


class Gallery:
    """Keeps some evenly spaced frames and the worst of all that it is offered."""

    def __init__(self, frames: int) -> None:
        self._places = {round((frames - 1) * step / (EVENLY_SPACED - 1)) for step in range(EVENLY_SPACED)}
        self._spaced: list[Picture] = []
        self.worst: Picture | None = None

    def offer(self, place: int, picture: Picture) -> None:
        """Consider the frame processed as number `place`; a PSNR of NaN is never the worst."""
        if place in self._places:
            self._spaced.append(picture)
        if not math.isnan(picture.psnr) and (self.worst is None or picture.psnr < self.worst.psnr):
            self.worst = picture

    @property
    def pictures(self) -> list[Picture]:
        """The kept frames in order of time, each once."""
        unique = {picture.frame_id: picture for picture in (*self._spaced, self.worst) if picture}
        return [unique[frame_id] for frame_id in sorted(unique)]


def depth_range(pictures: Sequence[Picture]) -> tuple[float, float]:
    """The nearest and furthest depth (m) to show: all but one in two hundred at either end lie between."""
    known = [picture.depth[picture.tissue & (picture.depth > 0)] for picture in pictures]
    depths = np.concatenate(known) if known else np.zeros(0, np.float32)
    if depths.size == 0:
        return 0.0, 1.0
    near, far = np.percentile(depths, [0.5, 99.5])
    return float(near), float(far)


def tiles(picture: Picture, near: float, far: float) -> list[U8]:
    """The tiles of one frame: input, render, depth and error, each `TILE_WIDTH` wide, RGB."""
    return [
        shrunk(picture.truth),
        shrunk(picture.render),
        depth_tile(picture, near, far),
        error_tile(picture),
    ]


def depth_tile(picture: Picture, near: float, far: float) -> U8:
    """The depth of one frame in colours; near is warm."""
    share = 1 - (picture.depth - near) / max(far - near, 1e-4)  # a plane has one depth
    tile = shrunk(_coloured(share, cv2.COLORMAP_TURBO, picture.tissue & (picture.depth > 0)))
    return _with_bar(tile, cv2.COLORMAP_TURBO, f"{far * 1e3:.0f} mm", f"{near * 1e3:.0f} mm")


def error_tile(picture: Picture) -> U8:
    """The difference of render and input on the tissue of one frame, in colours."""
    difference = cv2.absdiff(picture.truth, picture.render).astype(np.float32).mean(-1) / 255
    tile = shrunk(_coloured(difference / ERROR_AT_TOP, cv2.COLORMAP_INFERNO, picture.tissue))
    return _with_bar(tile, cv2.COLORMAP_INFERNO, "0", f"{ERROR_AT_TOP:.0%}")


def _coloured(share: F32, colormap: int, known: Bool) -> U8:
    levels = np.clip(share * 255, 0, 255).astype(np.uint8)
    coloured: U8 = cv2.cvtColor(cv2.applyColorMap(levels, colormap), cv2.COLOR_BGR2RGB)
    coloured[~known] = _UNKNOWN
    return coloured


def shrunk(picture: U8) -> U8:
    """Shrink an image to a width of `TILE_WIDTH`."""
    height = max(1, round(picture.shape[0] * TILE_WIDTH / picture.shape[1]))
    resized: U8 = cv2.resize(picture, (TILE_WIDTH, height), interpolation=cv2.INTER_AREA)
    return resized


def _with_bar(tile: U8, colormap: int, low: str, high: str) -> U8:
    """Draw the colour scale along the lower edge, with labels at its ends."""
    length, thickness, margin, size = TILE_WIDTH // 3, 10, 6, 0.55
    bar = _coloured(
        np.linspace(0, 1, length, dtype=np.float32)[None].repeat(thickness, 0), colormap, np.array(True)
    )
    bottom = tile.shape[0] - margin
    if bottom < thickness:
        return tile
    tile[bottom - thickness - margin :] = 0  # under it: the scale is readable on anything
    left = (TILE_WIDTH - length) // 2
    tile[bottom - thickness : bottom, left : left + length] = bar
    width = cv2.getTextSize(low, _FONT, size, 1)[0][0]
    for text, x in ((low, left - width - margin), (high, left + length + margin)):
        cv2.putText(tile, text, (x, bottom), _FONT, size, (255, 255, 255), 1, cv2.LINE_AA)
    return tile
