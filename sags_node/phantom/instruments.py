"""A fenestrated grasper and a hook: meshes that are posed by their tip and the trocar they come through.

Local axes: the tip of the closed instrument is the origin, the shaft runs along +z, the jaws open along x.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.phantom.motion import keyed
from sags_node.types import F64, I64

X, Y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
JAW_LENGTH = 0.0145  # m, hinge to tip
BITE = 0.0022  # m, how deep the closed jaws sit in the fold
SHAFT_END = 0.16  # m
SHAFT_RADIUS = 0.0034  # m
SEGMENTS = 32  # of a ring

# Reflectance (RGB, linear) and share of mirror-like reflection.
_STEEL = (0.66, 0.67, 0.68, 0.85)
_DARK_STEEL = (0.20, 0.20, 0.21, 0.70)
_CERAMIC = (0.62, 0.60, 0.52, 0.12)
_GOLD = (0.72, 0.50, 0.12, 0.60)
_BLACK = (0.022, 0.022, 0.024, 0.06)

# The instruments' work as (phase of one action, 0..1) keys: shares of RETREAT, of OPENING, of the way in.
GRASPER_AWAY = ((0.0, 1.0), (0.12, 0.0), (0.86, 0.0), (1.0, 1.0))
GRASPER_OPEN = ((0.0, 1.0), (0.12, 1.0), (0.18, 0.0), (0.82, 0.0), (0.88, 1.0), (1.0, 1.0))
HOOK_IN = ((0.0, 0.0), (0.30, 0.75), (0.45, 1.0), (0.62, 0.85), (1.0, 0.0))
RETREAT = 0.030  # m along the shaft
OPENING = np.radians(24.0)  # of each jaw
GRASPER_TROCAR = np.array([-0.105, 0.125, -0.010])  # m, world
HOOK_TROCAR = np.array([0.125, 0.105, 0.000])


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles with smooth normals and a material."""

    vertices: F64  # [V, 3] m
    normals: F64  # [V, 3]
    faces: I64  # [F, 3]
    materials: F64  # [F, 4] reflectance RGB, mirror share


NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 4)))


@dataclass(frozen=True, slots=True)
class _Part:
    mesh: Mesh
    jaw: int = 0  # -1, 1: turns about the hinge; 0: rigid


class Instruments:
    """Both instruments as one mesh whose vertices are posed for a phase."""

    def __init__(self) -> None:
        self._grasper = _grasper_parts()
        self._hook = _hook_parts()

    def mesh(self, action: float, grip: F64, view_at: F64) -> Mesh:
        """Return both instruments at phase `action` of their work.

        Args:
            grip: the gripped tissue point [3] (m, world).
            view_at: half width and half height of the view (m) at the hook's depth.
        """
        axis = _unit(GRASPER_TROCAR - grip)
        tip = grip + axis * (RETREAT * keyed(action, GRASPER_AWAY) - BITE)
        grasper = self.grasper(tip, GRASPER_TROCAR, OPENING * keyed(action, GRASPER_OPEN))

        reach = keyed(action, HOOK_IN)
        sway = 0.12 * np.sin(4 * np.pi * action)
        outside, inside = np.array([1.55, 0.95]), np.array([0.28, 0.30 + sway])
        tip = np.array([*(outside + (inside - outside) * reach) * view_at, 0.058 - 0.004 * reach])
        return joined([grasper, self.hook(tip, HOOK_TROCAR)])

    def grasper(self, tip: F64, trocar: F64, opening: float = 0.0) -> Mesh:
        """Return the grasper that comes through `trocar` [3] (m, world) and whose tip, when it is closed, is
        at `tip` [3]. `opening`: angle of each jaw, radians."""
        return _posed(self._grasper, _pose(tip, trocar, roll=np.radians(55.0)), opening)

    def hook(self, tip: F64, trocar: F64) -> Mesh:
        """Return the hook, as `grasper`. `tip` is on its axis; the end of the hook is 3 mm beside it."""
        return _posed(self._hook, _pose(tip, trocar, roll=np.radians(20.0)), 0.0)


def _pose(tip: F64, trocar: F64, roll: float) -> F64:
    z = _unit(trocar - tip)
    x = _unit(np.cross(z, [0.0, 0.0, 1.0]))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], -1) @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    pose[:3, 3] = tip
    return pose


def _posed(parts: list[_Part], pose: F64, opening: float) -> Mesh:
    meshes = []
    hinge = np.array([0.0, 0.0, JAW_LENGTH])
    for part in parts:
        turn = cv2.Rodrigues(np.array([0.0, -part.jaw * opening, 0.0]))[0]
        R = pose[:3, :3] @ turn
        vertices = (part.mesh.vertices - hinge) @ R.T + pose[:3, :3] @ hinge + pose[:3, 3]
        meshes.append(Mesh(vertices, part.mesh.normals @ R.T, part.mesh.faces, part.mesh.materials))
    return joined(meshes)


