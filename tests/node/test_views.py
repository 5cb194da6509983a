"""Views on request, anchors and pausing, from outside: a real node process and real sockets."""

import gc
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import independent_client as client
import msgpack
import numpy as np
import pytest
from engine_scenes import rasterize
from running_node import RunningNode
from synthetic import at_frame, plane_result
from waiting import START_SECONDS, until
from warp_on_cpu import use_warp_on_cpu

from sags_node.engine.gpu.rasterizer import DeviceRasterizer
from sags_node.engine.interface import Rasterizer
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.errors import SagsError
from sags_node.mapping.ladder import RUNGS
from sags_node.messaging.control import ControlClient
from sags_node.messaging.requests import AnchorRequest, ViewRequest, parse
from sags_node.node import views as views_module
from sags_node.node.allowance import LEAST_SHARE, SHARE, Allowance, Pace
from sags_node.node.views import MAX_VIEWS, Views, view_camera
from sags_node.types import Camera, Forecast, Gaussians, MotionState

pytestmark = pytest.mark.live

WHOLE = next(number for number, rung in enumerate(RUNGS) if rung.scale == 1)
ANCHOR_FIELDS = ["x", "y", "z", "id", "u", "v", "visibility", "age", "confidence"]
CLOSE_UP = [[0.995, 0, 0.1, -0.003], [0, 1, 0, 0.002], [-0.1, 0, 0.995, 0.012], [0, 0, 0, 1]]


# ---- the running node ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def node(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    # No frame is left out and the rung is given, so what is shown does not depend on how busy the machine is.
    # On this rung the node's renders are drawn at full size, as views always are. Views are the model alone.
    options = ["source.pace:=fast", f"mapping.rung:={WHOLE}", "publish.detail:=false"]
    running = RunningNode(phantom_session, tmp_path_factory.mktemp("node"), *options)
    yield running
    assert running.stop() == 0, running.said()


@pytest.fixture
def control(node: RunningNode) -> Iterator[ControlClient]:
    with ControlClient(node.connection["control"]) as asker:
        until(lambda: asker.request("get_status")["gaussians"], START_SECONDS)
        yield asker


def collect(node: RunningNode, names: list[str], count: int = 1, timeout: float = 60) -> dict[str, list[Any]]:
    return client.collect(node.data, names, count, timeout)


def anchor_rows(message: client.Received) -> dict[int, np.ndarray]:
    """Rows by anchor id."""
    client.check_meta(message, "sensor_msgs/msg/PointCloud2")
    assert message.meta["encoding"].split(",")[: len(ANCHOR_FIELDS)] == ANCHOR_FIELDS
    rows = message.array()
    ids = rows.view(np.uint32)[:, ANCHOR_FIELDS.index("id")]
    return {int(one): row for one, row in zip(ids, rows, strict=True)}


def test_anchors_are_added_followed_and_removed(node: RunningNode, control: ControlClient) -> None:
    by_pixel = control.request("add_anchor", {"u": 150.5, "v": 120})["id"]
    point = anchor_rows(collect(node, ["anchors"])["anchors"][0])[by_pixel][:3]
    by_point = control.request("add_anchor", {axis: float(x) for axis, x in zip("xyz", point, strict=True)})[
        "id"
    ]
    assert by_point > by_pixel
    messages = collect(node, ["anchors"], count=8)["anchors"]
    assert client.check_sequence(messages) == 0
    tracks = np.array([anchor_rows(message)[by_pixel] for message in messages])
    assert np.isfinite(tracks[:, [0, 1, 2, 4, 5, 6, 7, 8]]).all()
    assert (np.diff(tracks[:, 7]) > 0).all(), "age grows"
    assert 0.01 < np.ptp(tracks[:, 4:6], axis=0).max() < 40, "it moves with the tissue, not away"
    assert tracks[:, 6].mean() > 0.5 and tracks[:, 8].min() > 0.3
    told = control.request("measure", {"anchors": [by_pixel, by_point]})
    assert 0 <= told["value"] < 1e-3 and told["error"] > 0 and told["metric"] and told["stamp_ns"] > 0
    for wrong, why in (([by_pixel], "2 anchors or more"), ([by_pixel, by_pixel], "the same anchor twice")):
        with pytest.raises(SagsError, match=why):
            control.request("measure", {"anchors": wrong})
    assert "no anchor 999" in control.request("measure", {"anchors": [by_pixel, 999]})["unsure"]
    with pytest.raises(SagsError, match="start before"):
        control.request("remove_anchor", {"id": by_pixel, "session": "another"})
    session = messages[-1].meta["session"]
    assert control.request("remove_anchor", {"id": by_pixel, "session": session}) == {}
    left = anchor_rows(collect(node, ["anchors"], count=3)["anchors"][-1])
    assert by_pixel not in left and by_point in left
    with pytest.raises(SagsError, match=f"no anchor {by_pixel}"):
        control.request("remove_anchor", {"id": by_pixel})
    control.request("remove_anchor", {"id": by_point})


