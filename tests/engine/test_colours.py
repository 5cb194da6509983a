"""The colours of a drawn image: enlarged when somebody asks, once, from memory of their own."""

import threading
import time
from typing import Any

import cv2
import numpy as np
import pytest
from engine_scenes import camera

from sags_node.engine.rasterizer.views import colours_of, to_view
from sags_node.types import F32, U8, Colours

WIDTH, HEIGHT = 96, 64


def waves() -> F32:
    """[H, W, 3] 0..255: a wave of 8 px along each axis, one for each channel."""
    v, u = np.indices((HEIGHT, WIDTH))
    phase = np.stack([u, v, u + v], -1) * (2 * np.pi / 8)
    return (127.5 + 100 * np.cos(phase)).astype(np.float32)


def means(picture: F32) -> U8:
    """[H / 2, W / 2, 3]"""
    blocks = picture.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3)
    return np.rint(blocks.mean((1, 3))).astype(np.uint8)


def test_what_is_enlarged_shows_the_middles_of_what_was_averaged() -> None:
    """Where two are averaged along each axis, a wave of 8 px keeps cos(pi / 8) of its height: 7.6 % are lost
    for each axis that it runs along. Taking out what the second difference says leaves less than half."""
    picture = waves()
    whole = Colours(means(picture), WIDTH, HEIGHT).whole.astype(np.float32)
    blurred = cv2.resize(means(picture), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    inside = np.s_[8:-8, 8:-8]
    error, before = (np.sqrt(np.mean(np.square(each - picture)[inside])) for each in (whole, blurred))
    assert error < 0.5 * before


def test_they_are_enlarged_once_and_by_who_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    threads, resize = [], cv2.resize

    def slow(*args: Any, **named: Any) -> Any:
        threads.append(threading.get_ident())
        time.sleep(0.1)  # long enough for the others to come meanwhile
        return resize(*args, **named)

    planes = np.ones((5, HEIGHT // 2, WIDTH // 2), np.float32)
    view = to_view(planes, camera(WIDTH, HEIGHT), 0, 0)
    monkeypatch.setattr(cv2, "resize", slow)
    found: list[U8] = []
    askers = [threading.Thread(target=lambda: found.append(view.rgb)) for _ in range(4)]
    for asker in askers:
        asker.start()
    for asker in askers:
        asker.join(60)
    assert len(threads) == 1 and threads[0] in [asker.ident for asker in askers]
    assert len(found) == 4 and all(each is found[0] for each in found)


@pytest.mark.parametrize("scale", [1, 0.75, 0.5])
def test_few_pixels_are_the_same_whether_somebody_asked_for_all(scale: float) -> None:
    size = round(scale * WIDTH), round(scale * HEIGHT)
    small = cv2.resize(waves(), size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    colours = Colours(small, WIDTH, HEIGHT)
    few = colours.every(8)
    assert few.shape == (HEIGHT // 8, WIDTH // 8, 3)
    enlarged = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    assert np.abs(few.astype(int) - enlarged[::8, ::8]).max() <= 2  # another rounding of the weights
    assert colours.whole.shape == (HEIGHT, WIDTH, 3)
    assert np.array_equal(colours.every(8), few)


def test_a_view_has_its_own_memory() -> None:
    """Planes are overwritten by the next drawing, before somebody asks for the colours of this one."""
    planes = np.empty((5, HEIGHT // 2, WIDTH // 2), np.float32)
    planes[:] = np.array([0.4, 0.2, 0.6, 0.05, 0.8])[:, None, None]
    view = to_view(planes, camera(WIDTH, HEIGHT), 0, 0)
    expected = colours_of(planes)
    planes[:] = 0
    assert np.abs(view.rgb - 255 * expected[0, 0]).max() <= 0.5 + 1e-3  # rounded
    assert view.depth.min() == view.depth.max() == pytest.approx(0.0625)
