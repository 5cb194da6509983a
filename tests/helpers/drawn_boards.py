"""Boards drawn through the exact model of a known rig."""

import cv2
import numpy as np

from sags_node.phantom.board import TEXELS, PrintedBoard, chessboard, draw, fine_rays, printed
from sags_node.rig import rectify_eyes
from sags_node.types import F64, U8, StereoRig

SIZE = 480, 384
SQUARES = 10, 7
SQUARE = 0.0045  # m


def known_rig() -> StereoRig:
    K_left = np.array([[430.0, 0, 246.0], [0, 432.0, 187.0], [0, 0, 1]])
    K_right = np.array([[433.0, 0, 235.0], [0, 434.0, 195.0], [0, 0, 1]])
    distortion = np.array([-0.17, 0.06, 6e-4, -4e-4, 0]), np.array([-0.15, 0.05, -5e-4, 3e-4, 0])
    R = cv2.Rodrigues(np.radians([0.3, 0.8, -0.4]))[0]
    return rectify_eyes("known", SIZE, (K_left, K_right), distortion, R, np.array([-0.0047, 6e-5, -9e-5]))


def poses() -> list[F64]:
    """Board to left camera, [4, 4] m: all over the image, tilted all ways, near and far."""
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


def chessboard_print(squares: tuple[int, int] = SQUARES) -> PrintedBoard:
    return chessboard(squares, SQUARE)


def charuco_print(squares: tuple[int, int] = SQUARES, legacy: bool = False) -> PrintedBoard:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(squares, SQUARE, 0.75 * SQUARE, dictionary)
    board.setLegacyPattern(legacy)
    return printed(board.generateImage((squares[0] * TEXELS, squares[1] * TEXELS)), SQUARE)


def draw_pairs(board: PrintedBoard, board_poses: list[F64]) -> list[tuple[U8, U8]]:
    rig = known_rig()
    left, right = fine_rays(rig.left), fine_rays(rig.right)
    return [(draw(board, left, pose), draw(board, right, rig.T_right_left @ pose)) for pose in board_poses]
