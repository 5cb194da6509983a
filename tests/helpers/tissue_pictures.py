"""Images of tissue and instruments, made so that it is known which is which."""

import cv2
import numpy as np

from sags_node.types import U8, Bool, StereoFrame

WIDTH, HEIGHT = 320, 256
FRAME_NS = 33_333_333
SHAFT, GOLD, JAW = (
    (slice(110, 150), slice(240, 320)),
    (slice(112, 148), slice(200, 240)),
    (120, 140, 150, 200),
)


def make_frame(left: U8, tissue: Bool | None = None, number: int = 0) -> StereoFrame:
    return StereoFrame(number, number * FRAME_NS, number * FRAME_NS, left, left, tissue=tissue)


def textured_tissue(seed: int = 0) -> U8:
    rng = np.random.default_rng(seed)
    shade = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)), (0, 0), 5)
    shade = 1 + 0.12 * shade / shade.std()
    return np.clip(shade[..., None] * (170, 88, 84), 0, 255).astype(np.uint8)


def iou(a: Bool, b: Bool) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)
