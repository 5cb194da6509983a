"""Images of the newest frame on one sheet: what both eyes saw and are shown, the depth, the overlay."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.clients.viewer.feed import CONFIDENCE, DEPTH, LEFT, RIGHT, RIGHT_SHOWN, SHOWN, TISSUE, Moment
from sags_node.quality.gallery import TILE_WIDTH, Picture, depth_range, depth_tile, shrunk
from sags_node.types import U8

# The topics that each image is made of. What is shown is mostly the input: it is no measure of the model.
NEEDS = {
    "Left input": (LEFT,),
    "Left shown": (SHOWN,),
    "Depth": (DEPTH, TISSUE),
    "Right input": (RIGHT,),
    "Right shown": (RIGHT_SHOWN,),
    "Left overlay": (LEFT,),
    "Right overlay": (RIGHT,),
}
OVERLAID = {"Left overlay": "left", "Right overlay": "right"}
# What somebody may look at; the first is shown first.
VIEWS = {
    "Input, shown, depth": ("Left input", "Left shown", "Depth"),
    "Input": ("Left input",),
    "Shown": ("Left shown",),
    "Depth under the cursor": ("Left input", "Depth"),
    "Right eye": ("Right input", "Right shown"),
    "Stereo input": ("Left input", "Right input"),
    "Stereo shown": ("Left shown", "Right shown"),
    "Overlay": ("Left overlay",),
    "Stereo overlay": ("Left overlay", "Right overlay"),
}
COLUMNS = 2
BAR = 24  # px above each image
RANGE_MEMORY = 0.9  # weight of the last depth range, so that the colours do not flicker
_GROUND, _MARKED = 36, (255, 169, 77)
_NOTHING = np.zeros((0, 0), np.uint8)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class Sheet:
    """Draws one sheet after another, with steady depth colours.

    Attributes:
        fixed: the range that they are to have, m; None: they follow the tissue.
    """

    def __init__(self) -> None:
        self.fixed: tuple[float, float] | None = None
        self._followed: tuple[float, float] | None = None
        self._height = round(TILE_WIDTH * 0.8)  # of a tile; that of the last image

    @property
    def shown(self) -> tuple[float, float]:
        """The range of the depth colours, m."""
        return self.fixed or self._followed or (0.0, 1.0)

    def draw(self, moment: Moment, view: str, remark: str = "") -> U8:
        """Draw the images of a view [h, w, 3], RGB; a place is left empty where nothing is new."""
        known = _known(moment.pictures)
        if DEPTH in moment.pictures and TISSUE in moment.pictures:
            self._follow(known)
        if (left := moment.pictures.get(LEFT)) is not None:
            self._height = shrunk(left).shape[0]
        names, high = VIEWS[view], BAR + self._height
        columns = min(COLUMNS, len(names))
        sheet = np.full((-(-len(names) // columns) * high, columns * TILE_WIDTH, 3), _GROUND, np.uint8)
        for place, name in enumerate(names):
            top, left_edge = place // columns * high, place % columns * TILE_WIDTH
            tile, text = self._tile(name, known, moment), f"{name}{remark}"
            if tile is None:
                text = f"{name}: nothing new"
            else:
                if name in OVERLAID and OVERLAID[name] not in moment.drawn:
                    text += f": {_why_bare(moment)}"
                sheet[top + BAR : top + high, left_edge : left_edge + TILE_WIDTH] = tile
            color = _MARKED if remark else (220, 220, 220)
            cv2.putText(sheet, text, (left_edge + 6, top + 17), _FONT, 0.5, color, 1, cv2.LINE_AA)
        if moment.problem is not None:  # also where the controls, which say so, are folded away
            cv2.putText(sheet, moment.problem, (6, high - 8), _FONT, 0.5, _MARKED, 1, cv2.LINE_AA)
        return sheet

    def _tile(self, name: str, known: Picture, moment: Moment) -> U8 | None:
        needed = NEEDS[name]
        if not all(topic in moment.pictures for topic in needed):
            return None
        if name == "Depth":
            return depth_tile(known, *self.shown)
        picture = shrunk(moment.pictures[needed[0]])
        if name not in OVERLAID:
            return picture
        drawn = moment.drawn.get(OVERLAID[name])
        return picture if drawn is None else _blended(picture, drawn)

    def _follow(self, known: Picture) -> None:
        if not (known.tissue & (known.depth > 0)).any():
            return  # it tells nothing of where the tissue is
        new = depth_range([known])
        near, far = (
            RANGE_MEMORY * last + (1 - RANGE_MEMORY) * now
            for last, now in zip(self._followed or new, new, strict=True)
        )
        self._followed = (near, far)


def needs_of(view: str) -> list[str]:
    """The topics that a view needs. Depth confidence costs the node much, so only one view asks for it."""
    sure = [CONFIDENCE] if view == "Depth under the cursor" else []
    return sure + [topic for name in VIEWS[view] for topic in NEEDS[name]]


def overlaid_in(view: str) -> list[str]:
    """The eyes whose overlay a view shows."""
    return [OVERLAID[name] for name in VIEWS[view] if name in OVERLAID]


def _why_bare(moment: Moment) -> str:
    """Why no overlay lies on an image."""
    if moment.overlay is None:
        return "no overlay runs"
    return f"no overlay, {moment.overlay.reason}" if moment.overlay.reason else "its overlay came too late"


def _known(pictures: Mapping[str, NDArray[Any]]) -> Picture:
    """The depth and tissue of a frame."""
    depth = np.nan_to_num(pictures.get(DEPTH, _NOTHING), nan=0.0)
    return Picture(0, np.nan, _NOTHING, _NOTHING, depth, pictures.get(TISSUE, _NOTHING) > 0)


def _blended(picture: U8, drawn: U8) -> U8:
    """The overlay [H, W, 4], not premultiplied, over the image [h, w, 3]."""
    # Multiplied before it shrinks: else the black of what is not drawn darkens the rim of what is.
    drawn = np.asarray(cv2.cvtColor(drawn, cv2.COLOR_RGBA2mRGBA), np.uint8)
    small: U8 = cv2.resize(drawn, picture.shape[1::-1], interpolation=cv2.INTER_AREA)
    return small[..., :3] + np.rint(picture * (1 - small[..., 3:] / 255)).astype(np.uint8)