def test_a_model_that_starts_anew_loses_its_anchors_visibly(
    node: RunningNode, control: ControlClient
) -> None:
    anchor = control.request("add_anchor", {"u": 150, "v": 120})["id"]
    before = collect(node, ["anchors"], count=2)["anchors"][-1]
    control.request("reset_model")
    after = before
    while after.meta["epoch"] <= before.meta["epoch"]:
        after = collect(node, ["anchors"])["anchors"][0]
    row = anchor_rows(after)[anchor]
    assert np.isnan(row[[0, 1, 2, 4, 5]]).all() and row[6] == row[8] == 0
    control.request("remove_anchor", {"id": anchor})


def test_a_view_is_the_published_model_drawn_from_there(node: RunningNode, control: ControlClient) -> None:
    opened = control.request(
        "open_view",
        {"name": "close", "width": 240, "height": 200, "fov": 50, "T_world_cam": CLOSE_UP, "depth": True,
         "rate_hz": 30},
    )  # fmt: skip
    assert opened["asked_hz"] == 30 and opened["draw_ms"] > 0
    names = [f"view/close/{kind}" for kind in ("image", "depth", "depth_confidence", "camera_info")]
    assert set(opened["topics"]) == set(names)
    got = collect(node, [*names, "splats"], count=12)
    splats = {message.meta["stamp_ns"]: message for message in got["splats"]}
    depths = {message.meta["stamp_ns"]: message for message in got["view/close/depth"]}
    both = [
        m for m in got["view/close/image"] if m.meta["stamp_ns"] in splats and m.meta["stamp_ns"] in depths
    ]
    assert both, "no view of a frame whose splats came"
    stamp = both[-1].meta["stamp_ns"]
    info = client.camera_info(got["view/close/camera_info"][-1])
    focal = 120 / np.tan(np.radians(25))
    assert np.allclose(info["K"], [[focal, 0, 119.5], [0, focal, 99.5], [0, 0, 1]])
    assert (info["width"], info["height"], info["P"][0, 3]) == (240, 200, 0)

    columns = client.check_splats(splats[stamp])

    def stack(*keys: str) -> np.ndarray:
        return np.stack([columns[key] for key in keys], 1)

    gaussians = Gaussians(
        stack("x", "y", "z"), stack("rot_w", "rot_x", "rot_y", "rot_z"),
        stack("scale_0", "scale_1", "scale_2"), columns["opacity"].copy(),
        client.splat_colors(columns).astype(np.float32), columns["id"].astype(np.int64),
        slopes=stack("slope_0", "slope_1", "slope_2"),
    )  # fmt: skip
    expected = rasterize(gaussians, Camera(240, 200, info["K"], np.array(CLOSE_UP)))
    shown = client.check_image(both[-1], "rgba8", 240, 200).astype(float)
    solid = expected.alpha > 0.5
    assert solid.mean() > 0.9
    assert np.abs(shown[..., :3] - expected.rgb)[solid].max() < 2
    assert np.abs(shown[..., 3] / 255 - expected.alpha).max() < 2 / 255
    depth = client.check_image(depths[stamp], "32FC1", 240, 200)
    stated = solid & np.isfinite(depth)
    assert stated.sum() > 0.8 * solid.sum()
    assert np.allclose(depth[stated], expected.depth[stated], atol=2e-5)
    assert np.isnan(depth[expected.depth == 0]).all()
    sure = {m.meta["stamp_ns"]: m for m in got["view/close/depth_confidence"]}
    if stamp in sure:  # each topic was collected by itself
        confidence = client.check_image(sure[stamp], "32FC1", 240, 200)
        assert np.array_equal(confidence > 0, np.isfinite(depth))

    status = control.request("get_status")["views"]["close"]
    assert status["held_hz"] > 0 and status["draw_ms"] > 0
    control.request("close_view", {"name": "close"})
    assert collect(node, ["view/close/image"], timeout=0.5)["view/close/image"] == []
    assert "close" not in control.request("get_status")["views"]
    with pytest.raises(SagsError, match="no view 'close' is open"):
        control.request("close_view", {"name": "close"})


