"""Flicker, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sags_node.evaluation.flicker import FRAMES, Flicker
from sags_node.evaluation.spool import RunFacts, SpooledFrame
from sags_node.types import Camera, Gaussians, Snapshot

HEIGHT, WIDTH = 64, 96


def frame() -> SpooledFrame:
    """All tissue, gray, 100 mm away."""
    nothing = np.zeros((0, 3), np.float32)
    gaussians = Gaussians(
        nothing, np.zeros((0, 4), np.float32), nothing, nothing[:, 0], nothing, np.zeros(0, np.int64)
    )
    camera = Camera(WIDTH, HEIGHT, np.eye(3), np.eye(4))
    depth = np.full((HEIGHT, WIDTH), 0.1, np.float32)
    return SpooledFrame(
        facts=RunFacts(0, 0, None, 0, {}, {}, 0, {}),
        snapshot=Snapshot(0, 0, 0, gaussians, nothing, camera, 0.0, {}),
        baseline=0.005,
        rgb=np.full((HEIGHT, WIDTH, 3), 100, np.uint8),
        depth=depth,
        tissue=np.ones((HEIGHT, WIDTH), np.bool_),
        measured_depth=depth,
        confidence=depth,
        right_rgb=None,
    )


def test_flicker_is_the_deviation_where_nothing_moves_and_all_is_tissue() -> None:
    """The view alternates between 100 and 104 (deviation 2), the depth by 1 mm either way, the stereo depth
    by 3; the input has a checkerboard of noise, +-5, whose block means stay. In the left third something
    passes by, and in the right third an instrument lies in one frame: what happens there does not count."""
    flicker, seen = Flicker(), []
    checks = np.indices((HEIGHT, WIDTH)).sum(0) % 2 * 10 - 5
    for number in range(FRAMES):
        sign = 1 if number % 2 else -1
        shown = frame()
        shown.rgb[:] = 102 + 2 * sign
        shown.rgb[:, :32] = 8 * number
        depth, measured = shown.depth + np.float32(1e-3 * sign), shown.depth + np.float32(3e-3 * sign)
        measured[:, 40:48] = 0 if number == 7 else 0.2  # not known in all of them
        tissue = shown.tissue
        tissue[:, 64:] = number != 5
        picture = np.repeat((120 + sign * checks)[..., None], 3, 2).astype(np.uint8)
        picture[:, :32] = 5 * number
        seen.append(
            flicker(picture, replace(shown, depth=depth, measured_depth=measured, right_rgb=shown.rgb))
        )
    assert seen[:-1] == [None] * (FRAMES - 1)
    expected = {"input": 5, "picture": 2, "right": 2, "depth_mm": 1, "measured_depth_mm": 3, "share": 0.5}
    assert seen[-1] == pytest.approx(expected, rel=1e-3)
    assert flicker(picture, shown) is None  # the next thirty begin


def test_nothing_is_said_of_a_scene_that_moves() -> None:
    flicker, rng = Flicker(), np.random.default_rng(0)
    for _ in range(FRAMES):
        said = flicker(np.full((HEIGHT, WIDTH, 3), rng.integers(50, 200), np.uint8), frame())
    assert said is None
