"""Images made smaller in the time of a frame."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def resized_image(image: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """Resize an image [H, W] or [H, W, C] to `size` (width, height, px). Smaller ones are averaged by area.

    OpenCV's own area average takes fifteen times as long where a ratio is no whole number. So the image is
    first brought to the nearest whole multiple of its new size, linearly, and then averaged.
    """
    height, width = image.shape[:2]
    whole = max(1, round(width / size[0])), max(1, round(height / size[1]))
    multiple = whole[0] * size[0], whole[1] * size[1]
    if (width, height) != multiple:
        image = cv2.resize(image, multiple, interpolation=cv2.INTER_LINEAR)
    if multiple == size:
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
