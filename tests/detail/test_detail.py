"""Detail of images in views: the kernel beside its twin, what is learnt, remembered and shown."""

import itertools
import time
from dataclasses import replace
from pathlib import Path

import cv2
import independent_client as client
import numpy as np
import pytest
from engine_scenes import round_gaussians
from flat_scene import camera_in_front
from places import SESSION
from recorded_session import both, frames_of, opened
from running_node import RunningNode
from waiting import START_SECONDS, until

from sags_node.detail.carry import carry, coarse_camera, every_fourth, trace
from sags_node.detail.memory import EVERY, MATCHED, MOST, OLDEST, Matched, Memory, hidden_source
from sags_node.detail.motion import SmallDrawings
from sags_node.detail.seen import SAME, MatchedDepth, SeenFrame
from sags_node.detail.share import Share
from sags_node.detail.show import Detail
from sags_node.mapping.budget import StepBudget
from sags_node.messaging import published
from sags_node.messaging.content import tells_of
from sags_node.messaging.control import ControlClient
from sags_node.messaging.requests import ViewRequest
from sags_node.node import node as node_module
from sags_node.node.allowance import Allowance
from sags_node.node.views import Views
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.quality import metrics
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.session import evaluate
from sags_node.types import F32, U8, Camera, FrameResult, Gaussians, RenderedView, Shown

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
CAMERA = camera_in_front(WIDTH, HEIGHT, FOCAL)


def gaussians(count: int = 30, first_id: int = 0) -> Gaussians:
    rng = np.random.default_rng(3)
    means = rng.uniform((-0.04, -0.03, 0.1), (0.04, 0.03, 0.1), (count, 3)).astype(np.float32)
    return replace(round_gaussians(means, 0.004), ids=first_id + np.arange(count))


def seen(stamp_ns: int = 0, depth: F32 | None = None, camera: Camera = CAMERA) -> SeenFrame:
    picture: U8 = np.random.default_rng(5).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    depth = np.full((HEIGHT, WIDTH), 0.1, np.float32) if depth is None else depth
    return SeenFrame(
        stamp_ns, camera, gaussians(), lambda: picture, np.ones((HEIGHT, WIDTH), np.bool_), depth
    )


def twin(shown: U8, depth: F32, camera: Camera, source: SeenFrame, share: float) -> U8:
    """What `trace` and `carry` say they do, pixel by pixel in float64, for tissue at rest."""
    picture, out = source.picture().astype(float), shown.copy()
    for y in range(HEIGHT):
        for x in range(WIDTH):
            z = float(depth[y, x])
            point = camera.T_world_cam @ [*(np.linalg.inv(camera.K) @ [x * z, y * z, z]), 1]
            there = source.camera.K @ (source.camera.viewmat @ point)[:3]
            u, v = there[:2] / there[2]
            u, v = np.round(u, 6), np.round(v, 6)
            if not (-0.5 < u < WIDTH - 0.5 and -0.5 < v < HEIGHT - 0.5):
                continue
            cell = min(int(v + 0.5), HEIGHT - 1), min(int(u + 0.5), WIDTH - 1)
            u, v = np.clip(u, 0, WIDTH - 1), np.clip(v, 0, HEIGHT - 1)
            left, top = min(int(u), WIDTH - 2), min(int(v), HEIGHT - 2)
            if not (abs(source.depth[cell] - there[2]) < SAME * there[2]):
                continue
            s, t = u - left, v - top
            weights = np.outer((1 - t, t), (1 - s, s))
            if (weights * source.mask[top : top + 2, left : left + 2]).sum() < 0.5:
                continue
            above = picture[top, left] + s * (picture[top, left + 1] - picture[top, left])
            below = picture[top + 1, left] + s * (picture[top + 1, left + 1] - picture[top + 1, left])
            level = above + t * (below - above)
            out[y, x] = np.floor(shown[y, x] + share * (level - shown[y, x]) + 0.5)
    return out


def carried(
    depth: F32, camera: Camera, source: SeenFrame, motion: F32 | None = None, share: float = 1.0,
    steady: bool = False, focal: float = FOCAL, light: tuple[F32, ...] = (),
) -> tuple[U8, U8]:  # fmt: skip
    """A grey view with the image of a source, and the share that each pixel got."""
    shown, taken = np.full((*depth.shape, 3), 90, np.uint8), np.zeros(depth.shape, np.uint8)
    small, lent = coarse_camera(camera), source.lent(focal)
    tiles = np.full((2, 3), share, np.float32)
    traced = trace(every_fourth(depth, small), small, source, lent, motion, tiles, steady=steady)
    carry(shown, taken, traced, lent, *light)
    return shown, taken


