"""The first consumer: virtual geometry pinned to the tissue, over the live left picture.

It fails transparent: when anything it needs is stale, missing or lost, the plain picture is shown. The
picture itself is never held back.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sags_node.apps import overlay_draw
from sags_node.apps.overlay_pin import RENEW_BELOW, Ids, Pin, pin_pixel, surface_normal
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import invert, quat_to_matrix, transform
from sags_node.messaging.address import ClientKeys
from sags_node.messaging.received import (
    Received,
    ReceivedCameraInfo,
    ReceivedCloud,
    ReceivedImage,
    ReceivedRos,
)
from sags_node.messaging.subscriber import Subscriber
from sags_node.types import F32, F64, U8, Bool

PICTURE = "left/image_rect_color"
NEEDED = ("left/render/depth", "left/tissue_mask", "left/camera_info", "tf", "splats")
WAIT_FOR_FRAME = 0.2  # s for a picture
WAIT_FOR_REST = 0.05  # s for what belongs to the picture
NORMAL_MEMORY = 0.8  # of the last normal; the depth of one frame is noisy
PATIENCE = 5.0  # s for the very first picture
PICTURES_BEFORE_VIDEO = 5  # the frame rate must be known before a video file is opened


@dataclass(frozen=True, slots=True)
class Scene:
    """What the overlay knows of one frame."""

    picture: U8  # [H, W, 3]
    depth: F32  # [H, W] m, NaN unknown
    tissue: Bool  # [H, W]
    K: F64  # [3, 3]
    T_world_cam: F64  # [4, 4]
    means: F32  # [N, 3] m, world
    ids: Ids  # [N]
    generation: tuple[str, int]  # session and epoch: ids of another generation mean other Gaussians


class PinnedOverlay:
    """Draws one shape at one tissue point, frame after frame.

    Args:
        pixel: (u, v) of the tissue to pin to, in the first frame that has depth there; None: its middle.
        shape: one of `overlay_draw.SHAPES`.
    """

    def __init__(self, pixel: tuple[float, float] | None, shape: str) -> None:
        self.paths: list[list[F64]] = []  # world positions (m), frame by frame, for each time it was pinned
        self.pixel: tuple[int, int] | None = None  # where it was pinned
        self._wanted = pixel
        self._shape = overlay_draw.SHAPES[shape]
        self._pin: Pin | None = None
        self._normal: F64 | None = None
        self._generation: tuple[str, int] | None = None

    def draw(self, scene: Scene) -> tuple[U8, str | None]:
        """The picture with the shape, or the plain picture and the reason why there is none."""
        if scene.generation != self._generation:
            self._generation, self._pin, self._normal = scene.generation, None, None
        if self._pin is None and not self._attach(scene):
            return scene.picture, "nothing to pin to"
        assert self._pin is not None
        found = self._pin.locate(scene.means, scene.ids)
        if found is None:
            return scene.picture, "pin lost"
        world, remaining = found
        if remaining < RENEW_BELOW:
            self._pin = Pin.attach(world, scene.means, scene.ids) or self._pin
        point = np.asarray(transform(invert(scene.T_world_cam), world), np.float64)
        height, width = scene.depth.shape
        u, v = np.rint((scene.K @ point)[:2] / point[2]) if point[2] > 0 else (-1, -1)
        if not (0 <= u < width and 0 <= v < height):
            return scene.picture, "pin outside the picture"
        if not np.isfinite(scene.depth[int(v), int(u)]):
            return scene.picture, "no depth at the pin"
        normal = self._smooth(surface_normal(scene.depth, scene.tissue, scene.K, point))
        if normal is None:
            return scene.picture, "no surface at the pin"
        self.paths[-1].append(world)
        samples = self._shape(point, normal, scene.K, scene.depth)
        picture, drawn = overlay_draw.draw(scene.picture, samples, scene.K, scene.depth, scene.tissue)
        if drawn:
            overlay_draw.label(picture, point, scene.K, f"{1000 * point[2]:.0f} mm")
            picture[~scene.tissue] = scene.picture[~scene.tissue]  # instruments are in front of text too
        return picture, None

    def _attach(self, scene: Scene) -> bool:
        pixel = pin_pixel(self._wanted, scene.depth, scene.tissue)
        if pixel is None:
            return False
        u, v = pixel
        local = np.linalg.inv(scene.K) @ (u, v, 1.0) * float(scene.depth[v, u])
        world = np.asarray(transform(scene.T_world_cam, local), np.float64)
        self._pin = Pin.attach(world, scene.means, scene.ids)
        self.pixel = pixel
        self.paths.append([])
        return self._pin is not None

    def _smooth(self, normal: F64 | None) -> F64 | None:
        if normal is not None and self._normal is not None:
            normal = NORMAL_MEMORY * self._normal + (1 - NORMAL_MEMORY) * normal
            normal /= np.linalg.norm(normal)
        self._normal = self._normal if normal is None else normal
        return self._normal


def run_overlay(
    endpoint: str | None = None,
    ns: str = "sags",
    pin: tuple[float, float] | None = None,
    shape: str = "target",
    seconds: float | None = None,
    save: Path | None = None,
    run_dir: Path | None = None,
    keys: ClientKeys | None = None,
) -> dict[str, Any]:
    """Draw over the left picture of a running node until `seconds` have passed or Ctrl-C.

    Args:
        pin: pixel (u, v) of the tissue to pin to; default: the middle of the tissue.
        save: .mp4 for every picture shown, .png for the last one with the overlay.
        keys: for a node that wants them.

    Returns:
        frames, overlay (frames with it), blanked (reason -> frames), latency_ms (capture to drawn), pin
        (pixel, how often it was pinned, how far it moved and the 90th percentile of its steps, mm), lost
        (messages), saved (the file; None when too little was shown to write one).

    Raises:
        UsageError: an unknown shape or kind of file, or a pin outside the picture.
        SagsError: no node is known, no picture came within `PATIENCE`, or the file cannot be written.
    """
    if shape not in overlay_draw.SHAPES:
        raise UsageError(f"unknown shape '{shape}'; shapes: {', '.join(overlay_draw.SHAPES)}")
    output = _Output(save)
    overlay = PinnedOverlay(pin, shape)
    blanked: Counter[str] = Counter()
    latencies_ms: list[float] = []
    began = time.monotonic()
    last: Received | None = None
    with Subscriber([PICTURE, *NEEDED], endpoint, ns, run_dir, keys=keys) as subscriber:
        try:
            while seconds is None or time.monotonic() < began + seconds:
                received = subscriber.wait(PICTURE, WAIT_FOR_FRAME, after=last)
                if not isinstance(received, ReceivedImage):
                    if last is None and time.monotonic() > began + PATIENCE:
                        break
                    continue
                if last is None:
                    _check_pin(pin, received)
                last = received
                picture, reason = _overlaid(subscriber, overlay, received)
                latencies_ms.append(1000 * received.age())
                if reason is not None:
                    blanked[reason] += 1
                output.add(picture, reason is None, subscriber.period(PICTURE))
        except KeyboardInterrupt:
            pass
        finally:
            output.close()
        if not latencies_ms:
            silence = f"no picture came from {subscriber.endpoint}; is the node running and not waiting?"
            raise SagsError(subscriber.refusal or silence)
        lost = sum(subscriber.lost(name) for name in (PICTURE, *NEEDED))
    return {
        "frames": len(latencies_ms),
        "overlay": len(latencies_ms) - blanked.total(),
        "blanked": dict(blanked),
        "latency_ms": {f"p{q}": float(np.percentile(latencies_ms, q)) for q in (50, 90, 99)},
        "pin": _wander(overlay),
        "lost": lost,
        "saved": output.saved,
    }


def _check_pin(pin: tuple[float, float] | None, picture: ReceivedImage) -> None:
    height, width = picture.array.shape[:2]
    if pin is not None and not (0 <= pin[0] < width and 0 <= pin[1] < height):
        raise UsageError(f"pin {pin[0]:g} {pin[1]:g} lies outside the picture of {width}x{height} px")


def _overlaid(
    subscriber: Subscriber, overlay: PinnedOverlay, picture: ReceivedImage
) -> tuple[U8, str | None]:
    """The picture with the overlay if everything of that very frame is there and fresh; else plain."""
    frame = subscriber.aligned(NEEDED, picture.stamp_ns, WAIT_FOR_REST)
    for name in (PICTURE, *NEEDED):
        if subscriber.problem(name) is not None:
            return picture.array, f"stale {name}"
    if frame is None:
        return picture.array, "incomplete frame"
    scene = scene_of(picture, frame)
    return (picture.array, "sizes differ") if scene is None else overlay.draw(scene)


def scene_of(picture: ReceivedImage, frame: dict[str, Received]) -> Scene | None:
    """The messages of one frame as a scene; None when they do not fit together."""
    depth, tissue, info, pose, splats = (frame[name] for name in NEEDED)
    assert isinstance(depth, ReceivedImage) and isinstance(tissue, ReceivedImage)
    assert isinstance(info, ReceivedCameraInfo) and isinstance(pose, ReceivedRos)
    assert isinstance(splats, ReceivedCloud)
    size = picture.array.shape[:2]
    if not depth.array.shape == tissue.array.shape == size == (info.height, info.width):
        return None
    if "id" not in (splats.points.dtype.names or ()) or len(pose.message.transforms) != 1:
        return None
    moved = pose.message.transforms[0].transform
    T = np.eye(4)
    T[:3, :3] = quat_to_matrix(np.array([getattr(moved.rotation, axis) for axis in "wxyz"]))
    T[:3, 3] = [getattr(moved.translation, axis) for axis in "xyz"]
    generation = (splats.meta.session, splats.meta.epoch)
    return Scene(
        picture.array, depth.array, tissue.array > 0, info.K, T, splats.xyz(), splats.points["id"], generation
    )


def _wander(overlay: PinnedOverlay) -> dict[str, Any]:
    """Where the point was pinned, how often, and how it moved."""
    paths = [1000 * np.array(path) for path in overlay.paths if path]
    steps = [np.linalg.norm(np.diff(path, axis=0), axis=1) for path in paths if len(path) > 1]
    return {
        "pixel": overlay.pixel,
        "pinned": len(paths),
        "moved_mm": max(
            (float(np.linalg.norm(path - path[0], axis=1).max()) for path in paths), default=None
        ),
        "step_mm_p90": float(np.percentile(np.concatenate(steps), 90)) if steps else None,
    }


class _Output:
    """Keeps what is shown: every picture as video, or the last one with the overlay as PNG."""

    def __init__(self, file: Path | None) -> None:
        if file is not None and file.suffix not in (".mp4", ".png"):
            raise UsageError(f"cannot save {file}: the name must end in .mp4 or .png")
        if file is not None and not file.parent.is_dir():
            raise UsageError(f"cannot save {file}: there is no folder {file.parent}")
        self._file = file
        self._still: U8 | None = None
        self._video: Any = None
        self._shown = 0
        self.saved: str | None = None  # what has been written

    def add(self, picture: U8, with_overlay: bool, period: float) -> None:
        self._shown += 1
        if self._file is None:
            return
        if self._file.suffix == ".png":
            if with_overlay or self._still is None:
                self._still = picture
            return
        if self._shown < PICTURES_BEFORE_VIDEO:
            return
        if self._video is None:
            size = (picture.shape[1], picture.shape[0])
            code = cv2.VideoWriter_fourcc(*"mp4v")  # type: ignore[attr-defined]  # the stubs lack it
            self._video = cv2.VideoWriter(str(self._file), code, 1 / period, size)
            if not self._video.isOpened():
                raise SagsError(f"cannot write {self._file}; check the folder's rights and the disk")
        self._video.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))

    def close(self) -> None:
        if self._video is not None:
            self._video.release()
            self.saved = str(self._file)
        if self._still is not None:
            if not cv2.imwrite(str(self._file), cv2.cvtColor(self._still, cv2.COLOR_RGB2BGR)):
                raise SagsError(f"cannot write {self._file}; check the folder's rights and the disk")
            self.saved = str(self._file)
