"""Disturbances of the light: exposure, lamp, flash. They act on linear light, as in the camera."""

import cv2
import numpy as np

from benchmarks.disturbances.moment import Moment
from sags_node.types import F32, U8, StereoFrame

GAMMA = 2.2
GRAIN = 1.5  # grey levels, noise of a camera (standard deviation)
DARK = 0.003  # share of the light that is left when the lamp is off
FLICKER = 3.0  # the light is multiplied and divided by this in turn
FLASH = 8.0  # the light is multiplied by this
FLASH_GLOW = np.array([0.20, 0.22, 0.28], np.float32)  # linear light of a spark, added to that of the tissue
_LINEAR = (np.arange(256, dtype=np.float32) / 255) ** np.float32(GAMMA)


def to_linear(picture: U8) -> F32:
    """Return the linear light [H, W, 3] 0..1 of an image."""
    return np.asarray(cv2.LUT(picture, _LINEAR), np.float32)


def to_display(linear: F32, random: np.random.Generator | None = None) -> U8:
    """Return the image [H, W, 3] of linear light; what is brighter than 1 is white. `random` adds the grain
    of a camera, which stays where something veils the scene."""
    shown = np.asarray(cv2.pow(np.clip(linear, 0, 1), 1 / GAMMA)) * np.float32(255)
    if random is not None:
        shown += np.float32(GRAIN) * random.standard_normal(shown.shape, np.float32)
    return np.asarray(np.clip(np.rint(shown), 0, 255), np.uint8)


def dark(moment: Moment) -> StereoFrame:
    """The lamp is off."""
    return moment.both(
        lambda picture, eye: to_display(to_linear(picture) * np.float32(DARK), moment.random(eye))
    )


def flicker(moment: Moment) -> StereoFrame:
    """The exposure jumps between too much and too little from frame to frame."""
    gain = np.float32(1 / FLICKER if moment.index % 2 else FLICKER)
    return moment.both(lambda picture, eye: to_display(to_linear(picture) * gain))


def flash(moment: Moment) -> StereoFrame:
    """A spark of cautery: nearly all is white."""
    return moment.both(lambda picture, eye: to_display(to_linear(picture) * np.float32(FLASH) + FLASH_GLOW))
