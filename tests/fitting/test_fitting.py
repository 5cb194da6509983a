"""The offline fit on a short phantom session: it learns, stops, goes on, and says what is wrong."""

import dataclasses
import io
import json
import signal
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import cv2
import numpy as np
import pytest
import torch
from command_line import figures_of, refused, sags
from endonerf_clip import write_clip
from splat_files import splats_of

from sags_node.cli import fit_folder
from sags_node.cli.fit_folder import fit_verdict
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import SagsError, UsageError
from sags_node.field.losses import LossWeights, compare
from sags_node.field.model import FADE_NS, LOOK_BACK_NS, DeformableModel
from sags_node.files import alone
from sags_node.geometry import quat_to_matrix, transform
from sags_node.kernels.threads import configure_threads
from sags_node.model import columns
from sags_node.pipeline.session import open_session
from sags_node.quality.metrics import psnr
from sags_node.tools.export.scene import from_fit
from sags_node.tools.fitting import checkpoint, residuals, start
from sags_node.tools.fitting.clip import Clip, ClipFrame, play, read_clip
from sags_node.tools.fitting.density import quarter
from sags_node.tools.fitting.fit import FITTING, Fit
from sags_node.tools.fitting.midway import midway_frames
from sags_node.tools.fitting.outlook import Outlook
from sags_node.tools.fitting.refined import RefinedModel
from sags_node.tools.fitting.score import score, score_between, score_depth, score_tracks
from sags_node.tools.fitting.settings import FieldShape, FitSettings, Growth, RowRates, Units, path_frames
from sags_node.tools.fitting.start import follow_online
from sags_node.types import F32

SMALL = FitSettings(
    iterations=120, max_gaussians=1000, shape=FieldShape(cells=16, channels=16, frames_per_slot=12 / 7)
)
PAPER = dataclasses.replace(SMALL, schedule="paper", warm_up=60)
STEEP = dataclasses.replace(
    PAPER, slopes=True, color_softness=0.15, growth=Growth(first=800, every=4, until=0.7)
)
QUICK_PATHS = 300  # steps of the regression: twelve frames are learnt sooner than a clip
FRAMES = ["source.pace:=step", "source.loop:=false", "source.frames:=12"]
QUARTER = ["vision.width:=160", "vision.height:=128"]  # of the pixels, where no length is measured


def held_out(frame_id: int) -> bool:
    return frame_id in (3, 8)


def turned(frames: Sequence[ClipFrame]) -> list[ClipFrame]:
    """Another scene."""
    return [
        dataclasses.replace(frame, image=np.ascontiguousarray(255 - frame.image[::-1])) for frame in frames
    ]


def quietly(what: str, done: int, of: int) -> None:
    """No progress shown."""


