"""Splitting: identity stays, numbers stay, what is hidden stays, and the image gets better."""

from collections.abc import Callable

import numpy as np
import pytest
from recorded_session import frames_of, opened, play, psnr

from sags_node.engine.losses.pieces import LEVEL
from sags_node.engine.rasterizer.smoothing import bake_filter
from sags_node.geometry import project, unproject
from sags_node.mapping import densify, initialise, split
from sags_node.mapping.split import split_worst
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, F64, Bool, Camera, Colours, FrameResult, Observation, RenderedView

HEIGHT, WIDTH, DEPTH = 60, 80, 0.08
CAMERA = Camera(WIDTH, HEIGHT, np.array([[90.0, 0, 40], [0, 90.0, 30], [0, 0, 1]]), np.eye(4))
Played = Callable[[int, bool], tuple[F64, list[FrameResult]]]
COUNT, LARGE = 400, 7  # Gaussians, and the row of a large one in the middle of the image


class Scene:
    """A grid of small Gaussians on a plane, every tenth of which hardly shows, and a large one, turned, where
    the image is wrong."""

    def __init__(self) -> None:
        grid = np.stack(np.meshgrid(np.arange(2, WIDTH, 4), np.arange(2, HEIGHT, 3)), -1).reshape(-1, 2)
        pixels = grid[:COUNT].astype(np.float32)
        pixels[LARGE] = 40, 30
        means = unproject(CAMERA, pixels, np.full(COUNT, DEPTH, np.float32)).astype(np.float32)
        scales = np.full((COUNT, 3), 1e-3, np.float32)
        scales[LARGE] = 1e-3, 5e-3, 1e-3
        self.model = GaussianModel(COUNT + 50)
        self.model.append(means, scales, np.full((COUNT, 3), 0.5, np.float32), 0.9)
        self.model.quats[LARGE] = np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)  # 45 degrees around z
        self.model.contribution[:] = 10.0
        self.model.contribution[::10] = 0.1
        self.model.contribution[LARGE] = 60.0
        self.image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
        self.drawn = self.image * LEVEL
        self.drawn[20:41, 30:51] += 0.1
        self.tissue: Bool = np.ones((HEIGHT, WIDTH), np.bool_)
        self.depth: F32 = np.full((HEIGHT, WIDTH), DEPTH, np.float32)

    def split(self) -> int:
        alpha = np.ones((HEIGHT, WIDTH), np.float32)
        drawn = Colours(np.rint(255 * self.drawn).astype(np.uint8))
        gray = np.zeros((HEIGHT, WIDTH), np.uint8)
        observation = Observation(0, 0, CAMERA, self.image, gray, self.tissue, self.depth, alpha)
        return split_worst(self.model, observation, RenderedView(0, 0, CAMERA, drawn, self.depth, alpha), 0)


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_the_parts_cover_what_the_whole_did_and_the_middle_one_keeps_its_identity(scene: Scene) -> None:
    model = scene.model
    means, ids = model.means.copy(), model.ids.copy()
    assert scene.split() == int(split.SPLIT * COUNT) == 2
    assert model.count == COUNT and len(np.unique(model.ids)) == COUNT
    assert model.ids[LARGE] == ids[LARGE] and np.array_equal(model.means[LARGE], means[LARGE])
    assert model.scales[LARGE] == pytest.approx([1e-3, split.PART_SIZE * 5e-3, 1e-3], rel=1e-5)
    outer = np.flatnonzero((model.ids >= COUNT) & np.isclose(model.scales[:, 1], model.scales[LARGE, 1]))
    assert len(outer) == 2 and (outer % 10 == 0).all()  # in the rows of what hardly showed
    longest = np.array([-np.sin(np.pi / 4), np.cos(np.pi / 4), 0])  # the y axis, turned by 45 degrees
    away = (model.means[outer] - means[LARGE]) @ longest
    assert sorted(away) == pytest.approx([-split.APART * 5e-3, split.APART * 5e-3], rel=1e-4)
    assert model.means[outer].mean(0) == pytest.approx(means[LARGE], abs=1e-7)
    assert np.allclose(np.exp(model.log_scales), model.scales, rtol=1e-5)
    assert model.contribution[[LARGE, *outer]].sum() == pytest.approx(60.0)


