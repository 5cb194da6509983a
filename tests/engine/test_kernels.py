"""Every kernel of the mapper, compiled and parallel, does what its Python source says.

Numba has been seen to share variables of a parallel loop between threads; only a comparison shows it.
"""

from __future__ import annotations

import numpy as np
import pytest

from sags_node.engine.pinhole import pack
from sags_node.engine.rasterizer import confidence
from sags_node.mapping import densify, motion, optimiser, right_view, split
from sags_node.model import deformation
from sags_node.types import Camera
from sags_node.vision import depth_grid as grids
from sags_node.vision import pair_watch, palette, picture_fit, scene_watch
from sags_node.vision.depth_grid import depth_grid

N, WIDTH, HEIGHT = 3000, 160, 120


@pytest.fixture(scope="module")
def scene() -> dict[str, np.ndarray]:
    """Random Gaussians in, beside and behind two slightly different views, with holes in every map."""
    rng = np.random.default_rng(5)
    f4 = np.float32
    K = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])
    T = np.eye(4)
    T[:3, 3] = [1e-3, -2e-3, 1e-3]
    means = rng.uniform([-0.05, -0.04, -0.01], [0.05, 0.04, 0.11], (N, 3)).astype(f4)
    means[::97] = np.nan
    return {
        "means": means,
        "opacities": rng.uniform(0, 1, N).astype(f4),
        "colors": rng.uniform(0, 1, (N, 3)).astype(f4),
        "cam0": pack(Camera(WIDTH, HEIGHT, K, np.eye(4))),
        "cam1": pack(Camera(WIDTH, HEIGHT, K, T)),
        "tissue": rng.random((HEIGHT, WIDTH)) > 0.2,
        "depth": rng.uniform(0.03, 0.1, (HEIGHT, WIDTH)).astype(f4) * (rng.random((HEIGHT, WIDTH)) > 0.2),
        "alpha": rng.random((HEIGHT, WIDTH)).astype(f4),
        "flow": rng.normal(0, 2, (HEIGHT, WIDTH, 2)).astype(f4),
        "rows": rng.normal(0, 1, (N, 40)).astype(f4),
        "index": rng.integers(0, 50, (N, 4)).astype(np.int32),
        "weight": rng.uniform(0, 1, (N, 4)).astype(f4),
    }


