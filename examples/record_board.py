"""A recording to try `sags calib hand-eye` with: a robot moves a stereo scope over a board.

    python examples/record_board.py out/board
    sags calib hand-eye out/board/bag rig:=out/board/rig robot.kind:=bag robot.topic:=/ECM/measured_cp \
        --squares 10x7 --square-mm 4.5 -o out/board/rig

What must come out is printed: how the camera sits on the robot, and that the robot's clock is 60 ms ahead.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from sags_node.errors import SagsError
from sags_node.geometry import invert
from sags_node.messaging import cdr
from sags_node.messaging.topics import IMAGE
from sags_node.phantom.board import chessboard, draw, fine_rays
from sags_node.phantom.rig import phantom_rig
from sags_node.rig import save_rig

Pose = NDArray[np.float64]  # [4, 4] m

SIZE = 480, 384  # px
PICTURES, POSES = 10, 100  # a second
AHEAD_S = 0.06  # of the robot's clock
BEGIN_NS = 1_700_000_000 * 10**9


def rigid(turn_degrees: tuple[float, float, float], place_mm: tuple[float, float, float]) -> Pose:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.radians(turn_degrees))[0]
    T[:3, 3] = np.array(place_mm) * 1e-3
    return T


T_HAND_CAMERA = rigid((8, -25, 70), (12, -31, 220))  # of a scope of 22 cm
T_BASE_BOARD = rigid((30, 10, -50), (400, -200, 600))
T_CAMERA_BOARD = rigid((0, 0, 3), (-18, -13.5, 70))  # in the middle of the motion


def camera_at(t: float) -> Pose:
    """The left camera in the robot's base: turned to and fro about all axes, never twice in the same way."""
    turn = 12 * np.sin(1.9 * t), 14 * np.sin(2.7 * t + 1), 10 * np.sin(1.3 * t + 2)
    place = 6 * np.sin(2.3 * t), 5 * np.sin(1.7 * t + 1), 5 * np.sin(1.1 * t)
    return T_BASE_BOARD @ invert(rigid(turn, place) @ T_CAMERA_BOARD)


def record(folder: Path, seconds: float = 4.0) -> None:
    """Write `bag` and `rig`."""
    rig, board = phantom_rig(*SIZE), chessboard((10, 7), 4.5e-3)
    save_rig(rig, folder / "rig")
    rays = {"left": fine_rays(rig.left), "right": fine_rays(rig.right)}
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        eyes = {eye: bag.add_connection(f"/stereo/{eye}/image_raw", IMAGE, typestore=store) for eye in rays}
        robot = bag.add_connection("/ECM/measured_cp", cdr.POSE, typestore=store)
        for number in range(-POSES, round((seconds + 1) * POSES)):
            t = number / POSES
            stamp = BEGIN_NS + round((t + AHEAD_S) * 1e9)
            hand = camera_at(t) @ invert(T_HAND_CAMERA)
            bag.write(robot, stamp, b"".join(bytes(part) for part in cdr.pose(hand, stamp, "base").parts))
            if number % (POSES // PICTURES) or not 0 <= t < seconds:
                continue
            stamp = BEGIN_NS + round(t * 1e9)
            view = invert(camera_at(t)) @ T_BASE_BOARD
            for eye, T in (("left", view), ("right", rig.T_right_left @ view)):
                picture = cdr.image(draw(board, rays[eye], T), "rgb8", stamp)
                bag.write(eyes[eye], stamp, b"".join(bytes(part) for part in picture.parts))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="new; gets bag/ and rig/")
    folder = parser.parse_args().folder
    try:
        record(folder)
    except (SagsError, WriterError) as error:
        sys.exit(f"error: {error}")
    place = " ".join(f"{1e3 * part:.2f}" for part in T_HAND_CAMERA[:3, 3])
    print(f"camera on the hand: {place} mm; robot - images: {1e3 * AHEAD_S:.0f} ms")


if __name__ == "__main__":
    main()
