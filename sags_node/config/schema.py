"""What a launch file may hold, typed and validated."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from annotated_types import Ge, Gt, Le
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    model_validator,
)

from sags_node.geometry import is_rotation

# Every number has a lower and an upper limit: a slip is an error on reading, not in what it leads to.
Pixels = Annotated[int, Ge(0), Le(65536)]
Box = tuple[Pixels, Pixels, Pixels, Pixels]  # x, y, width, height in px
ClassNumber = Annotated[int, Ge(0), Le(65535)]
FrameNumber = Annotated[int, Ge(0), Le(1_000_000_000)]
Segments = dict[str, tuple[FrameNumber, FrameNumber]]
Rate = Annotated[float, Ge(0.001), Le(1000)]  # per second
Seconds = Annotated[float, Gt(0), Le(3600)]
Apart = Annotated[float, Gt(0), Le(1000)]  # ms between the stamps of a pair
Depth = Annotated[float, Ge(0.001), Le(10)]  # m
DepthUnit = Annotated[float, Gt(0), Le(1)]  # metres per count
Paths = Annotated[
    tuple[Path, ...], BeforeValidator(lambda said: [said] if isinstance(said, str | Path) else said)
]
Share = Annotated[float, Ge(0), Le(1)]
Finite = Annotated[float, Ge(-1_000_000), Le(1_000_000)]
Positive = Annotated[float, Ge(1e-6), Le(1_000_000)]
Side = Annotated[int, Ge(16), Le(4096)]  # px
Name = Annotated[  # it may be digits alone, as PyTorch names tensors: YAML reads those as a number
    str, BeforeValidator(lambda said: str(said) if type(said) in (int, float) else said)
]


def _possible_levels(levels: tuple[float, float]) -> tuple[float, float]:
    if levels[0] >= levels[1]:
        raise ValueError(f"levels {list(levels)} should be 0 <= black < white <= 1")
    return levels


def _values_of_masks(said: object) -> object:
    known = [
        0 <= value <= 255 if isinstance(value, int) else re.fullmatch("#[0-9a-f]{6}", str(value))
        for value in (said if isinstance(said, list | tuple) else ())
    ]
    if said not in ("white", "black") and not (known and all(known)):
        raise ValueError('should be white, black, or a list of values: 0 to 255, or colours as "#00ff00"')
    return said


def _not_zero(scale: float) -> float:
    if scale == 0:
        raise ValueError("should not be 0: nothing would be left of the output")
    return scale


Levels = Annotated[
    tuple[Share, Share], AfterValidator(_possible_levels)
]  # black and white, shares of the range
Instruments = Annotated[  # in masks
    Literal["white", "black"] | tuple[Annotated[int, Ge(0), Le(255)] | str, ...],
    BeforeValidator(_values_of_masks),
]
_INSTRUMENTS = (
    "how masks show them: white (above 127), black, or as one of these values and colours, e.g. [85,170] or "
    '["#00ff00"]; what has other values is tissue'
)


def _rigid(rows: tuple[Row, Row, Row, Row]) -> tuple[Row, Row, Row, Row]:
    T = np.array(rows, np.float64)
    if not is_rotation(T[:3, :3]) or rows[3] != (0, 0, 0, 1):
        raise ValueError("should be a rotation and a translation above a last row 0, 0, 0, 1")
    if np.abs(T[:3, 3]).max() > FARTHEST_BASE:
        raise ValueError(f"is more than {FARTHEST_BASE:g} m away; translations are in metres")
    return rows


Row = tuple[Finite, Finite, Finite, Finite]
Pose = Annotated[tuple[Row, Row, Row, Row], AfterValidator(_rigid)]  # m
FARTHEST_BASE = 10.0  # m, largest translation of a pose along an axis
NAMESPACE = r"^[A-Za-z0-9_]+(/[A-Za-z0-9_]+)*$"


def _taken_for_a_number(said: object, value: object) -> bool:
    if isinstance(said, list | tuple) and isinstance(value, list | tuple):
        return any(map(_taken_for_a_number, said, value))
    if isinstance(said, dict) and isinstance(value, dict):
        return any(_taken_for_a_number(each, value.get(key)) for key, each in said.items())
    return isinstance(said, bool) and type(value) in (int, float)


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="wrap")
    @classmethod
    def _yes_is_no_number(cls, said: object, read: ModelWrapValidatorHandler[Self]) -> Self:
        """Refuse `true` and `yes` where a number belongs: pydantic takes them for 1."""
        section = read(said)
        for key, value in said.items() if isinstance(said, dict) else ():
            if _taken_for_a_number(value, getattr(section, key, None)):
                raise ValueError(f"{key} should be a number, not true or false")
        return section


# ---- source ----------------------------------------------------------------------------------------------


class ReferenceConfig(Section):
    """Where a recording keeps what is known to be true. Used by `sags eval` only."""

    depth: Path | None = Field(None, description="folder of 16-bit PNGs named by frame number, from 0")
    depth_unit: DepthUnit = Field(1e-5, description="metres per count")
    depth_kind: Literal["exact", "structured_light", "ct", "stereo_network"] = Field(
        "exact", description="how the depth became known; reports name it"
    )
    tracks: Path | None = Field(
        None,
        description="npz with points [T, P, 3] (m), visible [T, P] and, where some frames are left out, the "
        "numbers of the others, frames [T]",
    )


class RecordedSource(Section):
    """What every recording has in common."""

    pace: Literal["realtime", "fast", "step"] = Field(
        "realtime",
        description="realtime: the recording's clock, late frames are replaced; fast: as fast as the node "
        "takes frames, none lost, stamped at release; step: the same with the recording's own stamps",
    )
    rate: Rate | None = Field(None, description="frames per second; default: the recording's own")
    loop: bool = Field(False, description="begin again at the end")
    start: float = Field(0.0, ge=0, le=1_000_000, description="seconds to skip at the beginning")
    frames: FrameNumber | None = Field(None, ge=1, description="stop after this many frames; default: all")
    warm_up: FrameNumber = Field(
        0,
        description="the first frames of these are played so that the model settles, and then left out: "
        "nothing of them is published, measured, exported or fitted",
    )
    stride: FrameNumber = Field(1, ge=1, description="play only each stride-th frame")
    poses: Path | None = Field(
        None, description="npz with T_world_cam [T, 4, 4] (m), one of each image of the left eye"
    )
    reference: ReferenceConfig = ReferenceConfig()


class FoldersSource(RecordedSource):
    """Two folders of images, paired by sorted file name, or one of a single camera's."""

    kind: Literal["folders"] = "folders"
    left: Path = Field(description="folder of the left eye's images")
    right: Path | None = Field(
        None, description="folder of the right eye's; null: one camera, with a monocular vision.onnx"
    )
    tools: Path | None = Field(None, description="folder of masks of the instruments (not tissue)")
    instruments: Instruments = Field("white", description=_INSTRUMENTS)
    levels: Levels | None = Field(
        None,
        description="what becomes black and white of 10 to 16 bit images, in units of the brightest value; "
        "default: white is the brightest value of the bits that they use",
    )


