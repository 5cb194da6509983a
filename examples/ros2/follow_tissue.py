"""A node of rclpy that pins a point of the tissue and publishes where it is: `tissue_point`, PointStamped.

    sags run launch/d4d_pull.yaml &
    sags bridge ros2 &
    python3 examples/ros2/follow_tissue.py --ros-args -p u:=320.0 -p v:=256.0     # where ROS 2 is set up

It needs rclpy and ROS' messages, and nothing of this package. Tried with Kilted; see docs/bridges.md.
"""

import json
import sys

import numpy as np
import rclpy
from geometry_msgs.msg import Point, PointStamped
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

SURE = 0.5  # of both confidences: docs/wire.md, Anchors
EXACT = 0.1  # s, of the time when an anchor was pinned: its `age` is a float32
ASK_AGAIN = 2.0  # s: a request of a publisher that has just begun may be lost


class FollowTissue(Node):
    """Silent while the point is not recognised, or how deep it lies is a guess."""

    def __init__(self) -> None:
        super().__init__("follow_tissue")
        self.anchor: int | None = None
        self.pinned = float("inf")  # s; when, by its first row
        self.pixel = Point(
            x=self.declare_parameter("u", 320.0).value, y=self.declare_parameter("v", 256.0).value
        )
        self.request = self.create_publisher(Point, "/sags/request/add_anchor_at_pixel", 1)
        self.place = self.create_publisher(PointStamped, "tissue_point", 1)
        self.create_subscription(String, "/sags/answer", self.answered, 10)
        self.create_subscription(PointCloud2, "/sags/anchors", self.came, 1)
        self.asking = self.create_timer(ASK_AGAIN, lambda: self.request.publish(self.pixel))

    def answered(self, message: String) -> None:
        answer = json.loads(message.data)
        asked = {"u": self.pixel.x, "v": self.pixel.y}
        is_ours = answer.get("request") == "add_anchor_at_pixel" and answer.get("args", asked) == asked
        if not is_ours or self.anchor is not None:  # others ask, too, and all hear all answers
            return
        if "error" in answer:  # and it is asked again
            self.get_logger().warning(answer["error"])
            return
        self.anchor = answer["result"]["id"]
        self.asking.cancel()
        self.get_logger().info(f"follows anchor {self.anchor}")

    def came(self, cloud: PointCloud2) -> None:
        if self.anchor is None:
            return
        columns = {field.name: field.offset // 4 for field in cloud.fields}
        numbers = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_step // 4)
        ids = numbers[:, columns["id"]].view("<u4") if len(numbers) else np.zeros(0, "<u4")
        rows = numbers[ids == self.anchor]
        if not len(rows) and np.isfinite(self.pinned):  # else it was pinned in a frame after this one
            sys.exit("the point was removed, or the node was started anew; start this again")
        for row in rows:
            pinned = cloud.header.stamp.sec + 1e-9 * cloud.header.stamp.nanosec - float(row[columns["age"]])
            if pinned > self.pinned + EXACT:  # another anchor: numbers begin again with a new node
                sys.exit("the node was started anew: its anchors are gone; start this again")
            self.pinned = pinned
            if min(row[columns["confidence"]], row[columns["depth_confidence"]]) >= SURE:
                place = PointStamped(header=cloud.header)
                place.point.x, place.point.y, place.point.z = (float(row[columns[axis]]) for axis in "xyz")
                self.place.publish(place)


def main() -> None:
    rclpy.init()
    node = FollowTissue()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
