"""The types that cross module boundaries, and every convention of this package.

Conventions
-----------
- SI units: metres and seconds; times inside types are integer nanoseconds of the wall clock
  (`time.time_ns`) for live sources and of the recording for deterministic ones.
- Images are uint8 RGB `[H, W, 3]` at the edges (sources, messages), float32 0..1 inside.
- OpenCV camera axes: x right, y down, z forward. The centre of the first pixel is (0, 0), as in `K` of
  OpenCV and ROS. The rasterisers sample at +0.5; `engine.rasterizer.rasterize` shifts once.
- Depth is camera z, never ray length. 0 means unknown (NaN on the wire, REP 117/118).
- A `tissue` mask is True where the pixel shows tissue and may be used. (EndoNeRF's files are the opposite.)
- The world is the left rectified camera of the first frame unless a pose comes with the frame.
  `T_world_cam` maps camera points to world points; `viewmat` is its inverse.
- Quaternions are wxyz.
- `frame_id` and `t_capture_ns` are set at capture (the left eye's stamp) and copied unchanged to everything
  derived from that frame, so the age of any content is always computable.
- An array in a published type is never written again.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
I8 = NDArray[np.int8]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]
Samples = NDArray[np.uint8] | NDArray[np.uint16]  # of an image as a camera gives it
Side = Literal["left", "right"]

# A view drawn at a small size holds the mean colour of each pixel. It differs from the colour at the centre
# by 1/24 of the second difference along each axis (Taylor). Correcting it gains 0.15 to 0.3 dB (measured).
MIDDLES = np.array([-1 / 24, 26 / 24, -1 / 24], np.float32)
_ENLARGING = threading.Lock()  # one for all objects, so that they can be copied; it is held for 1 to 2 ms
SH_DEGREE_0 = 0.5 / math.sqrt(math.pi)  # Y_00, the constant spherical harmonic: rgb = 0.5 + Y_00 f_dc


@dataclass(frozen=True, slots=True)
class Camera:
    """An undistorted pinhole camera."""

    width: int  # px
    height: int  # px
    K: F64  # [3, 3] px
    T_world_cam: F64  # [4, 4] m
    _viewmat: F64 | None = field(default=None, init=False, repr=False, compare=False)

    @property
    def viewmat(self) -> F64:
        """World to camera, [4, 4]; made once, since a frame asks a dozen times. Not to be written."""
        if self._viewmat is not None:
            return self._viewmat
        R, t = self.T_world_cam[:3, :3], self.T_world_cam[:3, 3]
        view = np.eye(4)
        view[:3, :3] = R.T
        view[:3, 3] = -R.T @ t
        view.flags.writeable = False
        object.__setattr__(self, "_viewmat", view)
        return view

    def moved_right(self, distance: float) -> Camera:
        """This camera moved along its own x axis by `distance` metres (the right eye: the baseline)."""
        T = self.T_world_cam.copy()
        T[:3, 3] += T[:3, 0] * distance
        return Camera(self.width, self.height, self.K, T)


@dataclass(frozen=True, slots=True)
class Eye:
    """One camera of a stereo rig, as a ROS camera_info file describes it."""

    width: int  # px, of the raw image
    height: int
    K: F64  # [3, 3] px, raw image
    distortion: F64  # [5] plumb_bob: k1 k2 p1 p2 k3; or [8] rational_polynomial: and k4 k5 k6
    R: F64  # [3, 3] rotation from the raw to the rectified camera
    P: F64  # [3, 4] projection of the rectified camera; P[0, 3] = -f B for the right eye, metres


@dataclass(frozen=True, slots=True)
class StereoRig:
    """Two calibrated eyes whose rectified images share rows."""

    name: str
    left: Eye
    right: Eye
    # Where it was read from, for messages that say how to fix it.
    path: Path | str = field(default="PATH", kw_only=True)
    # False: the calibration is guessed, so lengths are right only up to an unknown factor.
    metric: bool = field(default=True, kw_only=True)
    # The unit of lengths: the usual one of its files' format, which does not state it.
    unit: str = field(default="m", kw_only=True)
    # False: its files have no R and P; `cv2.stereoRectify` made them.
    says_P: bool = field(default=True, kw_only=True)

    @property
    def baseline(self) -> float:
        """Distance between the eyes, metres."""
        return float(-self.right.P[0, 3] / self.right.P[0, 0])

    @property
    def T_right_left(self) -> F64:
        """Left raw camera to right raw camera, [4, 4], metres."""
        T = np.eye(4)
        T[:3, :3] = self.right.R.T @ self.left.R
        T[:3, 3] = self.right.R.T @ np.array([-self.baseline, 0.0, 0.0])
        return T


@dataclass(frozen=True, slots=True)
class Reference:
    """The ground truth that a recording has for one frame. Only for evaluation: the frame path never reads
    it."""

    depth: F32 | None = None  # [H, W] m, 0 unknown, left rectified image at calibration size
    depth_kind: str = "exact"  # exact | structured_light | ct | stereo_network
    points: F64 | None = None  # [P, 3] m, world: the same surface points in every frame
    points_visible: Bool | None = None  # [P] seen by the left eye in this frame


@dataclass(frozen=True, slots=True)
class ToolPose:
    """Where a robot says that the tip of one of its tools is."""

    name: str  # its topic
    error: float  # m; nine of ten real errors are smaller
    T_cam_tool: F64 | None  # [4, 4] in the left rectified camera, z out of its tip; None: not known now
    problem: str = ""  # why it is not known


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """A raw stereo image pair as a source delivers it."""

    frame_id: int  # gaps are frames the source dropped
    t_capture_ns: int  # left eye
    t_capture_right_ns: int
    left: U8  # [H, W, 3] RGB, raw
    right: U8 | None  # [H, W, 3] RGB, raw; None only where `depth` is given
    epoch: int = 0  # grows when the clock jumps back or a recording loops
    T_world_cam: F64 | None = None  # [4, 4] pose of the left rectified camera, when the session knows it
    tissue: Bool | None = None  # [H, W] raw left image, when the session knows it
    reference: Reference | None = None
    depth: F32 | None = None  # [H, W] m, 0 unknown, left rectified, at calibration size; instead of stereo
    t_device_ns: int = 0  # left eye, as the device, sender or recording stamped it by its own clock; 0: none
    t_arrival_ns: int = 0  # left eye, wall clock; 0: not a live image
    pose_problem: Finding | None = None  # why `T_world_cam` is an older pose; such a frame is not taken in
    tools: tuple[ToolPose, ...] = ()  # where a robot says that its tools are
    warm_up: bool = False  # the model learns from it, and nothing of it is shown or counted
    recorded_s: float | None = None  # s, its time in the recording, from 0 in each loop; None: live
    recorded_number: int = -1  # index of its left image in the recording, from 0; -1: live


@dataclass(frozen=True, slots=True)
class GrayPyramid:
    """A gray image and its smaller copies; see `vision.pyramid`."""

    full: U8  # [H, W]
    halves: tuple[F32, ...]  # grey levels 0..255; [k] has (H >> k + 1) x (W >> k + 1) px and a border around


@dataclass(frozen=True, slots=True)
class RectifiedPictures:
    """The rectified images of a frame, before its camera's pose is known: the part that takes time."""

    left: U8  # [H, W, 3] RGB
    right: U8 | None  # [H, W, 3] RGB
    gray: tuple[GrayPyramid, GrayPyramid | None]
    ms: float  # that making them took


