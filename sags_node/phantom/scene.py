"""The phantom itself: one call gives both raw images of a frame and its ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from pydantic import Field

from sags_node.config.schema import PhantomSource
from sags_node.geometry import invert, scale_intrinsics, transform
from sags_node.phantom.camera import add_smoke, expose, look, shine, world_rays
from sags_node.phantom.casting import Bodies
from sags_node.phantom.instruments import NOTHING, Instruments, Mesh
from sags_node.phantom.motion import Clock, scope_pose
from sags_node.phantom.noise import fractal_noise
from sags_node.phantom.relief import BED_DEPTH, Relief, make_relief
from sags_node.phantom.rig import phantom_rig, raw_rays, rectified_rays
from sags_node.phantom.shading import Lamp, develop
from sags_node.phantom.skin import Skin, paint_skin
from sags_node.phantom.tissue import Tissue
from sags_node.phantom.vectors import normalized
from sags_node.types import F32, F64, U8, Bool, Camera

BAND = 1 << 19  # rays at a time

TRACKS = 240  # tracked surface points
HOOK_DEPTH = 0.055  # m
HIDDEN = 5e-5  # m: a surface this much nearer hides a tracked point


class PhantomScene(PhantomSource):
    """The session of a launch file, with further settings for tests, benchmarks and `sags phantom`."""

    smoke: float = Field(0.0, ge=0, le=1)  # density
    noise: float = Field(0.01, ge=0, le=0.2)  # of a pixel: standard deviation, in units of white
    blur: float = Field(0.0, ge=0, le=5)  # of the lens: standard deviation, px
    gloss: float = Field(1.0, ge=0, le=100)  # strength of the wet highlights
    still_tissue: bool = False  # only the instruments move, and the scope if `camera_motion` says so
    blackout: tuple[float, float] | None = None  # s: start and end of the time without light

    @classmethod
    def of(cls, config: PhantomSource) -> PhantomScene:
        """Return `config` as a scene; the source of a launch file gets the default further settings."""
        return config if isinstance(config, cls) else cls(**dict(config))


@dataclass(frozen=True, slots=True)
class PhantomFrame:
    """One frame and its truth."""

    left: U8  # [H, W, 3] RGB, raw
    right: U8  # [H, W, 3] RGB, raw
    tool: Bool  # [H, W] raw left image, True = instrument
    depth: F32  # [H, W] m, left rectified image; 0 = instrument or nothing
    points: F64  # [P, 3] m, world
    visible: Bool  # [P]
    T_world_cam: F64  # [4, 4] left rectified camera


@lru_cache(maxsize=1)
def _material(seed: int, half_view: tuple[float, float], focal_px: float) -> tuple[Relief, Skin]:
    """The tissue at rest and its texture: most of the work for a new scene, and shared by many scenes."""
    shape, paint = (np.random.default_rng(stream) for stream in np.random.SeedSequence(seed).spawn(2))
    relief = make_relief(shape, half_view)
    return relief, paint_skin(relief, paint, footprint=0.8 * BED_DEPTH / focal_px)


class Phantom:
    """A seeded scene; a frame is a pure function of its place in the session.

    Attributes:
        rig: the stereo rig that looks at the tissue.
        tissue: where the surface is at each moment.
    """

    def __init__(self, config: PhantomSource) -> None:
        self._scene = scene = PhantomScene.of(config)
        self.rig = phantom_rig(config.width, config.height)
        self._left_rays = raw_rays(self.rig.left).astype(np.float32)
        self._right_rays = raw_rays(self.rig.right).astype(np.float32)
        self._rectified_rays = rectified_rays(self.rig.left).astype(np.float32)
        widest = np.maximum(np.abs(self._left_rays), np.abs(self._right_rays)).max((0, 1))
        self._half_view = (float(widest[0]), float(widest[1]))

        # Independent random streams, so that changing one part of the scene leaves the others as they are.
        streams = np.random.SeedSequence(config.seed).spawn(5)
        tracks, smoke = (np.random.default_rng(stream) for stream in streams[2:4])
        self._noise_key = streams[4].generate_state(2)
        self._clock = Clock(config.seconds)
        self._relief, skin = _material(config.seed, self._half_view, float(self.rig.left.K[0, 0]))
        self.tissue = Tissue(self._relief, self._clock)
        self._skin = replace(skin, surface=skin.surface.copy())
        self._skin.surface[..., 2] *= np.sqrt(scene.gloss)  # highlights go with the square of the wetness
        self._instruments = Instruments()
        self._tracks = self.tissue.track_indices(tracks, self._half_view, TRACKS)
        self._cloud = fractal_noise(smoke, (512, 512), 70, 4)

    def frame(
        self, index: int, count: int, T_world_cam: F64 | None = None, tools: Mesh | None = None
    ) -> PhantomFrame:
        """Render frame `index` of a session of `count` frames. `T_world_cam` [4, 4]: pose of the scope, None:
        that of its path. `tools`: the instruments, None: those at work."""
        phase = index / count
        if T_world_cam is None:
            T_world_cam = self._scope(phase)
        vertices = self.tissue.vertices(0.0 if self._scene.still_tissue else phase)
        if tools is None:
            hook_view = HOOK_DEPTH * np.array(self._half_view)
            grip = self.tissue.grip(vertices)
            tools = self._instruments.mesh(self._clock.action(phase), grip, hook_view)
        bodies = Bodies(self.tissue, vertices, tools)
        lamp = Lamp.at_tip(T_world_cam, self.rig.baseline)

        pictures, masks = [], []
        for eye, (rays, offset) in enumerate(((self._left_rays, 0.0), (self._right_rays, self.rig.baseline))):
            linear, mask = look(rays, offset, T_world_cam, bodies, self._relief, self._skin, lamp)
            if self._is_dark(phase):
                linear = np.zeros_like(linear)
            elif self._scene.smoke > 0:
                drift = 60 * np.array([np.cos(2 * np.pi * phase), np.sin(2 * np.pi * phase)])
                linear = add_smoke(linear, rays, offset, self._cloud, drift, self._scene.smoke)
            rng = np.random.default_rng([*self._noise_key, index, eye])
            pictures.append(expose(linear, self._scene.blur, self._scene.noise, rng))
            masks.append(mask)

        hits = bodies.cast(world_rays(self._rectified_rays, 0.0, T_world_cam))
        points = vertices.reshape(-1, 3)[self._tracks].astype(np.float64)
        return PhantomFrame(
            left=pictures[0],
            right=pictures[1],
            tool=masks[0],
            depth=np.where(hits.tissue, hits.distance, np.float32(0)),
            points=points,
            visible=self._visible(bodies, points, T_world_cam),
            T_world_cam=T_world_cam,
        )

    def _scope(self, phase: float) -> F64:
        return scope_pose(self._clock.scope(phase), self._scene.camera_motion)

    def _is_dark(self, phase: float) -> bool:
        if self._scene.blackout is None:
            return False
        first, last = self._scene.blackout
        return first <= phase * self._scene.seconds < last

    def still(self, phase: float) -> Still:
        """Return the tissue alone at a phase 0..1 of the session, lit as for the scope's pose then."""
        T_world_cam = self._scope(phase)
        vertices = self.tissue.vertices(0.0 if self._scene.still_tissue else phase)
        bodies = Bodies(self.tissue, vertices, NOTHING)
        lamp = Lamp.at_tip(T_world_cam, self.rig.baseline)
        return Still(bodies, self._relief, self._skin, lamp, eye=T_world_cam[:3, 3])

    def _visible(self, bodies: Bodies, points: F64, T_world_cam: F64) -> Bool:
        """Which points [P] are inside the left rectified image and not hidden."""
        eye = self.rig.left
        local = transform(invert(T_world_cam), points)
        pixels = local @ eye.P[:, :3].T
        pixels = pixels[:, :2] / pixels[:, 2:]
        inside = ((pixels >= 0) & (pixels <= [eye.width - 1, eye.height - 1])).all(-1)
        hits = bodies.cast(world_rays((local / local[:, 2:]).astype(np.float32), 0.0, T_world_cam))
        return np.asarray(inside & (hits.distance > local[:, 2] - HIDDEN))