class GeometryConfig(Section):
    """How images become those of the two eyes: taken apart; each eye deinterlaced, cropped, turned."""

    layout: Literal[
        "separate", "side_by_side", "over_under", "panes", "row_interleaved", "frame_sequential"
    ] = Field(
        "separate",
        description="separate: an image shows one eye; side_by_side: both, in its left and right half; "
        "over_under: in the upper and lower half; panes: in the boxes crop and crop_right; row_interleaved: "
        "in every other row, as the two fields of field-sequential stereo are; frame_sequential: each eye in "
        "every other image",
    )
    first: Literal["left", "right"] = Field(
        "left", description="whose is the left or upper half, the first row, the first image"
    )
    deinterlace: Literal["none", "top", "bottom"] = Field(
        "none",
        description="of interlaced images, keep the field of the first (top) or second (bottom) row and "
        "fill the rows between from their neighbours",
    )
    crop: Box | None = Field(None, description="what is used of each eye's image; default: all")
    crop_right: Box | None = Field(None, description="of the right eye's; default: as source.geometry.crop")
    flip: Literal["none", "horizontal", "vertical", "both"] = Field(
        "none", description="of each eye's image: mirrored, upside down, or turned by 180 degrees (both)"
    )
    levels: Levels = Field(
        (0.0, 1.0),
        description="what becomes black and white, in units of the brightest value; of 10, 12 and 16 bit "
        "images the eight bits that are used then lie where the image has its tones",
    )

    @model_validator(mode="after")
    def _possible(self) -> GeometryConfig:
        if self.layout == "row_interleaved" and self.deinterlace != "none":
            raise ValueError("row_interleaved takes the fields apart itself: leave deinterlace out")
        if self.layout == "panes" and (self.crop is None or self.crop_right is None):
            raise ValueError("panes needs crop and crop_right: the boxes [x, y, width, height] of the eyes")
        for box in (self.crop, self.crop_right):
            if box is not None and min(box[2:]) < 1:
                raise ValueError(
                    f"{list(box)} is no box [x, y, width, height]: it needs a width and a height"
                )
        if self.layout == "panes" and self.first == "right":
            raise ValueError(
                "first: right says nothing of panes: leave it left, and exchange crop and crop_right"
            )
        return self


def _first_of_both(geometry: GeometryConfig) -> GeometryConfig:
    if geometry.layout == "separate" and geometry.first == "right":
        raise ValueError(
            "first: right says nothing of eyes that come separately: leave it left, and exchange source.left "
            "and source.right"
        )
    return geometry


