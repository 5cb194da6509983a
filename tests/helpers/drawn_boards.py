"""Boards drawn through the exact model of a known rig."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.calibration import rectify_eyes
from sags_node.types import F64, U8, Eye, StereoRig

SIZE = 480, 384
SQUARES = 10, 7
SQUARE = 0.0045  # m
TEXELS = 40  # of a square of the printed board
FINER = 3  # samples along each side of a pixel


def known_rig() -> StereoRig:
    K_left = np.array([[430.0, 0, 246.0], [0, 432.0, 187.0], [0, 0, 1]])
    K_right = np.array([[433.0, 0, 235.0], [0, 434.0, 195.0], [0, 0, 1]])
    distortion = np.array([-0.17, 0.06, 6e-4, -4e-4, 0]), np.array([-0.15, 0.05, -5e-4, 3e-4, 0])
    R = cv2.Rodrigues(np.radians([0.3, 0.8, -0.4]))[0]
    return rectify_eyes("known", SIZE, (K_left, K_right), distortion, R, np.array([-0.0047, 6e-5, -9e-5]))


def poses() -> list[F64]:
    """Board to left camera, [4, 4] m: all over the picture, tilted all ways, near and far."""
    rng = np.random.default_rng(5)
    made = []
    for index in range(18):
        tilts = rng.uniform(-28, 28, 2)
        turn = cv2.Rodrigues(np.radians([tilts[0], tilts[1], rng.uniform(-15, 15)]))[0]
        distance = rng.uniform(0.055, 0.085)
        across = np.array([(index % 3 - 1) * 0.011, (index // 3 % 3 - 1) * 0.008]) * distance / 0.07
        centre = np.array([SQUARES[0] / 2 - 1, SQUARES[1] / 2 - 1, 0]) * SQUARE
        pose = np.eye(4)
        pose[:3, :3] = turn
        pose[:3, 3] = np.array([*across, distance]) - turn @ centre
        made.append(pose)
    return made


@dataclass(frozen=True)
class Print:
    """A printed board: texels, and where its first inner corner lies in them."""

    picture: U8
    origin: float


def chessboard_print(squares: tuple[int, int] = SQUARES) -> Print:
    columns, rows = np.meshgrid(np.arange(squares[0]), np.arange(squares[1]))
    fields = np.where((columns + rows) % 2, 235, 20).astype(np.uint8)
    board = np.kron(fields, np.ones((TEXELS, TEXELS), np.uint8))
    return Print(cv2.copyMakeBorder(board, *[TEXELS] * 4, cv2.BORDER_CONSTANT, value=235), 2 * TEXELS - 0.5)


def charuco_print(squares: tuple[int, int] = SQUARES, legacy: bool = False) -> Print:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(squares, SQUARE, 0.75 * SQUARE, dictionary)
    board.setLegacyPattern(legacy)
    picture = board.generateImage((squares[0] * TEXELS, squares[1] * TEXELS))
    return Print(cv2.copyMakeBorder(picture, *[TEXELS] * 4, cv2.BORDER_CONSTANT, value=235), 2 * TEXELS - 0.5)


def fine_rays(eye: Eye) -> F64:
    """Rays [H * FINER, W * FINER, 2] at distance 1 of points spread evenly over each raw pixel."""
    steps = [(np.arange(side * FINER) + 0.5) / FINER - 0.5 for side in SIZE]
    pixels = np.stack(np.meshgrid(*steps), -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    plain = cv2.undistortPoints(pixels, eye.K, eye.distortion, criteria=criteria)
    return plain.reshape(SIZE[1] * FINER, SIZE[0] * FINER, 2)


def draw(printed: Print, rays: F64, camera_from_board: F64) -> U8:
    """The board on its plane, seen along rays; each pixel is the mean of its samples."""
    plane_to_ray = np.column_stack(
        [camera_from_board[:3, 0], camera_from_board[:3, 1], camera_from_board[:3, 3]]
    )
    on_board = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1) @ np.linalg.inv(plane_to_ray).T
    texels = (on_board[..., :2] / on_board[..., 2:] / SQUARE * TEXELS + printed.origin).astype(np.float32)
    fine = cv2.remap(printed.picture, texels, None, cv2.INTER_LINEAR, borderValue=90)
    gray = cv2.GaussianBlur(cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    return np.repeat(gray[..., None], 3, -1)


def draw_pairs(printed: Print, board_poses: list[F64]) -> list[tuple[U8, U8]]:
    rig = known_rig()
    left, right = fine_rays(rig.left), fine_rays(rig.right)
    return [
        (draw(printed, left, pose), draw(printed, right, rig.T_right_left @ pose)) for pose in board_poses
    ]
