"""A video around the tissue: the camera circles its own axis, turned towards the middle of the surface."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from sags_node.engine.rasterizer.rasterize import Drawer, to_view
from sags_node.errors import SagsError
from sags_node.files import whole
from sags_node.geometry import rigid
from sags_node.media.video_file import VideoFile
from sags_node.tools.export.scene import Advance, Scene
from sags_node.types import F32, U8, Camera, Gaussians

RATE = 30.0  # images per second
BACKGROUND = 0.12  # grey, where the model says nothing


def orbit(camera: Camera, distance: float, degrees: float, count: int) -> Iterator[Camera]:
    """`count` cameras on a circle that closes; all look at the point `distance` (m) in front of `camera`,
    from directions tilted by `degrees` against its own."""
    middle = np.array([0.0, 0.0, distance])
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        axis = np.deg2rad(degrees) * np.array([np.cos(angle), np.sin(angle), 0.0])
        R = cv2.Rodrigues(axis)[0]
        T = rigid(R, middle - R @ middle)
        yield replace(camera, T_world_cam=camera.T_world_cam @ T)


def picture_of(drawer: Drawer, gaussians: Gaussians, eye: Camera) -> tuple[U8, F32]:
    """The Gaussians as a camera sees them, RGB [H, W, 3], and their depth [H, W] m."""
    view = to_view(drawer.forward(gaussians, eye), eye, 0, 0)
    alpha = view.alpha[..., None]
    rgb = view.rgb * alpha + np.float32(255 * BACKGROUND) * (1 - alpha)
    return cv2.convertScaleAbs(rgb), view.depth


def write_orbit(path: Path, scene: Scene, degrees: float, seconds: float, advance: Advance) -> int:
    """Write a video that can be played in a loop; returns the number of images.

    Raises:
        SagsError: the camera sees nothing of the model, or the video cannot be written.
    """
    camera, count = scene.camera, max(1, round(seconds * RATE))
    drawer = scene.drawer()

    def draw(eye: Camera) -> tuple[U8, F32]:
        return picture_of(drawer, scene.gaussians, eye)

    depth = draw(camera)[1]
    if not (depth > 0).any():
        raise SagsError("the left camera sees nothing of the model; export another moment")
    with whole(path) as partial:
        video = VideoFile(partial, RATE, (camera.width, camera.height))
        for done, eye in enumerate(orbit(camera, float(np.median(depth[depth > 0])), degrees, count)):
            video.add(draw(eye)[0])
            advance(done + 1, count, "drawing")
        video.finish()
    return count