# For sources whose images are all of one kind: each shows both eyes, or each shows one.
Geometry = Annotated[GeometryConfig, AfterValidator(_first_of_both)]


class VideosSource(RecordedSource):
    """Two video files, paired by frame number; one with both eyes; or one of a single camera's."""

    kind: Literal["videos"] = "videos"
    left: Path = Field(description="video of the left eye, or of both where source.geometry.layout says so")
    right: Path | None = Field(
        None, description="video of the right eye; null: one camera, with a monocular vision.onnx"
    )
    geometry: Geometry = GeometryConfig()
    tools: Box | None = Field(
        None, description="of source.geometry.layout panes: the left eye with the instruments painted green"
    )

    @model_validator(mode="after")
    def _one_file_of_both(self) -> VideosSource:
        if self.tools is not None and self.geometry.layout != "panes":
            raise ValueError("tools is a pane beside those of the eyes: set geometry.layout to panes")
        if self.geometry.layout != "separate" and self.right is not None:
            raise ValueError(
                f"geometry.layout {self.geometry.layout}: source.left shows both, leave right out"
            )
        return self


class EndoNerfSource(RecordedSource):
    """A clip in the layout of EndoNeRF; docs/datasets.md says what is read and how."""

    kind: Literal["endonerf"] = "endonerf"
    folder: Path = Field(description="holds images/, masks/, depth/ and poses_bounds.npy")
    rate: Rate | None = Field(15.0, description="frames per second; the files do not say it")
    depth_unit: DepthUnit = Field(1e-3, description="metres per count of depth/; the files do not say it")
    instruments: Instruments = Field("white", description=_INSTRUMENTS)
    baseline: float | None = Field(
        None,
        gt=0,
        le=0.5,
        description="m between the eyes; makes images_right/ usable, the files do not say it; default: "
        "4.324e-3 of the published clips, which their author states, else none",
    )
    pose_axes: Literal["auto", "opencv", "llff", "opengl", "world_to_camera"] = Field(
        "auto",
        description="of poses_bounds.npy. Camera to world with axes right, down, forward (opencv), down, "
        "right, back (llff, as imgs2poses writes) or right, up, back (opengl); world_to_camera: the inverse "
        "of opencv. auto: what explains the images, else opencv",
    )


class ScaredSource(RecordedSource):
    """One keyframe folder of SCARED; docs/datasets.md says what is read and how."""

    kind: Literal["scared"] = "scared"
    folder: Path = Field(description="dataset_D/keyframe_K, holds endoscope_calibration.yaml and data/")


class BagSource(RecordedSource):
    """A ROS recording: rosbag2 folder or file (MCAP, db3) or ROS 1 .bag; docs/recordings.md says more."""

    kind: Literal["bag"] = "bag"
    path: Path = Field(description="folder with metadata.yaml, or a .mcap, .db3 or .bag file")
    left: str | None = Field(
        None,
        description="image topic of the left eye, or of both where source.geometry.layout says so; "
        "default: guessed, e.g. /RIG/left/image_raw",
    )
    right: str | None = Field(None, description="image topic of the right eye; default: guessed")
    left_info: str | None = Field(
        None, description="camera_info topic of the left eye; default: beside its images"
    )
    right_info: str | None = Field(
        None, description="camera_info topic of the right eye; default: beside its images"
    )
    tolerance: float = Field(0.02, gt=0, le=1, description="s; how far the stamps of a pair may lie apart")
    clocks: Literal["one", "two"] = Field(
        "one",
        description="one: both eyes are stamped by one clock; two: by clocks that differ, and the right "
        "eye's is set by when its images were recorded",
    )
    geometry: Geometry = GeometryConfig()

    @model_validator(mode="after")
    def _one_topic_of_both(self) -> BagSource:
        if self.geometry.layout == "frame_sequential":
            raise ValueError("geometry.layout frame_sequential is for cameras and videos, not for bags")
        if self.geometry.layout != "separate" and self.right is not None:
            raise ValueError(
                f"geometry.layout {self.geometry.layout}: source.left shows both, leave right out"
            )
        return self


class DvrkSource(RecordedSource):
    """A session of dVRK's `record`: side-by-side MP4 and its sidecar JSON."""

    kind: Literal["dvrk"] = "dvrk"
    path: Path = Field(description="the sidecar .json, or a folder with one stereo video in it")
    side_by_side: Literal["LR", "RL"] | None = Field(
        None, description="LR: the left eye is in the left half; default: what the sidecar says"
    )


CameraMotion = Literal["none", "sway", "zoom", "orbit"]
_MOVES = {False: "none", True: "sway"}


