"""The mapper's parts against known truth, and the mapper on images it must reproduce."""

from dataclasses import replace

import numpy as np
import pytest
from flat_scene import Scene, camera_in_front, flat_scene

from sags_node.mapping import densify, initialise
from sags_node.mapping.exposure import LARGEST, exposure_gain
from sags_node.mapping.motion import HALVINGS, found, scene_flow
from sags_node.mapping.surface import surface_at
from sags_node.model.gaussians import GaussianModel
from sags_node.quality.metrics import as_float
from sags_node.types import Bool, Camera, Observation
from sags_node.vision.margin import clear_of_instruments

WIDTH, HEIGHT, FOCAL, DEPTH = 64, 48, 60.0, 0.08


def camera(T: np.ndarray | None = None) -> Camera:
    return replace(camera_in_front(WIDTH, HEIGHT, FOCAL), T_world_cam=np.eye(4) if T is None else T)


def plane(depth: float, T: np.ndarray | None = None) -> Scene:
    """All of it tissue, without a model."""
    gray = np.zeros((HEIGHT, WIDTH), np.uint8)
    return flat_scene(camera(T), np.zeros((0, 3), np.float32), gray, depth, 1, 33_000_000)


def observation(depth: float = DEPTH, T: np.ndarray | None = None, seed: int = 0) -> Observation:
    image = np.random.default_rng(seed).integers(51, 205, (HEIGHT, WIDTH, 3), np.uint8)
    sure = np.ones((HEIGHT, WIDTH), np.float32)
    return replace(plane(depth, T)[0], image=image, depth_confidence=sure)


def pruned(model: GaussianModel, frame: Observation) -> Bool:
    surface = surface_at(model.means, frame)
    return densify.prune_mask(model, surface, frame.depth_is_new, model.capacity)


def grid_points(depth: float = DEPTH) -> np.ndarray:
    u, v = np.meshgrid(np.arange(8, 56, 4.0), np.arange(8, 40, 4.0))
    x = (u.ravel() - (WIDTH - 1) / 2) / FOCAL * depth
    y = (v.ravel() - (HEIGHT - 1) / 2) / FOCAL * depth
    return np.stack([x, y, np.full(x.size, depth)], 1).astype(np.float32)


def planes_of(image: np.ndarray, coverage: float, depth: float = 1.0) -> np.ndarray:
    """[5, H, W] that show an image, at that depth."""
    ones = np.ones(image.shape[:2], np.float32)
    picture = np.stack([*np.moveaxis(as_float(image), -1, 0), np.float32(depth) * ones, ones])
    return np.float32(coverage) * picture


def add_to(model: GaussianModel, points: np.ndarray) -> None:
    """Grey Gaussians of 0.2 mm."""
    size, grey = (np.full((len(points), 3), value, np.float32) for value in (2e-4, 0.5))
    model.append(points, size, grey, 0.9)


def model_of(points: np.ndarray, capacity: int | None = None) -> GaussianModel:
    model = GaussianModel(capacity or len(points))
    add_to(model, points)
    return model


