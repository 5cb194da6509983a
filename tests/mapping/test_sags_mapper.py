"""The paper's model learnt while the video runs, on the phantom, whose truth is known."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from places import SESSION

from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import UsageError
from sags_node.geometry import project
from sags_node.kernels.threads import configure_threads, thread_count
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.ladder import Rung
from sags_node.mapping.sags_mapper import FORGOTTEN_NS, KEPT_NS, WINDOW_NS, SagsMapper
from sags_node.model import columns
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.pipeline.session import open_posed, open_session
from sags_node.quality.metrics import as_float, psnr
from sags_node.types import F32, Camera, FrameResult, StereoFrame

RUNG = Rung(12_000)
SAGS = "mapping.method:=sags"


def pipeline_of(folder: Path, *overrides: str) -> tuple[Pipeline, list[StereoFrame]]:
    session = open_session(folder, ["source.pace:=step", SAGS, *overrides])
    with open_posed(session.config, session.rig) as source:
        return Pipeline(session.config, session.rig), list(source)


def mapper_of(pipeline: Pipeline) -> SagsMapper:
    assert isinstance(pipeline.mapper, SagsMapper)
    return pipeline.mapper


def played(pipeline: Pipeline, frames: Sequence[StereoFrame], steps: int = 4) -> list[FrameResult]:
    budget = StepBudget(steps, RUNG)
    return [pipeline.process(frame, budget, FrameRequest(right=True)) for frame in frames]


def picture_at(pipeline: Pipeline, t_ns: int, camera: Camera) -> F32:
    gaussians = mapper_of(pipeline).at(t_ns, [camera])
    return colours_of(make_rasterizer("numba", camera.width, camera.height).forward(gaussians, camera))


def quality(picture: F32, result: FrameResult) -> float:
    return psnr(picture, as_float(result.observation.image), result.observation.tissue)


@pytest.fixture(scope="module")
def lift(phantom_session: Path) -> tuple[Pipeline, list[StereoFrame], list[FrameResult]]:
    """Two seconds of the phantom."""
    configure_threads(None)
    pipeline, taken = pipeline_of(phantom_session, "source.frames:=20")
    return pipeline, taken, played(pipeline, taken)


Lift = tuple[Pipeline, list[StereoFrame], list[FrameResult]]


def test_its_picture_is_better_than_the_one_before_shown_again(lift: Lift) -> None:
    _, _, results = lift
    shown = [quality(as_float(each.views["left"].rgb), each) for each in results[1:]]
    again = [quality(as_float(before.observation.image), each) for before, each in pairwise(results)]
    assert np.mean(shown) > np.mean(again)


def test_asked_for_an_earlier_time_it_shows_that_frame_better_than_it_shows_the_newest(lift: Lift) -> None:
    pipeline, _, results = lift
    newest, camera = results[-1], results[-1].snapshot.camera
    now = picture_at(pipeline, newest.snapshot.t_capture_ns, camera)
    gains = [
        quality(picture_at(pipeline, each.snapshot.t_capture_ns, camera), each) - quality(now, each)
        for each in results[2:-5]
    ]
    assert np.mean(np.array(gains) > 0) > 0.9


def test_both_eyes_velocities_and_depth_are_published(lift: Lift) -> None:
    _, _, results = lift
    for each in results[5:]:
        assert {"left", "right"} == set(each.views)
        drawn, known = each.views["left"].depth, each.observation.depth
        both = (drawn > 0) & (known > 0)
        assert both.mean() > 0.5 and np.median(np.abs(drawn - known)[both]) < 0.02 * np.median(known[both])
        assert np.isfinite(each.snapshot.velocities).all()
        assert len(np.unique(each.snapshot.gaussians.ids)) == len(each.snapshot.gaussians)


def test_anchors_go_with_the_tissue(phantom_session: Path) -> None:
    """They are off by less than half of how far it moved."""
    pipeline, taken = pipeline_of(phantom_session, "source.frames:=20")
    budget = StepBudget(4, RUNG)
    first = pipeline.process(taken[0], budget)
    reference = taken[0].reference
    pixels, _ = project(first.snapshot.camera, reference.points)
    ids = {}
    for point in np.flatnonzero(reference.points_visible):
        u, v = pixels[point]
        inside = 20 < u < first.snapshot.camera.width - 20 and 20 < v < first.snapshot.camera.height - 20
        if inside and first.observation.tissue[round(v), round(u)]:
            ids[point] = pipeline.anchors.add_point(
                reference.points[point], first.observation, first.snapshot, first.views["left"]
            )
    off, moved = [], []
    for frame in taken[1:]:
        result = pipeline.process(frame, budget)
        found = dict(zip(result.anchors.ids.tolist(), result.anchors.points, strict=True))
        for point, anchor in ids.items():
            off.append(np.linalg.norm(found[anchor] - frame.reference.points[point]))
            moved.append(np.linalg.norm(frame.reference.points[point] - reference.points[point]))
    assert len(ids) >= 10
    assert np.nanmean(off) < 0.5 * np.mean(moved)


def test_two_runs_give_the_same_bits_whatever_the_number_of_threads() -> None:
    threads = thread_count()
    runs = []
    for count in (None, 1):
        configure_threads(count)
        pipeline, frames = pipeline_of(SESSION, "source.frames:=6")
        runs.append(played(pipeline, frames, steps=2))
    configure_threads(threads)
    for a, b in zip(*runs, strict=True):
        for name in ("means", "quats", "scales", "opacities", "colors", "ids"):
            assert np.array_equal(getattr(a.snapshot.gaussians, name), getattr(b.snapshot.gaussians, name))
        assert np.array_equal(a.snapshot.velocities, b.snapshot.velocities)
        assert np.array_equal(a.views["right"].rgb, b.views["right"].rgb)


def test_over_eight_windows_nothing_grows(phantom_session: Path) -> None:
    small = ["vision.width:=96", "vision.height:=76", "source.loop:=true", "source.frames:=160"]
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
    assert quality(as_float(after.views["left"].rgb), after) > 25
    pose = np.eye(4)
    pose[2, 3] = 1.0  # m: nothing of the model is in view from there
    moved = [replace(each, T_world_cam=pose) for each in taken[6:]]
    elsewhere = played(pipeline, moved)[-1]
    assert elsewhere.epoch == after.epoch + 1
    assert quality(as_float(elsewhere.views["left"].rgb), elsewhere) > 25


@pytest.mark.parametrize(
    ("which", "value"),
    [(slice(None), np.nan), (columns.COLOR, 10)],  # one step takes nine tenths off: it stays white
    ids=["it is damaged", "one colour would show more"],
)
def test_a_bad_model_is_made_anew_before_it_is_shown(
    phantom_session: Path, which: slice, value: float
) -> None:
    """Beside it every later image would seem too dark, too bright or of another scene, and be held."""
    pipeline, taken = pipeline_of(phantom_session, "source.frames:=8")
    before = played(pipeline, taken[:6])[-1]
    mapper_of(pipeline).field.table[:, which] = value
    after, later = played(pipeline, taken[6:], steps=1)
    assert after.epoch == later.epoch == before.epoch + 1
    assert quality(as_float(after.views["left"].rgb), after) > 25
    assert not later.held and quality(as_float(later.views["left"].rgb), later) > 25


@pytest.mark.filterwarnings("error")
def test_what_walked_away_in_a_long_session_is_brought_back(phantom_session: Path) -> None:
    """A scale of exp(-200) m is 0 in float32, one of exp(50) m infinite."""
    pipeline, taken = pipeline_of(phantom_session, "source.frames:=8")
    played(pipeline, taken[:6])
    mapper = mapper_of(pipeline)
    mapper.field.table[::9, columns.LOG_SCALE] = -200
    mapper.field.table[::200, columns.LOG_SCALE] = 50
    later = [replace(each, t_capture_ns=each.t_capture_ns + WINDOW_NS) for each in taken[6:]]
    result = played(pipeline, later)[-1]
    least, most = np.exp(columns.LOG_SCALE_RANGE)
    assert least / 2 < mapper.model.scales.min()  # four steps were taken since they were brought back
    assert mapper.model.scales.max() < 2 * most
    assert quality(as_float(result.views["left"].rgb), result) > 25


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


def test_a_clock_that_goes_back_stops_nothing(phantom_session: Path) -> None:
    pipeline, taken = pipeline_of(phantom_session, "source.frames:=12")
    played(pipeline, taken[:6])
    earlier = [replace(each, t_capture_ns=each.t_capture_ns - 10 * WINDOW_NS) for each in taken[6:]]
    last = played(pipeline, earlier)[-1]
    assert quality(as_float(last.views["left"].rgb), last) > 25


def test_the_colours_follow_a_jump_of_the_exposure(phantom_session: Path) -> None:
    pipeline, taken = pipeline_of(phantom_session, "source.frames:=7")
    played(pipeline, taken[:6])
    darker = replace(
        taken[6], left=(0.8 * taken[6].left).astype(np.uint8), right=(0.8 * taken[6].right).astype(np.uint8)
    )
    result = played(pipeline, [darker], steps=0)[0]
    assert quality(as_float(result.views["left"].rgb), result) > 25


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("vision.pose:=estimate", "vision.pose estimate"),
        ("mapping.field:=true", "control nodes"),
        ("device:=cuda", "CPU"),
    ],
)
def test_what_does_not_work_with_it_is_refused_at_the_start(
    phantom_session: Path, override: str, said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        open_session(phantom_session, [SAGS, override])
