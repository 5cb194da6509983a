"""The paper's model learnt while the video runs, on the phantom, whose truth is known."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from recorded_session import Frames, both

from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import UsageError
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.ladder import Rung
from sags_node.mapping.sags_mapper import FORGOTTEN_NS, KEPT_NS, WINDOW_NS, SagsMapper
from sags_node.model import columns
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.pipeline.session import open_posed, open_session
from sags_node.quality.metrics import as_float, psnr
from sags_node.types import F32, FrameResult, StereoFrame

RUNG = Rung(12_000)
SAGS = "mapping.method:=sags"
Lift = tuple[SagsMapper, list[FrameResult]]
Change = Callable[[SagsMapper, Frames], Frames]


def pipeline_of(folder: Path, *overrides: str) -> tuple[Pipeline, Frames]:
    session = open_session(folder, ["source.pace:=step", SAGS, *overrides])
    with open_posed(session.config, session.rig) as source:
        return Pipeline(session.config, session.rig), list(source)


def mapper_of(pipeline: Pipeline) -> SagsMapper:
    assert isinstance(pipeline.mapper, SagsMapper)
    return pipeline.mapper


def played(pipeline: Pipeline, frames: Sequence[StereoFrame], steps: int = 4) -> list[FrameResult]:
    budget = StepBudget(steps, RUNG)
    return [pipeline.process(frame, budget, FrameRequest(right=True)) for frame in frames]


def quality(picture: F32, result: FrameResult) -> float:
    return psnr(picture, as_float(result.observation.image), result.observation.tissue)


def shown_quality(result: FrameResult) -> float:
    return quality(as_float(result.views["left"].rgb), result)


@pytest.fixture(scope="module")
def lift(phantom_session: Path) -> Lift:
    """Two seconds of the phantom."""
    configure_threads(None)
    pipeline, frames = pipeline_of(phantom_session, "source.frames:=20")
    results = played(pipeline, frames)
    for each in results:
        assert {"left", "right"} == set(each.views) and np.isfinite(each.snapshot.velocities).all()
        assert len(np.unique(each.snapshot.gaussians.ids)) == len(each.snapshot.gaussians)
    return mapper_of(pipeline), results


def test_its_picture_is_better_than_the_one_before_shown_again(lift: Lift) -> None:
    _, results = lift
    shown = [shown_quality(each) for each in results[1:]]
    again = [quality(as_float(before.observation.image), each) for before, each in pairwise(results)]
    assert np.mean(shown) > np.mean(again)


def test_asked_for_an_earlier_time_it_shows_that_frame_better_than_it_shows_the_newest(lift: Lift) -> None:
    mapper, results = lift
    camera = results[-1].snapshot.camera
    rasterizer = make_rasterizer("numba", camera.width, camera.height)

    def picture_of(result: FrameResult) -> F32:
        gaussians = mapper.at(result.snapshot.t_capture_ns, [camera])
        return colours_of(rasterizer.forward(gaussians, camera)).copy()

    now = picture_of(results[-1])
    gains = [quality(picture_of(each), each) - quality(now, each) for each in results[2:-5]]
    assert np.mean(np.array(gains) > 0) > 0.9


def test_over_four_windows_nothing_grows(phantom_session: Path) -> None:
    small = ["vision.width:=96", "vision.height:=76", "source.loop:=true", "source.frames:=80"]
    pipeline, frames = pipeline_of(phantom_session, *small)
    budget, sizes = StepBudget(1, Rung(1000)), []
    for frame in frames:
        pipeline.process(frame, budget)
        mapper = mapper_of(pipeline)
        field = mapper.field
        sizes.append((field.field.deltas.hexplane.cells.nbytes, len(field.rows), len(mapper.kept)))
        assert len(field.rows) == mapper.model.count <= 1000 + 500  # and what may appear in a frame
    cells, _, kept = zip(*sizes, strict=True)
    assert set(cells) == {cells[0]}
    assert max(kept) == round(10 * KEPT_NS * 1e-9) + 1  # both ends
    assert np.isfinite(mapper_of(pipeline).model.means).all()


def test_a_reset_and_another_place_make_a_new_model_in_a_new_epoch(phantom_session: Path) -> None:
    pipeline, taken = pipeline_of(phantom_session, "source.frames:=9")
    before = played(pipeline, taken[:3])[-1]
    pipeline.reset()
    after = played(pipeline, taken[3:6])[-1]
    assert after.epoch == before.epoch + 1
    assert after.snapshot.gaussians.ids.min() > before.snapshot.gaussians.ids.max()
    assert shown_quality(after) > 25
    pose = np.eye(4)
    pose[2, 3] = 1.0  # m: nothing of the model is in view from there
    moved = [replace(each, T_world_cam=pose) for each in taken[6:]]
    elsewhere = played(pipeline, moved)[-1]
    assert elsewhere.epoch == after.epoch + 1
    assert shown_quality(elsewhere) > 25


def set_columns(which: slice, value: float, every: int = 1) -> Change:
    def change(mapper: SagsMapper, later: Frames) -> Frames:
        mapper.field.table[::every, which] = value
        return later

    return change


def shifted(ns: int) -> Change:
    return lambda mapper, later: [replace(each, t_capture_ns=each.t_capture_ns + ns) for each in later]


def walked_away(mapper: SagsMapper, later: Frames) -> Frames:
    """A scale of exp(-200) m is 0 in float32, one of exp(50) m infinite."""
    set_columns(columns.LOG_SCALE, -200, 9)(mapper, later)
    set_columns(columns.LOG_SCALE, 50, 200)(mapper, later)
    return shifted(WINDOW_NS)(mapper, later)


@pytest.mark.parametrize(
    ("change", "steps", "new_model"),
    [
        pytest.param(set_columns(slice(None), np.nan), 1, True, id="the model is damaged"),
        # One step takes nine tenths off: it stays white. Beside it every later image would be held.
        pytest.param(set_columns(columns.COLOR, 10), 1, True, id="one colour would show more than the model"),
        pytest.param(
            walked_away, 4, False, id="values walked away in a long session",
            marks=pytest.mark.filterwarnings("error"),
        ),
        pytest.param(shifted(-10 * WINDOW_NS), 4, False, id="the clock goes back"),
        pytest.param(
            lambda mapper, later: [both(each, lambda eye: 0.8 * eye) for each in later[:1]], 0, False,
            id="the exposure jumps",
        ),
    ],
)  # fmt: skip
def test_what_happens_to_it_is_made_good_before_the_next_picture_is_shown(
    phantom_session: Path, change: Change, steps: int, new_model: bool
) -> None:
    pipeline, taken = pipeline_of(phantom_session, "source.frames:=8")
    before = played(pipeline, taken[:6])[-1]
    for result in played(pipeline, change(mapper_of(pipeline), taken[6:]), steps):
        assert result.epoch == before.epoch + new_model and not result.held
        assert shown_quality(result) > 25
    least, most = np.exp(columns.LOG_SCALE_RANGE)
    scales = mapper_of(pipeline).model.scales
    assert least / 2 < scales.min() and scales.max() < 2 * most  # some steps were taken since


def test_what_the_field_forgets_moves_nothing(phantom_session: Path) -> None:
    """After three times `FORGOTTEN_NS` the twentieth part is left of what it learnt. Before, the window has
    to be full, and then full of what it learnt last: that takes two windows."""
    pipeline, frames = pipeline_of(phantom_session, "source.frames:=7")
    last = played(pipeline, frames)[-1].observation
    mapper, budget = mapper_of(pipeline), StepBudget(0, RUNG)
    cells, before = mapper.field.field.deltas.hexplane.cells, mapper.model.means.copy()

    def unlike_the_first() -> float:
        lines = cells.detach().numpy()[mapper.field.field.deltas.hexplane.slot(0).start :]
        return float(np.abs(lines - 1).max())  # lines in time are 1 at first

    learnt = unlike_the_first()
    for each in range(1, 31):
        later = replace(last, t_capture_ns=last.t_capture_ns + each * 4 * FORGOTTEN_NS // 30)
        mapper.update(later, None, budget, learn=False)
    assert 2 * WINDOW_NS <= FORGOTTEN_NS and unlike_the_first() < 1.1 * np.exp(-3) * learnt
    assert np.abs(mapper.model.means - before).max() < 1e-5


def test_a_veiled_picture_moves_nothing_and_a_dark_one_begins_nothing(phantom_session: Path) -> None:
    pipeline, taken = pipeline_of(phantom_session, "source.frames:=5")
    dark = replace(taken[0], left=np.zeros_like(taken[0].left), right=np.zeros_like(taken[0].left))
    assert played(pipeline, [dark])[-1].snapshot.counts["inserted"] == 0
    last = played(pipeline, taken[1:4])[-1].observation
    mapper, budget = mapper_of(pipeline), StepBudget(2, RUNG)
    before = mapper.model.means.copy()
    veiled = replace(last, t_capture_ns=last.t_capture_ns + 33_000_000, image=np.full_like(last.image, 128))
    mapped = mapper.update(veiled, None, budget, learn=False)
    assert mapped.snapshot.counts["iterations"] == 0
    assert np.abs(mapped.snapshot.gaussians.means - before).max() < 1e-3


@pytest.mark.parametrize(
    ("override", "said"),
    [("vision.pose:=estimate", "pose estimate"), ("mapping.field:=true", "nodes"), ("device:=cuda", "CPU")],
)
def test_what_does_not_work_with_it_is_refused_at_the_start(
    phantom_session: Path, override: str, said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        open_session(phantom_session, [SAGS, override])