class PhantomSource(RecordedSource):
    """The built-in synthetic session; rendered once into the cache folder, then replayed."""

    kind: Literal["phantom"] = "phantom"
    seconds: float = Field(4.0, gt=0, le=600, description="length of the session")
    width: int = Field(640, ge=64, le=4096, description="of an image, px")
    height: int = Field(512, ge=64, le=4096, description="of an image, px")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="another number gives another tissue")
    camera_motion: Annotated[
        CameraMotion, BeforeValidator(lambda said: _MOVES.get(said, said) if isinstance(said, bool) else said)
    ] = Field(
        "none",
        description="of the scope, again and again. sway (or true): it looks about; zoom: in and out, 15 mm; "
        "orbit: round a point of the tissue, 11 degrees to each side",
    )


class LiveSource(Section):
    """What every live source has in common."""

    latency_ms: float = Field(
        0.0, ge=-1000, le=1000, description="from the exposure to the stamp; taken off every stamp"
    )
    geometry: Geometry = GeometryConfig()


class V4l2Source(LiveSource):
    """Live cameras: two devices, or one whose images show both eyes."""

    kind: Literal["v4l2"] = "v4l2"
    left: str = Field(
        "/dev/video0", description="device; the only one where source.geometry.layout says it shows both eyes"
    )
    right: str | None = Field("/dev/video2", description="device of the right eye")
    width: Pixels = Field(640, ge=1, description="of one device's image, px")
    height: Pixels = Field(480, ge=1, description="of one device's image, px")
    rate: Rate = Field(30.0, description="frames per second")
    fourcc: str | None = Field(
        None,
        min_length=3,
        max_length=4,
        description="pixel format, e.g. YUYV, MJPG, or with more than 8 bit Y10, Y12, Y16; default: the "
        "device's",
    )
    deadline: Seconds = Field(1.0, description="seconds without an image before the device is reopened")
    pair_tolerance_ms: Apart = Field(
        20.0, description="how far the stamps of a pair may lie apart, two devices"
    )

    @model_validator(mode="before")
    @classmethod
    def _halves(cls, said: object) -> object:
        if isinstance(said, dict) and "side_by_side" in said:
            raise ValueError(
                "instead of side_by_side set geometry.layout: side_by_side (RL: geometry.first: right)"
            )
        return said


class GstSource(LiveSource):
    """Live images from GStreamer, in a process of its own; docs/inputs.md has examples."""

    kind: Literal["gst"] = "gst"
    launch: str | None = Field(
        None,
        description="launch string of both eyes. It ends open where an image shows both "
        "(source.geometry.layout), else in one branch to `left.` and one to `right.`",
    )
    left: str | None = Field(
        None, description="launch string of the left eye, ending open; instead of source.launch"
    )
    right: str | None = Field(None, description="launch string of the right eye, ending open")
    start: Seconds = Field(15.0, description="seconds until the first image of each eye, at most")
    deadline: Seconds = Field(2.0, description="seconds without an image before it is started again")
    pair_tolerance_ms: Apart = Field(
        5.0,
        description="how far the stamps of a pair may lie apart; cameras that are not synchronised need half "
        "a frame",
    )

    @model_validator(mode="after")
    def _both_eyes(self) -> GstSource:
        separate = self.geometry.layout == "separate"
        if self.launch is None and (self.left is None or self.right is None):
            raise ValueError("name launch (both eyes), or left and right (a launch string of each)")
        if self.launch is not None and (self.left is not None or self.right is not None):
            raise ValueError("launch is of both eyes: leave left and right out")
        if self.launch is None and not separate:
            raise ValueError(f"geometry.layout {self.geometry.layout} needs launch, one string of both eyes")
        led = [name for name in ("left.", "right.") if name in (self.launch or "").split()]
        if self.launch is not None and len(led) != (2 if separate else 0):
            raise ValueError(
                "launch needs one branch that ends in '! left.' and one in '! right.' (see tee), or "
                "geometry.layout where its images show both eyes"
                if separate
                else f"geometry.layout {self.geometry.layout}: launch ends open, without left. and right."
            )
        return self


class SentSource(LiveSource):
    """What all live images have in common that another program stamps and sends."""

    rate: Rate = Field(30.0, description="images per second that each eye should come with")
    pair_tolerance_ms: Apart = Field(5.0, description="how far the stamps of a pair may lie apart")
    stamps: Literal["wall", "own"] = Field(
        "wall",
        description="wall: of this machine's clock, or one that is set by it; own: of another clock, brought "
        "to ours by the shortest way that images take",
    )

    @model_validator(mode="after")
    def _of_one_moment(self) -> Self:
        if self.geometry.layout == "frame_sequential":
            raise ValueError("geometry.layout frame_sequential is for cameras: send each eye by itself")
        return self