@dataclass(frozen=True, slots=True)
class Published:
    """A frame as it is published: its size does not depend on the machine's speed (`messaging.published`)."""

    camera: Camera  # left eye, at the world's origin
    picture: Callable[[Side], U8]  # [H, W, 3] RGB, rectified; made once, when first asked for


@dataclass(frozen=True, slots=True)
class RectifiedPair:
    """Row-aligned, undistorted images at the working size."""

    frame_id: int
    t_capture_ns: int
    camera: Camera  # left eye
    baseline: float  # m
    left: U8  # [H, W, 3] RGB
    right: U8 | None  # [H, W, 3] RGB; None where the session has no right eye
    gray: tuple[GrayPyramid, GrayPyramid | None] | None = None  # of both, where they are made already
    published: Published | None = None  # None: it is published at the working size


@dataclass(frozen=True, slots=True)
class DepthGrid:
    """The depth of a frame on a coarse grid, also where it was not measured; see `vision.depth_grid`.

    Errors are predicted: nine of ten real ones are smaller. A depth z has the error `error * z * z`.
    """

    side: float  # px of a cell
    inverse: F32  # [h, w] 1/m, inverse depth: measured, else that of the surroundings; 0: unknown
    error: F32  # [h, w] 1/m, of the inverse depth; it grows with the distance to what was measured