@pytest.fixture(autouse=True)
def short_regression(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing is said of the paths they are not learnt, which is most of a fit's time."""
    monkeypatch.setattr(start, "PATH_STEPS", 1)


@pytest.fixture
def learnt_paths(short_regression: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start, "PATH_STEPS", QUICK_PATHS)


@pytest.fixture(scope="module")
def whole(phantom_session: Path) -> Clip:
    return read_clip(open_session(phantom_session, FRAMES), held_out)


@pytest.fixture(scope="module")
def clip(phantom_session: Path) -> Clip:
    configure_threads(None)
    return read_clip(open_session(phantom_session, [*FRAMES, *QUARTER]), held_out)


def begun(clip: Clip, settings: FitSettings) -> Fit:
    fit = Fit(clip, settings)
    fit.start(quietly)
    return fit


def ended(fit: Fit, at: int | None = None) -> Fit:
    while not fit.done and (at is None or fit.iteration < at):
        fit.iterate()
    return fit


def fitted(clip: Clip, settings: FitSettings, at: int | None = None) -> Fit:
    return ended(begun(clip, settings), at)


def decibels(fit: Fit, frame: ClipFrame) -> float:
    return float(score(fit, [frame], {})["psnr"])


def assert_same_bits(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    for name in wanted:
        np.testing.assert_array_equal(found[name], wanted[name], err_msg=name)


@pytest.fixture(scope="module")
def before_and_refined(whole: Clip) -> tuple[dict[str, Any], Fit]:
    """A fit from an online start, and how good it was before its first iteration."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(start, "PATH_STEPS", QUICK_PATHS)
        fit = begun(whole, dataclasses.replace(SMALL, max_gaussians=3000))
    before = score(fit, whole.test, {})
    return before, ended(fit)


@pytest.fixture
def refined(before_and_refined: tuple[dict[str, Any], Fit]) -> Fit:
    return before_and_refined[1]


def test_a_clip_is_split_and_whole(clip: Clip) -> None:
    assert [frame.frame_id for frame in clip.test] == [3, 8]
    assert [frame.frame_id for frame in clip.train] == [0, 1, 2, 4, 5, 6, 7, 9, 10, 11]
    frame = clip.train[0]
    assert frame.image.dtype == np.uint8 and frame.image.shape == (*frame.tissue.shape, 3)
    assert not frame.depth[~frame.tissue].any()
    assert frame.reference is not None and frame.reference.depth is not None


@pytest.mark.fault("launch file: a fit is told to estimate the pose")
def test_the_cameras_pose_is_the_one_that_was_asked_for() -> None:
    """Recorded, or fixed: then points are where that camera sees them. What a fit cannot do is refused."""
    moving = ["seconds:=1", "width:=160", "height:=128", "camera_motion:=sway", "frames:=3", "pace:=step"]

    def played(way: str) -> list[ClipFrame]:
        options = [*(f"source.{each}" for each in moving), "source.loop:=false", f"vision.pose:={way}"]
        return list(play(open_session(None, options), references=True))

    followed, fixed = played("session")[-1], played("fixed")[-1]
    pose = followed.camera.T_world_cam
    assert np.abs(pose[:3, 3]).max() > 1e-4 and np.array_equal(fixed.camera.T_world_cam, np.eye(4))
    assert followed.reference is not None and fixed.reference is not None
    assert fixed.reference.points is not None and followed.reference.points is not None
    np.testing.assert_allclose(transform(pose, fixed.reference.points), followed.reference.points, atol=1e-9)
    for way in ("estimate", "refine"):
        with pytest.raises(UsageError, match=rf"vision\.pose {way} .*vision\.pose:=session.* or fixed"):
            played(way)


@pytest.mark.parametrize("tokens", ["self", "nodes"])
def test_a_fit_learns_frames_it_never_saw(clip: Clip, tokens: Any) -> None:
    fit = begun(clip, dataclasses.replace(PAPER, tokens=tokens, iterations=240))
    before = score(fit, clip.test, {})
    after = score(ended(fit), clip.test, {})
    assert after["psnr"] > before["psnr"] + 2
    assert after["ssim"] > before["ssim"]


def test_papers_count_with_the_masks_as_they_were_given(whole: Clip, phantom_session: Path) -> None:
    """The margin around instruments, where errors are largest, does not count as perfect."""
    plain = open_session(phantom_session, [*FRAMES[:2], "source.frames:=4", "vision.tissue.dilate:=0"])
    given, frame = read_clip(plain, held_out).test[0].tissue, whole.test[0]
    assert frame.tissue.sum() < given.sum() < given.size
    fit = begun(whole, PAPER)
    shown = colours_of(fit.rasterizer.forward(fit.gaussians(frame), frame.camera))
    errors = (shown - frame.image / np.float32(255)) * given[..., None]
    found = score(fit, [frame], {})
    assert found["paper_psnr"] == pytest.approx(-10 * np.log10(np.mean(errors**2)), abs=1e-3)
    assert found["psnr"] == pytest.approx(psnr(shown, frame.image / np.float32(255), frame.tissue), abs=1e-3)


def test_each_part_of_the_method_has_its_share_in_the_result(clip: Clip) -> None:
    """The self-adaptive block, and both filters. The same settings twice give the same image."""
    frame = clip.test[0]

    def drawn(**changed: Any) -> F32:
        fit = fitted(clip, dataclasses.replace(PAPER, warm_up=3, iterations=20, **changed))
        return fit.rasterizer.forward(fit.gaussians(frame), frame.camera)[:3, frame.tissue]

    whole, alone = drawn(), drawn(tokens="self")
    assert np.array_equal(drawn(), whole)
    beyond_rounding = 100 * np.finfo(np.float32).eps
    assert np.abs(drawn(block="none") - whole).mean() > beyond_rounding
    assert np.abs(drawn(antialias=False) - whole).mean() > beyond_rounding
    assert np.abs(drawn(tokens="self", block="mlp") - alone).mean() > beyond_rounding


def test_a_part_without_a_unit_is_not_deformed(clip: Clip) -> None:
    """Last layers that start at random deform from the first step on."""
    shape = dataclasses.replace(SMALL.shape, units=Units(color=0), xavier=True)
    fit = begun(clip, dataclasses.replace(PAPER, shape=shape))
    change = (fit.model.rows_at(clip.train[3].t_capture_ns) - fit.model.rows).detach().numpy()
    assert np.abs(change[:, columns.MEAN]).max() > 1e-5  # m
    assert np.abs(change[:, columns.LOGIT]).max() > 1e-3
    assert not change[:, columns.COLOR].any()


def test_of_one_frame_no_motion_is_learnt(clip: Clip) -> None:
    """Which took minutes."""
    told: list[str] = []
    one = dataclasses.replace(clip, train=clip.train[:1], test=())
    Fit(one, SMALL).start(lambda what, done, of: told.append(what))
    assert told and "learning the paths" not in told


@pytest.mark.usefixtures("learnt_paths")
@pytest.mark.parametrize("tokens", ["self", "nodes"])
def test_an_online_start_is_what_the_mapper_saw(clip: Clip, tokens: Any) -> None:
    settings = dataclasses.replace(SMALL, tokens=tokens)
    fit = begun(clip, settings)
    rows, _, paths = follow_online(clip, fit.rasterizer, fit.model.exposure, settings, quietly)
    assert list(paths.times_ns) == [clip.train[t].t_capture_ns for t in (0, 3, 6, 9)]
    np.testing.assert_array_equal(rows, fit.model.table)
    assert isinstance(fit.model, RefinedModel)
    residuals = fit.model.residuals
    still, learnt = [], []
    for t, time_ns in enumerate(paths.times_ns.tolist()):
        field = fit.model.field.deform(fit.model.rows, time_ns).detach().numpy()
        known, states = paths.known[t], paths.states[t]
        whole = field + residuals.at(time_ns)
        np.testing.assert_allclose(whole[known], states[known], atol=1e-5)
        assert (whole[~known, columns.LOGIT] < -1).all()  # hidden
        still.append(np.abs(rows[known, columns.MEAN] - states[known, columns.MEAN]).mean())
        learnt.append(np.abs(field[known, columns.MEAN] - states[known, columns.MEAN]).mean())
    assert np.mean(learnt[1:]) < 0.5 * np.mean(still[1:])  # most of the motion is the field's


def test_refining_an_online_start_helps_frames_it_never_saw(
    whole: Clip, before_and_refined: tuple[dict[str, Any], Fit]
) -> None:
    before, fit = before_and_refined
    after, depth = score(fit, whole.test, {}), score_depth(fit, whole.test, {"first": (0, 5)})
    assert after["psnr"] > before["psnr"] + 0.2
    assert after["ssim"] > before["ssim"]
    assert depth is not None and depth["frames"] == 2 and depth["first"]["frames"] == 1
    assert depth["median_mm"] < 0.6 and depth["coverage"] > 0.98


def test_gaussians_stay_on_their_tissue(whole: Clip, refined: Fit) -> None:
    frames = sorted((*whole.train, *whole.test), key=lambda frame: frame.frame_id)
    tracks = score_tracks(refined, frames)
    assert tracks is not None
    assert 0 < tracks["median_mm"] < 0.5
    bare = [dataclasses.replace(frame, reference=None) for frame in frames]
    assert score_tracks(refined, bare) is None


def test_between_two_frames_the_model_goes_straight(whole: Clip, refined: Fit) -> None:
    frame = whole.test[0]
    around = whole.around(frame.t_capture_ns)
    assert around is not None and [near.frame_id for near in around] == [2, 4]
    before, after = (refined.gaussians(near).means for near in around)
    begin, end = (near.t_capture_ns for near in around)
    between = before + (frame.t_capture_ns - begin) / (end - begin) * (after - before)
    np.testing.assert_allclose(refined.gaussians(frame).means, between, rtol=0, atol=1e-7)
    first, last = whole.train[0].t_capture_ns, whole.train[-1].t_capture_ns
    assert [whole.around(t_ns) for t_ns in (first - 1, whole.train[3].t_capture_ns, last + 1)] == [None] * 3


def test_pictures_carried_along_the_motion_beat_their_mean(whole: Clip, refined: Fit) -> None:
    """The phantom's tissue moves all the time, so that the mean of two images is blurred."""
    found = score_between(refined, whole.test, {"first": (0, 5)})
    assert found is not None
    carried, mean = found["carried"], found["mean"]
    assert carried["frames"] == mean["frames"] == 2 and carried["first"]["frames"] == 1
    assert carried["psnr"] > mean["psnr"] + 0.5
    before, after = (frame.image / np.float32(255) for frame in (whole.train[2], whole.train[3]))
    frame = whole.test[0]
    by_hand = psnr(before / 2 + after / 2, frame.image / np.float32(255), frame.tissue)
    assert mean["first"]["psnr"] == pytest.approx(by_hand, abs=0.01)
    assert score_between(refined, whole.train, {}) is None


def test_a_picture_half_way_shows_the_tissue_where_it_was(whole: Clip) -> None:
    """Frame 3 from frames 0 and 6, between which the tissue moves by some pixels; the scope does not."""
    truth, before, after = whole.test[0], whole.train[0], whole.train[5]
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = cv2.Rodrigues(np.array([0, 0.2, 0]))[0], (0.1, 0, 0)
    start = before.camera.T_world_cam
    moved = dataclasses.replace(after.camera, T_world_cam=start @ turn)
    (found,) = midway_frames([before, dataclasses.replace(after, camera=moved)])
    half = np.linalg.inv(start) @ found.camera.T_world_cam
    np.testing.assert_allclose(cv2.Rodrigues(half[:3, :3])[0].ravel(), (0, 0.1, 0), atol=1e-9)
    np.testing.assert_allclose(half[:3, 3], (0.05, 0, 0), atol=1e-9)
    assert found.t_capture_ns == pytest.approx(truth.t_capture_ns, abs=1e6)
    assert found.tissue[~before.tissue & ~after.tissue].mean() < 0.02  # of an instrument that stays
    seen, of = found.tissue & truth.tissue, np.float32(255)
    assert seen.sum() > 0.9 * truth.tissue.sum()
    mean = np.mean([before.image, after.image], axis=0, dtype=np.float32)
    shown, by_hand = (psnr(image / of, truth.image / of, seen) for image in (found.image, mean))
    assert shown > by_hand + 1
    known = seen & (found.depth > 0) & (truth.depth > 0)
    assert np.median(np.abs(found.depth - truth.depth)[known]) < 5e-4  # m


@pytest.mark.fault("frames: a cut, or some are missing, in what a fit learns")
def test_no_picture_is_made_half_way_across_a_cut_or_a_gap(clip: Clip) -> None:
    """Nothing says what lay between. One frame that is missing beside one held out is no gap."""
    frames = [*clip.train[:3], *clip.train[4:]]

    def between(others: list[ClipFrame]) -> list[int]:
        return [frame.frame_id for frame in midway_frames(others)]

    assert between(frames) == [frame.frame_id for frame in frames[:-1]]
    later = [dataclasses.replace(each, t_capture_ns=each.t_capture_ns + 10**9) for each in frames[5:]]
    for rest in (turned(frames[5:]), later):
        assert between([*frames[:5], *rest]) == [frame.frame_id for frame in (*frames[:4], *frames[5:-1])]
    assert between(frames[:1]) == []


def test_an_iteration_of_several_frames_descends_on_all_of_them(clip: Clip) -> None:
    """The first step of Adam goes by the sign of the gradient: that of the frames' losses together."""
    settings = dataclasses.replace(PAPER, warm_up=0, iterations=1, batch_size=len(clip.train))
    fit = begun(clip, settings)
    model, unseen = fit.model, ~np.any([frame.tissue for frame in clip.train], axis=0)
    slopes = []
    for frame in clip.train:
        drawing = model.draw(fit.rasterizer, frame.t_capture_ns, frame.camera)
        given = frame.image, frame.tissue, frame.depth, unseen, settings.weights
        drawing.differentiate(compare(drawing.planes, *given).loss, np.ones(frame.tissue.shape, np.float32))
        assert model.rows.grad is not None
        slopes.append(model.rows.grad.numpy().copy())  # summed up
    moved = fitted(clip, settings).model.table - model.table
    seen = moved.any(axis=1)  # others lie where there is no tissue
    clear = seen[:, None] & (np.abs(slopes[-1]) > 1e-3 * np.abs(slopes[-1]).max(axis=0))
    assert seen.mean() > 0.99
    assert (np.sign(moved) == -np.sign(slopes[-1]))[clear].all()
    assert (np.sign(moved) != -np.sign(slopes[0]))[clear].any()  # not those of one frame


def test_the_step_on_colours_and_slopes_makes_no_picture_worse(clip: Clip) -> None:
    """By its bound (`mapping.optimiser.Optimiser`), without a rate that somebody chose; slopes show more."""
    still, alone = RowRates(0, 0, 0, 0, 0), LossWeights(inverse_depth=0, smoothness=0, depth_smoothness=0)
    settings = dataclasses.replace(
        PAPER, warm_up=40, iterations=0, rates=still, weights=alone, color_softness=0.15, slopes=True,
        max_gaussians=800,
    )  # fmt: skip
    fit, residuals = begun(clip, settings), []
    while not fit.done:
        fit.iterate()
        residuals.append(fit.residual)
    assert (np.diff(residuals) < 1e-6).all() and residuals[-1] < residuals[0]
    frame, model = clip.train[0], fit.model
    learnt = decibels(fit, frame)
    assert model.slopes is not None
    model.slopes.detach()[:] = 0
    assert decibels(fit, frame) < learnt


def test_the_number_of_gaussians_stays_under_its_cap(clip: Clip) -> None:
    often = dataclasses.replace(PAPER.growth, every=10)
    fit = begun(clip, dataclasses.replace(PAPER, max_gaussians=700, warm_up=10, iterations=100, growth=often))
    fit.model.keep(np.arange(len(fit.model)) < 500)  # room to grow
    fit = _restarted(fit)
    while not fit.done:
        fit.iterate()
        assert len(fit.model) <= 700
    assert fit.split > 0 and len(np.unique(fit.model.ids)) == len(fit.model)


def _restarted(fit: Fit) -> Fit:
    """The same fit, whose density counts begin anew with the Gaussians there are."""
    arrays = fit.arrays()
    arrays["pull"], arrays["seen"] = np.zeros(len(fit.model), np.float32), np.zeros(len(fit.model), np.int64)
    other = Fit(fit.clip, fit.settings)
    other.restore(fit.state(), arrays)
    return other


def test_four_for_one_have_its_place_and_its_colours(clip: Clip) -> None:
    settings = dataclasses.replace(STEEP, coarse=1.0)
    fit = fitted(clip, settings, at=settings.warm_up + settings.iterations - 1)
    learning = _restarted(fit)
    before, count, model = score(fit, clip.test, {})["psnr"], len(fit.model), fit.model
    assert model.slopes is not None
    parents, slopes = model.table.copy(), model.slopes.detach().numpy().copy()
    quarter(model)
    assert len(np.unique(model.ids)) == 4 * count
    family = model.table.reshape(4, count, -1)
    np.testing.assert_allclose(family[..., columns.MEAN].mean(0), parents[:, columns.MEAN], atol=1e-7)
    np.testing.assert_allclose(family[..., columns.COLOR].mean(0), parents[:, columns.COLOR], atol=1e-6)
    areas = (parents - family)[..., columns.LOG_SCALE].sum(2)
    np.testing.assert_allclose(areas, np.log(4), rtol=1e-5)
    axes, scales = quat_to_matrix(parents[:, columns.QUAT]), np.exp(parents[:, columns.LOG_SCALE])
    away = np.einsum("nij,fni->fnj", axes, (family - parents)[..., columns.MEAN]) / scales
    steeper = (away * slopes).sum(2, keepdims=True)  # as `types.Gaussians` says
    np.testing.assert_allclose((family - parents)[..., columns.COLOR], steeper.repeat(3, 2), atol=1e-4)
    assert len(ended(learning).model) == 4 * count <= settings.max_gaussians
    assert score(learning, clip.test, {})["psnr"] > before + 1


@pytest.mark.parametrize(
    "settings",
    [
        SMALL,
        dataclasses.replace(PAPER, tokens="nodes"),
        STEEP,
        dataclasses.replace(PAPER, slopes=True, color_softness=0.15, coarse=0.5),
        dataclasses.replace(PAPER, midway=True),
    ],
    ids=["self", "nodes", "slopes", "coarse", "midway"],
)
def test_a_resumed_fit_gives_the_same_bits(clip: Clip, settings: FitSettings, tmp_path: Path) -> None:
    """Also where Gaussians were split, and where somebody asked how long the rest takes."""
    settings = dataclasses.replace(settings, iterations=20, warm_up=5)
    whole = fitted(clip, settings, at=9)
    checkpoint.save(whole, tmp_path / "checkpoint.npz")
    resumed = Fit(clip, settings)
    checkpoint.load(resumed, tmp_path / "checkpoint.npz")
    assert resumed.prices()[FITTING] > 0
    assert settings.growth != STEEP.growth or whole.split > 0
    assert_same_bits(ended(resumed).arrays(), ended(whole).arrays())


def test_a_core_for_each_picture_changes_no_bit(clip: Clip) -> None:
    settings = dataclasses.replace(STEEP, batch_size=3, warm_up=2, iterations=8)
    found = []
    for threads in (1, 2):
        torch.set_num_threads(configure_threads(threads))
        found.append(fitted(clip, settings).arrays())
    torch.set_num_threads(configure_threads(None))
    assert_same_bits(*found)


def test_a_checkpoint_of_another_fit_is_refused(clip: Clip, tmp_path: Path) -> None:
    path, settings = tmp_path / "checkpoint.npz", dataclasses.replace(PAPER, iterations=5, warm_up=2)
    checkpoint.save(fitted(clip, settings), path)

    def load(train: Sequence[ClipFrame] = clip.train, **changed: Any) -> None:
        checkpoint.load(Fit(Clip(train, clip.test), dataclasses.replace(settings, **changed)), path)

    with pytest.raises(UsageError, match=r"other settings \(seed\)"):
        load(seed=1)
    with pytest.raises(UsageError, match="other training frames"):
        load(clip.train[1:])
    with pytest.raises(UsageError, match=r"other images \(5 of 10, first in frame 6\);"):
        load([*clip.train[:5], *turned(clip.train[5:])])
    frame = clip.train[2]
    for what, change in {
        "times": {"t_capture_ns": frame.t_capture_ns + 5_000_000},
        "camera matrix": {"camera": dataclasses.replace(frame.camera, K=frame.camera.K * 1.01)},
        "camera poses": {"camera": frame.camera.moved_right(0.001)},
        "tissue masks": {"tissue": frame.bare},
        "depth": {"depth": frame.depth / 2},
    }.items():
        with pytest.raises(UsageError, match=rf"fitted to other {what} \(1 of 10, first in frame 2\); give"):
            load([*clip.train[:2], dataclasses.replace(frame, **change), *clip.train[3:]])
    # As another decoder rounds.
    load([dataclasses.replace(each, image=each.image - (each.image > 2)) for each in clip.train])
    whole = dict(np.load(path))
    np.savez(path, **{name: array for name, array in whole.items() if name != "cells"})
    with pytest.raises(SagsError, match=r"damaged .*cells"):
        load()
    one_array = io.BytesIO()
    np.save(one_array, np.zeros(3))
    for content in (path.read_bytes()[:1000], b"", one_array.getvalue()):
        path.write_bytes(content)
        with pytest.raises(SagsError, match="cannot resume"):
            load()


def test_the_command_leaves_model_pictures_and_figures(phantom_session: Path, tmp_path: Path) -> None:
    command = "fit", phantom_session, "source.frames:=10", "--out", tmp_path, "--iterations", "20", "--json"
    found = figures_of(*command, "--max-gaussians", "1500")
    assert json.loads((tmp_path / "figures.json").read_text()) == {"provenance": ANY} | found
    assert found["heldout"]["frames"] == found["receipt"]["frames"]["count"] == 2
    assert found["heldout"]["psnr"] > 15 and found["depth"]["median_mm"] < 10
    assert sorted(path.name for path in (tmp_path / "test").iterdir()) == ["000001.png", "000009.png"]
    in_file = len(splats_of(tmp_path / "model.ply")["x"])
    assert 0 < found["gaussians"] <= 1500
    assert found["gaussians"] < in_file <= 2 * found["gaussians"]  # steep ones in two
    again = figures_of(*command, "--max-gaussians", "1500", "--resume")
    assert again["heldout"]["psnr"] == found["heldout"]["psnr"]


def test_ctrl_c_waits_for_the_end_of_an_iteration(
    phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fit that goes on from there ends with the same bits as one that nobody disturbed."""
    options = "--schedule paper --warm-up 2 --iterations 5 --max-gaussians 300 --set coarse=0 --out".split()
    command = "fit", phantom_session, "source.frames:=8", *options
    assert sags(*command, tmp_path / "whole").exit_code == 0
    descend, calls = DeformableModel.descend, count(1)

    def interrupted(model: DeformableModel, *arguments: Any) -> None:
        if next(calls) == 4:
            signal.raise_signal(signal.SIGINT)
        descend(model, *arguments)

    with monkeypatch.context() as patched:
        patched.setattr(DeformableModel, "descend", interrupted)
        assert sags(*command, tmp_path / "broken_off").exit_code == 130 and next(calls) == 5
    assert sags(*command, tmp_path / "broken_off", "--resume").exit_code == 0
    whole, resumed = (np.load(tmp_path / name / "checkpoint.npz") for name in ("whole", "broken_off"))
    assert_same_bits(resumed, {name: whole[name] for name in whole.files if name != "about"})


def test_a_folder_is_of_one_fit(
    phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new one, also one that was interrupted, keeps nothing of the one before, and no file of somebody."""
    quick = (
        "--schedule paper --warm-up 1 --iterations 1 --max-gaussians 300 --set midway=false --set coarse=0"
    )

    def left_by(wanted: int, *arguments: str) -> set[str]:
        result = sags("fit", phantom_session, *arguments, *quick.split(), "--out", tmp_path)
        assert result.exit_code == wanted, result.output
        return {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}

    results = {"checkpoint.npz", "figures.json", "model.ply", "test/000001.png"}
    assert left_by(0, "source.frames:=10") == results | {"test/000009.png"}
    finished = (tmp_path / "figures.json").read_bytes()
    (tmp_path / "test/mine.png").touch()
    with monkeypatch.context() as patched:
        patched.setattr(Fit, "iterate", lambda self: (_ for _ in ()).throw(KeyboardInterrupt))
        assert left_by(130, "source.frames:=6") == {"checkpoint.npz", "test/mine.png"}
    session = open_session(phantom_session, [*FRAMES[:2], "source.frames:=6"])
    with pytest.raises(UsageError, match=r"there is no .*figures.json; name the folder of a finished"):
        from_fit(tmp_path, session, None, lambda done, of, what: None)
    (tmp_path / "figures.json").write_bytes(finished.replace(b'"frames": 2', b'"frames": 1'))  # as of old
    with pytest.raises(UsageError, match="not finished; go on with sags fit --resume"):
        from_fit(tmp_path, session, None, lambda done, of, what: None)
    assert left_by(0, "source.frames:=6", "--resume") == results | {"test/mine.png"}


@pytest.mark.fault("process: two fits write into one folder")
def test_a_second_fit_does_not_mix_its_files_with_the_first(phantom_session: Path, tmp_path: Path) -> None:
    said = (f"another program writes into {tmp_path}", "name another folder")
    with alone(tmp_path):
        refused(2, "fit", phantom_session, "--out", tmp_path, *FRAMES, said=said)
    assert not any(tmp_path.iterdir())


def test_a_fit_that_holds_nothing_out_says_what_it_learnt(phantom_session: Path, tmp_path: Path) -> None:
    options = f"--hold-out 0 --iterations 2 --max-gaussians 1500 --verbose --out {tmp_path}".split()
    played = ["source.frames:=4", "source.stride:=3", "segments:={late: [3, 6]}"]
    result = sags("fit", phantom_session, *played, *options)
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "figures.json").read_text())
    assert found["train"]["frames"] == 4 and found["train"]["late"]["frames"] == 2  # 3 and 6 of 0, 3, 6, 9
    assert "on frames that it was fitted to" in result.output and "kept back" not in result.output


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ("--resume", 2, "start without --resume"),
        ("--lpips-weights nothing.npz", 2, "nothing.npz"),
        ("--warm-up 7 --set batch_size=4", 2, "warm_up, batch_size would change nothing"),
        ("--monocular", 2, "--schedule paper"),
        ("source.frames:=1 vision.stereo.min_depth:=0.25", 1, "depth"),
    ],
)
def test_usage(phantom_session: Path, tmp_path: Path, arguments: str, code: int, said: str) -> None:
    command = "fit", phantom_session, *arguments.split(), "--out", tmp_path / "fit", "--iterations", 1
    refused(code, *command, said=(said,))