class RosGraph(Section):
    """Where a ROS 2 graph is; needs the extra `ros2`, and no ROS."""

    domain: int | None = Field(
        None, ge=0, le=232, description="number of the graph; default: `$ROS_DOMAIN_ID`, else 0"
    )
    interface: str = Field(
        "lo", pattern=r"^[A-Za-z0-9_.:-]+$", description="network interface; lo: this machine only"
    )


class Ros2Source(SentSource, RosGraph):
    """Image topics (Image or CompressedImage) of a ROS 2 graph; docs/inputs.md says more."""

    kind: Literal["ros2"] = "ros2"
    left: str = Field(
        "/stereo/left/image_raw",
        description="image topic of the left eye; or of both: source.geometry.layout",
    )
    right: str = Field("/stereo/right/image_raw", description="image topic of the right eye")
    left_info: str | None = Field(
        None, description="camera_info topic of the left eye; default: beside its images; not used with rig"
    )
    right_info: str | None = Field(
        None, description="camera_info topic of the right eye; default: beside its images"
    )


class Guarded(Section):
    """Who may use the sockets that a node binds; docs/security.md says more."""

    key: Path | None = Field(None, description="the node's secret key file (sags keygen): encrypt all tcp")
    allow: Paths = Field(
        (), description="who may connect: .pub files, and folders of them; publish: folders in them are roles"
    )
    insecure: bool = Field(False, description="allow other addresses than loopback and ipc without keys")

    @model_validator(mode="after")
    def _keys_together(self) -> Self:
        if (self.key is None) != (not self.allow):
            raise ValueError("key and allow belong together: who the node is, and who may connect")
        return self


class PushSource(SentSource, Guarded):
    """Images that another program hands in over ZeroMQ; docs/inputs.md says how."""

    kind: Literal["push"] = "push"
    geometry: GeometryConfig = GeometryConfig()
    endpoint: str = Field("tcp://127.0.0.1:5558", description="ROUTER socket that the node binds")


Source = Annotated[
    FoldersSource
    | VideosSource
    | EndoNerfSource
    | ScaredSource
    | BagSource
    | DvrkSource
    | PhantomSource
    | V4l2Source
    | GstSource
    | Ros2Source
    | PushSource,
    Field(discriminator="kind"),
]

# ---- the robot -------------------------------------------------------------------------------------------


class RobotTool(Section):
    """A tool whose tip comes from the robot; published in the topic `instruments`."""

    topic: str = Field(
        description="of PoseStamped or TransformStamped, e.g. /PSM1/measured_cp: its tip, z points out"
    )
    T_base: Pose = Field(
        ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
        description="4 rows of 4, m: the base frame of its poses, in that of the scope's poses",
    )
    on_hand: bool = Field(
        False, description="T_base is in the frame that carries the camera, which moves: dVRK's in the ECM"
    )
    error_mm: float = Field(
        10.0, gt=0, le=100, description="assumed error of its uncorrected tips; nine of ten are smaller"
    )


class RobotPoses(Section):
    """What all poses of a robot have in common."""

    base: str | None = Field(None, description="frame of tf that is the world; not for topics of poses")
    hand: str | None = Field(None, description="frame of tf that carries the camera")
    hand_eye: Path | None = Field(
        None, description="how the camera sits on it (sags calib hand-eye); default: hand_eye.yaml in rig"
    )
    offset_ms: float | None = Field(
        None,
        ge=-1000,
        le=1000,
        description="the robot's stamp minus the image's (before latency_ms), of one moment; default: what "
        "the hand-eye calibration found",
    )
    tools: tuple[RobotTool, ...] = Field((), max_length=8, description="tools whose tips come from the robot")

    @model_validator(mode="after")
    def _a_topic_each(self) -> Self:
        names = [getattr(self, "topic", None), *(tool.topic for tool in self.tools)]
        topics = ["/" + name.lstrip("/") for name in names if name is not None]
        if len(set(topics)) < len(topics):
            twice = max(topics, key=topics.count)
            raise ValueError(f"{twice} is named twice: the scope and each tool have a topic of their own")
        return self


class Ros2Robot(RobotPoses, RosGraph):
    """Live poses of a ROS 2 graph."""

    kind: Literal["ros2"] = "ros2"
    topic: str = Field("/tf", description="of TFMessage, PoseStamped or TransformStamped")


class PushRobot(RobotPoses, Guarded):
    """Live poses that another program hands in over ZeroMQ."""

    kind: Literal["push"] = "push"
    endpoint: str = Field("tcp://127.0.0.1:5559", description="ROUTER socket that the node binds")
    topic: str | None = Field(
        None, description="of the scope's pose; default: that of the first pose that comes and is no tool's"
    )


class BagRobot(RobotPoses):
    """Poses of a ROS recording, beside its images."""

    kind: Literal["bag"] = "bag"
    topic: str = Field("/tf", description="of TFMessage, PoseStamped or TransformStamped")


