"""Draws placed objects for one eye, tested against tissue and instruments.

What is in front of the tissue or on it is drawn in full. What lies under it shows through: `UNDER` of its
opacity. So does all where the tissue's depth is not sure enough to tell, and an object whose anchors are not
sure; its label has a question mark. Over instruments, and where no depth is known, nothing is drawn.

Depth and instruments are known for the left eye. For the right eye each point is looked up where the left
eye sees it. How near an instrument is, is not known, so in the right eye its place is anywhere between the
tissue and `NEAREST`; all of that stays free.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.clients.overlay.frame import TissueFrame
from sags_node.clients.overlay.mark import draw_mark
from sags_node.clients.overlay.mesh import Mesh
from sags_node.clients.overlay.raster import fill, hide, key_out
from sags_node.confidence import SURE
from sags_node.geometry import invert, transform
from sags_node.kernels.jit import read_only
from sags_node.types import F32, F64, U8, Camera

UNDER = 0.35  # share of the opacity that is left under the tissue
ON_SURFACE = 0.001  # m; what lies less than this under the surface counts as lying on it
NEAREST = 0.03  # m; no instrument is nearer to the right eye
DARKEST = 0.45  # share of a colour that is left where the surface is seen edge on
LABEL_ASIDE = 6  # px to the right of the middle
FONT = cv2.FONT_HERSHEY_SIMPLEX
NOTHING: Mapping[str, str] = {}  # no warnings


class Body:
    """A mesh prepared to be drawn again and again; None: only a label.

    Attributes:
        vertices: [V, 3] m, in its own coordinates; [0, 3] of a label.
        triangles: [T, 3].
        corners: [2, 3] m, the opposite corners of its bounding box.
    """

    def __init__(self, mesh: Mesh | None, opacity: float, label: str | None) -> None:
        self.label = label
        self.corners = np.zeros((2, 3))
        self.vertices, self.triangles = np.zeros((0, 3)), np.zeros((0, 3), np.int32)
        if mesh is None:
            return
        self.vertices, self.triangles = mesh.vertices.astype(np.float64), mesh.triangles
        corners = self.vertices[self.triangles]  # [T, 3, 3]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        self._normals = normals / np.where(lengths > 0, lengths, 1)
        self._centres = corners.mean(1)
        self._colors, self._alpha = mesh.colors, np.uint8(round(255 * opacity))
        self.corners = np.stack([self.vertices.min(0), self.vertices.max(0)])

    def painted(self, color: tuple[int, int, int], label: str) -> Body:
        """Return it in one colour, opaque, with another label."""
        other = copy(self)
        other.label, other._alpha = label, np.uint8(255)
        other._colors = np.broadcast_to(np.array(color, np.float32), self._colors.shape)
        return other

    def lit(self, eye: F64) -> U8:
        """Return its colours [T, 4], lit from the eye (at [3], m) as by an endoscope; bending is left out."""
        rays = self._centres - eye
        facing = np.abs(np.einsum("tc,tc->t", self._normals, rays)) / np.linalg.norm(rays, axis=1)
        light = DARKEST + (1 - DARKEST) * facing
        colors = np.full((len(light), 4), self._alpha, np.uint8)
        colors[:, :3] = np.rint(light[:, None] * self._colors)
        return colors


@dataclass(frozen=True, slots=True)
class Placed:
    body: Body
    T_world_body: F64  # [4, 4]
    is_sure: bool = True
    vertices: F64 | None = None  # [V, 3] m, of the body, bent with the tissue; None: it is rigid
    depth_confidence: float = 1.0  # 0..1, of what holds it

    def shape(self, T: F64) -> F64:
        """Return its vertices [V, 3] (m), transformed by T [4, 4] from its body's coordinates."""
        return np.asarray(transform(T, self.body.vertices if self.vertices is None else self.vertices))

    def draw(self, camera: Camera, z: F32, rgba: U8, colors: U8 | None = None) -> F64:
        """Draw what one eye sees of it into an image [H, W, 4] with depths [H, W] (m), in place. Return its
        vertices [V, 3] (m, in camera coordinates). `colors` are [T, 4]; default: as it is lit."""
        T_cam_body = invert(camera.T_world_cam) @ self.T_world_body
        local = self.shape(T_cam_body)
        if len(local):
            depths = np.ascontiguousarray(local[:, 2])
            pixels = (local / np.where(depths != 0, depths, 1)[:, None] @ camera.K.T)[:, :2]
            colors = self.body.lit(invert(T_cam_body)[:3, 3]) if colors is None else colors
            fill(np.ascontiguousarray(pixels), depths, read_only(self.body.triangles), colors, z, rgba)
        return local


def draw(
    frame: TissueFrame,
    objects: Sequence[Placed],
    baseline: float = 0.0,
    note: str = "",
    warnings: Mapping[str, str] = NOTHING,
) -> U8:
    """The overlay [H, W, 4] RGBA, not premultiplied, of the eye `baseline` (m) to the right of the left one,
    with what `annotate` writes into it."""
    height, width = frame.depth.shape
    camera = frame.camera.moved_right(baseline)
    z, rgba = np.full((height, width), np.inf, np.float32), np.zeros((height, width, 4), np.uint8)
    for placed in objects:
        if placed.is_sure:
            placed.draw(camera, z, rgba)
    sure_z = z.copy()
    for placed in objects:
        if not placed.is_sure:
            placed.draw(camera, z, rgba)
    rows, columns = np.nonzero(z < sure_z)
    faint = np.rint(UNDER * rgba[rows, columns, 3]).astype(np.uint8)
    _hide(z, rgba, frame, slice(None), camera, baseline, UNDER)
    rgba[rows, columns, 3] = np.minimum(rgba[rows, columns, 3], faint)
    for placed in objects:
        if placed.body.label is not None:
            _label(rgba, frame, camera, placed, baseline)
    annotate(rgba, frame, baseline, note, warnings)
    return rgba


