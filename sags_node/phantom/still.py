"""The tissue at one instant, without instruments, noise or lens: exact truth for any pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.geometry import scale_intrinsics
from sags_node.phantom.camera import shine, world_rays
from sags_node.phantom.casting import Bodies
from sags_node.phantom.relief import Relief
from sags_node.phantom.shading import Lamp, develop
from sags_node.phantom.skin import Skin
from sags_node.phantom.vectors import normalized
from sags_node.types import F32, F64, Camera

BAND = 1 << 19  # rays at a time


@dataclass(frozen=True, slots=True)
class Still:
    """Its light and its gleam stay as the first camera has them, so that a view from elsewhere differs by its
    geometry alone. Nothing casts a shadow: the phantom softens shadows in the picture, by so many pixels."""

    bodies: Bodies
    relief: Relief
    skin: Skin
    lamp: Lamp
    eye: F64  # [3] m, world: where the gleam is seen from

    def look(self, camera: Camera, samples: int) -> tuple[F32, F32]:
        """Display values [H, W, 3] 0..1 and depth [H, W] (m): means over `samples` x `samples` rays per
        pixel. Depth is 0 where a ray of the pixel met nothing."""
        size = camera.width * samples, camera.height * samples
        K = scale_intrinsics(camera.K, (camera.width, camera.height), size)
        slopes_x = (np.arange(size[0]) - K[0, 2]) / K[0, 0]
        slopes_y = (np.arange(size[1]) - K[1, 2]) / K[1, 1]
        image = np.empty((camera.height, camera.width, 3), np.float32)
        depth = np.empty((camera.height, camera.width), np.float32)
        rows = max(1, BAND // (size[0] * samples))
        for top in range(0, camera.height, rows):
            bottom = min(top + rows, camera.height)
            x, y = np.meshgrid(slopes_x, slopes_y[top * samples : bottom * samples])
            rays = np.stack([x, y, np.ones_like(x)], -1).astype(np.float32)
            values, distances = self._trace(world_rays(rays, 0.0, camera.T_world_cam))
            band = camera.width, bottom - top
            image[top:bottom] = cv2.resize(values, band, interpolation=cv2.INTER_AREA)
            met = cv2.resize((distances > 0).astype(np.float32), band, interpolation=cv2.INTER_AREA)
            mean = cv2.resize(distances, band, interpolation=cv2.INTER_AREA)
            depth[top:bottom] = np.where(met == 1, mean, 0)
        return image, depth

    def _trace(self, rays: F32) -> tuple[F32, F32]:
        """Display values [..., 3] and depths [...] of rays [..., 6]; 0 where they meet nothing."""
        hits = self.bodies.cast(rays)
        distances = np.asarray(np.where(hits.tissue, hits.distance, 0), np.float32)
        points = np.asarray(rays[..., :3] + distances[..., None] * rays[..., 3:], np.float32)
        view = normalized(np.asarray(self.eye - points, np.float32))
        lit = np.ones(distances.shape, np.float32)
        light = shine(points, view, hits, self.bodies, self.relief, self.skin, self.lamp, lit)
        return develop(light), distances
