"""The 3D scene in the browser: Gaussians, the left camera with its image, and anchors.

Its unit is the millimetre, because viser keeps covariances as float16: those of tissue in square metres
would vanish. Its axes are the node's world: x right, y down, z away from the first left camera (OpenCV).
"""

import math
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from sags_node.clients.viewer.feed import LEFT, Moment, known_depth
from sags_node.clients.viewer.overlay import Overlay
from sags_node.clients.viewer.splats import Splats, splats_of
from sags_node.confidence import is_sure_in_space
from sags_node.geometry import matrix_to_quat, transform
from sags_node.types import F64, U8, Camera

UNIT = 1e-3  # m
FRUSTUM = 12.0  # mm deep
PICTURE_WIDTH = 240  # px, of the image in the frustum
JPEG_QUALITY = 80
STEP = 4096  # their number is filled up to a multiple of this
NEAR = 1.0  # mm; nothing closer is drawn
ANCHOR_SIZE = 1.5  # mm
SEEN, UNSURE, HIDDEN = (255, 220, 0), (255, 90, 0), (150, 150, 150)  # colours of an anchor
ASIDE = np.array([18.0, -16.0, -22.0])  # mm from the left camera, where the overview is drawn from
USUAL_DEPTH = 80.0  # mm, to look at before any depth is known