def flow_by(x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """The same everywhere, px."""
    return np.full((HEIGHT, WIDTH, 2), [x, y], np.float32)


def flow_of(
    means: np.ndarray, flow: np.ndarray, after: Observation, tissue: Bool | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The scene flow from the plane, all of it `tissue` by default, to a later frame."""
    tissue = np.ones((HEIGHT, WIDTH), np.bool_) if tissue is None else tissue
    before, now = (clear_of_instruments(mask, HALVINGS) for mask in (tissue, after.tissue))
    return scene_flow(means, found(means, plane(DEPTH)[2], before, flow, now), after, 0.4)


def test_scene_flow_of_a_sideways_shift() -> None:
    moved, seen = flow_of(grid_points(), flow_by(3.0, -2.0), observation())
    assert seen.all()
    assert np.allclose(moved, [3 * DEPTH / FOCAL, -2 * DEPTH / FOCAL, 0], atol=1e-6)


def test_scene_flow_is_pulled_to_the_measured_depth_but_not_across_a_gap() -> None:
    near, _ = flow_of(grid_points(), flow_by(), observation(depth=0.082))
    assert np.all(near[:, 2] > 0.4e-3) and np.all(near[:, 2] < 1.6e-3)
    other_surface, _ = flow_of(grid_points(), flow_by(), observation(depth=0.12))
    assert np.allclose(other_surface, 0, atol=1e-7)


def test_a_moving_camera_alone_moves_no_tissue() -> None:
    """The flow that a camera motion causes must give zero displacement in the world."""
    T = np.eye(4)
    T[:3, 3] = [0.002, -0.001, 0.0]
    flow = flow_by(-0.002 * FOCAL / DEPTH, 0.001 * FOCAL / DEPTH)
    moved, seen = flow_of(grid_points(), flow, observation(T=T))
    assert seen.mean() > 0.9
    assert np.abs(moved[seen > 0]).max() < 1e-6


def test_hidden_and_covered_gaussians_are_not_seen() -> None:
    nowhere = np.zeros((HEIGHT, WIDTH), np.bool_)
    assert not flow_of(grid_points(depth=0.095), flow_by(), observation())[1].any()
    assert not flow_of(grid_points(), flow_by(), observation(), nowhere)[1].any()


def test_the_motion_of_an_instrument_is_not_taken_for_that_of_the_tissue_beside_it() -> None:
    """Flow near a mask's edge belongs to the instrument: those Gaussians follow their nodes instead."""
    flow = flow_by()
    flow[:, :32] = 5.0
    tissue = np.ones((HEIGHT, WIDTH), bool)
    tissue[:, :31] = False
    moved, seen = flow_of(grid_points(), flow, observation(), tissue)
    assert 0 < seen.sum() < len(moved) / 2
    assert np.allclose(moved[seen > 0], 0, atol=1e-7)


def test_candidates_fill_holes_first() -> None:
    frame = observation()
    planes = planes_of(frame.image, 1.0, DEPTH)
    assert len(densify.candidates(planes, frame, 0)[0]) == 0
    planes[:, 10:30, 20:40] = 0
    pixels, _, _ = densify.candidates(planes, frame, 0)
    assert len(pixels) == 25
    assert pixels.min(0).tolist() == [20, 12] and pixels.max(0).tolist() == [36, 28]


def test_a_hole_without_depth_takes_that_of_its_neighbours() -> None:
    frame = observation()
    frame.depth[:, :20] = 0
    frame.depth[:, 20:] = 0.09
    pixels, depths, _ = densify.candidates(np.zeros((5, HEIGHT, WIDTH), np.float32), frame, 0)
    assert len(pixels) == (WIDTH // 4) * (HEIGHT // 4)
    assert np.allclose(depths, 0.09)
    frame.depth[:] = 0
    assert len(densify.candidates(np.zeros((5, HEIGHT, WIDTH), np.float32), frame, 0)[0]) == 0


def test_candidates_need_residual_and_depth_to_agree_before_a_new_surface_is_believed() -> None:
    frame = observation()
    planes = planes_of(frame.image, 1.0, 1.2 * DEPTH)  # the model is far behind, but the image agrees
    assert len(densify.candidates(planes, frame, 0)[0]) == 0
    planes[:3] = 1 - planes[:3]
    planes[0] += 0.3
    assert len(densify.candidates(planes, frame, 0)[0]) > 50


def test_free_space_is_cleared_only_after_several_frames() -> None:
    model, frame = model_of(grid_points(depth=0.06), 200), observation()
    for _ in range(densify.FRONT_FRAMES - 1):
        assert not pruned(model, frame).any()
    assert pruned(model, frame).all()


def test_what_is_not_finite_or_transparent_goes_at_once_and_what_left_the_view_when_it_is_crowded() -> None:
    points = grid_points()
    model = model_of(points[:50], len(points))
    model.means[0, 1] = np.nan
    model.colors[1, 2] = np.inf
    model.opacities[2] = 0.01
    model.means[3, 0] = 1.0
    assert np.flatnonzero(pruned(model, observation())).tolist() == [0, 1, 2]
    add_to(model, points[50:])
    assert np.flatnonzero(pruned(model, observation())).tolist() == [0, 1, 2, 3]


def test_where_the_machine_affords_fewer_those_that_show_least_go_but_none_that_has_just_come() -> None:
    """What was inserted in this frame was drawn by no step yet: nobody knows how much it shows."""
    points = grid_points()
    model = model_of(np.tile(points, (5, 1)), 10 * len(points))
    old = model.count
    model.contribution[:] = np.random.default_rng(0).uniform(2, 20, old)
    add_to(model, points)
    ids, shown, area = model.ids.copy(), model.contribution.copy(), shown_area(model)
    assert densify.prune_to_budget(model, model.contribution, len(ids)) == 0
    removed = densify.prune_to_budget(model, model.contribution, old // 2)
    assert removed == len(ids) - model.count == int(densify.SHED * len(ids))
    gone = ~np.isin(ids, model.ids)
    assert not gone[old:].any()
    assert shown[:old][gone[:old]].max() <= np.sort(shown[:old])[removed - 1]
    # What is left covers as much as all did, in the share that each one shows of its area.
    assert shown_area(model) == pytest.approx(area, rel=1e-3)
    np.testing.assert_allclose(model.log_scales, np.log(model.scales), atol=1e-5)
    assert densify.prune_to_budget(model, model.contribution, model.count - 1) == 1


def test_where_the_machine_affords_fewer_hidden_tissue_stays_as_likely_as_what_is_seen() -> None:
    """A third of the image lies under an instrument: none of it shows, and each is as good as the mean. So
    is what it begins to hide, of which little shows: with each step of the instrument that would be gone."""
    points = grid_points()
    model, now, edge = model_of(points), observation(), WIDTH // 3
    columns = points[:, 0] / DEPTH * FOCAL + (WIDTH - 1) / 2
    begins = (edge - 0.5 < columns) & (columns < edge + 4)
    now.tissue[:, :edge], now.depth[:, :edge] = False, 0
    surface = surface_at(model.means, now)
    hidden = (surface[:, 0] > 0) & (surface[:, 1] == 0)
    assert 0.2 < hidden.mean() < 0.5 and begins.any() and not (begins & hidden).any()
    model.contribution[:] = np.where(hidden, 0, np.random.default_rng(0).uniform(2, 20, model.count))
    model.contribution[begins] = 1
    protected, ids = hidden | begins, model.ids.copy()
    densify.prune(model, surface, replace(now, depth_is_new=False), model.count // 2)
    gone = ~np.isin(ids, model.ids)
    assert gone.any() and not gone[protected].any()
    least = densify.least_shown(densify.shown(model, surface_at(model.means, now), now), 10)
    assert not least[np.isin(model.ids, ids[protected])].any()


def shown_area(model: GaussianModel) -> float:
    """Of those whose contribution is known: px that they would show at their size of now."""
    known = model.contribution < np.inf
    return float((model.contribution * model.scales[:, 0] ** 2)[known].sum())


def test_a_full_model_gives_up_what_shows_least_and_nothing_that_shows_much() -> None:
    prune_mask = densify.least_shown(np.linspace(10, 1, 96), 10)
    assert np.flatnonzero(prune_mask).tolist() == list(range(96 - 10, 96))
    assert not densify.least_shown(np.linspace(10, 5, 96), 10).any()


def test_first_pixels_respect_the_limit_and_the_mask_and_fill_gaps() -> None:
    frame = observation()
    frame.tissue[:, :16] = False
    frame.depth[10:20, 30:] = 0
    frame.depth[:, 60:] = 0
    pixels, depths, _, spacing = initialise.first_pixels(frame, 100)
    assert spacing == pytest.approx(np.sqrt(48 * 48 / 100))
    assert 80 <= len(pixels) <= 120
    assert pixels[:, 0].min() >= 16
    assert np.allclose(depths, DEPTH)
    frame.depth[:] = 0
    assert len(initialise.first_pixels(frame, 100)[0]) == 0


# ---- A camera whose exposure changes is still the same camera. ----


SIZE = 96
ALL = np.ones((SIZE, SIZE), bool)


# Bytes that stay whole numbers times any of the gains.
PICTURE = 20 * np.random.default_rng(0).integers(3, 8, (SIZE, SIZE, 3), np.uint8)


def test_the_gain_of_each_channel_is_found_whatever_is_new_or_bright() -> None:
    gain = np.array([1.2, 0.9, 1.05], np.float32)
    seen = np.rint(PICTURE * gain).astype(np.uint8)
    seen[:30] = 26  # something dark came in
    seen[40:50] = 255  # highlights
    assert np.allclose(exposure_gain(planes_of(PICTURE, 0.8), seen, ALL), gain, atol=1e-3)


def test_where_nothing_can_be_compared_the_gain_is_one() -> None:
    for seen, planes in (
        (PICTURE, planes_of(PICTURE, 0.1)),  # hardly anything is drawn
        (np.zeros_like(PICTURE), planes_of(PICTURE, 1.0)),  # a blackout
        (PICTURE, np.full((5, SIZE, SIZE), np.nan, np.float32)),
    ):
        assert np.array_equal(exposure_gain(planes, seen, ALL), np.ones(3, np.float32))
    bright = np.minimum(3.0 * PICTURE, 240).astype(np.uint8)
    assert exposure_gain(planes_of(PICTURE, 1.0), bright, ALL).max() <= LARGEST
