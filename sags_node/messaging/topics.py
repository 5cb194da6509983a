"""The contents page of the wire: every topic this node publishes, under its namespace.

Coordinates: images and depth belong to the left or right optical frame, `points` and `splats` to `world`.
`splats` holds linear, activated values: scales in metres, opacity 0..1, and colour as the degree-0 spherical
harmonic f_dc = (rgb - 0.5) / 0.28209479. (A 3DGS PLY file holds the logarithm and the logit instead.)
"""

from __future__ import annotations

from dataclasses import dataclass

IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
STRING = "std_msgs/msg/String"


@dataclass(frozen=True, slots=True)
class Topic:
    name: str  # under the namespace
    type: str  # stock ROS 2 type
    content: str
    right: bool = False  # only when publish.right is set
    cached: bool = False  # the last value is sent again to whoever subscribes
    periodic: bool = True  # repeats with every frame or every second, so silence means stale


TOPICS = (
    Topic("left/image_rect_color", IMAGE, "rgb8, the rectified input"),
    Topic("right/image_rect_color", IMAGE, "rgb8, the rectified input", right=True),
    Topic("left/camera_info", CAMERA_INFO, "rectified camera", cached=True),
    Topic("right/camera_info", CAMERA_INFO, "rectified camera, P[3] = -f B (m)", right=True, cached=True),
    Topic("left/render/image", IMAGE, "rgba8, the model drawn for that eye, alpha = coverage"),
    Topic("right/render/image", IMAGE, "rgba8, the model drawn for that eye, alpha = coverage", right=True),
    Topic("left/render/depth", IMAGE, "32FC1, metres along z, NaN where the model says nothing"),
    Topic("left/depth", IMAGE, "32FC1, this frame's measured depth (m), NaN unknown"),
    Topic("left/tissue_mask", IMAGE, "mono8, 255 = tissue"),
    Topic("points", POINT_CLOUD, "x y z (m, world) rgb: the visible Gaussians"),
    Topic("splats", POINT_CLOUD, "every Gaussian: linear scales (m), opacity 0..1, world", cached=True),
    Topic("tf", TF, "world -> left optical frame"),
    Topic("diagnostics", DIAGNOSTICS, "1 Hz, one status per stage"),
    Topic("status", STRING, "JSON: rates, latencies, drops, memory, what was skipped", cached=True),
    Topic("parameters", STRING, "JSON: the launch configuration in force", cached=True, periodic=False),
)
BY_NAME = {topic.name: topic for topic in TOPICS}


def full_name(ns: str, name: str) -> str:
    """The topic as it stands on the wire, e.g. `sags/left/depth`."""
    return f"{ns}/{name}"
