"""What cameras do to a pair: exposure, colour, light, highlights, smoke, blur, noise, compression, rows."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.learning.example import Example
from sags_node.phantom.noise import fractal_noise
from sags_node.types import F32, U8

EXPOSURE, EYES_DIFFER = 0.25, 0.08  # standard deviations of a gain's logarithm: of both eyes, of one of them
GAMMA = 0.1  # likewise of the tone curve's exponent
SHADING = 0.08  # of light that falls on one eye's picture otherwise than on the other's
MOST_HIGHLIGHTS = 12
HIGHLIGHT = (0.5, 5.0)  # px, standard deviation
GLEAM_ASIDE = 4.0  # px: a highlight is a mirror image, farther or nearer than the surface
SMOKY = 0.2  # share of the pairs
BLUR, NOISE = 1.0, 0.03  # the most: px, and of white
COMPRESSED = 0.6  # share of the pairs
QUALITY = (40, 96)  # of JPEG
ROWS_OFF = 0.4  # px, standard deviation: how far the rows of the eyes differ
ROWS_TURNED = 0.002  # radians, likewise


def photographed(rng: np.random.Generator, clean: Example) -> Example:
    """The pair as two cameras would give it; what is true of it stays."""
    tones = rng.normal(0, EXPOSURE / 2, 3) + rng.normal(0, EXPOSURE)
    exponent = float(np.exp(rng.normal(0, GAMMA)))
    highlights = _highlights(rng, clean.disparity)
    smoke = _smoke(rng, clean.disparity.shape)
    blur, noise = float(rng.uniform(0, BLUR)), float(rng.uniform(0, NOISE)) ** 2 / NOISE
    quality = int(rng.integers(*QUALITY)) if rng.random() < COMPRESSED else None
    eyes = []
    for eye, glare in zip((clean.left, _rows_off(rng, clean.right)), highlights, strict=True):
        own = tones + rng.normal(0, EYES_DIFFER / 2, 3) + rng.normal(0, EYES_DIFFER)
        light = np.exp(own + SHADING * fractal_noise(rng, glare.shape, glare.shape[1], 1)[..., None])
        picture = (eye.astype(np.float32) / 255) ** np.float32(exponent * np.exp(rng.normal(0, GAMMA / 3)))
        picture = picture * light.astype(np.float32) + glare[..., None]
        picture += (smoke[1] - picture) * smoke[0][..., None]
        picture = cv2.GaussianBlur(picture, (0, 0), 0.05 + blur * float(rng.uniform(0.7, 1.3)))
        picture += np.float32(noise) * rng.standard_normal(picture.shape, np.float32)
        eyes.append(_compressed(np.clip(picture * 255 + 0.5, 0, 255).astype(np.uint8), quality))
    return Example(eyes[0], eyes[1], clean.disparity)


def _highlights(rng: np.random.Generator, disparity: F32) -> tuple[F32, F32]:
    """Light [H, W] on top of both pictures."""
    height, width = disparity.shape
    glare = np.zeros((2, height, width), np.float32)
    for _ in range(rng.integers(0, MOST_HIGHLIGHTS)):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        aside = disparity[y, x] + rng.normal(0, GLEAM_ASIDE / 2)
        axes = rng.uniform(*HIGHLIGHT, 2)
        turn = float(rng.uniform(0, 180))
        for eye, column in enumerate((x, x - aside)):
            centre = round(float(column) * 16), y * 16
            size = tuple(round(float(axis) * 16) for axis in axes)
            strength = float(rng.uniform(0.3, 1.5))
            cv2.ellipse(glare[eye], centre, size, turn, 0, 360, strength, cv2.FILLED, cv2.LINE_8, 4)
    soft = [cv2.GaussianBlur(one, (0, 0), float(rng.uniform(0.4, 1.5))) for one in glare]
    return soft[0], soft[1]


def _smoke(rng: np.random.Generator, shape: tuple[int, ...]) -> tuple[F32, float]:
    """How much of the pictures it hides [H, W], 0..1, and how bright it is."""
    if rng.random() > SMOKY:
        return np.zeros(shape, np.float32), 0.0
    cloud = fractal_noise(rng, (shape[0], shape[1]), shape[1] / 2, 3)
    thick = float(rng.uniform(0, 0.9)) * np.maximum(0.55 + 0.45 * cloud, 0)
    return np.asarray(1 - np.exp(-thick), np.float32), float(rng.uniform(0.4, 0.8))


def _rows_off(rng: np.random.Generator, picture: U8) -> U8:
    """Down by a part of a pixel, and turned a little."""
    height, width = picture.shape[:2]
    turn, down = rng.normal(0, ROWS_TURNED), rng.normal(0, ROWS_OFF)
    matrix = np.array([[1, 0, 0], [turn, 1, down - turn * width / 2]], np.float32)
    moved: U8 = cv2.warpAffine(picture, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return moved


def _compressed(picture: U8, quality: int | None) -> U8:
    if quality is None:
        return picture
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)
