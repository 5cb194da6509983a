"""What the phantom's tissue really looks like at other image sizes and from other distances."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sags_node.config.schema import PhantomSource
from sags_node.geometry import project, scale_intrinsics, unproject
from sags_node.phantom.scene import Phantom
from sags_node.types import F32, F64, Bool, Camera, Observation

PHASE = 0.5  # of the phantom's session: the fold is held up
FINEST = 4  # size of the finest image, in multiples of the trained size
SAMPLES = 4  # x 4 rays per pixel of the trained size; images of other sizes average as densely
HIDDEN = 0.02  # share of the depth: what is this far off what the trained camera sees, it never saw
BORDER = 2  # px left out around what the trained camera did not see
THIN = 5  # px of the trained size: vessels thinner than this
DARK = 0.03  # how much darker a vessel is than its surroundings, 0..1


@dataclass(frozen=True, slots=True)
class Shot:
    """The truth for one camera."""

    camera: Camera
    image: F32  # [H, W, 3] 0..1
    counted: Bool  # [H, W] tissue that the trained camera sees too


class AliasTruth:
    """One instant of the phantom, ray-cast without noise. Training uses its rectified left camera."""

    def __init__(self, config: PhantomSource) -> None:
        phantom = Phantom(config)
        self.rig = phantom.rig
        eye = self.rig.left
        self.camera = Camera(eye.width, eye.height, eye.P[:, :3].copy(), np.eye(4))
        self._still = phantom.still(PHASE)
        finest = resized(self.camera, FINEST)
        self._finest, depth = self._still.look(finest, SAMPLES // FINEST)
        self._image = _shrunk(self._finest, self.camera)
        self._depth = _shrunk(depth, self.camera)

    def observation(self) -> Observation:
        """Return the training data: the image and its exact depth."""
        shape = self._depth.shape
        picture = np.rint(self._image * 255).astype(np.uint8)
        return Observation(
            frame_id=0,
            t_capture_ns=0,
            camera=self.camera,
            image=picture,
            gray=cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY),
            tissue=np.ones(shape, np.bool_),
            depth=self._depth,
            depth_confidence=np.ones(shape, np.float32),
        )

    def at_size(self, factor: float) -> Shot:
        """Return the trained camera's view with `factor` times as many pixels along each side (up to FINEST),
        as means over the finest image's pixels."""
        camera = resized(self.camera, factor)
        return Shot(camera, _shrunk(self._finest, camera), np.ones((camera.height, camera.width), np.bool_))

    def at_distance(self, factor: float) -> Shot:
        """Return the view from `factor` times the median depth on the optical axis, at the trained size."""
        back = (factor - 1) * float(np.median(self._depth))
        return self._shot(moved(self.camera, np.array([0, 0, -back])), SAMPLES)

    def drift(self, factor: float, step: float, frames: int) -> Iterator[Shot]:
        """Yield views of the camera at `factor` of its size, moving right by `step` of its pixels a frame."""
        camera = resized(self.camera, factor)
        pixel = float(np.median(self._depth)) / camera.K[0, 0]
        for frame in range(frames):
            at = moved(camera, np.array([step * pixel * frame, 0, 0]))
            yield self._shot(at, round(SAMPLES / factor))

    def thin_vessels(self, factor: float) -> F32:
        """Return how much of each pixel [H, W] of `at_size(factor)` is thin vessel, 0..1."""
        luminance = self._image.mean(-1)
        around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (THIN, THIN))
        thin = cv2.morphologyEx(luminance, cv2.MORPH_BLACKHAT, around) > DARK
        camera = resized(self.camera, factor)
        enlarged = np.kron(thin, np.ones((FINEST, FINEST))).astype(np.float32)
        return _shrunk(enlarged, camera)

    def _shot(self, camera: Camera, samples: int) -> Shot:
        image, depth = self._still.look(camera, samples)
        pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1)
        points = unproject(camera, pixels.astype(np.float64), depth.astype(np.float64))
        seen, z = project(self.camera, points)
        inside = (depth > 0) & ((seen >= 0) & (seen <= [self.camera.width - 1, self.camera.height - 1])).all(
            -1
        )
        place = np.where(inside[..., None], seen, 0).astype(np.float32)
        surface = cv2.remap(self._depth, place, None, cv2.INTER_NEAREST)
        counted = inside & (np.abs(surface - z) < HIDDEN * surface)
        margin = np.ones((2 * BORDER + 1, 2 * BORDER + 1), np.uint8)
        counted = cv2.erode(counted.view(np.uint8), margin, borderValue=0).view(np.bool_)
        return Shot(camera, image, counted)


def resized(camera: Camera, factor: float) -> Camera:
    """Return the camera with `factor` times as many pixels along each side."""
    size = round(camera.width * factor), round(camera.height * factor)
    return Camera(*size, scale_intrinsics(camera.K, (camera.width, camera.height), size), camera.T_world_cam)


def moved(camera: Camera, by: F64) -> Camera:
    """Return the camera shifted by [3] m along its own axes."""
    T = camera.T_world_cam.copy()
    T[:3, 3] += T[:3, :3] @ by
    return replace(camera, T_world_cam=T)


def _shrunk(picture: F32, camera: Camera) -> F32:
    """Means over blocks of pixels, down to the camera's size."""
    size = camera.width, camera.height
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.float32)
