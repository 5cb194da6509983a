"""A process that sends pairs of phantom images for a minute, for tests of sources that other programs feed.

    python stereo_sender.py push ENDPOINT [key=value ...]
    python stereo_sender.py dds DOMAIN [key=value ...]

The number of each pair is painted into both images (`read_number`), so that a mismatch shows; with
`clock=1` the milliseconds of its stamp (of a minute), so that a wrong stamp shows. In the end it says how
many images were left out because nobody took them in time.
"""

import sys
import time
from collections.abc import Callable

import cv2
import numpy as np
from places import SESSION

from sags_node.rig import load_rig, resized_rig
from sags_node.types import U8

SECONDS = 60
BITS, BLOCK = 16, 8  # of the painted number, and px of one


def paint_number(picture: U8, number: int) -> None:
    for bit in range(BITS):
        picture[:BLOCK, BLOCK * bit : BLOCK * (bit + 1)] = 255 * (number >> bit & 1)


def read_number(picture: U8) -> int:
    middles = picture[BLOCK // 2, BLOCK // 2 : BLOCK * BITS : BLOCK, 0]
    return sum(int(value > 127) << bit for bit, value in enumerate(middles))


def push(endpoint: str, jpeg: bool) -> tuple[Callable[[U8, U8, int], None], Callable[[], int]]:
    """What sends a pair, and how many images it has left out."""
    from sags_node.client import FrameSender

    sender = FrameSender(endpoint)

    def send(left: U8, right: U8, stamp_ns: int) -> None:
        if jpeg:
            sender.send(
                *(cv2.imencode(".jpg", eye[..., ::-1])[1].tobytes() for eye in (left, right)), stamp_ns
            )
        else:
            sender.send(left, right, stamp_ns)

    return send, lambda: sender.left_out


def dds(domain: int, compressed: bool, scale: float) -> Callable[[U8, U8, int], None]:
    from sags_node.config.schema import RosGraph
    from sags_node.messaging import cdr
    from sags_node.messaging.topics import CAMERA_INFO, IMAGE, TF
    from sags_node.ros.graph import Graph

    graph = Graph(RosGraph(domain=domain))
    kind, suffix = (cdr.COMPRESSED, "/compressed") if compressed else (IMAGE, "")
    pictures = [graph.writer(f"/stereo/{eye}/image_raw{suffix}", kind) for eye in ("left", "right")]
    calibrations = [graph.writer(f"/stereo/{eye}/camera_info", CAMERA_INFO) for eye in ("left", "right")]
    tf = graph.writer("/tf", TF)
    pose = np.eye(4)
    pose[:3, 3] = 0.1, 0.2, 0.3
    rig = resized_rig(load_rig(SESSION / "calib"), scale)

    def send(left: U8, right: U8, stamp_ns: int) -> None:
        tf.write(cdr.transform(pose, stamp_ns).cdr(), stamp_ns)
        for writer, eye in zip(calibrations, (rig.left, rig.right), strict=True):
            writer.write(cdr.eye_info(eye, stamp_ns).cdr(), stamp_ns)
        for writer, picture in zip(pictures, (left, right), strict=True):
            if compressed:
                file = cv2.imencode(".jpg", picture[..., ::-1])[1].tobytes()
                writer.write(cdr.picture_file(file, stamp_ns).cdr(), stamp_ns)
            else:
                writer.write(cdr.image(picture, "rgb8", stamp_ns).cdr(), stamp_ns)

    return send


def main() -> None:
    way, where, *settings = sys.argv[1:]
    said = dict(setting.split("=") for setting in settings)
    rate = float(said.get("rate", 30))
    width, height = (int(side) for side in said.get("size", "1280x1024").split("x"))
    pairs = [
        [
            cv2.resize(cv2.imread(str(SESSION / eye / f"{index:04d}.jpg"))[..., ::-1], (width, height))
            for eye in ("left", "right")
        ]
        for index in range(4)
    ]
    compressed = "jpeg" in said
    if way == "push":
        send, left_out = push(where, compressed)
    else:
        send, left_out = dds(int(where), compressed, width / 320), lambda: 0
    print("sending", flush=True)
    due = time.monotonic()
    for number in range(round(SECONDS * rate)):
        time.sleep(max(0.0, due - time.monotonic()))
        due = max(due, time.monotonic()) + 1 / rate  # as a camera: what it was late with comes in no burst
        left, right = pairs[number % len(pairs)]
        stamp_ns = time.time_ns()
        painted = stamp_ns // 1_000_000 % 60_000 if "clock" in said else number
        for picture in (left, right):
            paint_number(picture, painted % 2**BITS)
        send(left, right, stamp_ns)
    time.sleep(0.5)
    print(left_out(), flush=True)


if __name__ == "__main__":
    main()
