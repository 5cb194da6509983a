"""Tissue is found again however far it was pulled; other tissue, or the same turned or mirrored, is not."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from sags_node.config.schema import PhantomSource
from sags_node.sources.source import open_source
from sags_node.types import F32, U8, GrayPyramid
from sags_node.vision.landmarks import find_again, motion
from sags_node.vision.pyramid import gray_pyramid

WIDTH, HEIGHT = 640, 512


def first_picture(seed: int) -> U8:
    """Of a phantom."""
    config = PhantomSource(seconds=0.2, width=WIDTH, height=HEIGHT, seed=seed, pace="step", loop=False)
    with open_source(config) as source:
        return next(iter(source)).left


@pytest.fixture(scope="module")
def tissue() -> U8:
    return first_picture(seed=3)


def pulled(picture: U8, by: float) -> tuple[U8, F32]:
    """The image bent: its middle moved by so many px right and up, its rim held. And where each pixel comes
    from, [H, W, 2]."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    share = np.exp(-(((columns - WIDTH / 2) / (WIDTH / 4)) ** 2) - ((rows - HEIGHT / 2) / (HEIGHT / 4)) ** 2)
    origin = np.dstack([columns - by * share, rows + by * share]).astype(np.float32)
    return cv2.remap(picture, origin, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT), origin


def everywhere(pyramid: GrayPyramid) -> np.ndarray:
    return np.ones(pyramid.full.shape, np.bool_)


def test_pulled_tissue_is_found_where_it_went(tissue: U8) -> None:
    """By a tenth of the image, far beyond what a search from the same place finds."""
    after, origin = pulled(tissue, WIDTH / 10)
    first, second = gray_pyramid(tissue), gray_pyramid(after)
    found = find_again(first, second, everywhere(first))
    columns, rows = np.rint(found.after).astype(int).T
    errors = np.linalg.norm(origin[rows, columns] - found.before, axis=1)
    assert np.percentile(errors, 90) < 2 * 1.2**7  # px: one of ORB's smallest image, of half the size
    back = motion(found.after, found.before, WIDTH, HEIGHT)
    here = np.dstack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))).astype(np.float32)
    truth = cv2.resize(origin - here, back.shape[1::-1], interpolation=cv2.INTER_AREA)
    moved = np.linalg.norm(truth, axis=2) > WIDTH / 20
    off, way = (np.linalg.norm(each[moved], axis=1).mean() for each in (back - truth, truth))
    assert off < 0.25 * way


def covered(picture: U8) -> U8:
    half = picture.copy()
    half[HEIGHT // 2 :] = (95, 8, 8)
    return half


SAME: dict[str, Callable[[U8], np.ndarray]] = {
    "covered": covered,
    "veiled": lambda picture: 0.25 * picture + 150,
    "darker": lambda picture: picture / 3,
}
OTHER: dict[str, Callable[[U8], np.ndarray]] = {
    "other": lambda picture: first_picture(seed=8),
    "upside down": lambda picture: picture[::-1, ::-1],
    "mirrored": lambda picture: picture[:, ::-1],
    "plain": lambda picture: np.full_like(picture, 120),
}


@pytest.mark.parametrize("name", [*SAME, *OTHER])
def test_the_same_tissue_is_known_in_a_bad_picture_and_another_scene_is_not(name: str, tissue: U8) -> None:
    changed = np.ascontiguousarray((SAME | OTHER)[name](tissue), np.uint8)
    first, second = gray_pyramid(tissue), gray_pyramid(changed)
    assert (find_again(first, second, everywhere(first)) is not None) == (name in SAME)


def test_what_is_no_tissue_is_not_looked_for(tissue: U8) -> None:
    """An instrument that stays is no proof that the tissue does."""
    first = gray_pyramid(tissue)
    left = everywhere(first)
    left[:, WIDTH // 2 :] = False
    found = find_again(first, first, left)
    assert found is not None and found.before[:, 0].max() < WIDTH / 2 + 16
    assert find_again(first, first, ~everywhere(first)) is None
