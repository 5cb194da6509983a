"""Images stay right at other sizes and distances; the 3D filter where it belongs."""

import dataclasses
from collections.abc import Callable
from functools import cache, partial

import cv2
import numpy as np
import pytest
from engine_scenes import as_bytes, rasterize, round_gaussians
from flat_scene import camera_in_front, flat_scene
from following import Following

from benchmarks.quality.alias import VARIANTS, Settings, Trained, train
from benchmarks.quality.alias_truth import moved, resized
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.geometry import project
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.mapped import Mapped
from sags_node.mapping.mapper import Mapper
from sags_node.mapping.refiner import CpuRefiner
from sags_node.mapping.tissue_map import TissueMap
from sags_node.model.alias_free import FILTER_VARIANCE, smoothing_variances
from sags_node.model.gaussians import GaussianModel
from sags_node.quality.metrics import as_float, psnr
from sags_node.types import F32, Camera, Observation

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


Wall = tuple[Observation, dict[str, Trained]]
SETTINGS = Settings(width=SIDE, height=SIDE, max_gaussians=8000, rounds=1)


@pytest.fixture(scope="module")
def wall() -> Wall:
    observation = pictured_wall(texture())
    return observation, {name: train(observation, VARIANTS[name], SETTINGS) for name in ("both", "none")}


def as_trained(observation: Observation) -> tuple[Camera, F32, slice]:
    return observation.camera, as_float(observation.image), np.s_[:]


def smaller(observation: Observation) -> tuple[Camera, F32, slice]:
    return resized(observation.camera, 0.25), shrunk(texture(), 0.25), np.s_[:]


def from_afar(observation: Observation) -> tuple[Camera, F32, slice]:
    """The wall fills a quarter of the image, as the small image shows it."""
    quarter, first = SIDE // 4, SIDE * 3 // 8
    camera = moved(observation.camera, np.array([0, 0, -3 * 0.08]))
    return camera, shrunk(texture(), 0.25)[2:-2, 2:-2], slice(first + 2, first + quarter - 2)


@pytest.mark.parametrize(
    ("seen", "gain", "least"), [(smaller, 3.0, 32), (from_afar, 3.0, 0), (as_trained, -0.5, 30)]
)
def test_both_filters_beat_none_and_cost_nothing_at_the_trained_size(
    wall: Wall, seen: Callable[[Observation], tuple[Camera, F32, slice]], gain: float, least: float
) -> None:
    observation, models = wall
    camera, truth, where = seen(observation)
    everywhere = np.ones(truth.shape[:2], bool)
    both, none = (
        psnr(models[name].draw(camera)[where, where], truth, everywhere) for name in ("both", "none")
    )
    assert both > none + gain and both > least


# ---- the 3D filter's width ---------------------------------------------------------------------------------


def looking(focal: float, place: tuple[float, float, float] = (0, 0, 0)) -> Camera:
    T = np.eye(4)
    T[:3, 3] = place
    return Camera(100, 80, np.array([[focal, 0, 50.0], [0, focal * 0.9, 40], [0, 0, 1]]), T)


def beside(u: float) -> tuple[float, float, float]:
    """A point that the camera sees at that column."""
    return (u - 50) / 120 * 0.04, 0, 0.04


FAR, NEAR, ASIDE, BEHIND = (0, 0, 0.08), (0, 0, 0.04), (1, 0, 0.02), (0, 0, -0.02)


def test_variance_is_that_of_the_finest_sampling_interval() -> None:
    """What no camera sees (beside the image, behind the camera, not a number) takes the widest."""
    one, closer, sharper, another = (
        looking(120), looking(120, (0, 0, 0.06)), looking(480), looking(120, (1, 0, 0.01)),
    )  # fmt: skip
    for means, cameras, depths in (
        ([FAR, NEAR, (0.01, -0.005, 0.16)], [one], [0.08, 0.04, 0.16]),
        ([FAR], [one, closer], [0.02]), ([FAR], [closer, one], [0.02]), ([FAR], [one, sharper], [0.08 / 4]),
        ([NEAR, FAR, ASIDE, BEHIND, (np.nan, 0, 1)], [one], [0.04, 0.08, 0.08, 0.08, 0.08]),
        ([FAR, ASIDE], [one, another], [0.08, 0.01]),
        ([FAR, beside(-14)], [one], [0.08, 0.04]), ([FAR, beside(-16)], [one], [0.08, 0.08]),
        ([], [one], []), ([BEHIND], [one], [0]), ([BEHIND], [], [0]),
    ):  # fmt: skip
        found = smoothing_variances(np.array(means, np.float32).reshape(-1, 3), cameras)
        expected = FILTER_VARIANCE * (np.array(depths) / 120) ** 2
        np.testing.assert_allclose(found, expected, rtol=1e-4, err_msg=f"{means} from {len(cameras)}")


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


def test_the_filter_stays_as_narrow_as_the_nearest_look_was() -> None:
    """From farther away nothing is forgotten of what was seen from near by; and what the camera does not see
    keeps its filter: from elsewhere all of it, from near by half of the tissue."""
    observation = pictured_wall(texture())
    mapper = Mapper(CpuRefiner(partial(make_rasterizer, "numba")), TissueMap(3000))
    mapper.update(observation, None, StepBudget(0))
    model = mapper.model
    hidden = dataclasses.replace(observation, tissue=np.zeros((SIDE, SIDE), bool))
    before, means = model.smoothing.copy(), model.means.copy()
    for place, depth in ((0, 0, -0.08), 2), ((1.0, 0, 0), 1), ((0, 0, 0.06), 1):
        camera = moved(observation.camera, np.array(place))
        looked = dataclasses.replace(hidden, camera=camera, depth=depth * observation.depth)
        mapper.update(looked, None, StepBudget(0))
        np.testing.assert_array_equal(model.means, means)
        pixels, _ = project(camera, means)
        outside = (np.abs(pixels - SIDE / 2) > 0.7 * SIDE).any(1)  # farther than the margin
        unchanged = outside if place[2] > 0 else np.ones_like(outside)
        np.testing.assert_array_equal(model.smoothing[unchanged], before[unchanged])
    inside = (np.abs(pixels - SIDE / 2) < 0.5 * SIDE).all(1)
    assert outside.mean() > 0.3 and inside.any()
    np.testing.assert_allclose(model.smoothing[inside], before[inside] / 16, rtol=0.1)
