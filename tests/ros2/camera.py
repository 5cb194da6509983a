"""A ROS 2 camera of rclpy's own: two image topics, their camera_info, and a pose. Runs without our package.

python camera.py SECONDS RATE WIDTH HEIGHT
"""

import array
import sys
import time

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

seconds, rate = float(sys.argv[1]), float(sys.argv[2])
width, height = int(sys.argv[3]), int(sys.argv[4])
rclpy.init()
node = rclpy.create_node("camera")
large = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
pictures = [node.create_publisher(Image, f"/stereo/{eye}/image_raw", large) for eye in ("left", "right")]
infos = [node.create_publisher(CameraInfo, f"/stereo/{eye}/camera_info", 10) for eye in ("left", "right")]
pose = node.create_publisher(PoseStamped, "/scope/measured_cp", 10)

image, info, where = Image(), CameraInfo(), PoseStamped()
image.height, image.width, image.encoding, image.step = height, width, "bgr8", 3 * width
pixels = bytearray(3 * width * height)
focal, baseline = 0.9 * width, 0.004
info.height, info.width, info.distortion_model, info.d = height, width, "plumb_bob", [0.0] * 5
info.k = [focal, 0.0, width / 2, 0.0, focal, height / 2, 0.0, 0.0, 1.0]
info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
where.header.frame_id = "base"
where.pose.orientation.w = 1.0

print("sending", flush=True)
begun = time.monotonic()
for number in range(round(seconds * rate)):
    time.sleep(max(0.0, begun + number / rate - time.monotonic()))
    stamp = time.time_ns()
    for message in (image, info, where):
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    for bit in range(16):  # the number, painted as tests/helpers/stereo_sender.py does
        value = 255 * (number >> bit & 1)
        for row in range(8):
            start = 3 * (row * width + 8 * bit)
            pixels[start : start + 24] = bytes([value]) * 24
    image.data = array.array("B", pixels)
    where.pose.position.x = 0.001 * number
    pose.publish(where)
    for eye in range(2):
        info.p = [
            focal, 0.0, width / 2, -focal * baseline * eye, 0.0, focal, height / 2, 0.0, 0.0, 0.0, 1.0, 0.0,
        ]  # fmt: skip
        infos[eye].publish(info)
        pictures[eye].publish(image)
time.sleep(0.5)