@pytest.mark.parametrize("smoothing", [0.0, 1e-5])
def test_a_slope_goes_on_through_the_parts(scene: Scene, smoothing: float) -> None:
    """At the middle of each part the luminance, and how it changes for a metre, are those of the whole as it
    is drawn, with the 3D filter."""
    model = scene.model
    model.smoothing[LARGE] = smoothing
    model.slopes[LARGE] = 0, 0.1, 0
    whole, middle = bake_filter(model.gaussians()), model.means[LARGE].copy()
    per_metre = whole.slopes[LARGE, 1] / whole.scales[LARGE, 1]
    scene.split()
    parts = bake_filter(model.gaussians())
    rows = np.flatnonzero(np.abs(parts.slopes[:, 1]) > 0)
    assert len(rows) == 3 and LARGE in rows
    along = (parts.means[rows] - middle) @ np.array([-np.sin(np.pi / 4), np.cos(np.pi / 4), 0])
    np.testing.assert_allclose(parts.slopes[rows, 1] / parts.scales[rows, 1], per_metre, rtol=1e-4)
    np.testing.assert_allclose(parts.colors[rows, 0], 0.5 + per_metre * along, atol=1e-6)


def test_who_shows_is_not_given_up(scene: Scene) -> None:
    before = scene.model.ids.copy()
    for _ in range(200):
        scene.split()
    gone = np.setdiff1d(before, scene.model.ids)
    assert 0 < len(gone) and (gone % 10 == 0).all()


def below_instruments(scene: Scene) -> None:
    pixels = project(CAMERA, scene.model.means[::10])[0].round().astype(int)
    scene.tissue[pixels[:, 1], pixels[:, 0]] = False


WHY_NOT: dict[str, Callable[[Scene], object]] = {
    "what hardly shows is below instruments": below_instruments,
    "it is other tissue": lambda scene: np.multiply.at(scene.model.means, np.s_[::10], 1.2),  # along the ray
    "it is out of view": lambda scene: np.add.at(scene.model.means, np.s_[::10, 0], 1.0),
    "it is behind the camera": lambda scene: np.multiply.at(scene.model.means, np.s_[::10], -1),
    "it is new": lambda scene: scene.model.contribution[::10].fill(np.inf),
    "the picture is right": lambda scene: np.copyto(scene.drawn, scene.image * LEVEL),
    "of the model nothing is known yet": lambda scene: scene.model.contribution.fill(np.inf),
    "there is no model": lambda scene: scene.model.clear(),
}


@pytest.mark.parametrize("why", WHY_NOT)
def test_nothing_is_split_or_given_up_without_need(scene: Scene, why: str) -> None:
    WHY_NOT[why](scene)
    assert scene.split() == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_damage_is_neither_split_nor_spread(scene: Scene, value: float) -> None:
    scene.model.means[LARGE] = value
    scene.split()
    assert scene.model.scales[LARGE, 1] == pytest.approx(5e-3)
    others = np.arange(COUNT) != LARGE
    assert np.isfinite(scene.model.means[others]).all()


def count(results: list[FrameResult]) -> int:
    """Gaussians at last."""
    return len(results[-1].snapshot.gaussians)


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Played:
    """Plays a recording with so many Gaussians: PSNR* and all else, frame by frame."""

    def with_most(most: int, splits: bool) -> tuple[F64, list[FrameResult]]:
        monkeypatch.setattr(split, "split_worst", split_worst if splits else lambda *args: 0)
        session = opened(f"mapping.max_gaussians:={most}")
        results, _, _ = play(session, frames_of(session), steps=1)
        return np.array([psnr(result) for result in results]), results

    return with_most


def test_the_same_number_of_gaussians_shows_more(played: Played, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(split, "GROWN", 0.0)  # else splitting adds some as well
    (errors, results), (plain, others) = played(20_000, True), played(20_000, False)
    assert errors[5:].mean() > plain[5:].mean() + 0.15
    assert count(results) < 1.02 * count(others)


def test_a_model_grows_by_splitting_to_what_it_may_have(
    played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it does when the machine turns out to afford more: no hole asks for Gaussians then."""
    monkeypatch.setattr(initialise, "INITIAL_SHARE", 0.2)
    (errors, results), (plain, others) = played(10_000, True), played(10_000, False)
    assert split.GROWN * 10_000 - 2 <= count(results) <= 10_000  # splits stop there; what appears may go on
    # Two more for each that is split.
    assert (1 + 2 * split.GROWTH) ** len(errors) * count(others) > count(results)
    assert errors[-5:].mean() > plain[-5:].mean() + 0.2


def test_a_full_model_fills_what_is_uncovered(played: Played) -> None:
    """When an instrument leaves, new Gaussians take the place of those that hardly show; and what splitting
    brought before is not lost by it."""
    (errors, results), (plain, _) = played(2500, True), played(2500, False)
    earlier, last = results[-6], results[-1]
    assert count(results[:-5]) == 2500  # full as it leaves
    uncovered = last.observation.tissue & ~earlier.observation.tissue
    holes = last.views["left"].alpha[uncovered] < densify.HOLE_ALPHA
    assert np.count_nonzero(uncovered) > 1000 and holes.mean() < 0.1
    assert errors[5:].mean() > plain[5:].mean() - 0.1