@dataclass(frozen=True, slots=True)
class Observation:
    """All that the mapper may know of one frame."""

    frame_id: int
    t_capture_ns: int
    camera: Camera
    image: U8  # [H, W, 3] RGB
    gray: U8  # [H, W], for optical flow
    tissue: Bool  # [H, W] True = tissue
    depth: F32  # [H, W] m, 0 unknown
    depth_confidence: F32  # [H, W] 0..1
    depth_is_new: bool = True  # measured in this frame; else in an earlier one, since which nothing has moved
    baseline: float = 0.0  # m, to the right eye
    pyramid: GrayPyramid | None = None  # of `gray`, where it is made already
    grid: DepthGrid | None = None  # of `depth`, where it is made already


@dataclass(frozen=True, slots=True)
class Gaussians:
    """Activated Gaussians at one time, ready to draw."""

    means: F32  # [N, 3] m, world
    quats: F32  # [N, 4] wxyz, any length but zero
    scales: F32  # [N, 3] m, > 0
    opacities: F32  # [N] 0..1
    colors: F32  # [N, 3] RGB 0..1, the part that does not depend on the view
    ids: I64  # [N] stable over the life of a Gaussian
    sh_rest: F32 | None = None  # [N, K - 1, 3] real spherical harmonics of degree 1 to 3 without the constant
    smoothing: F32 | None = None  # [N] m^2, variance of the 3D filter (Mip-Splatting), still to be applied
    depth_errors: F32 | None = None  # [N] m, predicted: nine of ten real ones are smaller; None: unknown
    slopes: F32 | None = None  # [N, 3] change of all three colours for each standard deviation along the
    # Gaussian's own axes: at a point x they are colors + slopes . diag(1 / scales) R^T (x - mean), and at a
    # pixel the expectation of that over the Gaussian along the pixel's ray, `engine.rasterizer.projection`;
    # None: 0, a Gaussian of one colour

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True, slots=True)
class MotionState:
    """How well motion was predicted over the last frames (`mapping.motion_field`)."""

    period: float | None  # s, after which the tissue's motion repeats; None: it does not repeat
    skill: float  # share of the motion's energy predicted right one frame ahead: 1 all, 0 none
    reach: float  # s, how far ahead of a frame motion is predicted; 0: not at all


@dataclass(frozen=True, slots=True)
class Forecast:
    """Where the tissue is expected after a frame; `model.forecast` applies it."""

    state: MotionState
    frame_s: float  # s from one frame to the next
    nodes: F32  # [M, 3] m, world: the control nodes in that frame
    moves: F32  # [H, M, 3] m, of the control nodes, after 1, 2, ... frames
    node_index: I32  # [N, 4] the nodes that each Gaussian of the snapshot follows
    node_weight: F32  # [N, 4]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The model at the time of one frame; immutable."""

    frame_id: int
    t_capture_ns: int
    step: int  # optimiser steps since the model was made
    gaussians: Gaussians
    velocities: F32  # [N, 3] m/s, world: the last observed motion
    camera: Camera
    loss: float  # mean absolute colour residual over tissue, last step
    counts: Mapping[str, int] = field(default_factory=dict)  # inserted, removed, iterations, ...
    forecast: Forecast | None = None  # None: nobody asks for it, or too little is known yet
    right_colors: F32 | None = None  # [N, 3] added to `colors` for the right eye; None: nobody looks there


