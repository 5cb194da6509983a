"""A process that sends pairs of phantom images for a minute, for tests of sources that other programs feed.

    python stereo_sender.py push ENDPOINT [key=value ...]
    python stereo_sender.py dds DOMAIN [key=value ...]

The number of each pair is painted into both images (`read_number`), so that a mismatch shows; with
`clock=1` the milliseconds of its stamp (of a minute), so that a wrong stamp shows. It sends them as
`examples/send_phantom.py` does.
"""

import sys
import time

import cv2
import numpy as np
from places import ROOT, SESSION

from sags_node.rig import load_rig, resized_rig
from sags_node.types import U8

SECONDS, RATE = 60, 30
BITS, BLOCK = 16, 8  # of the painted number, and px of one


def paint_number(picture: U8, number: int) -> None:
    for bit in range(BITS):
        picture[:BLOCK, BLOCK * bit : BLOCK * (bit + 1)] = 255 * (number >> bit & 1)


def read_number(picture: U8) -> int:
    middles = picture[BLOCK // 2, BLOCK // 2 : BLOCK * BITS : BLOCK, 0]
    return sum(int(value > 127) << bit for bit, value in enumerate(middles))


def main() -> None:
    sys.path.insert(0, str(ROOT / "examples"))
    from send_phantom import published, pushed

    way, where, *settings = sys.argv[1:]
    said = dict(setting.split("=") for setting in settings)
    width, height = (int(side) for side in said.get("size", "1280x1024").split("x"))
    pairs = [
        [
            cv2.resize(cv2.imread(str(SESSION / eye / f"{index:04d}.jpg"))[..., ::-1], (width, height))
            for eye in ("left", "right")
        ]
        for index in range(4)
    ]
    pose = np.eye(4)
    pose[:3, 3] = 0.1, 0.2, 0.3
    if way == "push":
        send = pushed(where, None, None)
    else:
        rig = resized_rig(load_rig(SESSION / "calib"), width / 320)
        send = published(int(where), "/stereo", (rig.left, rig.right), "jpeg" in said)
    print("sending", flush=True)
    due = time.monotonic()
    for number in range(SECONDS * RATE):
        time.sleep(max(0.0, due - time.monotonic()))
        due = max(due, time.monotonic()) + 1 / RATE  # as a camera: what it was late with comes in no burst
        left, right = pairs[number % len(pairs)]
        stamp_ns = time.time_ns()
        painted = stamp_ns // 1_000_000 % 60_000 if "clock" in said else number
        for picture in (left, right):
            paint_number(picture, painted % 2**BITS)
        send(left, right, pose, stamp_ns)


if __name__ == "__main__":
    main()