def test_a_stereo_pair_follows_the_camera_at_the_rigs_baseline(
    node: RunningNode, control: ControlClient
) -> None:
    """Opened without a pose and at the node's own size, its eyes show what the node's renders show."""
    opened = control.request("open_view", {"name": "eyes", "stereo": True, "width": 320, "height": 256})
    names = [f"view/eyes/{eye}/{kind}" for eye in ("left", "right") for kind in ("image", "camera_info")]
    assert set(opened["topics"]) == set(names)
    got = collect(node, [*names, "left/render/image", "right/render/image", "right/camera_info"], count=10)
    shown: dict[str, dict[int, np.ndarray]] = {}
    for topic in ("view/eyes/left", "view/eyes/right", "left/render", "right/render"):
        messages = got[f"{topic}/image"]
        shown[topic] = {
            m.meta["stamp_ns"]: client.check_image(m, "rgba8", 320, 256).astype(float) for m in messages
        }
    stamp = max(set.intersection(*(set(pictures) for pictures in shown.values())))
    left, right, left_render, right_render = (pictures[stamp] for pictures in shown.values())

    def apart(one: np.ndarray, other: np.ndarray) -> float:
        return float(np.mean(np.abs(one - other)))

    assert apart(left, left_render) < 1
    assert np.array_equal(right, right_render)
    P = client.camera_info(got["view/eyes/right/camera_info"][-1])["P"]
    assert np.allclose(P, client.camera_info(got["right/camera_info"][-1])["P"])
    control.request("close_view", {"name": "eyes"})


def test_a_static_view_is_sent_again_to_who_comes_later(node: RunningNode, control: ControlClient) -> None:
    opened = control.request("open_view", {"name": "still", "static": True, "width": 64, "height": 48})
    assert (opened["asked_hz"], opened["limited_by"]) == (0, "")
    first, again = (collect(node, ["view/still/image"])["view/still/image"][0] for _ in range(2))
    assert first.meta["stamp_ns"] == again.meta["stamp_ns"] and first.parts == again.parts
    assert collect(node, ["view/still/image"], count=2, timeout=0.5)["view/still/image"][1:] == []
    control.request("open_view", {"name": "still", "width": 64, "height": 48})
    later = collect(node, ["view/still/image"])["view/still/image"][0]
    assert later.meta["stamp_ns"] > first.meta["stamp_ns"], (
        "drawn again and again, it is not the one of before"
    )
    control.request("close_view", {"name": "still"})
    assert collect(node, ["view/still/image"], timeout=0.5)["view/still/image"] == []


def test_a_static_view_opened_again_with_less_sends_nothing_of_before(
    node: RunningNode, control: ControlClient
) -> None:
    view = {"name": "less", "static": True, "width": 64, "height": 48}
    old = [f"view/less/left/{kind}" for kind in ("image", "depth", "camera_info")]
    control.request("open_view", view | {"stereo": True, "depth": True})
    assert all(collect(node, old).values())
    control.request("open_view", view)
    assert collect(node, ["view/less/image"])["view/less/image"]
    assert not any(collect(node, old, timeout=0.5).values())
    control.request("close_view", {"name": "less"})


def test_what_is_wrong_with_a_request_is_said(node: RunningNode, control: ControlClient) -> None:
    outside = {"x": 0.0, "y": 0.0, "z": 3.0}
    for op, args, message in (
        ("add_anchor", {}, "either a pixel"), ("add_anchor", {"u": 1}, "either a pixel"),
        ("add_anchor", {"u": 1, "v": 2, "x": 3}, "either a pixel"),
        ("add_anchor", {"u": "1", "v": 2}, "`str`"),
        ("add_anchor", {"u": float("nan"), "v": 2}, "finite"), ("add_anchor", {"u": 900, "v": 2}, "outside"),
        ("add_anchor", outside, "no tissue within"), ("remove_anchor", {}, "missing required field `id`"),
        ("remove_anchor", {"id": "all"}, "`int`"), ("open_view", {}, "missing required field `name`"),
        ("open_view", {"name": "a/b"}, "name"), ("open_view", {"name": "a", "colour": 1}, "unknown field"),
        ("open_view", {"name": "a", "width": 4000}, "1920"), ("close_view", {"name": "a"}, "open are: none"),
    ):  # fmt: skip
        with pytest.raises(SagsError, match=message):
            control.request(op, args, timeout=60)
    assert control.request("get_status")["views"] == {}