Robot = Annotated[Ros2Robot | PushRobot | BagRobot, Field(discriminator="kind")]

# ---- the stages ------------------------------------------------------------------------------------------


USUAL_NEAREST = 0.03  # m: scopes work at 50 to 100 mm, an organ that swells towards one comes to 30


class StereoConfig(Section):
    """Depth from the rectified pair."""

    scale: Literal[1, 2, 4] | None = Field(
        None, description="divide the working size by this for matching; default: 2 from 480 px width, else 1"
    )
    min_depth: Depth | None = Field(
        None,
        description="m; nothing is looked for nearer; default: 0.03, and down to 0.01 where the images "
        "show something so near",
    )
    max_depth: Depth = Field(0.30, description="m; nothing is looked for beyond")

    @model_validator(mode="after")
    def _ordered(self) -> StereoConfig:
        if self.nearest >= self.max_depth:
            raise ValueError(f"min_depth {self.nearest} must be below max_depth {self.max_depth}")
        return self

    @property
    def nearest(self) -> float:
        """The nearest depth that is searched, m, unless the images show something nearer."""
        return USUAL_NEAREST if self.min_depth is None else self.min_depth


class Normalization(Section):
    """A network is fed (value / 255 - mean) / std: one number for all channels, or three for R, G and B."""

    mean: tuple[Finite] | tuple[Finite, Finite, Finite] = (0.0,)
    std: tuple[Positive] | tuple[Positive, Positive, Positive] = (1.0,)


NORMALIZATIONS = {
    "unit": Normalization(),  # 0..1
    "bytes": Normalization(std=(1 / 255,)),  # 0..255
    "imagenet": Normalization(mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225)),
    "symmetric": Normalization(mean=(0.5,), std=(0.5,)),  # -1..1
}


def _by_name(said: object) -> object:
    if isinstance(said, str):
        if said not in NORMALIZATIONS:
            raise ValueError(f"Input should be one of {', '.join(NORMALIZATIONS)}, or {{mean: [], std: []}}")
        return NORMALIZATIONS[said]
    return said


class NetworkFormat(Section):
    """How a depth network takes images and what it gives: what its file does not say must be set."""

    inputs: tuple[Name, ...] | None = Field(
        None, description="names: left eye, right eye; default: the only one"
    )
    layout: Literal["nchw", "nhwc"] | None = Field(
        None, description="order of the inputs' axes; default: by their shape"
    )
    color: Literal["rgb", "bgr"] | None = Field(None, description="order of the channels; default: rgb")
    normalization: Annotated[Normalization | None, BeforeValidator(_by_name)] = Field(
        None,
        description="`unit` (0..1), `bytes` (0..255), `imagenet`, `symmetric` (-1..1), or "
        "`{mean: [], std: []}`; to be set, but for inputs of bytes",
    )
    size: tuple[Side, Side] | None = Field(
        None, description="width and height for a network that takes any; default: the working size, padded"
    )
    multiple: int | None = Field(
        None,
        ge=1,
        le=512,
        description="px; width and height are padded to multiples of it, for a network that takes any",
    )
    output: Name | None = Field(None, description="name of the output to use; default: the only one")
    meaning: Literal["disparity", "depth", "inverse_depth"] | None = Field(
        None, description="of the output's numbers; to be set"
    )
    scale: Annotated[Finite, AfterValidator(_not_zero)] | None = Field(
        None,
        description="the output's numbers times this are px of the image that the network gets, or m; -1: "
        "disparities are negative; default: 1",
    )


class OnnxConfig(NetworkFormat):
    """Depth from a network of the user's; docs/networks.md has examples."""

    path: Path | None = Field(
        None, description="the .onnx file; null: depth is matched, as vision.stereo says"
    )
    providers: tuple[Literal["cuda", "cpu"], ...] = Field(
        ("cuda", "cpu"), min_length=1, description="processors; the first that ONNX Runtime has here is used"
    )
    threads: int | None = Field(
        None, ge=1, le=64, description="of the network; default: all cores of this process"
    )
    fallback: bool = Field(
        True, description="true: depth is matched where the network fails; false: the run ends"
    )
    declared_depth: Depth | None = Field(
        None, description="m to the middle of the first image: the scale of one camera alone"
    )


