"""Calibration boards and their corners in images."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from sags_node.errors import UsageError
from sags_node.types import F32, I64, U8

FEWEST_CORNERS = 8  # of one view, in both eyes
REFINE = 0.3  # half the window of cornerSubPix, as a share of the distance between corners
REFINE_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
PREFIX = "DICT_"


class Seen(NamedTuple):
    """A board in one image."""

    ids: I64  # [n] of the board's corners
    corners: F32  # [n, 2] px


@dataclass(frozen=True, slots=True)
class StereoView:
    """The corners that both eyes see of a board at one moment."""

    name: str
    ids: I64  # [n]
    left: F32  # [n, 2] px
    right: F32  # [n, 2] px


class Board(Protocol):
    @property
    def points(self) -> F32:
        """Corners [N, 3] on the board, m, z = 0."""

    def find(self, gray: U8) -> Seen | None:
        """The corners in an image [H, W]; None where the board is not seen."""

    def explain(self, gray: U8) -> str:
        """Return in words what an image [H, W] shows instead of this board; empty: that is not known."""


class Chessboard:
    """A plain chessboard of `squares` (columns, rows), each `square` m wide. It must be seen whole."""

    def __init__(self, squares: tuple[int, int], square: float) -> None:
        self._inner = squares[0] - 1, squares[1] - 1
        self.points = _grid(self._inner, square)
        self._ids = np.arange(len(self.points))

    def find(self, gray: U8) -> Seen | None:
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        found, corners = cv2.findChessboardCornersSB(gray, self._inner, flags=flags)
        if not found:
            return None
        # The detector is robust, but a gradient search around its corners is three times as exact.
        grid = corners.reshape(self._inner[1], self._inner[0], 2)
        nearest = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
        window = max(2, int(REFINE * nearest))
        refined = cv2.cornerSubPix(gray, corners, (window, window), (-1, -1), REFINE_CRITERIA)
        return Seen(self._ids, refined.reshape(-1, 2))

    def explain(self, gray: U8) -> str:
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
        found, _, meta = cv2.findChessboardCornersSBWithMeta(gray, (3, 3), flags)
        if not found:
            return ""
        return f"a board of {max(meta.shape) + 1}x{min(meta.shape) + 1} squares is seen"


class Charuco:
    """A ChArUco board of `squares` (columns, rows); it may be seen in part.

    Args:
        square, marker: m, sides of a square and of a marker.
        dictionary: of the markers, as OpenCV names it, with or without `DICT_`.
        legacy: laid out as OpenCV did before 4.6: a board with an even number of rows begins with a marker.

    Raises:
        UsageError: there is no such dictionary, or it has too few markers.
    """

    def __init__(
        self, squares: tuple[int, int], square: float, marker: float, dictionary: str, legacy: bool = False
    ) -> None:
        name = dictionary.upper().removeprefix(PREFIX)
        number = getattr(cv2.aruco, PREFIX + name, None)
        if number is None:
            known = sorted(n.removeprefix(PREFIX) for n in dir(cv2.aruco) if n.startswith(PREFIX))
            raise UsageError(f"--dictionary {dictionary}: known are {', '.join(known)}")
        markers = cv2.aruco.getPredefinedDictionary(number)
        self._markers = squares[0] * squares[1] // 2
        if self._markers > len(markers.bytesList):
            raise UsageError(
                f"--dictionary {dictionary} has {len(markers.bytesList)} markers, a board of {squares[0]}x"
                f"{squares[1]} squares {self._markers}; name the one that the board was printed with"
            )
        self._name = name
        board = cv2.aruco.CharucoBoard(squares, square, marker, markers)
        board.setLegacyPattern(legacy)
        self._detector = cv2.aruco.CharucoDetector(board)
        self.points = _grid((squares[0] - 1, squares[1] - 1), square)

    def find(self, gray: U8) -> Seen | None:
        corners, ids, _, _ = self._detector.detectBoard(gray)
        if ids is None or len(ids) < FEWEST_CORNERS:
            return None
        return Seen(ids.ravel().astype(np.int64), corners.reshape(-1, 2))

    def explain(self, gray: U8) -> str:
        _, _, _, ids = self._detector.detectBoard(gray)
        if ids is None or len(ids) == 0:
            return f"no marker of {self._name} is seen"
        if ids.max() >= self._markers:
            return f"marker {ids.max()} is seen, the board has 0 to {self._markers - 1}"
        return f"{len(ids)} markers are seen, but they do not lie as on this board (an old print: --legacy)"


def find_in_both(board: Board, name: str, left: U8, right: U8) -> StereoView | None:
    """The corners that both images [H, W, 3] (RGB) of one moment show; None where there are too few."""
    in_left = board.find(cv2.cvtColor(left, cv2.COLOR_RGB2GRAY))
    in_right = None if in_left is None else board.find(cv2.cvtColor(right, cv2.COLOR_RGB2GRAY))
    if in_left is None or in_right is None:
        return None
    ids, of_left, of_right = np.intersect1d(in_left.ids, in_right.ids, return_indices=True)
    if len(ids) < FEWEST_CORNERS:
        return None
    first, second = in_left.corners[of_left], in_right.corners[of_right]
    if isinstance(board, Chessboard):
        second = turned_like(second, first)
    return StereoView(name, ids, first, second)


def turned_like(corners: F32, others: F32) -> F32:
    """The corners [n, 2] of a chessboard seen whole, reversed where they run against `others`: the board may
    look the same upside down."""
    alike = float((corners[-1] - corners[0]) @ (others[-1] - others[0])) > 0
    return corners if alike else corners[::-1]


def _grid(inner: tuple[int, int], square: float) -> F32:
    x, y = np.meshgrid(np.arange(inner[0]), np.arange(inner[1]))
    return np.stack([x * square, y * square, 0 * x], -1).reshape(-1, 3).astype(np.float32)
