"""The contents page of the wire: every topic this node publishes, under its namespace.

Coordinates: images and depth belong to the left or right optical frame, `points`, `splats` and `anchors` to
`world`.
`splats` holds linear, activated values: scales in metres, opacity 0..1, and colour as the degree-0 spherical
harmonic f_dc = (rgb - 0.5) / 0.28209479. (A 3DGS PLY file holds the logarithm and the logit instead.)
"""

from __future__ import annotations

import re
from dataclasses import dataclass

IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
STRING = "std_msgs/msg/String"
CLOCK = "rosgraph_msgs/msg/Clock"


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
    Topic("left/render/depth", IMAGE, "32FC1, metres along z, NaN where the model says nothing sure enough"),
    Topic("left/render/depth_confidence", IMAGE, "32FC1, 0..1, how far to trust each depth; 0.5: 3 mm"),
    Topic("left/depth", IMAGE, "32FC1, this frame's measured depth (m), NaN unknown"),
    Topic("left/tissue_mask", IMAGE, "mono8, 255 = tissue"),
    Topic("points", POINT_CLOUD, "x y z (m, world) rgb confidence: the visible Gaussians"),
    Topic("splats", POINT_CLOUD, "every Gaussian: linear scales (m), opacity 0..1, world", cached=True),
    Topic("anchors", POINT_CLOUD, "points pinned to the tissue: x y z (m, world), pixel, visibility, age"),
    Topic("tf", TF, "world -> left optical frame"),
    Topic("diagnostics", DIAGNOSTICS, "1 Hz, one status per stage"),
    Topic("status", STRING, "JSON: rates, latencies, drops, memory, what was skipped", cached=True),
    Topic("parameters", STRING, "JSON: the launch configuration in force", cached=True, periodic=False),
)
BY_NAME = {topic.name: topic for topic in TOPICS}

# What `sags bag play --clock` adds to the topics of the recording.
PLAYER_TOPICS = (Topic("clock", CLOCK, "the moment of the recording that is played now"),)

# What `sags overlay` publishes on a socket of its own.
_KEYED = "rgb8, the overlay on a key colour, for displays that blend by one"
OVERLAY_TOPICS = (
    Topic("left/overlay/image", IMAGE, "rgba8, virtual geometry, not premultiplied"),
    Topic("right/overlay/image", IMAGE, "rgba8, virtual geometry, not premultiplied"),
    Topic("left/overlay/color_key", IMAGE, _KEYED),
    Topic("right/overlay/color_key", IMAGE, _KEYED),
    Topic("status", STRING, "JSON: what is drawn, or why nothing is; latency", cached=True),
)
_OF_OTHERS = {topic.name: topic for topic in (*PLAYER_TOPICS, *OVERLAY_TOPICS)}

VIEW_NAME = re.compile(r"[A-Za-z0-9_]{1,64}")
_VIEW_TOPIC = re.compile(
    rf"view/{VIEW_NAME.pattern}/(?:(?:left|right)/)?(image|depth|depth_confidence|camera_info)"
)
_VIEW_KINDS = {
    "image": (IMAGE, "rgba8, the model from a viewpoint that a consumer asked for"),
    "depth": (IMAGE, "32FC1, metres along z of that viewpoint, NaN where the model says nothing sure enough"),
    "depth_confidence": (IMAGE, "32FC1, 0..1, how far to trust each depth of that viewpoint"),
    "camera_info": (CAMERA_INFO, "the camera of that viewpoint"),
}


def find(name: str) -> Topic | None:
    """The entry of a topic named without the namespace, also of a player or an overlay, or of a view that a
    consumer may have opened."""
    known = BY_NAME.get(name) or _OF_OTHERS.get(name)
    if known is not None:
        return known
    view = _VIEW_TOPIC.fullmatch(name)
    return None if view is None else Topic(name, *_VIEW_KINDS[view[1]], cached=view[1] == "camera_info")


def full_name(ns: str, name: str) -> str:
    """The topic as it stands on the wire, e.g. `sags/left/depth`."""
    return f"{ns}/{name}"
