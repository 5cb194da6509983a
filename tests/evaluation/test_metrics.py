"""Figures of merit against closed forms and cases made by hand."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from engine_scenes import as_bytes, round_gaussians, rows
from numpy.lib.stride_tricks import sliding_window_view

from sags_node.detail.motion import SmallDrawings
from sags_node.detail.seen import SeenFrame
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.errors import UsageError
from sags_node.geometry import unproject
from sags_node.mapping.right_eye import right_eye_mask
from sags_node.quality import metrics
from sags_node.tools.evaluation.flicker import FRAMES, Flicker
from sags_node.tools.evaluation.lpips import Lpips
from sags_node.tools.evaluation.moments import carried
from sags_node.tools.evaluation.run import MappedFrame, RunFacts
from sags_node.tools.evaluation.tracking import PointTracks
from sags_node.types import F32, Camera, Gaussians, Snapshot


def picture(seed: int = 0, height: int = 96, width: int = 128) -> np.ndarray:
    """A smooth random texture, float32 RGB 0..1."""
    noise = np.random.default_rng(seed).random((height, width, 3), np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return (smooth - smooth.min()) / (smooth.max() - smooth.min())


def half_mask(height: int = 96, width: int = 128) -> np.ndarray:
    mask = np.zeros((height, width), bool)
    mask[:, : width // 2] = True
    return mask


# ---- images --------------------------------------------------------------------------------------------


def test_psnr_of_known_noise() -> None:
    truth = picture()
    sign = np.where(np.random.default_rng(1).random(truth.shape) < 0.5, -1, 1).astype(np.float32)
    noisy = truth + 0.05 * sign  # squared error exactly 0.0025 everywhere
    assert metrics.psnr(noisy, truth, half_mask()) == pytest.approx(-10 * np.log10(0.0025), abs=1e-4)
    gaussian = truth + np.random.default_rng(2).normal(0, 0.02, truth.shape).astype(np.float32)
    everywhere = np.ones(truth.shape[:2], bool)
    assert metrics.psnr(gaussian, truth, everywhere) == pytest.approx(-20 * np.log10(0.02), abs=0.1)


def test_figures_are_of_tissue_only_and_an_inverted_mask_shows() -> None:
    truth, tissue = picture(), half_mask()
    spoilt = truth.copy()
    spoilt[~tissue] += 0.5
    assert metrics.psnr(spoilt, truth, tissue) == metrics.BEST_PSNR
    assert metrics.psnr(spoilt, truth, ~tissue) == pytest.approx(-20 * np.log10(0.5), abs=1e-3)
    spoilt[~tissue] = 0
    assert metrics.ssim(spoilt, truth, tissue) == pytest.approx(1, abs=1e-6)
    assert metrics.ssim(spoilt, truth, ~tissue) < 0.5


def test_nothing_is_invented_over_an_empty_mask() -> None:
    truth = picture()
    empty = np.zeros(truth.shape[:2], bool)
    for figure in (metrics.psnr, metrics.paper_psnr, metrics.ssim):
        assert np.isnan(figure(truth, truth, empty))


def direct_ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Wang et al. 2004, equation 13, over each window in the image, in float64: [H - 10, W - 10, 3]."""
    ramp = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(ramp, ramp) / ramp.sum() ** 2
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2

    def mean(values: np.ndarray) -> np.ndarray:
        return np.einsum("yxkij,ij->yxk", values, window)

    p, q = (sliding_window_view(each.astype(np.float64) * 255, (11, 11), (0, 1)) for each in (a, b))
    mp, mq = mean(p), mean(q)
    dp, dq = p - mp[..., None, None], q - mq[..., None, None]
    vp, vq, cov = mean(dp**2), mean(dq**2), mean(dp * dq)
    return (2 * mp * mq + c1) * (2 * cov + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2))


