"""Images stay right at other sizes and distances; the 3D filter where it belongs; exports draw the same."""

import dataclasses
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from engine_scenes import as_bytes, rasterize, round_gaussians
from flat_scene import camera_in_front, flat_scene
from following import Following
from splat_files import splats_of

from benchmarks.quality.alias import VARIANTS, Settings, Trained, train
from benchmarks.quality.alias_truth import moved, resized
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.smoothing import bake_filter
from sags_node.geometry import project
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.mapped import Mapped
from sags_node.mapping.mapper import Mapper
from sags_node.mapping.refiner import CpuRefiner
from sags_node.mapping.tissue_map import TissueMap
from sags_node.model.alias_free import FILTER_VARIANCE, smoothing_variances
from sags_node.model.constant_colours import with_constant_colours
from sags_node.model.gaussians import GaussianModel
from sags_node.model.ply import write_ply
from sags_node.quality.metrics import as_float, psnr
from sags_node.types import F32, SH_DEGREE_0, Camera, Gaussians, Observation

# ---- the 2D filter switched off ----------------------------------------------------------------------------


def test_dilation_is_that_of_3d_gaussian_splatting() -> None:
    """One round Gaussian of 1 px: variance 1 + 0.3 px^2, and its opacity as it was."""
    view = camera_in_front(41, 41, 100.0)
    gaussian = round_gaussians(np.array([[0, 0, 0.1]], np.float32), 1e-3, opacity=0.8)
    alpha = make_rasterizer("numba", 41, 41, antialias=False).forward(gaussian, view)[4]
    offsets = np.arange(-2, 3)
    np.testing.assert_allclose(alpha[20, 18:23], 0.8 * np.exp(-0.5 * offsets**2 / 1.3), rtol=1e-4)


# ---- other sizes and distances -----------------------------------------------------------------------------

SIDE = 256


def texture() -> F32:
    """Detail of all sizes, down to 2 px, [4 SIDE, 4 SIDE, 3]: an image four times as fine as trained."""
    rng = np.random.default_rng(3)
    total = np.full((4 * SIDE, 4 * SIDE, 3), 0.5, np.float32)
    for cells in (16, 32, 64, 128):
        coarse = rng.normal(0, 0.07, (cells, cells, 3)).astype(np.float32)
        total += cv2.resize(coarse, (4 * SIDE, 4 * SIDE), interpolation=cv2.INTER_CUBIC)
    return np.clip(total, 0, 1)


def shrunk(fine: F32, factor: float) -> F32:
    """The image `factor` times as large as trained, by averaging the four times finer one."""
    size = round(SIDE * factor)
    return np.asarray(cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA), np.float32)


def pictured_wall(fine: F32) -> Observation:
    """The image on a wall 8 cm away."""
    gray = np.zeros((SIDE, SIDE), np.uint8)
    wall, *_ = flat_scene(camera_in_front(SIDE, SIDE, 250.0), np.zeros((0, 3), np.float32), gray, 0.08)
    return dataclasses.replace(wall, image=as_bytes(shrunk(fine, 1)))


SETTINGS = Settings(width=SIDE, height=SIDE, max_gaussians=8000, rounds=1)


@pytest.fixture(scope="module")
def wall() -> tuple[Observation, dict[str, Trained]]:
    observation = pictured_wall(texture())
    return observation, {name: train(observation, VARIANTS[name], SETTINGS) for name in ("both", "none")}


def error_db(model: Trained, camera: Camera, truth: F32) -> float:
    return psnr(model.draw(camera), truth, np.ones(truth.shape[:2], bool))


def test_both_filters_beat_none_at_a_quarter_of_the_size(
    wall: tuple[Observation, dict[str, Trained]],
) -> None:
    observation, models = wall
    camera, truth = resized(observation.camera, 0.25), shrunk(texture(), 0.25)
    assert error_db(models["both"], camera, truth) > error_db(models["none"], camera, truth) + 3
    assert error_db(models["both"], camera, truth) > 32


def test_both_filters_beat_none_from_four_times_the_distance(
    wall: tuple[Observation, dict[str, Trained]],
) -> None:
    """The wall then fills a quarter of the image, as the small image shows it."""
    observation, models = wall
    camera = moved(observation.camera, np.array([0, 0, -3 * 0.08]))
    quarter, first = SIDE // 4, SIDE * 3 // 8
    inside = slice(first + 2, first + quarter - 2)
    truth = shrunk(texture(), 0.25)[2:-2, 2:-2]
    counted = np.ones(truth.shape[:2], bool)
    both, none = (
        psnr(models[name].draw(camera)[inside, inside], truth, counted) for name in ("both", "none")
    )
    assert both > none + 3


