"""The topics of the protocol: every topic that a node publishes, under its namespace.

Coordinates: images and depth belong to the left or right optical frame, `points`, `splats`, `anchors` and
`instruments` to `world`.
`splats` holds linear, activated values: scales in metres, opacity 0..1, and colour as the degree-0 spherical
harmonic f_dc = (rgb - 0.5) / 0.28209479. (A 3DGS PLY file holds the logarithm and the logit instead.)
"""

import re
from dataclasses import dataclass

from sags_node.errors import UsageError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
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
    right: bool = False  # not with publish.right:=false
    cached: bool = False  # the last value is sent again to whoever subscribes
    periodic: bool = True  # repeats with every frame or every second, so silence means stale

    @property
    def in_metres(self) -> bool:
        """Tell whether it holds lengths. A camera_info does, too, but can say by itself that it is not
        calibrated."""
        return self.type in (POINT_CLOUD, TF) or self.name.endswith("/depth")


TOPICS = (
    Topic("left/image_rect_color", IMAGE, "rgb8, the rectified input"),
    Topic("right/image_rect_color", IMAGE, "rgb8, the rectified input", right=True),
    Topic("left/camera_info", CAMERA_INFO, "rectified camera", cached=True),
    Topic("right/camera_info", CAMERA_INFO, "rectified camera, P[3] = -f B (m)", right=True, cached=True),
    Topic("left/render/image", IMAGE, "rgba8, the tissue without instruments, alpha = coverage"),
    Topic("right/render/image", IMAGE, "rgba8, the tissue without instruments, alpha = coverage", right=True),
    Topic("left/render/depth", IMAGE, "32FC1, metres along z, NaN where the model says nothing sure enough"),
    Topic("left/render/depth_confidence", IMAGE, "32FC1, 0..1, how far to trust each depth; 0.5: 3 mm"),
    Topic("left/depth", IMAGE, "32FC1, this frame's measured depth (m), NaN unknown"),
    Topic("left/tissue_mask", IMAGE, "mono8, 255 = tissue"),
    Topic("points", POINT_CLOUD, "x y z (m, world) rgb confidence: the visible Gaussians"),
    Topic("splats", POINT_CLOUD, "every Gaussian: linear scales (m), opacity 0..1, world", cached=True),
    Topic("anchors", POINT_CLOUD, "points pinned to the tissue: x y z (m, world), pixel, visibility, age"),
    Topic("instruments", POINT_CLOUD, "tips and axes of instruments (m, world), how far the tissue is"),
    Topic("tf", TF, "world -> left optical frame"),
    Topic("diagnostics", DIAGNOSTICS, "1 Hz, one status per stage"),
    Topic("status", STRING, "JSON: rates, latencies, drops, memory, what was skipped", cached=True),
    Topic("parameters", STRING, "JSON: the launch configuration in force", cached=True, periodic=False),
)
NO_RIGHT_EYE = "a node with one camera, or with publish.right:=false, has no right eye"
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
    Topic("proximity", POINT_CLOUD, "tips that are nearer to a zone or to tissue than its margin (m, world)"),
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

THIN = "thin/"  # how the names of thin images begin
_EVERY = {"full": 1, "half": 2, "quarter": 4}
THIN_FORMS = {  # for each image, the forms that may be sent instead
    "left/image_rect_color": ("jpeg",),
    "right/image_rect_color": ("jpeg",),
    "left/render/image": ("jpeg", "alpha"),
    "right/render/image": ("jpeg", "alpha"),
    "left/render/depth": ("png",),
    "left/render/depth_confidence": ("png",),
    "left/depth": ("png",),
    "left/tissue_mask": ("png",),
}
_THIN_NAME = re.compile(r"thin/([a-z]+)/(?:(\d{1,5}),(\d{1,5}),(\d{1,5}),(\d{1,5})/)?(.+)/([a-z]+)")


@dataclass(frozen=True, slots=True)
class ThinPicture:
    """A smaller form of one of the node's images, as the name of its topic asks for it."""

    topic: str  # of the whole image
    form: str  # jpeg, png or alpha
    every: int  # px of the whole image per px of this one
    region: tuple[int, int, int, int] | None  # x, y, width, height in the whole image; None: all of it


def thin_picture(name: str) -> ThinPicture:
    """Parse the name of a thin image: `thin/SIZE/[X,Y,WIDTH,HEIGHT/]TOPIC/FORM`, without the namespace.

    No such name is a prefix of another, so a subscription to one brings no other.

    Raises:
        UsageError: there is nothing of that name.
    """
    found = _THIN_NAME.fullmatch(name)
    if found is None:
        raise UsageError(
            f"'{name}' is no thin topic: thin/SIZE/TOPIC/FORM or thin/SIZE/X,Y,WIDTH,HEIGHT/TOPIC/FORM, "
            "e.g. thin/half/left/render/image/jpeg"
        )
    size, *sides, topic, form = found.groups()
    if size not in _EVERY:
        raise UsageError(f"'{name}': no size '{size}'; there are {', '.join(_EVERY)}")
    if topic not in THIN_FORMS:
        raise UsageError(f"'{name}': no thin form of '{topic}'; there are those of {', '.join(THIN_FORMS)}")
    if form not in THIN_FORMS[topic]:
        raise UsageError(f"'{name}': {topic} comes as {' or '.join(THIN_FORMS[topic])}, not as {form}")
    every = _EVERY[size]
    if sides[0] is None:
        return ThinPicture(topic, form, every, None)
    x, y, width, height = (int(side) for side in sides)
    if min(width, height) < every:
        raise UsageError(f"'{name}': a region of {width}x{height} px has no pixel at size {size}")
    return ThinPicture(topic, form, every, (x, y, width, height))


def is_scaled(thin: ThinPicture) -> bool:
    """Tell whether its pixels are steps of a depth or confidence; `scale` in `meta` is the size of a step."""
    return thin.form == "png" and thin.topic.endswith(("/depth", "/depth_confidence"))


def find(name: str) -> Topic | None:
    """The entry of a topic named without the namespace; None: there is no such topic. Knows also those of
    players, overlays, thin images, and views that a consumer may have opened."""
    known = BY_NAME.get(name) or _OF_OTHERS.get(name)
    if known is not None:
        return known
    if name.startswith(THIN):
        try:
            asked = thin_picture(name)
        except UsageError:
            return None
        return Topic(name, COMPRESSED_IMAGE, f"{BY_NAME[asked.topic].content}, thin")
    view = _VIEW_TOPIC.fullmatch(name)
    return None if view is None else Topic(name, *_VIEW_KINDS[view[1]], cached=view[1] == "camera_info")


def plain_name(ns: str, name: str) -> str:
    """A topic as people write it, without leading slash and namespace."""
    return name.lstrip("/").removeprefix(f"{ns}/")


def full_name(ns: str, name: str) -> str:
    """The topic as it stands on the wire, e.g. `sags/left/depth`."""
    return f"{ns}/{name}"