class TissueConfig(Section):
    """Which pixels show tissue."""

    method: Literal["session", "classical", "onnx", "topic", "none"] = Field(
        "session",
        description="session: the recording's masks, else classical; onnx: a network's; topic: another "
        "process's; none: every pixel",
    )
    path: Path | None = Field(None, description="the .onnx file of a segmentation network, for onnx")
    tissue_is: Literal["white", "black"] | tuple[ClassNumber, ...] | None = Field(
        None,
        description="what shows tissue, for onnx and topic: white (class 1 and above), black (class 0), or a "
        "list of a network's class numbers",
    )
    endpoint: str | None = Field(None, description="data socket that publishes left/tissue_mask, for topic")
    ns: str = Field("masks", pattern=NAMESPACE, description="namespace of that topic")
    tolerance: float = Field(
        0.1, gt=0, le=10, description="s; how far the stamps of mask and image may lie apart"
    )
    dilate: int = Field(2, ge=0, le=64, description="px added around instruments, working size")
    exclude: tuple[Box, ...] = Field((), description="boxes of the raw left image never to use (captions)")

    @model_validator(mode="after")
    def _source_is_described(self) -> TissueConfig:
        for method, key in (("onnx", "path"), ("topic", "endpoint")):
            if "method" not in self.model_fields_set and getattr(self, key) is not None:
                raise ValueError(
                    f"{key} is for method {method}, which is not set: set it, or leave {key} out"
                )
        if self.method == "onnx" and (self.path is None or self.tissue_is is None):
            raise ValueError("onnx needs path (the .onnx file) and tissue_is (white, black or class numbers)")
        if self.method == "topic" and (self.endpoint is None or self.tissue_is not in ("white", "black")):
            raise ValueError("topic needs endpoint (tcp://127.0.0.1:PORT) and tissue_is (white or black)")
        return self


PoseWay = Literal["session", "fixed", "estimate", "refine"]