def test_ssim_is_the_published_formula() -> None:
    truth = picture(0, 32, 40)
    other = np.clip(truth + 0.1 * picture(5, 32, 40) - 0.05, 0, 1)
    inner = np.zeros(truth.shape[:2], bool)
    inner[5:-5, 5:-5] = True
    # windows of inner pixels see the frame of the image too: make that frame equal in both
    framed = np.where(inner[..., None], other, truth)
    expected = direct_ssim_map(framed, truth).mean()
    assert expected < 0.99
    assert metrics.ssim(other, truth, inner) == pytest.approx(expected, abs=2e-5)


def test_gain_and_offset_are_recovered_exactly() -> None:
    dark, tissue = picture(), half_mask()
    truth = dark * np.array([1.3, 0.7, 1.0], np.float32) + np.array([0.05, -0.02, 0.1], np.float32)
    truth[~tissue] = 0  # must not take part in the fit
    np.testing.assert_allclose(metrics.fit_gain_offset(dark, truth, tissue)[tissue], truth[tissue], atol=2e-6)
    flat = np.full_like(dark, 0.3)
    found = metrics.fit_gain_offset(flat, flat + np.float32(0.1), tissue)
    np.testing.assert_allclose(found[tissue], 0.4, atol=1e-6)


# ---- depth and timings -----------------------------------------------------------------------------------


def test_depth_errors_by_hand() -> None:
    reference = np.full((10, 10), 0.1, np.float32)
    reference[0] = 0  # unknown
    tissue = np.ones((10, 10), bool)
    tissue[1] = False
    depth = reference + np.float32(0.001)
    depth[2] = 0  # nothing known: 10 of 80 pixels
    depth[3] = 0.104
    depth[1] = 5.0  # an instrument: does not count
    errors = metrics.depth_errors(depth, reference, tissue)
    assert errors.coverage == pytest.approx(70 / 80)
    assert errors.median_mm == pytest.approx(1.0, abs=1e-3)
    assert errors.p90_mm == pytest.approx(4.0, abs=1e-3)
    assert errors.rmse_mm == pytest.approx(np.sqrt((60 * 1 + 10 * 16) / 70), abs=1e-3)


def test_depth_without_anything_to_compare() -> None:
    known, unknown = np.full((4, 4), 0.1, np.float32), np.zeros((4, 4), np.float32)
    tissue = np.ones((4, 4), bool)
    nothing_drawn = metrics.depth_errors(unknown, known, tissue)
    assert nothing_drawn.coverage == 0 and np.isnan(nothing_drawn.median_mm)
    assert np.isnan(metrics.depth_errors(known, unknown, tissue).coverage)


def test_nearest_resampling_keeps_pixel_centres() -> None:
    ramp = np.tile(np.arange(12, dtype=np.float32), (9, 1))
    np.testing.assert_array_equal(metrics.resample_nearest(ramp, 12, 9), ramp)
    third = metrics.resample_nearest(ramp, 4, 3)  # centres 0, 1, 2, 3 lie at 1, 4, 7, 10
    np.testing.assert_array_equal(third[0], [1, 4, 7, 10])
    triple = metrics.resample_nearest(third, 12, 9)
    np.testing.assert_array_equal(triple[0], np.repeat([1, 4, 7, 10], 3))


def test_percentiles() -> None:
    assert metrics.percentiles(list(range(101))) == {"p50": 50, "p90": 90, "p99": 99, "max": 100}
    assert metrics.percentiles([]) is None


# ---- LPIPS -----------------------------------------------------------------------------------------------


def test_lpips_grows_with_blur_and_is_symmetric(data_folder: Path) -> None:
    lpips = Lpips(data_folder / "lpips_squeeze" / "lpips_squeeze_v0.1.npz")
    truth = np.random.default_rng(0).random((96, 128, 3), np.float32)
    everywhere = np.ones(truth.shape[:2], bool)
    assert lpips(truth, truth, everywhere) == 0
    distances = [lpips(cv2.GaussianBlur(truth, (0, 0), s), truth, everywhere) for s in (0.4, 0.8, 1.6)]
    assert 0 < distances[0] < distances[1] < distances[2]
    other = picture(3)
    assert lpips(truth, other, everywhere) == pytest.approx(lpips(other, truth, everywhere), rel=1e-5)
    spoilt = truth.copy()
    spoilt[:, 64:] = 0
    assert lpips(spoilt, truth, half_mask()) == 0
    assert lpips(spoilt, truth, everywhere) > 0.1
    assert np.isnan(lpips(truth, truth, np.zeros_like(everywhere)))


