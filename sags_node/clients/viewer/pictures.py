"""The four pictures of the newest frame on one sheet: input, render, depth, error."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.clients.viewer.feed import Moment
from sags_node.quality.gallery import TILE_WIDTH, Picture, depth_range, tiles
from sags_node.types import U8

CAPTIONS = ("Left input", "Model", "Depth", "Error on tissue")
BAR = 24  # px above each picture
RANGE_MEMORY = 0.9  # of the last depth range: the colours must not flicker
_GROUND = (36, 36, 36)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class Sheet:
    """Draws the sheet, one after another with steady depth colours."""

    def __init__(self) -> None:
        self._range: tuple[float, float] | None = None
        self._height = round(TILE_WIDTH * 0.8)  # of a tile; that of the last picture

    def draw(self, moment: Moment) -> U8:
        """Two by two pictures [h, w, 3], RGB; empty where there is nothing new to show."""
        shown: list[U8] = []
        if moment.model is not None:
            small = _small(moment.model)  # first: all that follows costs by the pixel
            self._follow(*depth_range([small]))
            assert self._range is not None
            shown = tiles(small, *self._range)
        elif moment.picture is not None:
            shown = [_fitted(moment.picture, cv2.INTER_AREA)]
        if shown:
            self._height = shown[0].shape[0]
        panes = [
            self._pane(caption, shown[place] if place < len(shown) else None)
            for place, caption in enumerate(CAPTIONS)
        ]
        return np.vstack([np.hstack(panes[:2]), np.hstack(panes[2:])])

    def _follow(self, near: float, far: float) -> None:
        if self._range is not None:
            near, far = (
                RANGE_MEMORY * old + (1 - RANGE_MEMORY) * new
                for old, new in zip(self._range, (near, far), strict=True)
            )
        self._range = (near, far)

    def _pane(self, caption: str, tile: U8 | None) -> U8:
        pane = np.full((BAR + self._height, TILE_WIDTH, 3), _GROUND, np.uint8)
        if tile is not None:
            pane[BAR:] = tile
        text = caption if tile is not None else f"{caption}: nothing new"
        cv2.putText(pane, text, (6, 17), _FONT, 0.5, (220, 220, 220), 1, cv2.LINE_AA)
        return pane


def _small(model: Picture) -> Picture:
    """A frame as wide as a tile. Depth is picked, not averaged: 0 means unknown."""
    return Picture(
        model.frame_id,
        model.psnr,
        truth=_fitted(model.truth, cv2.INTER_AREA),
        render=_fitted(model.render, cv2.INTER_AREA),
        depth=_fitted(model.depth, cv2.INTER_NEAREST),
        tissue=_fitted(model.tissue.view(np.uint8), cv2.INTER_NEAREST) > 0,
    )


def _fitted(picture: NDArray[Any], interpolation: int) -> NDArray[Any]:
    height = max(1, round(picture.shape[0] * TILE_WIDTH / picture.shape[1]))
    fitted: NDArray[Any] = cv2.resize(picture, (TILE_WIDTH, height), interpolation=interpolation)
    return fitted
