"""What sits on the lens, and what shakes it."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from benchmarks.disturbances.light import to_display, to_linear
from benchmarks.disturbances.moment import SEED, Moment
from sags_node.phantom.noise import fractal_noise
from sags_node.types import F32, U8, StereoFrame

FOG_SECONDS = 0.2  # in which a cold lens fogs
FOG_VEIL = 0.72  # share of the light that comes from the droplets
FOG_PATCHES = 0.10  # how much it differs from place to place (standard deviation)
FOG_BLUR = 0.012  # of the width (standard deviation)
FOG_WHITE = np.array([0.36, 0.34, 0.34], np.float32)  # linear light
DROPS = 7  # on each lens
DROP_RADII = 0.05, 0.12  # of the width
DROP_BLUR = 0.012  # of the width
DROP_TURNS = 1.6  # 1: the middle of a drop shows one place; more: it shows the scene upside down
DROP_RIM = 0.25  # of the radius, over which it fades into the image
SHAKE = 0.025  # of the width: how far the image moves while it is exposed
SHAKE_TURN = 0.9  # rad, of its direction, from frame to frame


def fog_left(moment: Moment) -> StereoFrame:
    """The left lens is fogged."""
    return replace(moment.frame, left=_fogged(moment, moment.frame.left, 0))


def fog_right(moment: Moment) -> StereoFrame:
    """The right lens is fogged."""
    return replace(moment.frame, right=_fogged(moment, moment.right, 1))


def drops(moment: Moment) -> StereoFrame:
    """Drops of water on both lenses, on each in other places, which stay where they are."""
    return moment.both(_through_drops)


def blur(moment: Moment) -> StereoFrame:
    """The scope shakes: motion blur, the same in both eyes."""

    def shaken(picture: U8, eye: int) -> U8:
        length = SHAKE * picture.shape[1]
        angle = SHAKE_TURN * moment.index
        return np.asarray(cv2.filter2D(picture, -1, _line(length, angle), borderType=cv2.BORDER_REPLICATE))

    return moment.both(shaken)


def _fogged(moment: Moment, picture: U8, eye: int) -> U8:
    height, width = picture.shape[:2]
    grown = min(1.0, (moment.index + 1) / max(1.0, FOG_SECONDS * moment.rate))
    patches = _patches((height, width), eye)
    veil = np.clip(FOG_VEIL + FOG_PATCHES * patches, 0, 0.9).astype(np.float32)[..., None] * np.float32(grown)
    blurred = cv2.GaussianBlur(to_linear(picture), (0, 0), max(0.1, FOG_BLUR * grown * width))
    glow = 0.5 * blurred.mean((0, 1)) + 0.5 * FOG_WHITE  # droplets scatter the scene's light and the lamp's
    return to_display(np.asarray(blurred + veil * (glow - blurred), np.float32), moment.random(eye))


@cache
def _patches(shape: tuple[int, int], eye: int) -> F32:
    return fractal_noise(np.random.default_rng([SEED, eye]), shape, 0.4 * shape[1], 3)


def _through_drops(picture: U8, eye: int) -> U8:
    height, width = picture.shape[:2]
    x, y, share = _lenses((height, width), eye)
    bent = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    bent = cv2.GaussianBlur(bent, (0, 0), max(0.1, DROP_BLUR * width)).astype(np.float32)
    return np.asarray(np.rint(picture + share[..., None] * (bent - picture)), np.uint8)


@cache
def _lenses(shape: tuple[int, int], eye: int) -> tuple[F32, F32, F32]:
    """The place x, y [H, W] in the image that each pixel shows through the drops on a lens, and the drops'
    share of the pixel [H, W] 0..1. A drop is a thick lens: it shrinks the scene and turns it upside down."""
    height, width = shape
    random = np.random.default_rng([SEED, eye])
    y, x = np.indices(shape, dtype=np.float32)
    through_x, through_y, share = x.copy(), y.copy(), np.zeros(shape, np.float32)
    for _ in range(DROPS):
        radius = np.float32(random.uniform(*DROP_RADII) * width)
        centre_x = np.float32(random.uniform(0.08, 0.92) * width)
        centre_y = np.float32(random.uniform(0.08, 0.92) * height)
        from_centre = np.hypot(x - centre_x, 1.15 * (y - centre_y)) / radius
        zoom = 1 - np.float32(DROP_TURNS) * np.maximum(1 - from_centre**2, 0)
        inside = from_centre < 1
        through_x[inside] = (centre_x + zoom * (x - centre_x))[inside]
        through_y[inside] = (centre_y + zoom * (y - centre_y))[inside]
        share = np.maximum(share, np.clip((1 - from_centre) / DROP_RIM, 0, 1))
    return through_x, through_y, share


def _line(length: float, angle: float) -> F32:
    """A kernel that spreads each pixel over a line; sum 1."""
    reach = max(1, int(np.ceil(length / 2)))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for along in np.linspace(-length / 2, length / 2, 4 * reach + 1):
        column, row = reach + along * np.cos(angle), reach + along * np.sin(angle)
        kernel[round(float(row)), round(float(column))] += 1
    return np.asarray(kernel / kernel.sum(), np.float32)