def test_paused_it_says_so_sends_nothing_and_goes_on_with_what_is_new(
    node: RunningNode, control: ControlClient
) -> None:
    with client.subscribed(node.data, "sags/left/render/depth") as socket:
        assert socket.poll(60_000)
        assert control.request("pause") == {"paused": True}
        assert control.request("get_status")["state"] == "paused"
        newest = None
        while socket.poll(1000):  # the last ones that were on their way
            newest = msgpack.unpackb(socket.recv_multipart()[1])
        assert control.request("get_status")["rate_hz"] == 0
        assert control.request("resume") == {"paused": False}
        assert socket.poll(60_000)
        meta = msgpack.unpackb(socket.recv_multipart()[1])
        assert newest is None or (meta["seq"], meta["frame_id"]) == (
            newest["seq"] + 1,
            newest["frame_id"] + 1,
        )
    until(lambda: control.request("get_status")["state"] == "running")


# ---- requests --------------------------------------------------------------------------------------------


def test_wrong_poses_and_cameras_are_refused() -> None:
    identity, mirrored = np.eye(4).tolist(), np.diag([1.0, 1, -1, 1]).tolist()
    far = (np.eye(4) + np.eye(4, k=3) * 25).tolist()
    skewed = [[100, 2, 0], [0, 100, 0], [0, 0, 1]]
    for args, message in (
        ({"T_world_cam": identity, "T_left_cam": identity}, "not both"),
        ({"K": skewed, "fov": 50}, "not both"),
        ({"T_world_cam": mirrored}, "rotation"), ({"T_left_cam": far}, "in metres"), ({"K": skewed}, "fx"),
        ({"T_left_cam": identity[:3]}, "4 rows of 4"), ({"K": [[float("nan")] * 3] * 3}, "finite"),
        ({"K": np.diag([1e300, 1, 1]).tolist()}, "no more than"), ({"name": "a\n"}, "name"),
        ({"K": np.diag([1e-300, 1, 1]).tolist()}, "of 1 or more"),
        ({"fov": 170}, "150"), ({"rate_hz": 0}, "> 0"), ({"width": 1920, "height": 1920}, "too large"),
    ):  # fmt: skip
        with pytest.raises(SagsError, match=message):
            parse(ViewRequest, {"name": "a", **args})
    assert parse(AnchorRequest, {"u": 3, "v": 4}).u == 3
    with pytest.raises(SagsError, match="no more than"):
        parse(AnchorRequest, {"x": 1e300, "y": 0, "z": 0})


def test_a_relative_view_moves_with_the_left_camera() -> None:
    left = plane_result().snapshot.camera
    ahead = np.eye(4)
    ahead[:3, 3] = [0.001, 0, 0.01]
    camera = view_camera(parse(ViewRequest, {"name": "a", "T_left_cam": ahead.tolist()}), left)
    assert np.allclose(camera.T_world_cam, left.T_world_cam @ ahead)
    assert camera.K[0, 0] == pytest.approx(left.K[0, 0] * 640 / left.width)


# ---- sharing the machine ---------------------------------------------------------------------------------


