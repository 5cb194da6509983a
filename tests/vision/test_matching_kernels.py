"""The kernels of stereo and optical flow: plain NumPy says the same, and known motion is found."""

import cv2
import numpy as np
import pytest

from sags_node.types import F32
from sags_node.vision import agreement
from sags_node.vision.dense_depth import guided
from sags_node.vision.flow import OpticalFlow
from sags_node.vision.inverse_search import PATCH, at_pixels, centres, grid_shape, search
from sags_node.vision.pyramid import BORDER, gray_pyramid, inner, level, level_count

WIDTH, HEIGHT = 90, 70  # no multiple of the patches' distance, nor of a vector
PX = np.float64


def texture(width: int = WIDTH, height: int = HEIGHT, seed: int = 0) -> F32:
    rng = np.random.default_rng(seed)
    spots = sum(s * cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), s) for s in (1.5, 3, 8))
    return np.clip(125 + 35 * spots / spots.std(), 5, 250).astype(np.float32)


def shifted(picture: F32, right: float, down: float) -> F32:
    """What stood at (x, y) stands at (x + right, y + down)."""
    move = np.array([[1, 0, right], [0, 1, down]])
    size = picture.shape[1], picture.shape[0]
    return cv2.warpAffine(picture, move, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def bordered(picture: F32) -> F32:
    sides = (BORDER,) * 4
    return np.ascontiguousarray(cv2.copyMakeBorder(picture, *sides, cv2.BORDER_REPLICATE), np.float32)


# ---- gray images ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(128, 96), (131, 67), (33, 32), (20, 90)])
def test_halves_are_means_with_repeated_edges(width: int, height: int) -> None:
    picture = texture(width, height).astype(np.uint8)
    pyramid = gray_pyramid(picture)
    assert pyramid.full is picture and len(pyramid.halves) == level_count(width, height)
    expected = picture.astype(PX)
    for half in pyramid.halves:
        rows, columns = (side // 2 for side in expected.shape)
        expected = expected[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean((1, 3))
        np.testing.assert_allclose(half, np.pad(expected, BORDER, mode="edge"), rtol=1e-6)
    np.testing.assert_array_equal(level(pyramid, 0), np.pad(picture, BORDER, mode="edge"))


# ---- inverse search --------------------------------------------------------------------------------------


def one_step(first: F32, second: F32, stride: int) -> np.ndarray:
    """A Gauss-Newton step of each patch from where it stands, as the papers write it."""
    a, b = first.astype(PX), second.astype(PX)
    across = np.pad((a[:, 2:] - a[:, :-2]) / 2, ((0, 0), (1, 1)))
    down = np.pad((a[2:] - a[:-2]) / 2, ((1, 1), (0, 0)))
    rows, columns = grid_shape(first, stride)
    found = np.empty((rows, columns, 2))
    for row in range(rows):
        for column in range(columns):
            y = min(row * stride, a.shape[0] - 2 * BORDER - PATCH) + BORDER
            x = min(column * stride, a.shape[1] - 2 * BORDER - PATCH) + BORDER
            at = np.s_[y : y + PATCH, x : x + PATCH]
            gradient = np.stack([each[at].ravel() - each[at].mean() for each in (across, down)])
            difference = (b[at] - a[at]).ravel()
            found[row, column] = -np.linalg.solve(gradient @ gradient.T + np.eye(2), gradient @ difference)
    return found


@pytest.mark.parametrize("stride", [4, 6, 8])
def test_a_step_is_that_of_gauss_and_newton(stride: int) -> None:
    down, across = np.gradient(texture())
    first, second = bordered(texture()), bordered(texture() - 0.015 * across + 0.01 * down)
    begin = np.zeros((*grid_shape(first, stride), 2), np.float32)
    expected = one_step(first, second, stride)
    short = (expected**2).sum(-1) < 0.029**2  # a step so small is the last, and taken unseen
    assert short.mean() > 0.9
    found = search(first, second, stride, begin, 1)
    np.testing.assert_allclose(found[short], expected[short], atol=1e-4)


@pytest.mark.parametrize("moved", [(0.0, 0.0), (1.6, -0.7), (-2.3, 1.2)])
def test_patches_are_found_where_they_went(moved: tuple[float, float]) -> None:
    first = bordered(texture())
    second = bordered(shifted(texture(), *moved) * np.float32(0.9) + 12)  # and the light has changed
    begin = np.zeros((*grid_shape(first, 4), 2), np.float32)
    field = search(first, second, 4, search(first, second, 4, begin, 12), 12)
    across, down = centres(first, 4)
    inside = (across > 12) & (across < WIDTH - 12) & (down > 12) & (down < HEIGHT - 12)
    error = np.hypot(*(field - np.array(moved, np.float32))[inside].T)
    assert np.median(error) < 0.1 and np.percentile(error, 90) < 0.3
    flow = at_pixels(first, second, 4, field)
    assert flow.shape == (HEIGHT, WIDTH, 2)
    assert np.abs(np.median(flow[12:-12, 12:-12], (0, 1)) - moved).max() < 0.1


def test_a_tether_holds_rows_where_there_is_nothing_to_say_otherwise() -> None:
    """Vertical stripes: rows could be any."""
    stripes = np.tile(texture()[:1], (HEIGHT, 1))
    first = bordered(stripes)
    begin = np.zeros((*grid_shape(first, 4), 3), np.float32)
    begin[..., 1:] = 0.4
    field = search(first, bordered(shifted(stripes, 0.5, 0)), 4, begin, 6, tether=0.7)
    np.testing.assert_allclose(field[..., 1], 0.4, atol=1e-3)


@pytest.mark.parametrize("stride", [4, 6])
def test_flow_of_a_known_motion(stride: int) -> None:
    """Turned, grown and moved, as by a scope; beside it what OpenCV finds at the same size."""
    before = texture(320, 256)
    turn = cv2.getRotationMatrix2D((160, 128), 1.0, 1.02)
    turn[:, 2] += (5.0, -3.0)
    after = cv2.warpAffine(before, turn, (320, 256), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    pyramids = [gray_pyramid(picture.astype(np.uint8)) for picture in (before, after)]
    flow = OpticalFlow(stride)(*pyramids)
    assert flow.shape == (128, 160, 2)
    y, x = np.mgrid[:128, :160] * 2 + 0.5
    truth = np.stack([x, y, np.ones_like(x)], -1) @ turn.T - np.stack([x, y], -1)
    peer = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    peer.setFinestScale(1)
    halves = [cv2.convertScaleAbs(inner(pyramid.halves[0])) for pyramid in pyramids]
    error, theirs = (
        np.linalg.norm(each - truth, axis=-1)[12:-12, 12:-12] for each in (flow, 2 * peer.calc(*halves, None))
    )
    assert np.median(error) < 1.25 * np.median(theirs)
    assert np.percentile(error, 95) < 1.25 * np.percentile(theirs, 95) < 0.4
    assert np.linalg.norm(truth, axis=-1).mean() > 4  # there was something to find


# ---- stereo ----------------------------------------------------------------------------------------------


def test_agreement_is_the_correlation_of_windows() -> None:
    left = texture()
    seen = (left + np.random.default_rng(1).normal(0, 20, left.shape)).astype(np.float32)
    found = np.empty_like(left)
    agreement.correlate(bordered(left), seen, found)
    side = 2 * agreement.RADIUS + 1
    windows = np.lib.stride_tricks.sliding_window_view
    a, b = (windows(picture.astype(PX), (side, side)) for picture in (left, seen))
    covariance = (a * b).mean((-1, -2)) - a.mean((-1, -2)) * b.mean((-1, -2))
    noise = float(agreement.NOISE_VARIANCE)
    expected = covariance / np.sqrt((a.var((-1, -2)) + noise) * (b.var((-1, -2)) + noise))
    edge = agreement.RADIUS
    # Squares of 250 are subtracted from each other: 1e-7 of 6e4, beside variances of some hundreds.
    np.testing.assert_allclose(found[edge:-edge, edge:-edge], expected, atol=1e-3)


def test_trust_is_lost_to_what_cannot_be_and_to_nearer_surfaces() -> None:
    rng = np.random.default_rng(2)
    found, share = rng.uniform(0, 1, (2, HEIGHT, WIDTH)).astype(np.float32)
    disparity = rng.uniform(0, 40, (HEIGHT, WIDTH)).astype(np.float32)
    trust = np.empty_like(found)
    agreement.drop_wrong(found, disparity, share, np.float32(5), np.float32(30), trust)
    least = float(agreement.LEAST_AGREEMENT)
    expected = np.maximum((found.astype(PX) - least) / (1 - least), 0)
    columns = np.arange(WIDTH)
    expected[(share <= 0.5) | (disparity < 5) | (disparity > np.minimum(30, columns))] = 0
    for row, d in zip(expected, disparity, strict=True):
        there = (columns - d + np.float32(0.5)).astype(int)
        nearest = np.zeros(WIDTH)
        np.maximum.at(nearest, there[row > 0], d[row > 0])
        hidden = (row > 0) & (d <= nearest[np.clip(there, 0, WIDTH - 1)] - agreement.HIDDEN_TOLERANCE)
        row[hidden] = 0
    assert 0.02 < (expected > 0).mean() < 0.3
    np.testing.assert_allclose(trust, expected, atol=1e-5)


# ---- smoothing -------------------------------------------------------------------------------------------


def test_smoothing_is_the_guided_filter() -> None:
    """On its own definition, of every window of 7x7 px; so planes stay, and steps larger than the noise."""
    variance, rows, columns = 0.2, np.arange(HEIGHT)[:, None], np.arange(WIDTH)
    field = 16 + 0.01 * columns - 0.012 * rows + 8 * (columns > WIDTH // 2)
    noisy = (field + np.random.default_rng(0).normal(size=field.shape)).astype(np.float32)
    smooth, of_field = np.empty_like(noisy), np.empty_like(noisy)
    guided(noisy, 3, np.float32(variance), smooth)
    windows = np.lib.stride_tricks.sliding_window_view
    patches = windows(noisy.astype(np.float64), (7, 7))
    mean, spread = patches.mean((-1, -2)), patches.var((-1, -2))
    kept = spread / (spread + variance)
    slope, offset = (windows(part, (7, 7)).mean((-1, -2)) for part in (kept, mean * (1 - kept)))
    np.testing.assert_allclose(smooth[6:-6, 6:-6], slope * noisy[6:-6, 6:-6] + offset, atol=2e-3)
    guided(field.astype(np.float32), 3, np.float32(variance), of_field)
    assert np.abs(of_field - field)[8:-8, 8:-8].max() < 0.2  # px, of a step of 8
