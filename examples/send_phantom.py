"""A simulator in the place of cameras: the phantom, handed in over ZeroMQ or published as ROS 2 does it.

    python examples/send_phantom.py push
    python examples/send_phantom.py ros2

The node then runs, in another terminal, with `launch/push.yaml` or `launch/ros2.yaml`.
"""

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.client import FrameSender, PoseSender, SagsError
from sags_node.config.schema import PhantomSource
from sags_node.messaging import cdr
from sags_node.phantom import cached_session
from sags_node.rig import load_rig, save_rig
from sags_node.rig.hand_eye import HandEye, save_hand_eye
from sags_node.types import Eye

Picture = NDArray[np.uint8]
Send = Callable[[Picture, Picture, NDArray[np.float64], int], None]  # left, right, T_world_cam, stamp (ns)


def pushed(endpoint: str, jpeg: int | None, pose_endpoint: str | None) -> Send:
    """Over ZeroMQ."""
    frames = FrameSender(endpoint)
    poses = None if pose_endpoint is None else PoseSender(pose_endpoint)

    def send(left: Picture, right: Picture, pose: NDArray[np.float64], stamp_ns: int) -> None:
        if poses is not None:
            poses.send(pose, stamp_ns)
        if jpeg is None:
            frames.send(left, right, stamp_ns)
        else:
            files = (
                cv2.imencode(".jpg", eye[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, jpeg])[1].tobytes()
                for eye in (left, right)
            )
            frames.send(*files, stamp_ns)

    return send


def published(domain: int, name: str, infos: tuple[Eye, Eye], compressed: bool) -> Send:
    """As ROS 2 topics `name/left/image_raw` and so on, with camera_info and tf."""
    from sags_node.config.schema import RosGraph
    from sags_node.messaging.topics import CAMERA_INFO, IMAGE, TF
    from sags_node.ros.graph import Graph

    graph = Graph(RosGraph(domain=domain))
    kind, suffix = (cdr.COMPRESSED, "/compressed") if compressed else (IMAGE, "")
    pictures = [graph.writer(f"{name}/{eye}/image_raw{suffix}", kind) for eye in ("left", "right")]
    calibrations = [graph.writer(f"{name}/{eye}/camera_info", CAMERA_INFO) for eye in ("left", "right")]
    tf = graph.writer("/tf", TF)

    def send(left: Picture, right: Picture, pose: NDArray[np.float64], stamp_ns: int) -> None:
        tf.write(cdr.transform(pose, stamp_ns).cdr(), stamp_ns)
        for info_writer, info in zip(calibrations, infos, strict=True):
            info_writer.write(cdr.eye_info(info, stamp_ns).cdr(), stamp_ns)
        for writer, eye in zip(pictures, (left, right), strict=True):
            if compressed:
                file = cv2.imencode(".jpg", eye[..., ::-1])[1].tobytes()
                writer.write(cdr.picture_file(file, stamp_ns).cdr(), stamp_ns)
            else:
                writer.write(cdr.image(eye, "rgb8", stamp_ns).cdr(), stamp_ns)

    return send


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("way", choices=["push", "ros2"])
    parser.add_argument("--endpoint", default="tcp://127.0.0.1:5558")
    parser.add_argument("--pose-endpoint", help="also hand the scope's pose in there")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--name", default="/stereo")
    parser.add_argument("--jpeg", type=int, help="quality; default: raw images")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 512), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--seconds", type=float, help="default: until Ctrl-C")
    parser.add_argument("--rig", type=Path, help="write the calibration here, for the node, and end")
    said = parser.parse_args()
    if said.rate <= 0:
        parser.error("--rate must be above 0")
    print("rendering the phantom (once)", flush=True)
    config = PhantomSource(width=said.size[0], height=said.size[1], camera_motion="sway", seconds=2.0)
    folder = cached_session(config)
    rig = load_rig(folder / "calib")
    if said.rig is not None:
        save_rig(rig, said.rig)
        T = np.eye(4)
        T[:3, :3] = rig.left.R  # the phantom tells the pose of its left rectified camera
        save_hand_eye(HandEye(T), said.rig, {})
        return
    pairs = [
        [cv2.imread(str(folder / eye / f"{index:04d}.jpg"))[..., ::-1].copy() for eye in ("left", "right")]
        for index in range(60)
    ]
    poses = np.load(folder / "poses.npz")["T_world_cam"]
    if said.way == "push":
        send = pushed(said.endpoint, said.jpeg, said.pose_endpoint)
    else:
        send = published(said.domain, said.name, (rig.left, rig.right), said.jpeg is not None)
    print("sending", flush=True)
    begun = time.monotonic()
    for number in itertools.count():
        if said.seconds is not None and number >= said.seconds * said.rate:
            return
        time.sleep(max(0.0, begun + number / said.rate - time.monotonic()))
        turn = number % len(pairs)
        send(pairs[turn][0], pairs[turn][1], poses[turn], time.time_ns())


if __name__ == "__main__":
    try:
        main()
    except (SagsError, ValueError) as error:  # ValueError: a size or a domain that there is not
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)  # as sags
