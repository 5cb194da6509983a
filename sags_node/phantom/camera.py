"""Renders the image of one raw eye: its view in linear light, then smoke, then lens and sensor."""

import cv2
import numpy as np

from sags_node.geometry import transform
from sags_node.phantom.casting import Bodies, Hits, grid_position
from sags_node.phantom.relief import SPACING, Relief
from sags_node.phantom.shading import Lamp, develop, shade_metal, shade_tissue
from sags_node.phantom.skin import Skin
from sags_node.phantom.vectors import normalized
from sags_node.types import F32, F64, U8, Bool

LENS_BLUR = 0.45  # px: no endoscope is sharper; it also softens the edges of single-sample rendering
SMOKE_DISTANCE = 0.035  # m from the scope
SMOKE_COLOR = np.array([0.42, 0.40, 0.40], np.float32)
_NOTHING = 0.003  # linear light where a ray leaves the scene


def world_rays(directions: F32, offset: float, T_world_cam: F64) -> F32:
    """Return the rays [..., 6], in the world, of an eye `offset` m to the right of the camera.

    `directions` [..., 3] are in the camera's axes with z = 1, so that a hit's distance is its depth.
    """
    rays = np.empty((*directions.shape[:-1], 6), np.float32)
    rays[..., :3] = transform(T_world_cam, np.array([offset, 0.0, 0.0]))
    rays[..., 3:] = directions @ T_world_cam[:3, :3].T.astype(np.float32)
    return rays


def look(
    directions: F32, offset: float, T_world_cam: F64, bodies: Bodies, relief: Relief, skin: Skin, lamp: Lamp
) -> tuple[F32, Bool]:
    """Render linear light [H, W, 3] along `directions` [H, W, 3], and the mask of the instruments [H, W]."""
    rays = world_rays(directions, offset, T_world_cam)
    hits, towards = bodies.cast(rays), rays[..., 3:]
    distance = np.where(np.isfinite(hits.distance), hits.distance, np.float32(1))
    points = np.asarray(rays[..., :3] + distance[..., None] * towards, np.float32)
    view = -normalized(towards)
    picture = shine(points, view, hits, bodies, relief, skin, lamp, _lit(points, bodies, lamp))

    if hits.tool.any():
        tools = bodies.tools
        face, (second, third) = hits.face[hits.tool], hits.barycentric[hits.tool].T
        corners = tools.normals[tools.faces[face]]
        weights = np.stack([1 - second - third, second, third], -1)
        smooth = normalized(np.einsum("nk,nkc->nc", weights, corners))
        materials = tools.materials[face].astype(np.float32)
        picture[hits.tool] = shade_metal(
            points[hits.tool], smooth.astype(np.float32), view[hits.tool], materials, lamp
        )
    return picture, hits.tool


def shine(
    points: F32, view: F32, hits: Hits, bodies: Bodies, relief: Relief, skin: Skin, lamp: Lamp, lit: F32
) -> F32:
    """Return the linear light [..., 3] of the tissue at the hits of rays; a ray without a hit is nearly dark.

    Args:
        points: [..., 3] where the rays hit, m, world.
        view: [..., 3] unit vectors towards the eye.
        lit: [...] share of the lamp's light that arrives.
    """
    place = grid_position(hits, len(relief.x))
    normals = normalized(cv2.remap(bodies.normals, place, None, cv2.INTER_LINEAR))
    material = place * np.float32(SPACING) + np.array(
        [relief.x[0] - skin.x0, relief.y[0] - skin.y0], np.float32
    )
    texel = material / np.float32(skin.texel)
    color = cv2.remap(skin.color, texel, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    surface = cv2.remap(skin.surface, texel, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    picture = shade_tissue(points, normals, view, color, surface, lamp, lit)
    picture[~hits.tissue] = _NOTHING
    return picture


def _lit(points: F32, bodies: Bodies, lamp: Lamp) -> F32:
    """Share of the lamp's light [H, W] that reaches points [H, W, 3], at half resolution: soft edges."""
    from_points = np.ascontiguousarray(points[::2, ::2])
    shadow = bodies.occluded(np.concatenate([from_points, lamp.place - from_points], -1)).astype(np.float32)
    soft = cv2.GaussianBlur(shadow, (0, 0), 1.2)
    return np.asarray(1 - cv2.resize(soft, points.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def add_smoke(picture: F32, directions: F32, offset: float, cloud: F32, drift: F64, density: float) -> F32:
    """Add smoke to an image [H, W, 3]: a lit cloud [S, S] that hangs in front of the tissue.

    `drift` [2] moves the cloud, in its own pixels; `density` 0..1.
    """
    across = directions[..., :2] * np.float32(SMOKE_DISTANCE)
    across[..., 0] += np.float32(offset)
    place = (across / np.float32(0.3e-3) + drift + 0.5 * len(cloud)).astype(np.float32)
    thick = cv2.remap(cloud, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    opacity = 1 - np.exp(-density * np.maximum(0.55 + 0.45 * thick, 0))
    return np.asarray(picture + (SMOKE_COLOR - picture) * opacity[..., None], np.float32)


def expose(linear: F32, blur: float, noise: float, rng: np.random.Generator) -> U8:
    """Return the recorded image [H, W, 3]: lens blur (px, standard deviation), tone curve, noise (0..1)."""
    sharpness = float(np.hypot(LENS_BLUR, blur))
    shown = develop(cv2.GaussianBlur(linear, (0, 0), sharpness))
    if noise > 0:
        shown += np.float32(noise) * rng.standard_normal(shown.shape, dtype=np.float32)
    return np.asarray(np.clip(shown * 255 + 0.5, 0, 255), np.uint8)