def test_beyond_the_last_frame_the_model_moves_on_and_comes_to_rest(whole: Clip, refined: Fit) -> None:
    model, last = refined.model, whole.train[-1]
    t_ns, cameras = last.t_capture_ns, [last.camera]

    def means(later_ns: int) -> Any:
        return model.predict(t_ns + later_ns, t_ns, cameras).means

    now = model.at(t_ns, cameras).means
    moved = model.field.deform(model.rows, t_ns) - model.field.deform(model.rows, t_ns - LOOK_BACK_NS)
    velocity = moved[:, columns.MEAN].detach().numpy() / LOOK_BACK_NS
    assert np.abs(velocity).max() * 1e9 > 1e-3  # m/s: there is something to go on with
    np.testing.assert_allclose(means(0), now, atol=1e-7)
    np.testing.assert_allclose(means(1_000_000), now + velocity * 1e6, atol=1e-6)
    np.testing.assert_allclose(means(10**12), now + velocity * FADE_NS, atol=1e-6)
    later = dataclasses.replace(last, t_capture_ns=t_ns + 30_000_000)
    np.testing.assert_array_equal(refined.gaussians(later).means, means(30_000_000))


def test_monocular_depth_is_of_the_papers_schedule(phantom_session: Path, tmp_path: Path) -> None:
    options = "--schedule paper --warm-up 2 --iterations 2 --set max_gaussians=500 --json --out".split()
    found = figures_of("fit", phantom_session, "source.frames:=6", "--monocular", *options, tmp_path)
    assert found["settings"]["weights"]["inverse_depth"] == 0
    assert 0 < found["gaussians"] <= found["cap"] == 500