class Scene:
    """Shows moments; what is not new is taken away."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.splats: Splats | None = None  # those shown
        self.camera: Camera | None = None
        self.places: dict[int, F64] = {}  # of the anchors that have one, mm
        self._server = server
        self._drawn_splats: viser.GaussianSplatHandle | None = None
        self._frustum: viser.CameraFrustumHandle | None = None
        self._anchors: viser.PointCloudHandle | None = None
        self._labels: dict[int, viser.LabelHandle] = {}
        self._depth = USUAL_DEPTH  # mm, of the tissue
        server.scene.set_up_direction("-y")
        server.initial_camera.up = (0.0, -1.0, 0.0)
        server.initial_camera.near = NEAR
        server.initial_camera.position = ASIDE
        server.initial_camera.look_at = np.array([0.0, 0.0, self._depth])

    def show(self, moment: Moment) -> None:
        """Bring the scene up to date."""
        if (known := known_depth(moment.pictures)).size:
            self._depth = float(np.median(known)) / UNIT
        self._show_splats(None if moment.splats is None else splats_of(moment.splats))
        self._show_camera(moment.camera, moment.pictures.get(LEFT))
        self._show_anchors(moment.anchors, {} if moment.overlay is None else names_of(moment.overlay))

    def anchor_at(self, origin: F64, direction: F64) -> int | None:
        """The anchor that a ray from `origin` (mm) along `direction` hits first; None: it hits none."""
        ray = direction / np.linalg.norm(direction)
        hit = {
            anchor: float(offset @ ray)
            for anchor, offset in ((anchor, place - origin) for anchor, place in self.places.items())
            if np.linalg.norm(np.cross(offset, ray)) < ANCHOR_SIZE and offset @ ray > 0
        }
        return min(hit, key=hit.__getitem__, default=None)

    def look(self, client: viser.ClientHandle, through: bool = False) -> None:
        """Turn a browser to the tissue: from aside, or as the left camera sees it."""
        pose = np.eye(4) if self.camera is None else self.camera.T_world_cam
        eye = np.zeros(3) if through else ASIDE
        with client.atomic():
            client.camera.position = transform(pose, eye * UNIT) / UNIT
            client.camera.look_at = transform(pose, np.array([0.0, 0.0, self._depth]) * UNIT) / UNIT
            client.camera.up_direction = -pose[:3, 1]
            client.camera.near = 1.1 * FRUSTUM if through else NEAR  # beyond the image in the frustum
            if through and self.camera is not None:
                client.camera.fov = _fov(self.camera)

    def _show_splats(self, splats: Splats | None) -> None:
        """Show splats, padded to a round number, as browsers rebuild their buffers when it changes."""
        self.splats = splats
        if splats is None or len(splats.means) == 0:
            if self._drawn_splats is not None:
                self._drawn_splats.remove()
            self._drawn_splats = None
            return
        count = len(splats.means)
        filled = np.minimum(np.arange(-(-count // STEP) * STEP), count - 1)  # the last one again and again
        opacities = np.where(np.arange(len(filled)) < count, splats.opacities[filled], 0)
        content = (
            splats.means[filled] / UNIT,
            splats.covariances(UNIT)[filled],
            splats.colors[filled],
            opacities[:, None],
        )
        if self._drawn_splats is None:
            self._drawn_splats = self._server.scene.add_gaussian_splats("/splats", *content)
        else:
            self._drawn_splats.set_gaussians(*content)

    def _show_camera(self, camera: Camera | None, picture: U8 | None) -> None:
        self.camera = camera
        if camera is None or picture is None:
            if self._frustum is not None:
                self._frustum.remove()
            self._frustum = None
            return
        height = max(1, round(camera.height * PICTURE_WIDTH / camera.width))
        small = cv2.resize(picture, (PICTURE_WIDTH, height), interpolation=cv2.INTER_AREA)
        if self._frustum is None:
            self._frustum = self._server.scene.add_camera_frustum(
                "/left_camera",
                fov=_fov(camera),
                aspect=camera.width / camera.height,
                scale=_frustum_scale(camera),
                thickness=0.1,
                color=(230, 230, 230),
                jpeg_quality=JPEG_QUALITY,
                format="jpeg",
                image=small,
            )
        else:
            self._frustum.image = small
        self._frustum.wxyz = matrix_to_quat(camera.T_world_cam[:3, :3])
        self._frustum.position = camera.T_world_cam[:3, 3] / UNIT

    def _show_anchors(self, anchors: NDArray[Any] | None, names: Mapping[int, str]) -> None:
        """Show anchors that have a place, as numbered points; `names`: of overlay objects that they hold."""
        rows = () if anchors is None else anchors[np.isfinite(anchors["x"])]
        self.places = {int(row["id"]): np.array([row[axis] for axis in "xyz"]) / UNIT for row in rows}
        for gone in self._labels.keys() - self.places.keys():
            self._labels.pop(gone).remove()
        for anchor, place in self.places.items():
            text = f"{anchor} {names.get(anchor, '')}".rstrip()
            if anchor not in self._labels:
                self._labels[anchor] = self._server.scene.add_label(f"/anchors/{anchor}", text)
            self._labels[anchor].position, self._labels[anchor].text = place, text
        if self._anchors is not None and not self.places:
            self._anchors.remove()
            self._anchors = None
        if self.places:
            self._anchors = self._server.scene.add_point_cloud(
                "/anchor_points",
                np.array(list(self.places.values())),
                np.array([anchor_color(row) for row in rows], np.uint8),
                point_size=ANCHOR_SIZE,
                point_shape="circle",
                precision="float32",
            )


def names_of(overlay: Overlay) -> dict[int, str]:
    """The name of the overlay's object that each anchor holds, with a `?` where its place is not sure."""
    return {
        int(anchor["id"] or 0): thing.name + ("" if thing.unsure is None else " ?")
        for thing in overlay.objects
        for anchor in thing.anchors
    }


def anchor_color(row: Any) -> tuple[int, int, int]:
    """The colour of an anchor: grey if the left eye does not see it, orange if its place is not sure."""
    if row["visibility"] == 0:
        return HIDDEN
    return SEEN if is_sure_in_space(row) else UNSURE


def _fov(camera: Camera) -> float:
    """Vertical field of view, radians."""
    return 2 * math.atan(camera.height / (2 * float(camera.K[1, 1])))


def _frustum_scale(camera: Camera) -> float:
    """viser keeps the volume of frustums alike, not their depth; this makes one `FRUSTUM` deep."""
    half_height = math.tan(_fov(camera) / 2)
    return FRUSTUM * math.cbrt(half_height * half_height * camera.width / camera.height / 3)