@dataclass(frozen=True, slots=True)
class Still:
    """The tissue at one instant, without instruments, noise or lens: exact truth for any pinhole camera.

    Light and highlights stay as the scope's camera sees them, so that a view from elsewhere differs only by
    its geometry. Nothing casts a shadow: the phantom softens shadows in an image, by a number of pixels."""

    bodies: Bodies
    relief: Relief
    skin: Skin
    lamp: Lamp
    eye: F64  # [3] m, world: where the highlights are seen from

    def look(self, camera: Camera, samples: int) -> tuple[F32, F32]:
        """Return display values [H, W, 3] 0..1 and depth [H, W] (m), each the mean of `samples` x `samples`
        rays per pixel. Depth is 0 where any ray of the pixel meets nothing."""
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
        """Display values [..., 3] and depths [...] (m) of rays [..., 6]; depth 0 where they meet nothing."""
        hits = self.bodies.cast(rays)
        distances = np.asarray(np.where(hits.tissue, hits.distance, 0), np.float32)
        points = np.asarray(rays[..., :3] + distances[..., None] * rays[..., 3:], np.float32)
        view = normalized(np.asarray(self.eye - points, np.float32))
        lit = np.ones(distances.shape, np.float32)
        light = shine(points, view, hits, self.bodies, self.relief, self.skin, self.lamp, lit)
        return develop(light), distances