@pytest.mark.usefixtures("learnt_paths")
@pytest.mark.parametrize(("schedule", "psnr"), [("online", 25), ("paper --warm-up 40", 18)])
def test_a_clip_of_a_public_data_set_is_fitted_by_its_path(tmp_path: Path, schedule: str, psnr: int) -> None:
    folder = tmp_path / "pulling"
    write_clip(folder, 10)
    options = f"--schedule {schedule} --iterations 80 --max-gaussians 2000 --json --out".split()
    found = figures_of("fit", folder, *options, tmp_path / "fit")
    assert found["session"] == "pulling" and found["depth"] is None and found["track"] is None
    for margin, said in ((2, "a margin of 2 px"), (0, "")):  # theirs learn with none
        verdict = dict(fit_verdict(found | {"published": {"SAGS": 38.3}, "margin_px": margin}))
        assert found["margin_px"] == 2 and (said or " dB") in verdict["published"]
        assert ("vision.tissue.dilate:=0" in verdict["published"]) == bool(margin)
    assert found["heldout"]["frames"] == 2 and found["heldout"]["psnr"] > psnr


def test_a_cut_in_the_recording_keeps_the_cap(clip: Clip) -> None:
    """The mapper begins anew, so that more Gaussians lived than ever at a time."""
    cut = Clip([*clip.train[:5], *turned(clip.train[5:])], clip.test)
    fit = fitted(cut, dataclasses.replace(SMALL, max_gaussians=400), at=60)
    assert len(fit.model) == 400
    for frame in (cut.train[1], cut.train[-2]):
        assert decibels(fit, frame) > 18  # two scenes share the cap