class Colours:
    """The colours of a drawn view, normalised by coverage, at the size in which they were drawn. They are
    enlarged once, when first asked for, on the asking thread: of most views only a few pixels are read.

    Attributes:
        small: [h, w, 3] RGB.
    """

    __slots__ = ("_made", "_size", "small")

    def __init__(self, small: U8, width: int | None = None, height: int | None = None) -> None:
        """`width`, `height`: of the view, px; None: those of `small`."""
        self.small = small
        self._size = width or small.shape[1], height or small.shape[0]
        self._made: dict[tuple[int, int], U8] = {(small.shape[1], small.shape[0]): small}

    @property
    def whole(self) -> U8:
        """The colours [H, W, 3] at the size of the view, as by `at`."""
        return self.at(*self._size)

    def at(self, width: int, height: int) -> U8:
        """The colours [height, width, 3], by bicubic interpolation, which keeps twice the sharpness of
        bilinear. Any thread may ask."""
        import cv2  # a client that only reads these types need not load it

        size = width, height
        with _ENLARGING:
            if size not in self._made:
                middles = cv2.sepFilter2D(self.small, -1, MIDDLES, MIDDLES, borderType=cv2.BORDER_REPLICATE)
                self._made[size] = np.asarray(cv2.resize(middles, size, interpolation=cv2.INTER_CUBIC))
            return self._made[size]

    def every(self, step: int) -> U8:
        """Every `step`-th pixel of every `step`-th row of `whole`, but less sharp where the view was drawn
        small. The result does not depend on whether `whole` was made before."""
        if self._size == self.small.shape[1::-1]:
            return self.small[::step, ::step]
        import cv2

        (width, height), (small_height, small_width) = self._size, self.small.shape[:2]
        across, down = small_width / width, small_height / height
        places = np.array([[step * across, 0, 0.5 * across - 0.5], [0, step * down, 0.5 * down - 0.5]])
        size, flags = (-(-width // step), -(-height // step)), cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        return np.asarray(
            cv2.warpAffine(self.small, places, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        )


@dataclass(frozen=True, slots=True)
class Shown:
    """What consumers are shown of a view: the model with the detail of images, see
    `sags_node.detail`."""

    rgb: U8  # [H, W, 3]
    taken: U8  # [H, W] 0..255, the share that comes from an image
    oldest_ns: int  # when the oldest of these images was captured


@dataclass(frozen=True, slots=True)
class RenderedView:
    """The model drawn for one camera."""

    frame_id: int
    t_capture_ns: int
    camera: Camera
    colours: Colours
    depth: F32  # [H, W] m along z, 0 where the model says nothing, or nothing sure enough
    alpha: F32  # [H, W] coverage 0..1
    confidence: F32 | None = None  # [H, W] 0..1 of the depth, see `sags_node.confidence`; None: unknown
    shown: Shown | None = None  # None: the model alone

    @property
    def rgb(self) -> U8:
        """[H, W, 3] RGB, normalised by coverage. Made at the first call (`Colours`)."""
        return self.colours.whole


@dataclass(frozen=True, slots=True)
class AnchorsAhead:
    """Where anchors are expected some time after a frame."""

    seconds: F32  # [A] after the frame; 0: not predicted
    points: F32  # [A, 3] m, world
    pixels: F32  # [A, 2]


@dataclass(frozen=True, slots=True)
class AnchorStates:
    """The points that users pinned to the tissue, at one time."""

    ids: I64  # [A] an id is never used again
    points: F32  # [A, 3] m, world; NaN: lost
    pixels: F32  # [A, 2] in the left image, also beyond its edges; NaN: behind the camera or lost
    visibility: F32  # [A] 0..1, seen by the left eye: neither behind an instrument nor behind other tissue
    confidence: F32  # [A] 0..1; falls while the anchor is not seen, 0: lost
    ages: F32  # [A] s since it was pinned
    depth_confidence: F32  # [A] 0..1, of the tissue that carries it, see `sags_node.confidence`
    ahead: AnchorsAhead | None = None  # None: nobody asked, or motion is not predicted

    def __len__(self) -> int:
        return len(self.ids)

    @staticmethod
    def none() -> AnchorStates:
        def empty(*shape: int) -> F32:
            return np.empty((0, *shape), np.float32)

        return AnchorStates(np.empty(0, np.int64), empty(3), empty(2), empty(), empty(), empty(), empty())


@dataclass(frozen=True, slots=True)
class InstrumentStates:
    """The instruments in one frame. What is not known is NaN, and its confidence 0."""

    ids: I64  # [I] an id is never used again
    tips: F32  # [I, 3] m, world
    axes: F32  # [I, 3] unit, world, from the shaft to the tip
    pixels: F32  # [I, 2] of the tip in the left image
    confidence: F32  # [I] 0..1, of the tip, see `sags_node.confidence`
    distance: F32  # [I] m, from the tip along the axis to the tissue; 0: it touches it, or is in it
    distance_confidence: F32  # [I] 0..1
    clearance: F32  # [I] m, from the tip to the nearest tissue
    clearance_confidence: F32  # [I] 0..1
    nearest: F32  # [I, 3] m, world, of the tissue
    sources: I64  # [I] who tells it: 1 the image, 2 the robot, 3 the robot corrected by the image

    def __len__(self) -> int:
        return len(self.ids)


class Finding(NamedTuple):
    """Something a person should know of: a warning."""

    code: str  # stable, e.g. right_eye_dark; explained in docs/warnings.md
    text: str  # what is wrong and how to fix it


@dataclass(frozen=True, slots=True)
class RungState:
    """The rung of the quality ladder on which frames are processed (`mapping.ladder`)."""

    number: int  # 0: the cheapest
    of: int  # how many there are
    reason: str  # why it is that one
    gaussians: int  # at most
    scale: float  # share of the working size at which the model is drawn and refined
    depth_every: int  # frames: how often depth is matched


class Strained(Protocol):
    """The strain of the tissue since a moment; see `sags_node.model.strain`."""

    since_ns: int  # that moment, by the present clock of the frames

    def at(self, gaussians: Gaussians) -> F32:
        """The largest and the smallest principal strain [N, 2] where each Gaussian is; NaN: not known."""


@dataclass(frozen=True, slots=True)
class FrameResult:
    """All results of one frame."""

    pair: RectifiedPair
    observation: Observation
    snapshot: Snapshot
    views: Mapping[str, RenderedView]  # "left", and "right" while somebody looks there
    epoch: int
    timings_ms: Mapping[str, float]  # stage -> ms
    skipped: Mapping[str, str] = field(default_factory=dict)  # what was left out, and why
    anchors: AnchorStates = field(default_factory=AnchorStates.none)
    rung: RungState | None = None  # None: fixed steps, no ladder
    held: str = ""  # why the frame was not taken in, so the model is of an older one; empty: it was taken in
    hurried: bool = False  # there was no time to measure its depth
    recorded_s: float | None = None  # as `StereoFrame.recorded_s`
    instruments: InstrumentStates | None = None  # None: nobody asked
    strain: Strained | None = None  # None: nobody asked
    plain: bool = False  # as nobody looked, its left view lacks the detail of images


@dataclass(frozen=True, slots=True)
class DrawnView:
    """The model drawn from a viewpoint that a consumer asked for."""

    eyes: Mapping[str, RenderedView]  # "left" and "right" of a stereo pair, "" of a single view
    baseline: float  # m, of the pair
    depth: bool  # also publish the depth
    still: bool  # drawn once, and sent again to those who subscribe later
    epoch: int
    ahead_s: float = 0.0  # s; shows where the tissue is expected so long after its frame; 0: where it was


@dataclass(frozen=True, slots=True)
class ViewStatus:
    """How well a view that a consumer asked for is served."""

    asked_hz: float  # 0: drawn once
    granted_hz: float  # what its share of the machine allows
    held_hz: float  # rate at which it was drawn over the last seconds
    draw_ms: float  # of one drawing; 0 before the first
    limited_by: str  # what keeps it below the rate asked for; empty: nothing


@dataclass(frozen=True, slots=True)
class ClockStatus:
    """The clock that stamps live images, against this machine's wall clock."""

    offset_ms: float  # wall clock - that clock, plus the shortest delay of an image
    drift_ppm: float | None  # how fast the offset grows, us/s; None: it is not known yet
    seconds: float  # for which it was watched


@dataclass(frozen=True, slots=True)
class NodeHealth:
    """What the node says of itself once a second, also when no frames come."""

    state: str  # starting | running | held | waiting | paused | degraded | stopping
    rate_hz: float
    latency_ms: Mapping[str, float]  # p50, p90, p99, max over the last seconds
    frame_ms: Mapping[str, float]  # the same of the work on a frame
    stage_ms: Mapping[str, float]
    dropped: Mapping[str, int]  # per slot
    gaussians: int
    rss_mb: float
    skipped: Mapping[str, int]  # rule -> frames
    last_error: str | None = None
    warnings: Mapping[str, tuple[Finding, ...]] = field(default_factory=dict)  # by stage, `findings`
    connections: Mapping[str, Mapping[str, int]] = field(default_factory=dict)  # socket -> open, refused
    views: Mapping[str, ViewStatus] = field(default_factory=dict)  # those that consumers asked for, by name
    rung: RungState | None = None  # None: fixed steps, or no frame yet
    motion: MotionState | None = None  # None: nobody asks for it, or too little is known yet
    clock: ClockStatus | None = None  # None: a recording, or images without stamps
    recording: Mapping[str, object] | None = None  # state of the recording asked for; None: none was
