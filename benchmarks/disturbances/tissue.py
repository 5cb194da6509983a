"""What comes between the eyes and the tissue: smoke, and blood on the tissue. Both have a depth, so that the
eyes see them with disparity, as they see the scene."""

from functools import cache

import cv2
import numpy as np

from benchmarks.disturbances.light import to_display, to_linear
from benchmarks.disturbances.moment import SEED, Moment
from sags_node.phantom.camera import SMOKE_COLOR
from sags_node.phantom.noise import fractal_noise
from sags_node.types import F32, U8, StereoFrame

SMOKE_VEIL = 0.70  # share of the light from the farthest tissue that thick smoke takes
FARTHEST = 95  # percentile of the depths
CLOUD_TEXEL = 0.3e-3  # m
CLOUD_SPREAD = 0.45  # how much the smoke's density differs (standard deviation), see `phantom.camera`
CLOUD_DRIFT = np.array([55.0, -35.0])  # texels per second
BLOOD_COVERS = 0.5  # of the image
BLOOD_FINGERS = 0.07  # of the height, how far its front is from straight (standard deviation)
BLOOD_FILM = 0.03  # of the height, behind the front, over which it grows thick
BLOOD_ABSORBS = np.array([1.5, 6.0, 6.5], np.float32)  # of red, green and blue light, where it is thick
BLOOD_COLOR = np.array([0.85, 0.045, 0.035], np.float32)  # of the light that falls on it
_PATTERN = 512  # texels of the noises


def smoke(moment: Moment) -> StereoFrame:
    """Smoke of cautery fills the space, drifts, and is sucked off. The farther away the tissue is,
    the more it is veiled, up to `SMOKE_VEIL`; the clouds hang half way to it."""
    frame_id = moment.frame.frame_id
    depths = moment.scene.depths(frame_id)
    density = -np.log(1 - SMOKE_VEIL) * moment.swell() / np.percentile(depths[0][::4, ::4], FARTHEST)
    half_way = 0.5 * float(np.median(depths[0][::4, ::4]))
    drift = CLOUD_DRIFT * (moment.index / moment.rate) + 0.5 * _PATTERN

    def veiled(picture: U8, eye: int) -> U8:
        across = moment.scene.rays[eye] * np.float32(half_way)
        across[..., 0] += np.float32(eye * moment.scene.rig.baseline)
        place = (across / np.float32(CLOUD_TEXEL) + drift).astype(np.float32)
        cloud = cv2.remap(_clouds(), place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        thickness = density * depths[eye] * np.maximum(1 + CLOUD_SPREAD * cloud, 0.1)
        opacity = 1 - np.exp(-thickness)[..., None].astype(np.float32)
        linear = to_linear(picture)
        return to_display(linear + opacity * (SMOKE_COLOR - linear), moment.random(eye))

    return moment.both(veiled)


def blood(moment: Moment) -> StereoFrame:
    """Blood comes from below until it covers half the image, and is sucked off. It lies on the surface of
    the tissue, hides its texture, and lets red light through where it is thin. It does not cover instruments
    that the session has masks for."""
    frame = moment.frame
    P, height, width = moment.scene.rig.left.P, *frame.left.shape[:2]
    front = np.float32(1 - BLOOD_COVERS * moment.swell())
    everywhere = np.ones((height, width), np.bool_) if frame.tissue is None else frame.tissue
    tissue = moment.scene.rectified_left(everywhere.astype(np.float32))

    def covered(picture: U8, eye: int) -> U8:
        seen = moment.scene.in_left(eye, frame.frame_id)
        x = (seen[..., 0] * P[0, 0] + P[0, 2]).astype(np.float32)
        y = (seen[..., 1] * P[1, 1] + P[1, 2]).astype(np.float32)
        pattern = x * np.float32(_PATTERN / width), y * np.float32(_PATTERN / width)
        fingers = cv2.remap(_fingers(), *pattern, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        behind = y / height + np.float32(BLOOD_FINGERS) * fingers - front
        thick = np.clip(behind / np.float32(BLOOD_FILM), 0, 1)[..., None]
        thick *= cv2.remap(tissue, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[..., None]
        linear = to_linear(picture)
        light = cv2.GaussianBlur(linear.mean(-1), (0, 0), 0.05 * width)[..., None]
        passes = np.exp(-BLOOD_ABSORBS * thick)
        colour = BLOOD_COLOR * light
        mixed = linear * passes + colour * (1 - passes)
        hidden = colour + (mixed - colour) * (1 - thick)  # a thick layer shows nothing of what is below
        return to_display(np.asarray(hidden, np.float32), moment.random(eye))

    return moment.both(covered)


@cache
def _clouds() -> F32:
    return fractal_noise(np.random.default_rng([SEED, 2]), (_PATTERN, _PATTERN), 70, 4)


@cache
def _fingers() -> F32:
    return fractal_noise(np.random.default_rng([SEED, 3]), (_PATTERN, _PATTERN), 90, 3)