class VisionConfig(Section):
    """The images that are published and worked on, and where the camera is."""

    width: int | None = Field(
        None,
        ge=16,
        le=4096,
        description="px; all that is published and all pixels that are asked for are of this size; default: "
        "the calibration's, or what keeps its proportions where vision.height is set",
    )
    height: int | None = Field(
        None,
        ge=16,
        le=4096,
        description="px; default: the calibration's, or what keeps its proportions where vision.width is set",
    )
    scale: Literal["auto"] | Annotated[float, Ge(0.25), Le(1)] = Field(
        "auto",
        description="share of that size that is worked at; it changes no pixel that is published or asked "
        "for. auto: where frames come in real time what shows most on this machine, from 1 down to 0.25; "
        "else 1",
    )
    stereo: StereoConfig = StereoConfig()
    onnx: OnnxConfig = OnnxConfig()
    tissue: TissueConfig = TissueConfig()
    pose: PoseWay = Field(
        "session",
        description="of the camera. session: the session's or the robot's, fixed where there is none; fixed: "
        "it never moves; estimate: from the images, by the motion that most of the tissue shares; refine: "
        "as session, and the images take out what it is slowly off by",
    )

    def published_size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height of published images, for a camera of `width` x `height` px. Where one is
        set, the other keeps the proportions."""
        if self.width is not None:
            return self.width, self.height or round(height * self.width / width)
        if self.height is not None:
            return round(width * self.height / height), self.height
        return width, height

    def working_size(self, width: int, height: int) -> tuple[int, int]:
        """Return the size of the images that are worked on, as `published_size` does. A scale that is still
        to be chosen counts as 1."""
        scale = 1.0 if self.scale == "auto" else self.scale
        width, height = self.published_size(width, height)
        return round(scale * width), round(scale * height)


class EngineConfig(Section):
    """What draws the Gaussians."""

    threads: int | None = Field(
        None, ge=1, le=64, description="of the kernels; default: all cores, of a running node all but one"
    )


USUAL_MS = 33.0  # ms, budget of a frame where nothing says when the next one comes
# Share of the time until the next frame. A node that uses all of it never makes up for a late frame: those
# after it wait, too. benchmarks/ladder.md says what this reserve is worth.
SHARE = 0.9
LONGEST_MS = 100.0  # ms, longest budget where frames come more seldom: what is shown must still be new


MappingMethod = Literal["nodes", "sags"]


class MappingConfig(Section):
    """How the model is built, and what it may cost."""

    method: MappingMethod = Field(
        "nodes",
        description="how tissue moves. nodes: control nodes follow optical flow and depth; sags: the paper's "
        "deformation field, on the CPU, slower and less sharp, which also tells of the last two seconds. "
        "docs/how-it-works.md compares them",
    )
    budget_ms: float | None = Field(
        None,
        ge=1,
        le=1000,
        description="wall time of one frame, all stages; default: nine tenths of the time until the next "
        "one comes, 100 at most; 33 where a recording is not played in real time",
    )
    iterations: int | None = Field(
        None, ge=0, le=10_000, description="fixed steps per frame instead of the budget"
    )
    rung: int | None = Field(
        None,
        ge=0,
        le=100,
        description="stay on this rung of the ladder of quality, 0 the cheapest; default: what the machine "
        "affords",
    )
    max_gaussians: int | None = Field(
        None,
        ge=100,
        le=2_000_000,
        description="the model has no more; default: as many as the machine refines within the budget",
    )
    field: bool | None = Field(
        None,
        description="remember how tissue moves: hidden tissue goes on as it did before, and motion is "
        "predicted to the moment of a display; default: once an anchor or a view asks for `ahead_ms`",
    )

    @model_validator(mode="after")
    def _one_memory(self) -> Self:
        if self.method == "sags" and self.field:
            raise ValueError(
                "field remembers how control nodes move, which method sags has none of: leave it out"
            )
        return self

    def frame_ms(self, rate: float | None = None) -> float:
        """Return the time budget of a frame, ms.

        Args:
            rate: frames per second; None: each comes when the node takes it.
        """
        if self.budget_ms is not None:
            return self.budget_ms
        if rate is None or self.iterations is not None:
            return USUAL_MS
        return min(SHARE * 1e3 / rate, LONGEST_MS)


class PublishConfig(Guarded):
    """Sockets, and who may use them; docs/wire.md and docs/security.md say more."""

    data: tuple[str, ...] = Field(("tcp://127.0.0.1:5556",), description="XPUB endpoints")
    ipc: bool = Field(True, description="also bind an ipc socket in the run directory")
    control: str | None = Field("tcp://127.0.0.1:5557", description="ROUTER endpoint; null: none")
    run_dir: Path | None = Field(
        None,
        description="of the ipc socket and the connection file; default: `$XDG_RUNTIME_DIR/sags`, else "
        "`/tmp/sags-UID`",
    )
    right: Literal["auto", True, False] = Field(
        "auto",
        description="the right eye's input and render. auto: where there is a right eye; it is drawn while "
        "somebody subscribes. true: it is drawn in every frame, which `sags eval` measures. false: nothing "
        "of it is published",
    )
    detail: bool = Field(
        True,
        description="the left render and consumers' views show the images' own detail where the model says "
        "that they saw the same tissue; false: the model alone",
    )


DeviceName = Literal["auto", "cpu", "cuda"]


class LaunchConfig(Section):
    """One way to run the node."""

    ns: str = Field("sags", pattern=NAMESPACE, description="namespace of all topics")
    device: DeviceName = Field(
        "auto",
        description="auto: a GPU where one can be used, else the CPU; cuda: a GPU, or an error; docs/gpu.md",
    )
    rig: Path | None = Field(
        None,
        description="the calibration, in any form of docs/calibration.md; needed unless the recording brings "
        "one",
    )
    rectified: bool | None = Field(
        None,
        description="the images are rectified already: only the projection_matrix of the calibration is "
        "used; default: what the names of their folders, files or topics say (rect, rectified, image_rect)",
    )
    source: Source = PhantomSource()
    robot: Robot | None = Field(
        None, description="where the scope's poses come from; null: the recording, or none. docs/inputs.md"
    )
    vision: VisionConfig = VisionConfig()
    engine: EngineConfig = EngineConfig()
    mapping: MappingConfig = MappingConfig()
    publish: PublishConfig = PublishConfig()
    segments: Segments = Field(
        {}, description="stretches of the recording that are measured apart, `{name: [first, last frame]}`"
    )

    @model_validator(mode="after")
    def _one_pose(self) -> Self:
        if self.robot is not None and self.vision.pose not in ("session", "refine"):
            raise ValueError(f"robot says where the scope is, vision.pose {self.vision.pose} too: choose one")
        if self.robot is not None and getattr(self.source, "poses", None) is not None:
            raise ValueError("robot says where the scope is, source.poses too: leave one of them out")
        return self

    @model_validator(mode="after")
    def _sags_can(self) -> Self:
        if self.mapping.method == "sags" and self.vision.pose == "estimate":
            raise ValueError(
                "mapping.method sags cannot go back to an earlier map, as vision.pose estimate wants: use "
                "another pose, or mapping.method nodes"
            )
        if self.mapping.method == "sags" and self.device == "cuda":
            raise ValueError(
                "mapping.method sags runs on the CPU: leave device out, or use mapping.method nodes"
            )
        return self

    @property
    def played_segments(self) -> Segments:
        """`segments` in numbers of played frames: a stride leaves frames out."""
        stride = self.source.stride if isinstance(self.source, RecordedSource) else 1
        return {name: (-(-first // stride), last // stride) for name, (first, last) in self.segments.items()}

    @property
    def in_real_time(self) -> bool:
        """Whether frames come at their own times, taken or not."""
        return isinstance(self.source, LiveSource) or self.source.pace == "realtime"

    @property
    def one_camera(self) -> bool:
        """Whether there is only one eye: no source for the right one, and no images that show both."""
        if isinstance(self.source, VideosSource) and self.source.geometry.layout != "separate":
            return False
        return isinstance(self.source, FoldersSource | VideosSource) and self.source.right is None


LIVE_PARAMETERS = ("mapping.budget_ms",)  # that `set_parameters` may change while the node runs