def test_filters_cost_nothing_at_the_trained_size(wall: tuple[Observation, dict[str, Trained]]) -> None:
    observation, models = wall
    both, none = (
        error_db(models[name], observation.camera, as_float(observation.image)) for name in ("both", "none")
    )
    assert both > 30
    assert both > none - 0.5


def light_of_a_line(factor: float) -> float:
    """All light of one bright line 1.4 px thick, drawn `factor` times as large as it was trained, in pixels
    of the trained size."""
    camera = camera_in_front(128, 96, 500.0)
    means = np.array([[0, 0, 0.08]], np.float32)
    line = dataclasses.replace(
        round_gaussians(means, 0.08 / 500, 1.0),
        quats=np.array([[0.99, 0, 0, 0.14]], np.float32),
        smoothing=smoothing_variances(means, [camera]),
    )
    line.scales[:] *= [15, 0.6, 0.1]  # px
    view = resized(camera, factor)
    planes = make_rasterizer("numba", view.width, view.height).forward(line, view)
    return float(planes[0].sum(dtype=np.float64)) / factor**2


@pytest.mark.parametrize("factor", [0.25, 0.5, 2, 4])
def test_a_thin_bright_line_keeps_its_light(factor: float) -> None:
    assert light_of_a_line(factor) == pytest.approx(light_of_a_line(1), rel=0.02)


# ---- the 3D filter's width ---------------------------------------------------------------------------------


def looking(focal: float, place: tuple[float, float, float] = (0, 0, 0)) -> Camera:
    T = np.eye(4)
    T[:3, 3] = place
    return Camera(100, 80, np.array([[focal, 0, 50.0], [0, focal * 0.9, 40], [0, 0, 1]]), T)


def test_variance_is_that_of_the_sampling_interval() -> None:
    means = np.array([[0, 0, 0.08], [0, 0, 0.16], [0.01, -0.005, 0.04]], np.float32)
    expected = FILTER_VARIANCE * (means[:, 2].astype(float) / 120) ** 2
    np.testing.assert_allclose(smoothing_variances(means, [looking(120)]), expected, rtol=1e-5)


def test_the_camera_that_sees_finest_counts() -> None:
    means = np.array([[0, 0, 0.08]], np.float32)
    near = looking(120, (0, 0, 0.06))
    assert smoothing_variances(means, [looking(120), near]) == pytest.approx(0.2 * (0.02 / 120) ** 2)
    assert smoothing_variances(means, [near, looking(120)]) == pytest.approx(0.2 * (0.02 / 120) ** 2)
    sharp = looking(480)
    assert smoothing_variances(means, [looking(120), sharp]) == pytest.approx(0.2 * (0.08 / 480) ** 2)


def test_what_no_camera_sees_takes_the_widest_filter() -> None:
    """Beside the image, behind the camera, not a number."""
    means = np.array([[0, 0, 0.04], [0, 0, 0.08], [1, 0, 0.02], [0, 0, -0.02], [np.nan, 0, 1]], np.float32)
    found = smoothing_variances(means, [looking(120)])
    np.testing.assert_allclose(found[2:], found[1])
    # a second camera that does see the point on the side
    found = smoothing_variances(means, [looking(120), looking(120, (1, 0, 0.01))])
    assert found[2] == pytest.approx(0.2 * (0.01 / 120) ** 2, rel=1e-4)


def test_a_little_beyond_the_border_still_counts_as_seen() -> None:
    def beside(u: float) -> F32:
        return np.array([[0, 0, 0.08], [(u - 50) / 120 * 0.04, 0, 0.04]], np.float32)

    inside, outside = (smoothing_variances(beside(u), [looking(120)]) for u in (-14.0, -16.0))
    assert inside[1] == pytest.approx(inside[0] / 4, rel=1e-4)
    assert outside[1] == outside[0]


def test_nothing_seen_is_nothing_filtered() -> None:
    assert smoothing_variances(np.zeros((0, 3), np.float32), [looking(120)]).shape == (0,)
    behind = np.array([[0, 0, -1]], np.float32)
    assert smoothing_variances(behind, [looking(120)]) == 0
    assert smoothing_variances(behind, []) == 0


# ---- in the mapper, and on the way out ---------------------------------------------------------------------


@cache
def mapped(smoothing: bool) -> tuple[GaussianModel, Mapped, Observation]:
    """A small model after two frames, and what was published of it."""
    observation = pictured_wall(texture())
    mapper = Mapper(CpuRefiner(partial(make_rasterizer, "numba")), TissueMap(3000), smoothing)
    frames = Following(mapper)
    frames.take(observation, StepBudget(1))
    return mapper.model, frames.take(observation, StepBudget(1)), observation


