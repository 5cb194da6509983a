"""Strain of a surface: of plain motions it is known exactly."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from flat_scene import camera_in_front

from sags_node.config.schema import LaunchConfig
from sags_node.errors import SagsError
from sags_node.mapping.budget import StepBudget
from sags_node.model.strain import FULL, SURE, UNKNOWN, Strain, painted
from sags_node.phantom.instruments import NOTHING
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.pipeline.pipeline import Pipeline
from sags_node.types import F32, F64, Gaussians, Snapshot, StereoFrame

S = 1_000_000_000


def surface(count: int = 3000, bend: float = 0.0) -> Gaussians:
    """Gaussians on a patch of 60 x 60 mm, bent like a dome; sure to 1 mm."""
    xy = np.random.default_rng(0).uniform(-0.03, 0.03, (count, 2))
    means = np.column_stack([xy, 0.08 + bend * (xy**2).sum(1)]).astype(np.float32)
    ones = np.ones((count, 4), np.float32)
    return Gaussians(
        means, ones, 1e-3 * ones[:, :3], ones[:, 0], 0.5 * ones[:, :3], np.arange(count)[::-1].copy(),
        depth_errors=np.full(count, 1e-3, np.float32),
    )  # fmt: skip


def model(gaussians: Gaussians) -> Snapshot:
    return Snapshot(0, S, 0, gaussians, np.zeros_like(gaussians.means), camera_in_front(64, 64, 60.0), 0.0)


def since(gaussians: Gaussians) -> Strain:
    return Strain(model(gaussians))


def moved(gaussians: Gaussians, F: F64) -> Gaussians:
    return replace(gaussians, means=(gaussians.means @ F.T + 0.01).astype(np.float32))


TURN = cv2.Rodrigues(np.array([0.4, -0.3, 0.8]))[0]


@pytest.mark.parametrize(
    ("F", "strain"),
    [
        (TURN, (0.0, 0.0)),  # a rigid motion is none
        (TURN @ np.diag([1.2, 0.9, 1.0]), (0.2, -0.1)),
        (np.diag([0.8, 0.8, 1.0]), (-0.2, -0.2)),
        # Simple shear by 0.2: the stretches are sqrt(1 + 0.01) +- 0.1.
        (np.array([[1, 0.2, 0], [0, 1, 0], [0, 0, 1]]), (np.sqrt(1.01) - 0.9, np.sqrt(1.01) - 1.1)),
    ],
)
def test_a_plane_that_is_stretched_alike_everywhere(F: F64, strain: tuple[float, float]) -> None:
    before = surface()
    found = since(before).at(moved(before, F))
    known = np.isfinite(found[:, 0])
    assert known.mean() > 0.9
    np.testing.assert_allclose(found[known], np.broadcast_to(strain, (known.sum(), 2)), atol=1e-4)


def test_a_curved_surface_that_grows_by_a_tenth() -> None:
    before = surface(bend=4.0)
    found = since(before).at(moved(before, 1.1 * TURN))
    assert np.nanmax(np.abs(found - 0.1)) < 1e-4


def test_what_is_new_hidden_or_alone_is_not_known() -> None:
    before = surface()
    strain, now = since(before), moved(before, 1.1 * TURN)
    new = before.ids < 100
    errors = np.where(before.means[:, 0] > 0, 1.1 * SURE, 0.9 * SURE).astype(np.float32)
    found = strain.at(replace(now, ids=np.where(new, before.ids + 10_000, before.ids), depth_errors=errors))
    unknown = np.isnan(found[:, 0])
    assert unknown[new].all() and unknown[errors > SURE].all()
    assert not unknown[~new & (before.means[:, 0] < -0.005)].any()
    few = surface(5)
    assert np.isnan(since(few).at(few)).all()
    unsure = replace(before, depth_errors=np.full(len(before), 1.1 * SURE, np.float32))
    assert np.isnan(since(unsure).at(before)).all()


def test_what_was_hidden_under_way_stays_unknown_and_a_gap_forgets_nothing() -> None:
    """Behind an instrument Gaussians move by a guess: sure again, they may lie on other tissue."""
    before = surface()
    left, gap = before.means[:, 0] < -0.01, np.ones(len(before), np.bool_)
    for hidden, known in ((left, ~left), (gap, gap)):
        errors = np.where(hidden, 1.1 * SURE, 0.5 * SURE).astype(np.float32)
        under_way = replace(before, depth_errors=errors)
        strain = since(before).followed(model(under_way))
        assert np.isnan(strain.at(under_way)[hidden]).all()
        found = strain.followed(model(before)).at(before)[:, 0]
        assert np.isnan(found[~known]).all()
        assert np.isfinite(found[known & (before.means[:, 0] > 0)]).mean() > 0.9


def test_tissue_that_was_pulled_and_is_back_is_not_said_to_be_strained() -> None:
    """The phantom, pulled within half a second: what is painted looks like rest again, in 99 of 100 places
    below the middle of the scale."""
    scene = PhantomScene(seconds=4.0, width=320, height=256, seed=1)
    phantom = Phantom(scene)
    pipeline = Pipeline(LaunchConfig(source=scene), phantom.rig, rate=10)
    frames = {i: phantom.frame(i, 40, tools=NOTHING) for i in (0, *range(8, 19, 2))}
    order = [0] * 10 + [8, 10, 12, 14, 16, 18] + [18] * 3 + [16, 14, 12, 10, 8] + [0] * 10
    for number, i in enumerate(order):
        stamp = round((1 + 0.1 * number) * S)
        result = pipeline.process(
            StereoFrame(number, stamp, stamp, frames[i].left, frames[i].right), StepBudget(2)
        )
        if number == 9:
            pipeline.start_strain()
    assert result.strain is not None
    told = np.abs(result.strain.at(result.snapshot.gaussians))
    told = told[np.isfinite(told[:, 0])]
    assert len(told) > 0.3 * len(result.snapshot.gaussians)
    assert np.quantile(told, 0.99) < FULL / 2


def test_where_no_depth_is_sure_strain_is_refused_and_not_silently_unknown() -> None:
    scene = PhantomScene(seconds=1.0, width=160, height=128, seed=1)
    phantom = Phantom(scene)
    pipeline = Pipeline(LaunchConfig(source=scene), phantom.rig, rate=10)
    shown = phantom.frame(0, 10, tools=NOTHING)
    result = pipeline.process(StereoFrame(0, S, S, shown.left, shown.right), StepBudget(1))
    far_off = np.full(len(result.snapshot.gaussians), 3 * SURE, np.float32)
    unsure = replace(result.snapshot.gaussians, depth_errors=far_off)
    pipeline.newest = replace(result, snapshot=replace(result.snapshot, gaussians=unsure))
    with pytest.raises(SagsError, match=r"sure to 2 mm.*one camera"):
        pipeline.start_strain()
    assert pipeline.newest.strain is None


def test_colours_go_with_the_largest_strain_and_grey_is_not_known() -> None:
    def colour(F: F64) -> F32:
        before = surface()
        return np.median(painted(moved(before, F), since(before)).colors, 0)

    ends = cv2.applyColorMap(np.array([[0], [255]], np.uint8), cv2.COLORMAP_VIRIDIS)[:, 0, ::-1] / 255
    np.testing.assert_allclose(colour(np.eye(3)), ends[0], atol=0.01)
    np.testing.assert_allclose(colour((1 + 2 * FULL) * np.eye(3)), ends[1], atol=1e-6)
    few = surface(5)
    np.testing.assert_allclose(painted(few, since(few)).colors, np.broadcast_to(UNKNOWN, (5, 3)), atol=1e-6)
