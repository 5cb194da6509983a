"""Numbers that cameras can read: ArUco markers (Garrido-Jurado et al., 2014)."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.types import U8

NUMBERS = 1000  # after the last one the first comes again
CELLS = 7  # across, the black border included
_DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)


def cells(number: int) -> U8:
    """The picture of a number [CELLS, CELLS], 0 or 255."""
    return np.asarray(cv2.aruco.generateImageMarker(_DICTIONARY, number % NUMBERS, CELLS), np.uint8)


def paint(picture: U8, number: int) -> None:
    """Paint a number into the upper left corner of a picture [H, W, 3], over half of its height."""
    cell = picture.shape[0] // 2 // (CELLS + 2)
    whole = np.pad(cells(number), 1, constant_values=255).repeat(cell, 0).repeat(cell, 1)
    picture[: len(whole), : len(whole)] = whole[..., None]


class Reader:
    """Reads the number of a picture."""

    def __init__(self) -> None:
        exact = cv2.aruco.DetectorParameters()
        exact.errorCorrectionRate = 0.0  # two codes in one exposure must not be taken for a third one
        self._detector = cv2.aruco.ArucoDetector(_DICTIONARY, exact)

    def read(self, picture: U8) -> int | None:
        """The number that a picture [H, W, 3] shows; None: none, or several."""
        _, ids, _ = self._detector.detectMarkers(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
        return int(ids.ravel()[0]) if ids is not None and len(ids) == 1 else None