class Clocks:
    """Wall time set by the test; every drawing costs `cost` s of processor time."""

    def __init__(self, cost: float) -> None:
        self.now, self.cost, self._calls = 0.0, cost, 0
        self.allowance = Allowance()

    def wall(self) -> float:
        return self.now

    def processor(self) -> float:
        self._calls += 1
        return self.cost * (self._calls // 2)


def run(views: Views, clocks: Clocks, seconds: float, watched: set[str], waited: float = 0.0) -> list[str]:
    """Names drawn while scenes come at 30 Hz."""
    drawn, plane = [], plane_result()
    for i in range(round(30 * seconds)):
        clocks.now += 1 / 30
        clocks.allowance.frame(waited, missed=False)
        drawn += [name for name, _ in views.draw_due(at_frame(plane, i, i), watched)]
    return drawn


def opened(cost: float, **rates: float) -> tuple[Views, Clocks]:
    clocks = Clocks(cost)
    views = Views(clocks.allowance, clocks.wall, clocks.processor)
    for name, rate in rates.items():
        request = parse(ViewRequest, {"name": name, "width": 32, "height": 32, "rate_hz": rate})
        assert views.open(request, plane_result()) is not None
    return views, clocks


def test_each_view_keeps_its_rate_while_there_is_time() -> None:
    views, clocks = opened(0.005, a=10, b=4)
    drawn = run(views, clocks, 10, {"a", "b"})
    assert drawn.count("a") == pytest.approx(100, abs=3) and drawn.count("b") == pytest.approx(40, abs=2)
    status = views.status["a"]
    assert status.held_hz == pytest.approx(10, rel=0.05) and status.limited_by == ""


def test_too_much_is_shared_in_proportion_and_said() -> None:
    views, clocks = opened(0.05, a=10, b=5)  # would take three quarters of a core
    drawn = run(views, clocks, 20, {"a", "b"})
    assert 0.05 * len(drawn) <= 20 * SHARE * 1.1
    assert drawn.count("a") == pytest.approx(2 * drawn.count("b"), rel=0.1)
    status = views.status["a"]
    assert status.granted_hz == pytest.approx(10 / 3, rel=0.01)
    assert status.held_hz == pytest.approx(10 / 3, rel=0.15) and "of a core" in status.limited_by


def test_while_the_mapping_is_late_little_is_drawn() -> None:
    views, clocks = opened(0.01, a=10, b=10)
    run(views, clocks, 1, {"a", "b"}, waited=0.010)
    drawn = run(views, clocks, 20, {"a", "b"}, waited=0.010)
    assert 0.01 * len(drawn) == pytest.approx(20 * LEAST_SHARE, rel=0.1)
    assert abs(drawn.count("a") - drawn.count("b")) <= 1
    assert "the mapping is late" in views.status["a"].limited_by
    run(views, clocks, 5, {"a", "b"})
    assert len(run(views, clocks, 4, {"a", "b"})) == pytest.approx(80, abs=3)
    assert views.status["a"].limited_by == ""


def test_what_nobody_watches_costs_nothing() -> None:
    views, clocks = opened(0.05, a=10, b=10)
    assert set(run(views, clocks, 4, {"b"})) == {"b"}
    assert views.status["a"].limited_by == "nobody subscribes"
    assert views.status["b"].granted_hz == pytest.approx(SHARE / 0.05)


def test_views_are_limited_and_one_of_the_same_name_is_moved() -> None:
    views, _ = opened(0.005, **{f"v{i}": 10.0 for i in range(MAX_VIEWS)})
    scene = plane_result()
    with pytest.raises(SagsError, match="8 views are open"):
        views.open(parse(ViewRequest, {"name": "more"}), scene)
    assert views.open(parse(ViewRequest, {"name": "v0", "rate_hz": 3}), scene) is None
    assert views.status["v0"].asked_hz == 3 and len(views.status) == MAX_VIEWS


def test_what_drew_a_size_goes_with_the_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer that follows its window's size would end the node by its memory, 25 MB at a time."""
    made: weakref.WeakSet[Rasterizer] = weakref.WeakSet()

    def make(backend: str, width: int, height: int) -> Rasterizer:
        rasterizer = make_rasterizer(backend, width, height)  # type: ignore[arg-type]
        made.add(rasterizer)
        return rasterizer

    monkeypatch.setattr(views_module, "make_rasterizer", make)
    views, clocks = opened(0.005, a=10, b=10)
    for width in range(40, 60):
        views.open(parse(ViewRequest, {"name": "a", "width": width, "height": 32}), plane_result())
        assert "a" in run(views, clocks, 0.2, {"a", "b"})
    gc.collect()
    assert len(made) == 2


@pytest.mark.fault("memory: none is left for a view that a consumer asked for")
def test_what_cannot_be_drawn_costs_its_view_alone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    views, clocks = opened(0.005, a=10, b=10)
    full = True

    def make(backend: str, width: int, height: int) -> Rasterizer:
        if full:
            raise MemoryError
        return make_rasterizer(backend, width, height)  # type: ignore[arg-type]

    monkeypatch.setattr(views_module, "make_rasterizer", make)
    views.open(parse(ViewRequest, {"name": "a", "width": 48, "height": 32}), plane_result())
    assert set(run(views, clocks, 2, {"a", "b"})) == {"b"}
    assert views.status["a"].limited_by == "it cannot be drawn: MemoryError"
    (record,) = caplog.records
    assert record.message == "view 'a': it cannot be drawn: MemoryError" and record.exc_info
    with pytest.raises(MemoryError):
        views.open(parse(ViewRequest, {"name": "c", "width": 64, "height": 32}), plane_result())
    assert set(views.status) == {"a", "b"}
    full = False
    assert "a" in run(views, clocks, 0.2, {"a", "b"}) and views.status["a"].limited_by == ""


def test_a_view_of_strain_that_nobody_measures_is_one_line_in_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    views, clocks = opened(0.005)
    views.open(parse(ViewRequest, {"name": "a", "show": "strain"}), None)  # it waits for a frame
    assert not run(views, clocks, 2, {"a"})
    (record,) = caplog.records
    assert "send start_strain first" in record.message and not record.exc_info


@pytest.mark.parametrize(("missed", "share"), [(False, SHARE), (True, LEAST_SHARE)])
def test_work_that_is_not_shared_out_keeps_to_its_allowance(missed: bool, share: float) -> None:
    """As thin images do: 12 ms for each frame at 30 Hz would be 36 % of a core."""
    allowance, worked = Allowance(), 0
    pace = Pace(allowance)
    for _ in range(100):
        allowance.frame(0.0, missed)
    for number in range(3000):
        allowance.frame(0.0, missed)
        if pace.is_due(number / 30):
            pace.worked(number / 30, 0.012)
            worked += 1
    assert 0.012 * worked == pytest.approx(100 * share, rel=0.02)


def test_a_view_opened_before_the_first_frame_is_drawn_with_it() -> None:
    clocks = Clocks(0.005)
    views = Views(clocks.allowance, clocks.wall, clocks.processor)
    assert views.open(parse(ViewRequest, {"name": "a", "width": 32, "height": 32}), None) is None
    assert views.status["a"].limited_by == "it waits for a frame that is taken in"
    assert run(views, clocks, 0.1, set()) == ["a"]


def test_a_view_ahead_is_drawn_where_the_tissue_is_expected_and_says_so() -> None:
    plane = plane_result()
    gaussians = plane.snapshot.gaussians
    count = len(gaussians)
    step = np.full((1, 3), [1e-3, 0, 0], np.float32)
    forecast = Forecast(
        MotionState(None, 0.9, 0.1), 0.05, np.zeros((1, 3), np.float32), np.stack([step, 2 * step]),
        np.zeros((count, 4), np.int32), np.full((count, 4), 0.25, np.float32),
    )  # fmt: skip
    scene = replace(plane, snapshot=replace(plane.snapshot, forecast=forecast))
    there = replace(gaussians, means=gaussians.means + 2 * step)
    views = Views(Allowance(), lambda: 0.0, lambda: 0.0, latency=lambda: 0.05)
    asked = {"width": 64, "height": 48}
    for name, ahead_ms, seconds in (("now", 0, 0.0), ("far", 500, 0.1), ("own", "auto", 0.05)):
        drawn = views.open(parse(ViewRequest, {"name": name, "ahead_ms": ahead_ms, **asked}), scene)
        assert drawn is not None and drawn.ahead_s == pytest.approx(seconds)
        assert drawn.eyes[""].t_capture_ns == plane.snapshot.t_capture_ns
        if name == "far":
            camera = drawn.eyes[""].camera
            apart = drawn.eyes[""].rgb.astype(int) - rasterize(there, camera).rgb
            assert np.abs(apart).max() <= 1
    with pytest.raises(SagsError, match="ahead_ms"):
        parse(ViewRequest, {"name": "a", "ahead_ms": "soon"})


def test_a_view_is_drawn_on_the_gpu_and_on_the_cpu_where_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    use_warp_on_cpu(monkeypatch)
    scene = plane_result()
    views = Views(Allowance(), lambda: 0.0, lambda: 0.0, backend="warp")
    drawn = []
    for name in ("gpu", "cpu"):
        drawn.append(views.open(parse(ViewRequest, {"name": name, "width": 64, "height": 48}), scene))
        monkeypatch.setattr(DeviceRasterizer, "forward", Mock(side_effect=RuntimeError("CUDA error")))
    assert drawn[0] is not None and drawn[1] is not None and drawn[0].eyes[""].alpha.mean() > 0.5
    apart = drawn[0].eyes[""].rgb.astype(int) - drawn[1].eyes[""].rgb
    assert np.abs(apart).max() <= 1 and not np.array_equal(drawn[0].eyes[""].depth, drawn[1].eyes[""].depth)