def test_lpips_names_a_wrong_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    np.savez(tmp_path / "pickled.npz", weights=np.array([{}], dtype=object))
    for name, said in (("no", r"no\.npz"), ("other", r"lacks net\.0\.weight"), ("pickled", r"pickled\.npz")):
        with pytest.raises(UsageError, match=said):
            Lpips(tmp_path / f"{name}.npz")


# ---- views of other moments and of the other eye -----------------------------------------------------------

CAMERA = Camera(128, 96, np.array([[200.0, 0, 63.5], [0, 200.0, 47.5], [0, 0, 1]]), np.eye(4))


def cloud(count: int = 4000, seed: int = 0) -> Gaussians:
    """A slab of small Gaussians 0.1 m before the camera."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-0.03, -0.022, 0.099], [0.03, 0.022, 0.101], (count, 3)).astype(np.float32)
    made = round_gaussians(means, 4e-4, rng.random((count, 3), np.float32))
    return replace(made, ids=np.arange(100, 100 + count))


def moved(gaussians: Gaussians, by: np.ndarray) -> Gaussians:
    return replace(gaussians, means=gaussians.means + by.astype(np.float32))


def test_right_eye_mask_never_lets_an_instrument_through() -> None:
    rng = np.random.default_rng(4)
    focal_px, baseline = 200.0, 0.004
    for _ in range(20):
        depth = cv2.GaussianBlur(rng.uniform(0.04, 0.2, (96, 128)).astype(np.float32), (0, 0), 6)
        tissue = np.ones((96, 128), bool)
        x, y = rng.integers(0, 90), rng.integers(0, 70)
        tissue[y : y + 26, x : x + 30] = False
        mask = right_eye_mask(tissue, depth[tissue], focal_px, baseline)
        known = depth[tissue]
        disparities = np.unique(np.round(focal_px * baseline / known[::7], 1))
        low, high = np.percentile(disparities, [1, 99])
        rows, columns = np.nonzero(mask)
        assert len(rows) > 0
        inside = disparities[(disparities >= low) & (disparities <= high)]
        for disparity in [*inside, 1.2 * high, 1.45 * high]:  # an instrument is nearer than the tissue
            left = columns + disparity
            assert (left <= 127).all()
            assert tissue[rows, np.floor(left).astype(int)].all()
            assert tissue[rows, np.ceil(left).astype(int)].all()


def test_right_eye_mask_of_a_plane_is_the_shifted_tissue() -> None:
    depth = np.full((8, 128), 0.1, np.float32)
    tissue = np.ones((8, 128), bool)
    tissue[:, 60:70] = False
    mask = right_eye_mask(tissue, depth[tissue], 2500.0, 0.00042)  # disparity 10.5 px, widened to 9..16
    expected = np.ones(128, bool)
    expected[60 - 16 : 70 - 9] = False
    expected[128 - 16 :] = False
    np.testing.assert_array_equal(mask, np.tile(expected, (8, 1)))
    assert not right_eye_mask(tissue, depth[:0], 2500.0, 0.00042).any()


# ---- images that are carried along a model's motion to a moment between them ------------------------------

DEPTH = 0.1  # m


def sheet(shift_px: float) -> Gaussians:
    """Grey Gaussians on a plane that covers the image with room to spare, all moved to the right."""
    u, v = np.meshgrid(np.arange(-24, CAMERA.width + 24, 4.0), np.arange(-24, CAMERA.height + 24, 4.0))
    means = unproject(CAMERA, np.stack([u.ravel() + shift_px, v.ravel()], 1), np.full(u.size, DEPTH))
    return round_gaussians(means.astype(np.float32), 3 * DEPTH / CAMERA.K[0, 0])


def stripes(shift_px: float) -> F32:
    """A texture that the sheet does not know, moved to the right."""
    wave = 0.5 + 0.3 * np.sin((np.arange(CAMERA.width) - shift_px) / 3)
    return np.tile(wave[None, :, None], (CAMERA.height, 1, 3)).astype(np.float32)


def seen(shift_px: float) -> SeenFrame:
    size = CAMERA.height, CAMERA.width
    return SeenFrame(
        0, CAMERA, sheet(shift_px), lambda: as_bytes(stripes(shift_px)), np.ones(size, np.bool_),
        np.full(size, DEPTH, np.float32),
    )  # fmt: skip


def shown(middle_px: float, *around: SeenFrame) -> F32:
    middle = sheet(middle_px)
    planes = make_rasterizer("numba", CAMERA.width, CAMERA.height).forward(middle, CAMERA)
    return carried(planes, middle, CAMERA, [(each, 0.5) for each in around], SmallDrawings())


def off(picture: F32, truth: F32) -> float:
    """Mean error away from the border, where an image has come in."""
    inner = np.s_[8:-8, 16:-16]
    return float(np.abs(picture[inner] - truth[inner]).mean())


def test_detail_that_gaussians_lack_goes_where_they_go() -> None:
    """A wave of 3 px times 2 pi moves by 6 px: the mean of both images as they are is grey."""
    assert off(shown(3, seen(0), seen(6)), stripes(3)) < 0.01  # cubic remapping
    assert off(stripes(0) / 2 + stripes(6) / 2, stripes(3)) > 0.05


def test_where_nothing_moves_it_is_the_mean_of_both() -> None:
    noise = np.random.default_rng(0).uniform(-0.04, 0.04, (2, *stripes(0).shape)).astype(np.float32)
    first, second = (as_bytes(stripes(0) + each) for each in noise)
    around = replace(seen(0), picture=lambda: first), replace(seen(0), picture=lambda: second)
    np.testing.assert_allclose(shown(0, *around), (first / 2 + second / 2) / 255, atol=1e-3)


def test_an_instrument_is_not_carried_into_the_tissue() -> None:
    here = seen(0)
    picture, mask = here.picture().copy(), here.mask.copy()
    picture[20:40, 30:50], mask[20:40, 30:50] = 255, False
    covered = replace(here, picture=lambda: picture, mask=mask)
    np.testing.assert_allclose(shown(0, covered, here), here.picture() / 255, atol=1e-3)
    inside = shown(0, covered, covered)[25:35, 35:45]
    np.testing.assert_allclose(inside, 0.5, atol=0.01)  # neither shows it: the Gaussians' grey


@pytest.mark.parametrize("moved", [0.0, 0.0005])
def test_a_camera_that_moves_is_told_from_tissue_that_does(moved: float) -> None:
    """Tissue at rest, seen from a place to the left: the image lies to the right."""
    aside = seen(CAMERA.K[0, 0] * moved / DEPTH)
    other = replace(aside, gaussians=sheet(0), camera=CAMERA.moved_right(-moved))
    assert off(shown(0, other), stripes(0)) < 0.01


def test_what_another_place_saw_in_front_of_the_tissue_is_not_carried() -> None:
    folded = replace(seen(0), camera=CAMERA.moved_right(-0.0005), depth=0.9 * seen(0).depth)
    np.testing.assert_allclose(shown(0, folded), 0.5, atol=0.01)  # the Gaussians' grey


# ---- tracking --------------------------------------------------------------------------------------------


ALL = np.ones(40, bool)


def surface_points() -> np.ndarray:
    return np.random.default_rng(9).uniform([-0.02, -0.015, 0.0995], [0.02, 0.015, 0.1005], (40, 3))


def bound(start: Gaussians, points: np.ndarray) -> PointTracks:
    """Tracks that have seen all points in the first frame."""
    tracks = PointTracks(40)
    first = tracks.update(start, points, ALL, CAMERA)
    assert len(first.errors_mm) == 0 and first.lost == 0  # binding says nothing of following
    return tracks


def test_a_frozen_cloud_is_wrong_by_the_whole_motion() -> None:
    start, points = cloud(), surface_points()
    errors = bound(start, points).update(start, points + np.array([0.003, 0, 0]), ALL, CAMERA)
    np.testing.assert_allclose(errors.errors_mm, 3.0, atol=1e-6)
    np.testing.assert_allclose(errors.errors_px, 200 * 0.003 / points[:, 2], rtol=1e-6)


def test_points_survive_as_long_as_one_neighbour_does() -> None:
    start, points = cloud(), surface_points()
    tracks, rng = bound(start, points), np.random.default_rng(1)
    order = rng.permutation(len(start))[:3000]  # rows shuffled, a quarter pruned: ids must do the work
    step = np.array([0.001, 0, 0])
    errors = tracks.update(rows(moved(start, step), order), points + step, ALL, CAMERA)
    assert errors.lost == 0 and errors.errors_mm.max() < 1e-4
    nothing_left = tracks.update(rows(start, np.zeros(0, int)), points, ALL, CAMERA)
    assert nothing_left.lost == 40 and len(nothing_left.errors_mm) == 0


def test_a_point_is_bound_when_it_is_first_seen_near_the_model() -> None:
    start, points = cloud(), surface_points()
    points[0] = [0, 0, 0.5]  # far from every Gaussian
    visible = np.ones(40, bool)
    visible[1] = False
    tracks = PointTracks(40)
    assert tracks.update(start, points, visible, CAMERA).lost == 1
    visible[1] = True
    later = tracks.update(start, points, visible, CAMERA)
    assert later.lost == 1  # still the far one; the newly seen one is bound, not lost
    assert len(later.errors_mm) == 38
    assert len(tracks.update(start, points, visible, CAMERA).errors_mm) == 39


# ---- flicker, by hand ----------------------------------------------------------------------------------


HEIGHT, WIDTH = 64, 96


def frame() -> MappedFrame:
    """All tissue, gray, 100 mm away."""
    nothing = np.zeros((0, 3), np.float32)
    camera = Camera(WIDTH, HEIGHT, np.diag([100.0, 100, 1]), np.eye(4))  # 5 px of disparity
    depth = np.full((HEIGHT, WIDTH), 0.1, np.float32)
    return MappedFrame(
        facts=RunFacts(0, 0, None, 0, {}, {}, 0, {}),
        snapshot=Snapshot(0, 0, 0, round_gaussians(nothing, 1), nothing, camera, 0.0, {}),
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
    passes by, and in the right third an instrument lies in one frame: what happens there does not count.
    The right view shows the same 5 px farther left."""
    flicker, seen = Flicker(), []
    checks = np.indices((HEIGHT, WIDTH)).sum(0) % 2 * 10 - 5
    for number in range(FRAMES):
        sign = 1 if number % 2 else -1
        shown = frame()
        shown.rgb[:] = 102 + 2 * sign
        shown.rgb[:, :32] = 8 * number
        right = np.roll(shown.rgb, -5, axis=1)
        depth, measured = shown.depth + np.float32(1e-3 * sign), shown.depth + np.float32(3e-3 * sign)
        measured[:, 40:48] = 0 if number == 7 else 0.2  # not known in all of them
        tissue = shown.tissue
        tissue[:, 64:] = number != 5
        picture = np.repeat((120 + sign * checks)[..., None], 3, 2).astype(np.uint8)
        picture[:, :32] = 5 * number
        seen.append(flicker(picture, replace(shown, depth=depth, measured_depth=measured, right_rgb=right)))
    assert seen[:-1] == [None] * (FRAMES - 1)
    expected = {"input": 5, "picture": 2, "right": 2, "depth_mm": 1, "measured_depth_mm": 3, "share": 0.5}
    assert seen[-1] == pytest.approx(expected, rel=1e-3)
    assert flicker(picture, shown) is None  # the next thirty begin


def test_nothing_is_said_of_a_scene_that_moves() -> None:
    flicker, rng = Flicker(), np.random.default_rng(0)
    for _ in range(FRAMES):
        said = flicker(np.full((HEIGHT, WIDTH, 3), rng.integers(50, 200), np.uint8), frame())
    assert said is None
