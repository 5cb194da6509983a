"""Images made smaller in the time of a frame."""

import numpy as np
import pytest

from sags_node.resizing import resized_image

SIZES = [(640, 512), (675, 540), (506, 405), (1280, 720), (1919, 1079), (321, 200)]


@pytest.mark.parametrize("size", SIZES)
def test_by_whole_numbers_each_pixel_is_the_mean_of_its_square(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).random((3 * size[1], 2 * size[0], 3))
    means = image.reshape(size[1], 3, size[0], 2, 3).mean((1, 3))
    np.testing.assert_allclose(resized_image(image, size), means, atol=1e-12)


@pytest.mark.parametrize("size", SIZES)
def test_pixels_keep_their_places_at_any_ratio(size: tuple[int, int]) -> None:
    """A ramp in pixel units of the old image says, in the new one, where each pixel's middle lay."""
    width, height = size
    ramp = np.tile(np.arange(width, dtype=np.float32), (height, 1))
    seen = resized_image(ramp, (320, 256))
    expected = (np.arange(320) + 0.5) * (width / 320) - 0.5
    np.testing.assert_allclose(seen[128, 3:-3], expected[3:-3], atol=1e-3 * width / 320)


@pytest.mark.parametrize("size", SIZES)
def test_what_is_finer_than_a_pixel_is_averaged_and_not_sampled(size: tuple[int, int]) -> None:
    """Noise of independent pixels: the mean over the area of a new pixel divides its spread by the root of
    that area. A pixel between two middles has half of the variance, so linear steps leave no more."""
    width, height = size
    noise = np.random.default_rng(0).normal(size=(height, width)).astype(np.float32)
    area = max(width / 320, 1) * max(height / 256, 1)
    assert resized_image(noise, (320, 256)).std() < 1.25 / np.sqrt(area)
    assert resized_image(noise, (width, height)) is noise