def annotate(
    rgba: U8, frame: TissueFrame, baseline: float, note: str = "", warnings: Mapping[str, str] = NOTHING
) -> None:
    """Write `note` small into the upper right corner of an overlay, `warnings` (code -> text) on the lower
    edge, in place."""
    height, width = frame.depth.shape
    if note:
        (across, down), _ = cv2.getTextSize(note, FONT, _text_scale(height), 1)
        _write(rgba, frame, note, (width - across - 6, down + 6), NEAREST, baseline)
    if warnings:
        known = frame.depth[::8, ::8][frame.depth[::8, ::8] > 0]
        shift = float(frame.camera.K[0, 0]) * baseline / float(np.median(known)) if known.size else 0.0
        draw_mark(rgba, warnings, round(shift))


def color_key(rgba: U8, key: tuple[int, int, int]) -> U8:
    """The overlay [H, W, 4] on the key colour [H, W, 3], for displays that know no opacity.

    A pixel is either exactly the key colour or the overlay's own. Of what is less than half opaque, every
    other pixel is drawn, as on a chessboard. An overlay's colour that is the key by chance is changed by one.
    """
    keyed = np.empty((*rgba.shape[:2], 3), np.uint8)
    key_out(read_only(rgba), np.array(key, np.uint8), keyed)
    return keyed


def over(picture: U8, rgba: U8) -> U8:
    """The image [H, W, 3] with the overlay [H, W, 4] over it."""
    rows, columns = np.nonzero(rgba[..., 3])
    alpha = rgba[rows, columns, 3:].astype(np.float32) / 255
    shown = picture.copy()
    shown[rows, columns] = np.rint(alpha * rgba[rows, columns, :3] + (1 - alpha) * picture[rows, columns])
    return shown


def warm_up() -> None:
    """Load the kernels, or compile them once: not while frames wait."""
    corner = np.array([[0, 0, 1], [3, 0, 1], [0, 3, 1]], np.float32)
    mesh = Mesh(corner, np.array([[0, 1, 2]], np.int32), np.zeros((1, 3), np.float32))
    shape = (4, 4)
    camera = Camera(*shape, np.eye(3), np.eye(4))
    frame = TissueFrame(
        0, 0, "", 0, camera, None, read_only(np.ones(shape, np.float32)), np.ones(shape, bool), {}
    )
    color_key(draw(frame, [Placed(Body(mesh, 1.0, None), np.eye(4))]), (0, 0, 0))


def _hide(
    z: F32, rgba: U8, frame: TissueFrame, lines: slice, camera: Camera, baseline: float, under: float
) -> None:
    shift = float(camera.K[0, 0] * baseline)
    depth, tissue = frame.depth[lines], frame.tissue[lines]
    sure = np.ones_like(tissue) if frame.confidence is None else frame.confidence[lines] >= SURE
    hide(z, rgba, read_only(depth), read_only(tissue), read_only(sure), shift, NEAREST, ON_SURFACE, under)


def _label(rgba: U8, frame: TissueFrame, camera: Camera, placed: Placed, baseline: float) -> None:
    assert placed.body.label is not None
    middle = np.asarray(transform(placed.T_world_body, placed.body.corners.mean(0)))
    point = np.asarray(transform(camera.viewmat, middle))
    if point[2] > 0:
        u, v = (camera.K @ point)[:2] / point[2]
        if 0 <= u < camera.width and 0 <= v < camera.height:
            text = placed.body.label if placed.is_sure else f"{placed.body.label} ?"
            _write(rgba, frame, text, (int(u) + LABEL_ASIDE, int(v)), point[2], baseline)


def _write(
    rgba: U8, frame: TissueFrame, text: str, at: tuple[int, int], depth: float, baseline: float
) -> None:
    """Write white on black, in place, as if at a depth (m): over tissue, but not over instruments."""
    height, width = rgba.shape[:2]
    scale = _text_scale(height)
    (_, above), below = cv2.getTextSize(text, FONT, scale, 1)
    top, bottom = max(0, at[1] - above - 2), min(height, at[1] + below + 2)
    if top >= bottom:
        return
    letters = np.zeros((bottom - top, width), np.uint8)
    cv2.putText(letters, text, (at[0], at[1] - top), FONT, scale, 255, 1, cv2.LINE_AA)
    z, written = np.full(letters.shape, depth, np.float32), np.empty((*letters.shape, 4), np.uint8)
    written[..., :3] = letters[..., None]
    written[..., 3] = cv2.dilate(letters, np.ones((3, 3), np.uint8))
    lines = slice(top, bottom)
    _hide(z, written, frame, lines, frame.camera, baseline, under=1.0)
    free = written[..., 3] > 0
    rgba[lines][free] = written[free]


def _text_scale(height: int) -> float:
    return max(height / 1000, 0.4)