def joined(meshes: list[Mesh]) -> Mesh:
    """Join several meshes into one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        faces=np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        materials=np.concatenate([mesh.materials for mesh in meshes]),
    )


def _grasper_parts() -> list[_Part]:
    parts = []
    for side in (-1, 1):
        # A jaw is a loop of wire (the window of a fenestrated grasper) that meets its twin at the tip.
        angle = np.linspace(0, 2 * np.pi, 49)
        along = 0.5 * JAW_LENGTH * (0.96 - np.cos(angle))
        width = 0.00185 * np.sin(angle) * (0.75 + 0.25 * along / JAW_LENGTH)
        bow = side * (0.0005 + 0.0010 * np.sin(np.pi * np.clip(along / JAW_LENGTH, 0, 1)))
        path = np.stack([bow, width, along], -1)
        parts.append(_Part(_tube(path, 0.00060, 0.00075, X, _STEEL), side))
        yoke = np.array([[0, 0, 0.0115], [0, 0, 0.0118], [0, 0, 0.0150], [0, 0, 0.0165], [0, 0, 0.0166]])
        yoke = yoke + side * np.array([0.0008, 0, 0])
        parts.append(
            _Part(
                _tube(yoke, [0, 0.0009, 0.0012, 0.0012, 0], [0, 0.0016, 0.0024, 0.0022, 0], Y, _STEEL), side
            )
        )
    pin = np.array(
        [[0, -0.0033, JAW_LENGTH], [0, -0.0032, JAW_LENGTH], [0, 0.0032, JAW_LENGTH], [0, 0.0033, JAW_LENGTH]]
    )
    parts.append(_Part(_tube(pin, [0, 0.0012, 0.0012, 0], [0, 0.0012, 0.0012, 0], X, _DARK_STEEL)))
    for side in (-1, 1):  # the fork that holds the hinge
        prong = np.array([[0, 0, 0.0126], [0, 0, 0.0129], [0, 0, 0.0150], [0, 0, 0.0200]]) + side * Y * 0.0025
        parts.append(_Part(_tube(prong, [0, 0.0016, 0.0021, 0.0026], [0, 0.0006, 0.0007, 0.0009], Y, _STEEL)))
    parts.append(_Part(_turned([(0.0175, 0), (0.0176, 0.0022), (0.0190, 0.0030), (0.0202, 0.0033)], _STEEL)))
    core = [(0.0148, 0.0), (0.0150, 0.0016), (0.0180, 0.0020)]
    parts.append(_Part(_turned(core, _DARK_STEEL)))
    housing = [
        *[(0.0200, 0.0), (0.0201, 0.0032), (0.0206, 0.0036), (0.0235, 0.0037), (0.0237, 0.0034)],
        *[(0.0242, 0.0034), (0.0244, 0.0037), (0.0275, 0.0038), (0.0282, 0.0036), (0.0283, 0.0)],
    ]
    parts.append(_Part(_turned(housing, _CERAMIC)))
    parts.append(
        _Part(_turned([(0.0280, 0.0), (0.0281, 0.0031), (0.0300, 0.0031), (0.0301, 0.0)], _DARK_STEEL))
    )
    parts.append(_Part(_turned([(0.0298, 0.0), (0.0299, SHAFT_RADIUS), (SHAFT_END, SHAFT_RADIUS)], _BLACK)))
    return parts


def _hook_parts() -> list[_Part]:
    bend = np.linspace(0, 1, 13)
    tip = np.stack(
        [0.0030 * (1 - bend) ** 2.2, np.zeros(13), 0.0042 * bend - 0.0012 * np.sin(np.pi * bend)], -1
    )
    rod = np.vstack([tip, [[0, 0, 0.0060], [0, 0, 0.0100]]])
    radii = np.concatenate([[0.0, 0.00030], np.full(11, 0.00042), [0.0005, 0.0007]])
    gold = [
        *[(0.0150, 0.0), (0.0151, 0.0022), (0.0165, 0.0031), (0.0195, 0.0033), (0.0197, 0.0029)],
        *[(0.0204, 0.0029), (0.0206, 0.0033), (0.0250, 0.0034), (0.0260, 0.0031), (0.0261, 0.0)],
    ]
    return [
        _Part(_tube(rod, radii, radii, Y, _STEEL)),
        _Part(_turned([(0.0098, 0.0), (0.0099, 0.0009), (0.0130, 0.0013), (0.0155, 0.0014)], _DARK_STEEL)),
        _Part(_turned(gold, _GOLD)),
        _Part(_turned([(0.0259, 0.0), (0.0260, SHAFT_RADIUS), (SHAFT_END, SHAFT_RADIUS)], _BLACK)),
    ]


def _turned(profile: list[tuple[float, float]], material: tuple[float, float, float, float]) -> Mesh:
    """A solid of revolution about z from (z, radius) pairs (m)."""
    z, radius = np.array(profile).T
    return _tube(np.stack([0 * z, 0 * z, z], -1), radius, radius, Y, material)


def _tube(
    path: F64,
    across: F64 | list[float] | float,
    normal: F64 | list[float] | float,
    plane_normal: F64,
    material: tuple[float, float, float, float],
) -> Mesh:
    """A tube of elliptic rings along a path [n, 3] in (about) a plane; half axes (m) in and normal to it."""
    count = len(path)
    tangent = np.gradient(path, axis=0)
    side = _unit(np.cross(plane_normal, tangent))
    angle = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    half_axes = np.stack([np.broadcast_to(across, count), np.broadcast_to(normal, count)], -1)
    ring = half_axes[:, None, :1] * np.cos(angle)[:, None] * side[:, None]
    ring = ring + half_axes[:, None, 1:] * np.sin(angle)[:, None] * plane_normal
    vertices = (path[:, None] + ring).reshape(-1, 3)

    start = (np.arange(count - 1)[:, None] * SEGMENTS + np.arange(SEGMENTS)).ravel()
    after = (np.arange(count - 1)[:, None] * SEGMENTS + (np.arange(SEGMENTS) + 1) % SEGMENTS).ravel()
    upper = np.stack([start, after, start + SEGMENTS], -1)
    lower = np.stack([after, after + SEGMENTS, start + SEGMENTS], -1)
    faces = np.concatenate([upper, lower])

    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face_normals)
    outward = np.sign((normals * ring.reshape(-1, 3)).sum(-1).sum())
    return Mesh(vertices, outward * _unit(normals), faces, np.tile(np.array(material), (len(faces), 1)))


def _unit(vectors: F64) -> F64:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30))
