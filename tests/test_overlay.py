"""The overlay: depth-tested, pinned to the tissue by Gaussian ids, and blank when anything is in doubt."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from synthetic import HEIGHT, NORMAL, WIDTH, at_frame, plane_result, publisher, stream

from sags_node.apps import overlay_draw
from sags_node.apps.overlay import PinnedOverlay, Scene, run_overlay
from sags_node.apps.overlay_pin import Pin, pin_pixel, surface_normal
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import quat_to_matrix, transform
from sags_node.messaging import content
from sags_node.types import FrameResult

K = np.array([[300.0, 0, 40], [0, 300, 30], [0, 0, 1]])
SIZE = (60, 80)
GRAY = np.full((*SIZE, 3), 100, np.uint8)
WALL = np.full(SIZE, 0.05, np.float32)  # a wall at 50 mm
TISSUE = np.ones(SIZE, bool)


def ball(z: float) -> overlay_draw.Samples:
    return overlay_draw.sphere(np.array([0.0, 0.0, z]), 0.001, 5e-5, (255, 0, 0))


def scene_of(result: FrameResult) -> Scene:
    depth = result.views["left"].depth
    gaussians, camera = result.snapshot.gaussians, result.pair.camera
    return Scene(
        picture=result.pair.left,
        depth=np.where(depth > 0, depth, np.float32(np.nan)),
        tissue=result.observation.tissue,
        K=camera.K,
        T_world_cam=camera.T_world_cam,
        means=gaussians.means,
        ids=gaussians.ids.astype(np.uint32),
        generation=("s", result.epoch),
    )


# ---- drawing -------------------------------------------------------------------------------------------


def test_a_ball_in_front_is_a_full_disc() -> None:
    picture, drawn = overlay_draw.draw(GRAY, ball(0.03), K, WALL, TISSUE)
    radius = 300 * 0.001 / 0.03
    assert drawn == pytest.approx(np.pi * radius**2, rel=0.15)
    assert picture[30, 40, 0] > 200 and picture[30, 40, 1] < 60
    assert np.array_equal(picture[:15], GRAY[:15])
    assert (GRAY == 100).all()  # the picture given is not touched


def test_a_ball_behind_the_surface_is_hidden() -> None:
    picture, drawn = overlay_draw.draw(GRAY, ball(0.06), K, WALL, TISSUE)
    assert drawn == 0 and np.array_equal(picture, GRAY)


def test_a_ball_half_way_through_a_step_shows_one_half() -> None:
    step = WALL.copy()
    step[:, :40] = 0.02
    whole = overlay_draw.draw(GRAY, ball(0.03), K, WALL, TISSUE)[1]
    picture, drawn = overlay_draw.draw(GRAY, ball(0.03), K, step, TISSUE)
    assert drawn == pytest.approx(whole / 2, rel=0.15)
    assert np.array_equal(picture[:, :40], GRAY[:, :40])


@pytest.mark.parametrize("what", ["instrument", "unknown depth"])
def test_nothing_is_drawn_over_instruments_or_unknown_depth(what: str) -> None:
    depth, tissue = WALL.copy(), TISSUE.copy()
    if what == "instrument":
        tissue[:, 40:] = False
    else:
        depth[:, 40:] = np.nan
    picture, drawn = overlay_draw.draw(GRAY, ball(0.03), K, depth, tissue)
    assert drawn > 50 and np.array_equal(picture[:, 40:], GRAY[:, 40:])


def test_the_nearer_of_two_shapes_wins() -> None:
    blue = overlay_draw.sphere(np.array([0.0, 0.0, 0.02]), 0.0005, 5e-5, (0, 0, 255))
    for both in (blue + ball(0.03), ball(0.03) + blue):
        picture, _ = overlay_draw.draw(GRAY, both, K, WALL, TISSUE)
        assert picture[30, 40, 2] > 150 and picture[30, 40, 0] < 60


def test_samples_outside_or_behind_the_camera_are_left_out() -> None:
    for center in ([0.0, 0.0, -0.03], [5.0, 0.0, 0.03], [0.0, -5.0, 0.03]):
        shape = overlay_draw.sphere(np.array(center), 0.001, 5e-5, (255, 0, 0))
        assert overlay_draw.draw(GRAY, shape, K, WALL, TISSUE)[1] == 0


@pytest.mark.parametrize("shape", overlay_draw.SHAPES)
def test_shapes_lie_on_and_above_the_surface(shape: str) -> None:
    normal = np.array([0.0, 0.0, -1.0])
    samples = overlay_draw.SHAPES[shape](np.array([0.0, 0.0, 0.05]), normal, K, WALL)
    assert samples.points[:, 2].max() < 0.05 + overlay_draw.ON_SURFACE
    picture, drawn = overlay_draw.draw(GRAY, samples, K, WALL, TISSUE)
    assert drawn > 100
    hidden = overlay_draw.draw(GRAY, samples, K, np.full(SIZE, 0.03, np.float32), TISSUE)[1]
    assert hidden == 0 and not np.array_equal(picture, GRAY)


def test_a_ring_bends_over_a_curved_surface() -> None:
    """A flat ring in a hollow is half hidden by its sides; a draped one is seen all around."""
    u = np.broadcast_to(np.arange(SIZE[1]), SIZE)
    hollow = (0.05 - 0.002 * np.cos(u / 12.0)).astype(np.float32)
    center = np.array([0.0, 0.0, float(hollow[30, 40])])
    flat = overlay_draw.disc(center, np.array([0.0, 0.0, -1.0]), 0.003, 0.004, 5e-5, (0, 255, 0))
    everywhere = overlay_draw.draw(GRAY, flat, K, np.full(SIZE, 1.0, np.float32), TISSUE)[1]
    assert overlay_draw.draw(GRAY, flat, K, hollow, TISSUE)[1] < 0.5 * everywhere
    draped = overlay_draw.drape(flat, K, hollow)
    assert overlay_draw.draw(GRAY, draped, K, hollow, TISSUE)[1] > 0.9 * everywhere


# ---- the pin -------------------------------------------------------------------------------------------


def cloud(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """400 Gaussians on a 20 x 20 mm patch, with ids in no order."""
    rng = np.random.default_rng(seed)
    means = np.stack([*rng.uniform(-0.01, 0.01, (2, 400)), 0.06 + rng.normal(0, 2e-4, 400)], 1)
    return means.astype(np.float32), rng.permutation(5000)[:400].astype(np.uint32)


def test_the_pin_follows_its_gaussians_whatever_their_order() -> None:
    means, ids = cloud()
    point = np.array([0.001, -0.002, 0.06])
    pin = Pin.attach(point, means, ids)
    assert pin is not None
    rng = np.random.default_rng(1)
    order = rng.permutation(len(ids))[:380]
    moved = means[order] + np.float32([0.002, 0.0, -0.003])
    extra = rng.uniform(-0.01, 0.01, (100, 3)).astype(np.float32)  # new Gaussians with new ids
    found = pin.locate(np.concatenate([moved, extra]), np.append(ids[order], np.arange(9000, 9100)))
    assert found is not None
    assert np.allclose(found[0], point + np.array([0.002, 0.0, -0.003]), atol=1e-7)


def test_the_pin_follows_a_bending_surface_closely() -> None:
    means, ids = cloud()
    point = np.array([0.001, -0.002, 0.06])
    pin = Pin.attach(point, means, ids)
    assert pin is not None

    def bend(p: np.ndarray) -> np.ndarray:
        turned = (p - [0, 0, 0.06]) @ quat_to_matrix(np.array([1.0, 0.02, 0.03, 0.1])).T + [0, 0, 0.06]
        return turned + np.stack([0 * p[:, 0], 0 * p[:, 0], 0.002 * np.sin(200 * p[:, 0])], 1)

    found = pin.locate(bend(means.astype(np.float64)).astype(np.float32), ids)
    assert found is not None
    assert np.linalg.norm(found[0] - bend(point[None])[0]) < 1e-4  # 0.1 mm while the point moves 2 mm


def test_the_pin_is_lost_with_its_gaussians() -> None:
    means, ids = cloud()
    pin = Pin.attach(np.array([0.0, 0.0, 0.06]), means, ids)
    assert pin is not None
    heaviest = pin.ids[np.argsort(-pin.weights)]
    keep = ~np.isin(ids, heaviest[:3])
    found = pin.locate(means[keep], ids[keep])
    assert found is not None and found[1] < 1
    keep = ~np.isin(ids, heaviest[:12])
    assert pin.locate(means[keep], ids[keep]) is None
    assert pin.locate(np.empty((0, 3), np.float32), np.empty(0, np.uint32)) is None


def test_there_must_be_gaussians_near() -> None:
    means, ids = cloud()
    assert Pin.attach(np.array([0.0, 0.0, 0.08]), means, ids) is None
    assert Pin.attach(np.zeros(3), np.empty((0, 3), np.float32), np.empty(0, np.uint32)) is None


def test_the_pixel_to_pin_has_tissue_and_depth() -> None:
    depth, tissue = WALL.copy(), TISSUE.copy()
    depth[:, :10] = np.nan
    tissue[:, 50:] = False
    assert pin_pixel((5, 20), depth, tissue) == (10, 20)
    assert pin_pixel((70, 20), depth, tissue) is None
    assert pin_pixel(None, depth, tissue) in {(u, v) for u in (29, 30) for v in (29, 30)}
    assert pin_pixel(None, depth * np.nan, tissue) is None


def test_the_normal_is_that_of_the_surface() -> None:
    scene = scene_of(plane_result())
    u, v = 30, 40
    point = np.linalg.inv(scene.K) @ (u, v, 1.0) * float(scene.depth[v, u])
    normal = surface_normal(scene.depth, scene.tissue, scene.K, point)
    assert normal is not None
    assert np.allclose(normal, -NORMAL / np.linalg.norm(NORMAL), atol=1e-3)
    assert surface_normal(scene.depth * np.nan, scene.tissue, scene.K, point) is None
    assert surface_normal(scene.depth, ~scene.tissue, scene.K, np.array([0.0, 0.0, 0.06])) is None


# ---- frame after frame ---------------------------------------------------------------------------------


def test_the_shape_moves_with_the_tissue() -> None:
    """The tissue slides 3 mm to the right: so does the drawing, by as many pixels as that is."""
    overlay = PinnedOverlay((20, 30), "target")
    scene = scene_of(plane_result())
    first, reason = overlay.draw(scene)
    assert reason is None and overlay.pixel == (20, 30)
    right = scene.T_world_cam[:3, 0].astype(np.float32) * np.float32(0.003)
    second, reason = overlay.draw(replace(scene, means=scene.means + right))
    assert reason is None
    assert np.allclose(overlay.paths[-1][1] - overlay.paths[-1][0], right, atol=1e-7)
    columns = [np.nonzero((p != scene.picture).any(axis=2))[1].min() for p in (first, second)]  # ring's left
    depth = float(scene.depth[30, 20])
    assert columns[1] - columns[0] == pytest.approx(scene.K[0, 0] * 0.003 / depth, abs=1.0)


def test_an_instrument_in_front_hides_the_shape_only_there() -> None:
    overlay = PinnedOverlay((54, 30), "target")  # columns 60 to 69 are an instrument
    scene = scene_of(plane_result())
    picture, reason = overlay.draw(scene)
    changed = (picture != scene.picture).any(axis=2)
    assert reason is None
    assert changed[:, :60].sum() > 30 and changed[:, 70:].any() and not changed[:, 60:70].any()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda s: {"depth": s.depth * np.float32(np.nan)}, "no depth at the pin"),
        (lambda s: {"ids": s.ids + np.uint32(1_000_000)}, "pin lost"),
        (lambda s: {"means": s.means + s.T_world_cam[:3, 0].astype(np.float32)}, "pin outside the picture"),
        (lambda s: {"means": s.means - s.T_world_cam[:3, 2].astype(np.float32)}, "pin outside the picture"),
        (lambda s: {"generation": ("s", 3), "tissue": ~np.ones_like(s.tissue)}, "nothing to pin to"),
    ],
)
def test_the_plain_picture_is_shown_when_in_doubt(change: Any, why: str) -> None:
    overlay = PinnedOverlay((20, 30), "target")
    scene = scene_of(plane_result())
    assert overlay.draw(scene)[1] is None
    picture, reason = overlay.draw(replace(scene, **change(scene)))
    assert reason == why and np.array_equal(picture, scene.picture)
    assert overlay.draw(scene)[1] is None  # and it comes back


def test_ids_of_another_generation_are_not_followed() -> None:
    """After a reset the same ids mean other Gaussians: the point is pinned anew."""
    overlay = PinnedOverlay((20, 30), "target")
    scene = scene_of(plane_result())
    overlay.draw(scene)
    overlay.draw(replace(scene, generation=("s", 9), ids=scene.ids[::-1].copy()))
    assert [len(path) for path in overlay.paths] == [1, 1]
    assert np.allclose(
        transform(np.linalg.inv(scene.T_world_cam), overlay.paths[-1][0])[2], scene.depth[30, 20]
    )


def test_a_pin_that_loses_gaussians_slowly_is_renewed() -> None:
    overlay = PinnedOverlay((20, 30), "target")
    scene = scene_of(plane_result())
    overlay.draw(scene)
    start = overlay.paths[0][0]
    rng = np.random.default_rng(5)
    means, ids = scene.means, scene.ids
    for generation in range(1, 9):  # each time a fifth of all Gaussians is replaced by new ones nearby
        gone = rng.permutation(len(ids))[: len(ids) // 5]
        ids = ids.copy()
        ids[gone] = 100_000 * generation + np.arange(len(gone))
        assert overlay.draw(replace(scene, means=means, ids=ids))[1] is None
    assert np.linalg.norm(overlay.paths[-1][-1] - start) < 1e-6


# ---- over real sockets ---------------------------------------------------------------------------------


def test_the_overlay_runs_against_a_publisher(tmp_path: Path) -> None:
    """The tissue slides 0.05 mm a frame; the pin reports that motion, and the video is written."""
    still = plane_result()
    right = still.pair.camera.T_world_cam[:3, 0].astype(np.float32) * np.float32(5e-5)

    def frame(i: int) -> FrameResult:
        moved = replace(still.snapshot.gaussians, means=still.snapshot.gaussians.means + right * i)
        result = replace(still, snapshot=replace(still.snapshot, gaussians=moved))
        return at_frame(result, i, time.time_ns())

    run_dir, video = tmp_path / "run", tmp_path / "overlay.mp4"
    with publisher(run_dir) as running, stream(running, frame):
        summary = run_overlay(pin=(20, 30), seconds=2.0, save=video, run_dir=run_dir)
    assert summary["overlay"] > 20
    assert summary["frames"] == summary["overlay"] + sum(summary["blanked"].values())
    assert 0 < summary["latency_ms"]["p50"] <= summary["latency_ms"]["p99"]
    assert summary["pin"]["pixel"] == (20, 30)
    assert summary["pin"]["moved_mm"] > 0.8
    assert summary["pin"]["step_mm_p90"] < 0.5
    capture = cv2.VideoCapture(str(video))
    assert capture.get(cv2.CAP_PROP_FRAME_WIDTH) == WIDTH and capture.get(cv2.CAP_PROP_FRAME_HEIGHT) == HEIGHT
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) > 15
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(30, rel=0.5)


def test_old_splats_blank_the_overlay_but_not_the_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From frame 30 on no splats are published: they turn stale while the pictures go on."""
    table = dict(content.FRAME_CONTENT)
    monkeypatch.setattr(content, "FRAME_CONTENT", table)
    still = plane_result()

    def frame(i: int) -> FrameResult:
        if i == 30:
            del table["splats"]
        return at_frame(still, i, time.time_ns())

    run_dir, shown = tmp_path / "run", tmp_path / "shown.png"
    with publisher(run_dir) as running, stream(running, frame):
        summary = run_overlay(pin=(20, 30), seconds=2.5, save=shown, run_dir=run_dir)
    assert summary["overlay"] > 5
    assert summary["blanked"]["stale splats"] > 10
    assert summary["frames"] > summary["overlay"] + summary["blanked"]["stale splats"] - 1
    picture = cv2.cvtColor(cv2.imread(str(shown)), cv2.COLOR_BGR2RGB)
    assert (picture != still.pair.left).any(axis=2).sum() > 30


def test_mistakes_are_named(tmp_path: Path) -> None:
    endpoint = "tcp://127.0.0.1:9"
    with pytest.raises(UsageError, match="shapes: target, sphere"):
        run_overlay(endpoint, shape="cube")
    with pytest.raises(UsageError, match=r"\.mp4 or \.png"):
        run_overlay(endpoint, save=tmp_path / "film.gif")
    with pytest.raises(UsageError, match="no folder"):
        run_overlay(endpoint, save=tmp_path / "missing" / "film.mp4")
    with pytest.raises(SagsError, match="no picture came"):
        run_overlay(endpoint, seconds=0.3)
