"""Images that are carried along a model's motion to a moment between them."""

from dataclasses import replace

import numpy as np
import pytest
from engine_scenes import round_gaussians

from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.tools.evaluation.moments import Seen, carried
from sags_node.types import F32, Camera, Gaussians

WIDTH, HEIGHT, DEPTH, FOCAL = 96, 64, 0.1, 100.0
CAMERA = Camera(
    WIDTH, HEIGHT, np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]]), np.eye(4)
)


def sheet(shift_px: float) -> Gaussians:
    """Grey Gaussians on a plane that covers the image with room to spare, all moved to the right."""
    x, y = np.meshgrid(np.arange(-24, WIDTH + 24, 4.0), np.arange(-24, HEIGHT + 24, 4.0))
    across, down = x.ravel() + shift_px - (WIDTH - 1) / 2, y.ravel() - (HEIGHT - 1) / 2
    means = np.stack([across, down, np.full(x.size, FOCAL)], 1).astype(np.float32) * np.float32(DEPTH / FOCAL)
    return round_gaussians(means, 3 * DEPTH / FOCAL)


def stripes(shift_px: float) -> F32:
    """A texture that the sheet does not know, moved to the right."""
    wave = 0.5 + 0.3 * np.sin((np.arange(WIDTH) - shift_px) / 3)
    return np.tile(wave[None, :, None], (HEIGHT, 1, 3)).astype(np.float32)


def seen(shift_px: float, weight: float = 0.5) -> Seen:
    return Seen(sheet(shift_px), CAMERA, stripes(shift_px), np.ones((HEIGHT, WIDTH), np.bool_), weight)


def shown(middle_px: float, *around: Seen) -> F32:
    return carried(make_rasterizer("numba", WIDTH, HEIGHT), sheet(middle_px), CAMERA, around)


def off(picture: F32, truth: F32) -> float:
    """Mean error away from the border, where an image has come in."""
    inner = np.s_[8:-8, 16:-16]
    return float(np.abs(picture[inner] - truth[inner]).mean())


def test_detail_that_gaussians_lack_goes_where_they_go() -> None:
    """A wave of 3 px times 2 pi moves by 6 px: the mean of both images as they are is grey."""
    before, after = seen(0), seen(6)
    truth = stripes(3)
    mean = before.picture / 2 + after.picture / 2
    assert off(shown(3, before, after), truth) < 0.01  # cubic remapping
    assert off(mean, truth) > 0.05


def test_where_nothing_moves_it_is_the_mean_of_both() -> None:
    noise = np.random.default_rng(0).uniform(-0.04, 0.04, (2, HEIGHT, WIDTH, 3)).astype(np.float32)
    pictures = [stripes(0) + each for each in noise]
    around = [replace(seen(0), picture=picture) for picture in pictures]
    expected = pictures[0] / 2 + pictures[1] / 2
    np.testing.assert_allclose(shown(0, *around), expected, atol=1e-3)


def test_an_instrument_is_not_carried_into_the_tissue() -> None:
    covered = seen(0)
    covered.picture[20:40, 30:50] = 1
    covered.tissue[20:40, 30:50] = False
    one = shown(0, covered, seen(0))
    np.testing.assert_allclose(one, stripes(0), atol=1e-3)  # from the other image
    both = shown(0, covered, covered)
    inside = both[25:35, 35:45]
    np.testing.assert_allclose(inside, 0.5, atol=0.01)  # neither shows it: the Gaussians' grey


@pytest.mark.parametrize("moved", [0.0, 0.0005])
def test_a_camera_that_moves_is_told_from_tissue_that_does(moved: float) -> None:
    """Tissue at rest, seen from a place to the left: the image lies to the right."""
    pose = np.eye(4)
    pose[0, 3] = -moved
    shift = FOCAL * moved / DEPTH
    other = replace(seen(0), camera=replace(CAMERA, T_world_cam=pose), picture=stripes(shift))
    assert off(shown(0, other), stripes(0)) < 0.01