@pytest.mark.parametrize("share", [1.0, 0.4])
@pytest.mark.parametrize("aside", [0.0, 0.0041])
def test_the_kernels_do_what_their_twin_does(aside: float, share: float) -> None:
    """A third of the tissue is nearer in the view, and its surface another one than the source saw there; an
    instrument covers a part of the rest."""
    depth = np.full((HEIGHT, WIDTH), 0.1, np.float32)
    depth[:, :20] = 0.08
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    mask[30:40, 45:50] = False
    source, camera = replace(seen(), mask=mask), CAMERA.moved_right(aside)
    shown, taken = carried(depth, camera, source, share=share)
    expected = twin(np.full_like(shown, 90), depth, camera, source, share)
    differs = np.abs(shown.astype(int) - expected).max(-1)
    # Places in steps of 1/256 px along two axes, where an image changes by up to 255 levels; three roundings
    # to whole levels, and a share in steps of 1/255. Beside the step in depth there is one between two fourth
    # pixels.
    assert differs[:, 26:].max() <= share * 2 * 255 / 512 + 2.5 and differs[:, :14].max() == 0
    assert not taken[:, :16].any() and (taken[:, 28:] > 0).mean() > 0.85


@pytest.mark.parametrize(("width", "height"), [(61, 47), (64, 48), (33, 50)])
def test_a_view_of_any_size_reaches_its_edges(width: int, height: int) -> None:
    """Sizes that four does not divide, and an image of another size than the source worked at."""
    source = replace(seen(), picture=lambda: np.full((2 * HEIGHT, 2 * WIDTH, 3), 200, np.uint8))
    depth = np.full((height, width), 0.1, np.float32)
    camera = Camera(width, height, CAMERA.K, CAMERA.T_world_cam)
    shown, taken = (each[:HEIGHT, :WIDTH] for each in carried(depth, camera, source, focal=2 * FOCAL))
    assert (taken == 255).all() and (shown == 200).all()