def test_mapper_filters_and_publishes_what_it_draws() -> None:
    model, made, observation = mapped(smoothing=True)
    published = made.snapshot.gaussians
    expected = smoothing_variances(model.means, [observation.camera])
    np.testing.assert_allclose(model.smoothing, expected, rtol=0.05)  # one step moves them a little
    assert published.smoothing is None
    drawn = made.view
    sent = rasterize(published, observation.camera)
    np.testing.assert_array_equal(sent.rgb, drawn.rgb)
    unfiltered = rasterize(dataclasses.replace(model.gaussians(), smoothing=None), observation.camera)
    assert np.abs(unfiltered.alpha - drawn.alpha).max() > 0.05  # the filter does something


def test_first_scales_are_as_drawn_without_a_filter() -> None:
    filtered, plain = (mapped(smoothing)[1].snapshot.gaussians for smoothing in (True, False))
    np.testing.assert_allclose(np.median(filtered.scales, 0), np.median(plain.scales, 0), rtol=0.1)


def begun() -> tuple[Mapper, Observation]:
    observation = pictured_wall(texture())
    mapper = Mapper(CpuRefiner(partial(make_rasterizer, "numba")), TissueMap(3000))
    mapper.update(observation, None, StepBudget(0))
    return mapper, observation


def test_the_filter_stays_as_narrow_as_the_nearest_look_was() -> None:
    """From farther away nothing is forgotten of what was seen from near by."""
    mapper, observation = begun()
    before = mapper.model.smoothing.copy()
    far = dataclasses.replace(
        observation,
        camera=moved(observation.camera, np.array([0, 0, -0.08])),
        depth=observation.depth * 2,
        tissue=np.zeros((SIDE, SIDE), bool),
    )
    mapper.update(far, None, StepBudget(0))
    np.testing.assert_array_equal(mapper.model.smoothing, before)
    near = dataclasses.replace(far, camera=moved(observation.camera, np.array([0, 0, 0.04])))
    mapper.update(near, None, StepBudget(0))
    assert (mapper.model.smoothing <= before).all()
    assert mapper.model.smoothing.min() == pytest.approx(before.min() / 4, rel=0.1)


def test_what_the_camera_does_not_see_keeps_its_filter() -> None:
    """From near by half of the tissue is out of view; from elsewhere all of it."""
    mapper, observation = begun()
    before, means = mapper.model.smoothing.copy(), mapper.model.means.copy()
    away = dataclasses.replace(observation, tissue=np.zeros((SIDE, SIDE), bool))
    near = moved(observation.camera, np.array([0, 0, 0.06]))
    for seen_from in (moved(observation.camera, np.array([1.0, 0, 0])), near):
        mapper.update(dataclasses.replace(away, camera=seen_from), None, StepBudget(0))
        np.testing.assert_array_equal(mapper.model.means, means)
        pixels, _ = project(seen_from, means)
        outside = (np.abs(pixels - SIDE / 2) > 0.7 * SIDE).any(1)  # farther than the margin
        assert outside.mean() > 0.3
        np.testing.assert_array_equal(mapper.model.smoothing[outside], before[outside])
        assert (mapper.model.smoothing > 0).all()
    inside = (np.abs(pixels - SIDE / 2) < 0.5 * SIDE).all(1)
    assert inside.any() and (mapper.model.smoothing[inside] < 0.5 * before[inside]).all()


def test_a_ply_file_draws_the_same_without_knowing_the_filter(tmp_path: Path) -> None:
    model, _, observation = mapped(smoothing=True)
    file = tmp_path / "model.ply"
    write_ply(file, model.gaussians())
    rows = splats_of(file)

    def columns(*wanted: str) -> F32:
        return np.stack([rows[name] for name in wanted], 1)

    read = Gaussians(
        means=columns("x", "y", "z"),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        scales=np.exp(columns("scale_0", "scale_1", "scale_2")),
        opacities=1 / (1 + np.exp(-rows["opacity"])),
        colors=columns("f_dc_0", "f_dc_1", "f_dc_2") * np.float32(SH_DEGREE_0) + np.float32(0.5),
        ids=np.arange(len(rows["x"])),
    )
    written = with_constant_colours(model.gaussians())
    found, drawn = rasterize(read, observation.camera), rasterize(written, observation.camera)
    step = 1 / 255  # a logit's last bit may carry a pixel over the cut-off
    apart = np.abs(found.rgb.astype(int) - drawn.rgb)
    assert apart.max() <= 1 and apart.mean() < 1e-3
    np.testing.assert_allclose(found.alpha, drawn.alpha, atol=step)


def test_folding_twice_changes_nothing() -> None:
    model, _, _ = mapped(smoothing=True)
    once = bake_filter(model.gaussians())
    assert bake_filter(once) is once
