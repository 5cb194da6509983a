"""Light and colour of tissue and metal. The light sits at the scope's tip, just above the eyes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sags_node.geometry import transform
from sags_node.phantom.vectors import dot, normalized
from sags_node.types import F32, F64

LAMP_ABOVE = 0.006  # m above the eyes; this offset makes shadows visible
LIGHT_POWER = 0.0052  # m^2: a white wall at sqrt(LIGHT_POWER) m has brightness 1
LIGHT_SPREAD = 3.0  # exponent of the fall-off towards the rim
_WRAP = np.array([0.34, 0.14, 0.12], np.float32)  # subsurface scattering: red light leaks into the shade
_AMBIENT = np.array([0.085, 0.050, 0.047], np.float32)  # light that has bounced off other tissue
_CAVITY_GLOW = np.array([0.30, 0.085, 0.075], np.float32)  # what metal mirrors when it faces the tissue


@dataclass(frozen=True, slots=True)
class Lamp:
    """The scope's light."""

    place: F32  # [3] m, world
    axis: F32  # [3] unit vector, where it points

    @staticmethod
    def at_tip(T_world_cam: F64, baseline: float) -> Lamp:
        """Return the lamp above the eyes of a scope whose left eye has this pose."""
        place = transform(T_world_cam, np.array([0.5 * baseline, -LAMP_ABOVE, 0.0]))
        return Lamp(place.astype(np.float32), T_world_cam[:3, 2].astype(np.float32))

    def reach(self, points: F32) -> tuple[F32, F32]:
        """Return unit vectors to the light [..., 3] and the strength received [...] at points [..., 3]."""
        to_light = self.place - points
        squared = dot(to_light, to_light)
        to_light = normalized(to_light)
        strength = LIGHT_POWER / squared * np.maximum(-(to_light @ self.axis), 0) ** np.float32(LIGHT_SPREAD)
        return to_light, np.asarray(strength, np.float32)


def shade_tissue(points: F32, normals: F32, view: F32, color: F32, surface: F32, lamp: Lamp, lit: F32) -> F32:
    """Return the linear-light colour [..., 3] of wet tissue.

    Args:
        points, normals: [..., 3] m and unit vectors.
        view: [..., 3] unit vectors towards the eye.
        color: [..., 3] reflectance.
        surface: [..., 3] slopes of the fine relief along x and y, wetness.
        lamp: the light.
        lit: [...] share of the light that reaches the point, 0 = in shadow.
    """
    fine = _tilted(normals, surface[..., :2])
    to_light, strength = lamp.reach(points)
    strength = strength * lit
    cosine = 0.45 * dot(to_light, normals) + 0.55 * dot(to_light, fine)  # scattering blurs the fine relief
    diffuse = np.maximum((cosine[..., None] + _WRAP) / (1 + _WRAP), 0)

    facing = np.clip(dot(normalized(to_light + view), fine), 0, 1)  # of the half-way vector
    # Two lobes: the film of liquid, and the rougher tissue below it.
    film = surface[..., 2] ** 2 * 2.6 * facing ** np.float32(260)
    gleam = 0.075 * facing ** np.float32(22)
    mirrored = (film + gleam) * np.minimum(strength, 1.6) * (cosine > 0)
    return np.asarray(color * (diffuse * strength[..., None] + _AMBIENT) + mirrored[..., None], np.float32)


def _tilted(normals: F32, slope: F32) -> F32:
    """Normals of a surface with fine slopes [..., 2] along its tangents nearest the x and y axes."""
    nx, ny, nz = normals[..., 0], normals[..., 1], normals[..., 2]
    # Tangents (1, 0, -nx/nz) and (0, 1, -ny/nz); the normal points to the camera, nz < 0.
    safe_nz = np.minimum(nz, -0.2)
    scale_x, scale_y = 1 / np.sqrt(1 + (nx / safe_nz) ** 2), 1 / np.sqrt(1 + (ny / safe_nz) ** 2)
    a, b = slope[..., 0] * scale_x, slope[..., 1] * scale_y
    return normalized(np.stack([nx - a, ny - b, nz + a * nx / safe_nz + b * ny / safe_nz], -1))


def shade_metal(points: F32, normals: F32, view: F32, materials: F32, lamp: Lamp) -> F32:
    """Return the linear-light colour [N, 3] of metal; `materials` [N, 4] is reflectance and mirror share."""
    to_light, strength = lamp.reach(points)
    color, mirror = materials[:, :3], materials[:, 3:]
    facing = dot(normals, view)[:, None]
    reflected = 2 * facing * normals - view
    towards_tissue = np.clip(0.5 + 0.5 * (reflected @ lamp.axis), 0, 1)[:, None]
    towards_light = np.clip(dot(reflected, to_light), 0, 1)[:, None]
    strength = np.minimum(strength, 2.2)[:, None]
    surroundings = _CAVITY_GLOW * towards_tissue**2 + 0.9 * towards_light**3 + 4.0 * towards_light**90
    matt = np.maximum(dot(normals, to_light), 0)[:, None] + _AMBIENT
    gleam = 0.10 * towards_light**30 + 0.9 * towards_light**250
    rim = 0.05 * (1 - np.clip(facing, 0, 1)) ** 3
    return np.asarray(
        strength * (color * (mirror * surroundings + (1 - mirror) * matt) + (1 - mirror) * gleam + rim),
        np.float32,
    )


def develop(linear: F32) -> F32:
    """Turn linear light into display values 0..1: a soft shoulder, so that highlights bloom, and gamma."""
    shoulder = np.where(linear < 0.6, linear, 1 - 0.4 * np.exp(-(linear - 0.6) / 0.4))
    return np.asarray(np.maximum(shoulder, 0) ** np.float32(1 / 2.2), np.float32)