def test_moved_tissue_is_looked_up_where_it_was() -> None:
    """By whole pixels, so that nothing is interpolated."""
    source = seen()
    motion = np.zeros((4, HEIGHT // 4, WIDTH // 4), np.float32)
    motion[0], motion[3] = 3 * 0.1 / FOCAL, 1  # three pixels to the right since then
    shown, taken = carried(source.depth, CAMERA, source, motion)
    assert np.abs(shown[:, 4:].astype(int) - source.picture()[:, 1:-3]).max() <= 1
    assert not taken[:, :2].any()


def test_from_aside_the_surface_is_where_stereo_saw_it() -> None:
    """The model has the tissue at 100 mm, stereo at 102, but for a column of which it says nothing."""
    drawn, measured = np.full((HEIGHT, WIDTH), 0.1, np.float32), np.full((HEIGHT, WIDTH), 0.102, np.float32)
    measured[:, 30] = 0
    source = replace(seen(), matched=MatchedDepth(drawn, measured))
    shown, taken = carried(drawn, CAMERA.moved_right(10 * 0.102 / FOCAL), source)
    assert np.abs(shown[:, :-14].astype(int) - source.picture()[:, 10:-4]).max() <= 1
    assert (taken[:, :-14] == 255).all()


def test_what_stereo_saw_counts_for_a_moment() -> None:
    matched, drawn = Matched(), np.ones((2, 2), np.float32)
    assert matched(0, drawn, 0 * drawn) is None
    for later_ns in (0, int(0.9e9 * MATCHED)):
        found = matched(later_ns, drawn * (1 + later_ns), 1.01 * drawn * (later_ns == 0))
        assert found is not None and (found.drawn == 1).all() and (found.measured > 1).all()
    assert matched(int(1.1e9 * MATCHED), drawn, 0 * drawn) is None
    assert matched(-1, drawn, 0 * drawn) is None  # clocks are set back


def test_what_is_carried_is_in_the_light_of_the_view() -> None:
    source = replace(seen(), picture=lambda: np.full((HEIGHT, WIDTH, 3), 100, np.uint8))
    tint = np.full((HEIGHT // 4, WIDTH // 4, 3), 20 / 255, np.float32)
    gain = np.array([1.5, 1, 3], np.float32)
    shown, _ = carried(source.depth, CAMERA, source, light=(gain, tint))
    assert (shown == [180, 120, 255]).all()


@pytest.mark.parametrize("depth", [np.nan, np.inf, -1.0, 0.0, 1e-30, 1e30])
@pytest.mark.parametrize("moved", [None, np.nan, np.inf, 1e30])
def test_it_ends_in_a_picture_whatever_it_is_given(depth: float, moved: float | None) -> None:
    odd = np.full((HEIGHT, WIDTH), depth, np.float32)
    motion = None if moved is None else np.full((4, HEIGHT // 4, WIDTH // 4), moved, np.float32)
    for steady in (False, True):
        shown, taken = carried(odd, CAMERA.moved_right(0.01), seen(depth=odd), motion, steady=steady)
        assert (shown[taken == 0] == 90).all()


def test_a_view_of_a_whole_frame_has_the_hidden_tissue_too() -> None:
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    mask[10:30, 20:40] = False
    taken = np.full((HEIGHT, WIDTH), 255, np.uint8)
    taken[15:20, 25:30] = 0  # nobody ever saw that
    filled = Shown(np.full((HEIGHT, WIDTH, 3), 7, np.uint8), taken, 1)
    source = replace(seen(5), mask=mask, whole=filled)
    shown, got = carried(source.depth, CAMERA, source)
    assert (shown[mask] == source.picture()[mask]).all()
    assert (shown[~mask & (taken > 0)] == 7).all() and not got[taken == 0].any()
    assert source.oldest_ns == 1 and seen(5).oldest_ns == 5


def test_a_share_is_the_least_squares_mix_of_both_guesses() -> None:
    """The truth is a quarter of the way in the left half, and beyond the second guess in the right one."""
    first = np.full((32, 64, 3), 100, np.uint8)
    second, truth = first + np.uint8(40), first.copy()
    truth[:, :32], truth[:, 32:] = 110, 180
    share = Share()
    assert share.tiles().tolist() == [[1.0]]
    for _ in range(5):
        share.learn(first, second, truth, np.ones((32, 64), np.bool_))
    tiles = share.tiles()
    half = tiles.shape[1] // 2
    np.testing.assert_allclose(tiles[:, :half], 0.25, atol=1e-3)
    np.testing.assert_allclose(tiles[:, half:], 1)


def test_memory_is_bounded_and_keeps_what_is_seldom() -> None:
    memory = Memory()
    for step in range(300):
        now = step * 33_333_333
        memory.add(seen(now))
        ages = [(now - one.t_capture_ns) * 1e-9 for one in memory.frames]
        assert len(ages) <= MOST and ages == sorted(ages) and max(ages, default=0) <= OLDEST
        assert min(np.diff(ages), default=EVERY) >= EVERY - 1e-6
    assert max(ages) > 3  # s, though the newest ten lie within two


@pytest.mark.parametrize(("box", "kept"), [(np.s_[10:24, 10:24], True), (np.s_[:, 20:28], False)])
def test_the_last_frame_before_tissue_is_hidden_is_kept(box: tuple[slice, slice], kept: bool) -> None:
    """A strip of eight pixels is an edge that came and went, a box is something."""
    memory, mask = Memory(), np.ones((HEIGHT, WIDTH), np.bool_)
    mask[box] = False
    for stamp_ns in (0, 10_000_000, 20_000_000):
        memory.add(seen(stamp_ns))
    memory.add(replace(seen(30_000_000), mask=mask))
    memory.add(replace(seen(40_000_000), mask=mask))
    assert [one.t_capture_ns for one in memory.frames] == ([20_000_000, 0] if kept else [0])


def test_hidden_tissue_comes_from_the_newest_frame_that_saw_it_in_the_light_of_now() -> None:
    old, newer, hidden = seen(1), seen(2), gaussians()
    blind = replace(seen(2), mask=np.zeros((HEIGHT, WIDTH), np.bool_))

    def chosen(now_ns: int, *frames: SeenFrame) -> SeenFrame | None:
        source = hidden_source(hidden, now_ns, frames)
        return None if source is None else source.frame

    assert chosen(3, newer, old) is newer
    empty = replace(seen(2), gaussians=gaussians(0))
    assert chosen(3, blind, old) is chosen(3, empty, old) is old
    assert SmallDrawings().motion(hidden, CAMERA, empty) is None
    assert hidden_source(gaussians(first_id=1000), 3, [newer, old]) is None
    assert chosen(round(OLDEST * 1e9) + 2, newer, old) is newer  # after a pause
    darker = hidden_source(replace(hidden, colors=0.5 * hidden.colors), 3, [old])
    assert darker is not None
    np.testing.assert_allclose(darker.gain, 0.5)


def test_what_is_seen_is_the_picture_and_what_is_hidden_comes_from_before() -> None:
    """A box is hidden for the last four frames; beside it the model alone. Nothing else changes by it."""
    session = opened("source.frames:=12", "mapping.max_gaussians:=3000")
    pipeline = Pipeline(session.config, session.rig)
    plain = Pipeline(opened("mapping.max_gaussians:=3000", "publish.detail:=false").config, session.rig)
    box = np.s_[100:150, 120:180]
    for number, frame in enumerate(frames_of(session)):
        tissue = np.ones(frame.left.shape[:2], np.bool_) if frame.tissue is None else frame.tissue.copy()
        true = tissue.copy()
        if number >= 8:
            tissue[box] = False
        given = replace(frame, tissue=tissue)
        result = pipeline.process(given, StepBudget(1), FrameRequest(left=True))
        alone = plain.process(given, StepBudget(1))
        assert alone.views["left"].shown is None and tells_of(alone, RENDER)
        assert np.array_equal(alone.views["left"].rgb, result.views["left"].rgb)
    view, truth = result.views["left"], result.pair.left
    assert view.shown is not None
    inner = np.zeros_like(true)
    inner[110:140, 130:170] = true[110:140, 130:170]
    shown, drawn, expected = (metrics.as_float(each) for each in (view.shown.rgb, view.rgb, truth))
    assert metrics.psnr(shown, expected, inner) > metrics.psnr(drawn, expected, inner)
    assert view.shown.oldest_ns < view.t_capture_ns
    far = pipeline.seen[0].sure_tissue.astype(bool)
    far[90:160, 110:190] = False
    agree = (view.shown.rgb == truth).all(-1)[far]
    assert agree.mean() > 0.9  # the rest lies at seams


@pytest.mark.parametrize("published_px", [320, 640])
def test_an_image_in_another_light_is_shown_in_that_of_the_model(published_px: int) -> None:
    """At half the exposure, the image is multiplied out: off by half a level of that, and a gain's error."""
    session = opened("mapping.max_gaussians:=3000", f"vision.width:={published_px // 2}")
    pipeline = Pipeline(session.config, session.rig)
    *before, last = list(frames_of(session))[:8]
    for frame in before:
        pipeline.process(frame, StepBudget(1), FrameRequest(left=True))
    dark = both(last, lambda eye: np.rint(0.5 * eye))
    view = pipeline.process(dark, StepBudget(1), FrameRequest(left=True)).views["left"]
    assert view.shown is not None
    truth = published.picture(pipeline.rectifier(last), "left")
    sure = published.nearest(pipeline.rectifier(last), pipeline.seen[0].sure_tissue.astype(bool))
    assert np.median(np.abs(view.shown.rgb.astype(int) - truth)[sure]) <= 2


def test_who_comes_while_frames_are_equal_is_shown_detail_at_once() -> None:
    """Equal frames are not mapped: the first that somebody looks at is, those after it are not."""
    session = opened("source.frames:=3", "mapping.max_gaussians:=3000")
    pipeline = Pipeline(session.config, session.rig)
    frames = frames_of(session)
    for frame in (*frames, replace(frames[-1], frame_id=3)):
        result = pipeline.process(frame, StepBudget(1))
    assert "frame" in result.skipped and not tells_of(result, RENDER)
    came, after = (
        pipeline.process(replace(frames[-1], frame_id=n), StepBudget(1), FrameRequest(left=True))
        for n in (4, 5)
    )
    assert came.views["left"].shown is after.views["left"].shown is not None
    assert "frame" in after.skipped and tells_of(came, RENDER) and tells_of(after, RENDER)


@pytest.mark.parametrize("moved", [0.005, 0.0])
def test_lessons_cost_nothing_until_a_view_that_needs_them_is_drawn(
    moved: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A view ahead of the image needs one kind, one from aside the other, one that is only turned neither."""
    learnt = []
    for kind in ("learn_ahead", "learn_aside"):
        monkeypatch.setattr(Detail, kind, lambda *_, kind=kind: learnt.append(kind))
    session = opened("source.frames:=12", "mapping.max_gaussians:=3000")
    seconds, beside = itertools.count(), np.eye(4)
    beside[:3, :3], beside[0, 3] = cv2.Rodrigues(np.array([0, 0.1, 0]))[0], moved
    pipeline = Pipeline(session.config, session.rig)
    views = Views(Allowance(), clock=lambda: float(next(seconds)), detail=True)
    for number, frame in enumerate(frames_of(session)):
        scene = pipeline.process(frame, StepBudget(1), FrameRequest())
        if number == 6:
            views.open(ViewRequest("aside", fov=60, T_left_cam=beside.tolist()), None)
        drawn = dict(views.draw_due(scene, {"aside"}, pipeline.seen))
        assert bool(drawn) == (number >= 6) and bool(learnt) == (number >= 6 and moved > 0)
    assert set(learnt) <= {"learn_aside"}  # nobody looked ahead


def test_measuring_tells_detail_from_the_model_alone() -> None:
    """Beside it the same run without detail, whose figures are the model's."""
    played = ["source.frames:=16", "mapping.max_gaussians:=3000", "vision.width:=240", "vision.height:=192"]
    options = MeasureOptions(hold_out=0, hidden=True)
    with_detail = evaluate(SESSION, played, options, iterations=1).summary
    alone = evaluate(SESSION, [*played, "publish.detail:=false"], options, iterations=1).summary
    for group in ("predict", "hidden"):
        assert with_detail[group]["psnr"] > with_detail[group]["model_psnr"]
        assert alone[group]["psnr"] == alone[group]["model_psnr"] == with_detail[group]["model_psnr"]


# ---- from outside: a real node process and real sockets ---------------------------------------------------

RENDER, DEPTH, VIEW = "left/render/image", "left/render/depth", "view/later/image"
INPUT, MASK = "left/image_rect_color", "left/tissue_mask"
AWAY = np.ones((11, 11), np.uint8)  # px: nearer to an instrument the render is not the image


@pytest.mark.live
def test_the_left_render_is_the_picture_where_tissue_is_seen_and_says_how_old_the_rest_is(
    phantom_session: Path, tmp_path: Path
) -> None:
    node = RunningNode(phantom_session, tmp_path, "source.pace:=fast")
    with ControlClient(node.connection["control"]) as control:
        until(lambda: control.request("get_status")["gaussians"], START_SECONDS)
        control.request("open_view", {"name": "later", "ahead_ms": 30, "rate_hz": 30})
        got = client.collect(node.data, [RENDER, INPUT, MASK, DEPTH, VIEW], 20, START_SECONDS)
    assert node.stop() == 0, node.said()
    assert len(got[RENDER]) == 20
    by_stamp = [{one.meta["stamp_ns"]: one for one in got[name]} for name in (RENDER, INPUT, MASK)]
    stamps = sorted(set.intersection(*map(set, by_stamp)))
    assert stamps, "no frame of which all came"
    for stamp in stamps:
        render, picture, mask = (messages[stamp] for messages in by_stamp)
        height, width = render.meta["shape"][:2]
        shown = client.check_image(render, "rgba8", width, height)
        given = client.check_image(picture, "rgb8", width, height)
        tissue = cv2.erode(client.check_image(mask, "mono8", width, height), AWAY) > 0
        assert tissue.mean() > 0.3
        assert (shown[tissue][:, :3] == given[tissue]).all() and (shown[tissue][:, 3] == 255).all()
        assert 0 <= render.meta["detail_age_ns"] <= 10e9
    assert got[VIEW] and all(one.meta["detail_age_ns"] >= 0 for one in got[VIEW])
    assert all("detail_age_ns" not in one.meta for one in got[DEPTH])  # depth is the model's


@pytest.mark.live
def test_who_takes_single_images_gets_their_detail_after_any_silence(
    phantom_session: Path, tmp_path: Path
) -> None:
    """At this pace a frame is always being mapped that was begun before anybody looked: it is not sent."""
    node = RunningNode(phantom_session, tmp_path, "source.pace:=fast")
    with ControlClient(node.connection["control"]) as control:
        until(lambda: control.request("get_status")["gaussians"], START_SECONDS)
        time.sleep(node_module.LOOKS_AGAIN + 0.5)
        (first,) = client.collect(node.data, [RENDER], 1, START_SECONDS)[RENDER]
        assert "detail_age_ns" in first.meta
    assert node.stop() == 0, node.said()


@pytest.mark.live
def test_a_recordings_first_frames_have_detail_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who starts a node looks soon; of a short recording nothing would be left for them."""
    monkeypatch.setattr(node_module, "LOOKS_AGAIN", 60.0)  # however slow this machine is
    own = ["publish.data:=[]", "publish.control:=null", f"publish.run_dir:={tmp_path / 'run'}"]
    session = opened("source.frames:=3", "mapping.max_gaussians:=3000", *own)
    views: list[RenderedView] = []

    def note(result: FrameResult, _: float) -> None:
        views.append(result.views["left"])

    node = node_module.Node(session.config, session.rig, session.source, note)
    node.start()
    assert node.wait(START_SECONDS)
    assert len(views) == 3 and all(view.shown is not None for view in views)
