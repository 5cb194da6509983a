"""A printed calibration board, drawn through the exact model of an eye."""

from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.types import F64, U8, Eye

TEXELS = 40  # along each side of a square
FINER = 3  # samples along each side of a pixel
DARK, WHITE, AROUND = 20, 235, 90  # grey levels
LENS_BLUR = 0.6  # px


@dataclass(frozen=True, slots=True)
class PrintedBoard:
    """A board's image and its scale."""

    picture: U8  # [h, w]
    origin: float  # px of the image: x and y of the first inner corner
    square: float  # m, side of a square


def printed(squares: U8, square: float) -> PrintedBoard:
    """Return a board of `squares` [rows * TEXELS, columns * TEXELS], with a white margin of one square."""
    return PrintedBoard(np.pad(squares, TEXELS, constant_values=WHITE), 2 * TEXELS - 0.5, square)


def chessboard(squares: tuple[int, int], square: float) -> PrintedBoard:
    """Return a chessboard with `squares` columns and rows of squares, each `square` m wide."""
    columns, rows = np.meshgrid(np.arange(squares[0]), np.arange(squares[1]))
    fields = np.where((columns + rows) % 2, WHITE, DARK).astype(np.uint8)
    return printed(np.kron(fields, np.ones((TEXELS, TEXELS), np.uint8)), square)


def fine_rays(eye: Eye) -> F64:
    """Return the rays [H * FINER, W * FINER, 2] (x, y at z = 1) of points spread evenly over raw pixels."""
    steps = [(np.arange(side * FINER) + 0.5) / FINER - 0.5 for side in (eye.width, eye.height)]
    pixels = np.stack(np.meshgrid(*steps), -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    plain = cv2.undistortPoints(pixels, eye.K, eye.distortion, criteria=criteria)
    rays: F64 = plain.reshape(eye.height * FINER, eye.width * FINER, 2)
    return rays


def draw(board: PrintedBoard, rays: F64, T_camera_board: F64) -> U8:
    """Draw the board [H, W, 3] as an eye sees it; each pixel is the mean of its samples.

    Args:
        rays: of the eye, see `fine_rays`.
        T_camera_board: [4, 4] m, from the board, whose origin is its first inner corner, to the raw camera.
    """
    plane_to_ray = np.column_stack([T_camera_board[:3, 0], T_camera_board[:3, 1], T_camera_board[:3, 3]])
    on_board = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1) @ np.linalg.inv(plane_to_ray).T
    texels = on_board[..., :2] / on_board[..., 2:] / board.square * TEXELS + board.origin
    fine = cv2.remap(board.picture, texels.astype(np.float32), None, cv2.INTER_LINEAR, borderValue=AROUND)
    size = rays.shape[1] // FINER, rays.shape[0] // FINER
    gray = cv2.GaussianBlur(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), (0, 0), LENS_BLUR)
    return np.repeat(np.asarray(gray, np.uint8)[..., None], 3, -1)