def test_little_room_is_told(phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(residuals, "MAX_BYTES", 900 * len(path_frames(5)) * columns.COUNT * 4)
    result = sags("fit", phantom_session, "source.frames:=6", "--iterations", "2", "--out", tmp_path)
    assert result.exit_code == 0 and "room for 900 Gaussians only" in result.output


@pytest.mark.fault("memory: a clip is too long for a fit")
def test_a_clip_too_long_for_its_memory_is_refused_at_once(clip: Clip) -> None:
    with pytest.raises(SagsError, match="max-gaussians"):
        fitted(clip, dataclasses.replace(SMALL, max_gaussians=5_000_000, pixels_each=0.0))


@pytest.mark.fault("memory: the images of a clip have no room")
def test_a_clip_whose_pictures_have_no_room_is_refused_before_they_are_made(
    whole: Clip, phantom_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = {"SC_PAGE_SIZE": 1, "SC_AVPHYS_PAGES": 10_000_000}
    monkeypatch.setattr("os.sysconf", lambda name: free[name])
    with pytest.raises(SagsError, match=r"give source\.frames, source\.stride or a smaller vision\.width"):
        read_clip(open_session(phantom_session, FRAMES[:2]), held_out)
    read: list[int] = []
    needed = 12 * sum(getattr(whole.train[0], key).nbytes for key in ("image", "tissue", "bare", "depth"))
    # Half of it may be used: room for all frames, but not for twice as many.
    free["SC_AVPHYS_PAGES"] = 3 * needed
    with pytest.raises(SagsError, match=r"12 frames and images half way between them .*--set midway=false"):
        read_clip(open_session(phantom_session, FRAMES), held_out, read.append, midway=True)
    assert not read
    read_clip(open_session(phantom_session, FRAMES), held_out)


def test_the_seconds_of_a_fit_are_all_that_passed_also_over_a_resumption(clip: Clip, tmp_path: Path) -> None:
    """On a clock that goes a second with each look: what lies between counts, and is not counted twice."""
    path, settings = tmp_path / "checkpoint.npz", dataclasses.replace(PAPER, warm_up=2, iterations=2)

    def resumed(first: int) -> tuple[Fit, Callable[[], int]]:
        clock = partial(next, count(first))
        fit = Fit(clip, settings, now=clock)
        checkpoint.load(fit, path)
        return fit, clock

    fit = Fit(clip, settings, now=(now := partial(next, count(100))))
    fit.start(quietly)
    fit.prices()
    fit.iterate()
    checkpoint.save(fit, path)
    assert fit.seconds == now() - 1 - 100  # the clock was last asked by `save`
    goes_on, now = resumed(9000)
    assert ended(goes_on).seconds == fit.seconds + now() - 1 - 9000
    checkpoint.save(goes_on, path)
    assert resumed(0)[0].seconds == goes_on.seconds  # nothing was left to do


def test_the_time_left_is_that_of_all_stages() -> None:
    """Steps take twice as long as was expected; one is paused for an hour."""
    steps, price = {"follow": 10, "learn": 100, "refine": 50}, {"follow": 1.0, "learn": 0.1, "refine": 0.4}
    moment, rest = 0.0, 2 * sum(steps[name] * price[name] for name in steps)
    outlook = Outlook(steps, price, lambda: moment)
    for name, of in steps.items():
        for done in range(of + 1):
            left = outlook.left(name, done)
            assert left is None if name == "follow" and done < 3 else left == pytest.approx(rest, abs=1e-9)
            if done < of:
                moment += 2 * price[name] + (3600 if done == 5 else 0)
                rest -= 2 * price[name]
    told = Outlook(steps, price, lambda: moment)
    told.expect({name: 7.0 for name in steps})  # measured
    assert told.left("learn", 40) == 7 * (60 + 50)
    outlook.expect({name: 7.0 for name in steps})
    assert outlook.left("refine", 50) == 0


@pytest.mark.usefixtures("learnt_paths")
@pytest.mark.parametrize(
    ("schedule", "stage"), [("online", "following the tissue"), ("paper --warm-up 5", "warming up")]
)
def test_the_time_a_fit_takes_is_told_before_its_first_long_stage_ends(
    phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, schedule: str, stage: str
) -> None:
    shown: list[str] = []
    left = Outlook.left

    def noted(outlook: Outlook, stage: str, done: int) -> float | None:
        shown.append(stage)
        return left(outlook, stage, done)

    monkeypatch.setattr(Outlook, "left", noted)
    monkeypatch.setattr(fit_folder, "tell", shown.append)
    options = f"--schedule {schedule} --iterations 5 --max-gaussians 500 --out {tmp_path}".split()
    assert sags("fit", phantom_session, *QUARTER, "source.frames:=8", *options).exit_code == 0
    (place,) = (number for number, said in enumerate(shown) if said.startswith("this fit takes about"))
    assert set(shown[:place]) == {stage}
    assert place < 8