def test_the_right_view(scene: dict[str, np.ndarray]) -> None:
    s, rng, f4 = scene, np.random.default_rng(6), np.float32
    picture = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    left = rng.random((HEIGHT, WIDTH, 3)).astype(f4)
    rights, brought = np.tile(left[::-1], (2, 1, 1, 1)), np.zeros((2, HEIGHT // 4, WIDTH // 4, 3), f4)
    near = np.full((HEIGHT, WIDTH), f4(0.05))
    for step, right, found in zip(
        (right_view._carry, right_view._carry.py_func), rights, brought, strict=True
    ):
        step(picture, left, near, s["tissue"], f4(0.5), f4(0.7), right, near, found)
    assert np.array_equal(rights[0], rights[1]) and np.array_equal(brought[0], brought[1])
    assert 0.3 < (rights[0] != left[::-1]).mean() < 1 and brought[0].any()
    colors, same = np.tile(rng.normal(0, 0.1, (N, 3)).astype(f4), (2, 1, 1)), rng.random(N) > 0.1
    before, sure = colors[0].copy(), s["tissue"][::4, ::4]
    for step, each in zip((right_view._learn, right_view._learn.py_func), colors, strict=True):
        for turn in (0, 1):
            step(s["means"], same, s["cam0"], picture, left, s["depth"], sure, each, turn)
    assert np.allclose(colors[0], colors[1], atol=1e-6)
    assert np.array_equal(colors[0][~same], before[~same]) and (colors[0][same] != before[same]).any(1).all()


def test_find_and_advect(scene: dict[str, np.ndarray]) -> None:
    s = scene
    arguments = (s["means"], s["cam0"], s["depth"], s["alpha"], s["tissue"], s["flow"],
                 s["tissue"][::-1].copy())  # fmt: skip
    pixels = np.full((2, N, 2), np.float32(np.nan))
    motion._find(*arguments, pixels[0])
    motion._find.py_func(*arguments, pixels[1])
    assert np.allclose(pixels[0], pixels[1], atol=1e-4, equal_nan=True)
    arguments = (s["means"], pixels[0], s["cam1"], s["depth"][::-1].copy(), np.float32(0.4))
    moved, seen = np.zeros((2, N, 3), np.float32), np.zeros((2, N), np.float32)
    motion._advect(*arguments, moved[0], seen[0])
    motion._advect.py_func(*arguments, moved[1], seen[1])
    assert 100 < seen[0].sum() < N
    assert np.array_equal(seen[0], seen[1])
    assert np.allclose(moved[0], moved[1], atol=1e-6)


def test_look(scene: dict[str, np.ndarray]) -> None:
    s = scene
    means, depth = s["means"].copy(), np.full((HEIGHT, WIDTH), np.float32(0.06))
    means[::2, 2] = 0.06  # the others are scattered before and behind
    rgb, image = np.random.default_rng(8).random((2, HEIGHT, WIDTH, 3), np.float32)
    contribution = s["weight"][:, 0].copy()
    contribution[::31], contribution[1::31] = np.inf, np.nan
    arguments = (means, contribution, s["cam0"], rgb, depth, image, s["tissue"],
                 np.float32(0.4), np.float32(0.6))  # fmt: skip
    score, spare = np.zeros((2, N), np.float32), np.zeros((2, N), np.bool_)
    split._look(*arguments, score[0], spare[0])
    split._look.py_func(*arguments, score[1], spare[1])
    assert 30 < spare[0].sum() and 30 < np.count_nonzero(score[0])
    assert not (spare[0] & (score[0] > 0)).any()
    assert np.array_equal(spare[0], spare[1]) and np.allclose(score[0], score[1], rtol=1e-5)


@pytest.mark.parametrize("crowded", [False, True])
def test_inspect(scene: dict[str, np.ndarray], crowded: bool) -> None:
    s = scene
    r = np.abs(s["rows"]) + np.float32(1e-6)
    quats, scales, contribution = (np.ascontiguousarray(r[:, k]) for k in (slice(4), slice(4, 7), 7))
    smoothing, weight = np.full(N, 1e-9, np.float32), np.full((N, 4), 0.25, np.float32)
    arguments = (s["means"], quats, scales, smoothing, weight, s["opacities"], s["colors"], contribution,
                 s["cam0"], s["tissue"], s["depth"], True, crowded)  # fmt: skip
    front, remove = np.full((2, N), 2, np.int32), np.zeros((2, N), bool)
    densify._inspect(*arguments, front[0], remove[0])
    densify._inspect.py_func(*arguments, front[1], remove[1])
    assert 100 < remove[0].sum() < N
    assert np.array_equal(front[0], front[1])
    assert np.array_equal(remove[0], remove[1])


def test_candidates(scene: dict[str, np.ndarray]) -> None:
    rng = np.random.default_rng(6)
    planes = rng.random((5, HEIGHT, WIDTH)).astype(np.float32)
    image = rng.random((HEIGHT, WIDTH, 3)).astype(np.float32)
    grid = depth_grid(scene["depth"], np.ones_like(scene["depth"]), scene["tissue"], 150.0, 4e-3)
    pixels, (depths, errors) = np.zeros((2, 400, 2), np.int32), np.zeros((2, 2, 400), np.float32)
    arguments = (planes, image, scene["tissue"], scene["depth"], grid.inverse, grid.error,
                 np.float32(grid.side), 1)  # fmt: skip
    count = densify._candidates(*arguments, pixels[0], depths[0], errors[0])
    assert count == densify._candidates.py_func(*arguments, pixels[1], depths[1], errors[1]) == 400
    assert np.array_equal(pixels[0], pixels[1])
    assert np.allclose(depths[0], depths[1], rtol=1e-6) and np.allclose(errors[0], errors[1], rtol=1e-5)


def test_optimiser_step(scene: dict[str, np.ndarray]) -> None:
    r = scene["rows"]
    contribution = np.abs(r[:, 39]) * (r[:, 38] > -1)
    v_means = r[:, 20:23].copy()
    v_means[5::101] = np.inf
    gradients = (v_means, r[:, 23:27], r[:, 27:30], r[:, 30], r[:, 31:34], contribution)
    lengths = np.linspace(0.01, 0.02, 11, dtype=np.float32)
    view_z = np.array([0, 0, 1, 0.1], np.float32)
    states = []
    for step in (optimiser._step, optimiser._step.py_func):
        state = [r[:, 0:3], r[:, 3:7], r[:, 7:10], r[:, 10], np.exp(r[:, 7:10]), 1 / (1 + np.exp(-r[:, 10])),
                 r[:, 11:14], np.zeros((N, 11)), np.zeros((N, 11))]  # fmt: skip
        state = [np.ascontiguousarray(array, np.float32) for array in state]
        step(*state, *(np.ascontiguousarray(g) for g in gradients), lengths, view_z, 500.0,
             np.array([2.0, 100.0], np.float32))  # fmt: skip
        states.append(state)
    assert np.array_equal(states[0][0][5::101], r[5::101, 0:3])  # gradient not finite: left alone
    assert (states[0][0] != r[:, 0:3]).any(1).mean() > 0.7
    for compiled, source in zip(*states, strict=True):
        assert np.allclose(compiled, source, rtol=1e-5, atol=1e-6)


def test_skin_and_nearest_nodes(scene: dict[str, np.ndarray]) -> None:
    s = scene
    nodes = np.random.default_rng(7).uniform(-0.05, 0.1, (50, 3)).astype(np.float32)
    points = np.nan_to_num(s["means"])
    index, squared = deformation._nearest(points, nodes, 4)
    distances = np.linalg.norm(points[:, None] - nodes, axis=-1)
    assert np.array_equal(index, np.argsort(distances, 1, kind="stable")[:, :4])
    assert np.allclose(np.sqrt(squared), np.sort(distances, 1)[:, :4], atol=1e-6)
    weight = deformation.nearest_nodes(points, nodes)[1]
    assert np.allclose(weight.sum(1), 1, atol=1e-5) and (np.diff(weight, axis=1) <= 0).all()
    a, b = points.copy(), points.copy()
    deformation._skin(nodes, s["index"], s["weight"], a)
    deformation._skin.py_func(nodes, s["index"], s["weight"], b)
    assert np.allclose(a, b, atol=1e-6)


def test_average_at_nodes(scene: dict[str, np.ndarray]) -> None:
    s = scene
    values, seen = np.ascontiguousarray(s["rows"][:, :3]), (s["rows"][:, 5] > 0).astype(np.float32)
    compiled, source = (
        f(values, seen, s["index"], s["weight"], 60)
        for f in (deformation._average, deformation._average.py_func)
    )
    assert np.allclose(compiled[0], source[0], atol=1e-4)
    assert np.allclose(compiled[1], source[1], rtol=1e-5)


def test_confidence(scene: dict[str, np.ndarray]) -> None:
    s, r = scene, np.abs(scene["rows"])
    scales, errors = np.ascontiguousarray(r[:, :3]), r[:, 3].copy() * np.float32(1e-3)
    side = 7  # which divides neither the width nor the height
    rows, columns = -(-HEIGHT // side), -(-WIDTH // side)
    sums = np.zeros((2, confidence.SHARES, 2, rows, columns), np.float32)
    coarse = np.empty((2, rows, columns), np.float32)
    wide = np.random.default_rng(9).random((rows, columns * side), np.float32)
    depths, found = np.stack([s["depth"]] * 2), np.zeros((2, HEIGHT, WIDTH), np.float32)
    arguments = (s["means"], scales, s["opacities"], errors, tuple(s["cam0"]), s["depth"],
                 np.float32(1 / side), 2)  # fmt: skip
    inverse, error = np.random.default_rng(10).uniform(0, 30, (2, rows, columns)).astype(np.float32)
    inverse[::2], error[::3] = 0, 0  # nothing is measured there, or without an error
    for k, source in enumerate((False, True)):
        add_up, average, state = (
            each.py_func if source else each
            for each in (confidence._add_up, confidence._average, confidence._state)
        )
        add_up(*arguments, sums[k])
        average(sums[k], np.float32(3e-3), s["depth"], side, inverse, error, coarse[k])
        state(wide, np.float32(1 / side), np.float32(0.2), depths[k], found[k])
    assert np.count_nonzero(sums[0, :, 0]) > 100
    assert np.allclose(sums[0], sums[1], rtol=1e-5)
    assert np.allclose(coarse[0], coarse[1], rtol=1e-4)
    assert np.allclose(found[0], found[1], atol=1e-6) and np.array_equal(depths[0], depths[1])
    assert 0 < np.count_nonzero(depths[0]) < np.count_nonzero(s["depth"])


def test_ends_and_correlate() -> None:
    rng = np.random.default_rng(10)
    picture = rng.integers(0, 256, (30, 40, 3), np.uint8)
    assert np.array_equal(pair_watch._ends(picture, 12), pair_watch._ends.py_func(picture, 12))
    a, b = rng.normal(0, 1, (2, 8, 30)).astype(np.float32)
    a[:, 20:] = b[:, 20:] = a[[0, -1]] = b[[0, -1]] = 0
    found = np.empty((2, 21), np.float32)
    pair_watch._correlate(a, b, 20, found[0])
    pair_watch._correlate.py_func(a, b, 20, found[1])
    assert np.allclose(found[0], found[1], atol=1e-5)


def test_fit() -> None:
    rng = np.random.default_rng(11)
    seen, drawn = rng.random((2, 30, 40, 3), np.float32)
    known = rng.random((30, 40)) > 0.3
    results = []
    for source in (False, True):
        compare, gain, subtract, judge, take, energies = (
            each.py_func if source else each
            for each in (
                picture_fit._compare, picture_fit._gain, picture_fit._subtract, picture_fit._judge,
                picture_fit._take_green, picture_fit._energies,
            )
        )  # fmt: skip
        fair, ratios, counts = np.empty((30, 40, 3), bool), np.zeros((3, 400), np.float32), np.zeros(3, int)
        difference, wrong = np.empty((30, 40, 3), np.float32), np.empty((30, 40), bool)
        picture, model = np.empty((2, 30, 40), np.float32)
        channels = compare(seen, drawn, known, fair, ratios, counts)
        gains = gain(ratios, counts)
        subtract(seen, drawn, fair, 1 / gains, difference)
        judged = judge(difference, known, fair, wrong)
        take(seen, drawn, fair, gains[1], picture, model)
        results.append(
            [
                channels,
                fair,
                ratios,
                counts,
                gains,
                difference,
                wrong,
                *judged,
                picture,
                model,
                *energies(picture, model, fair),
            ]
        )
    for compiled, source_s in zip(*results, strict=True):
        assert np.allclose(compiled, source_s, rtol=1e-5, atol=1e-6)


def test_colors() -> None:
    rng = np.random.default_rng(12)
    picture, tissue = rng.integers(0, 256, (30, 40, 3), np.uint8), rng.random((30, 40)) > 0.3
    bins = palette.BINS
    of_bins = rng.random((bins, bins)) > 0.5
    colors, of_pixels = np.empty((2, 30, 40), np.int64), np.empty((2, 30, 40), bool)
    found = np.zeros((2, bins, bins), np.float32)
    small = np.zeros((2, 10, 14, 3), np.uint8)
    counts = []
    for k, source in enumerate((False, True)):
        sort, look_up, count, every = (
            each.py_func if source else each
            for each in (
                palette._sort_colors, palette._look_up, palette._count_colors, scene_watch._every
            )
        )  # fmt: skip
        sort(picture, colors[k])
        look_up(colors[k], of_bins, of_pixels[k])
        counts.append(count(colors[k], tissue, found[k]))
        every(3, picture, small[k])
    assert np.array_equal(colors[0], colors[1]) and np.array_equal(of_pixels[0], of_pixels[1])
    assert counts[0] == counts[1] > 100 and np.array_equal(found[0], found[1])
    assert np.array_equal(small[0], picture[::3, ::3]) and np.array_equal(small[0], small[1])


@pytest.mark.parametrize("side", [2, 3])
def test_depth_grid(scene: dict[str, np.ndarray], side: int) -> None:
    s, around, lanes = scene, grids.AROUND, grids.LANES
    confidence = np.ascontiguousarray(s["alpha"])
    rows, columns = -(-HEIGHT // side), -(-WIDTH // side)
    line = -(-columns // lanes) * lanes + 2 * around
    sums = np.zeros((3, rows + 2 * around, line), np.float32)
    grids._gather(s["depth"], confidence, s["tissue"], side, columns, sums)
    expected = np.zeros_like(sums)
    for row in range(rows):
        for column in range(columns):
            cell = np.s_[row * side : (row + 1) * side : 2, column * side : (column + 1) * side : 2]
            depth, trust = s["depth"][cell], confidence[cell] * (s["depth"][cell] > 0)
            inverse = (trust / np.where(depth > 0, depth, 1)).sum() / trust.sum() if trust.any() else 0
            expected[:, row + around, column + around] = s["tissue"][cell].mean(), trust.mean(), inverse
    assert np.allclose(sums, expected, rtol=1e-5)
    # Vectors know no Python: what they compute is written out here.
    found, px = np.zeros((4, *sums.shape[1:]), np.float32), np.float32(0.3)
    tolerance, slope = np.float32(2.0), np.float32(0.05)
    grids._compare(sums, tolerance, slope, found)
    grids._judge(sums, px, found)
    shown, trust, inverse = sums.astype(np.float64)

    def shifted(plane: np.ndarray, j: int, i: int) -> np.ndarray:
        return np.roll(plane, (-j, -i), (0, 1))

    with np.errstate(all="ignore"):
        near = [(j, i) for j in (-1, 0, 1) for i in (-1, 0, 1) if i or j]
        weight = sum(shifted(trust, *at) for at in near)
        off = (sum(shifted(trust * inverse, *at) for at in near) / weight - inverse) ** 2
        off[~((trust > 0) & (weight > 0))] = 0
        agreeing = total = 0.0
        for j in range(-4, 5, 2):
            for i in range(-4, 5, 2):
                limit = tolerance + slope * max(abs(j), abs(i)) * inverse
                same = abs(shifted(inverse, j, i) - inverse) < limit
                agreeing, total = agreeing + same * shifted(trust, j, i), total + shifted(shown, j, i)
        support = np.where((trust > 0) & (total > 0), np.minimum(agreeing / total, 1), 0)
        wide = [(j, i) for j in range(-2, 3) for i in range(-2, 3)]
        rough = sum(shifted(trust * off, *at) for at in wide) / sum(shifted(trust, *at) for at in wide)
        floor, alone = grids.FLOOR * px, grids.UNSUPPORTED * px * (1 - support)
        error = np.sqrt(floor**2 + alone**2 + grids.ROUGHNESS**2 * rough)
    believed = (trust > 0) & (support >= grids.LEAST_SUPPORT)
    assert 100 < believed.sum()
    assert np.allclose(found[0], off, rtol=1e-3, atol=1e-3)
    assert np.allclose(found[1], support, rtol=1e-4)
    assert np.allclose(found[2], np.where(believed, inverse, 0))
    assert np.allclose(found[3], np.where(believed, error, np.where(trust > 0, -1, 0)), rtol=1e-3)
