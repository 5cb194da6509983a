"""Views on request: what is refused, how they share the machine, and what they show."""

import gc
import weakref
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from engine_scenes import rasterize
from synthetic import at_frame, plane_result
from warp_on_cpu import use_warp_on_cpu

from sags_node.engine.gpu.rasterizer import DeviceRasterizer
from sags_node.engine.rasterizer.rasterize import Drawer
from sags_node.errors import SagsError
from sags_node.messaging.requests import AnchorRequest, ViewRequest, parse
from sags_node.node import views as views_module
from sags_node.node.allowance import LEAST_SHARE, SHARE, Allowance, Pace
from sags_node.node.views import MAX_VIEWS, Views, view_camera
from sags_node.types import Forecast, MotionState

pytestmark = pytest.mark.live

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
        assert views.open(asked(name, rate_hz=rate), plane_result()) is not None
    return views, clocks


def asked(name: str, **changed: Any) -> ViewRequest:
    """A small view."""
    return parse(ViewRequest, {"name": name, "width": 32, "height": 32, **changed})


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
    run(views, clocks, 5, {"a", "b"}, waited=0.010)  # the mean of late frames settles
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
    with pytest.raises(SagsError, match="8 views are open"):
        views.open(asked("more"), plane_result())
    assert views.open(asked("v0", rate_hz=3), plane_result()) is None
    assert views.status["v0"].asked_hz == 3 and len(views.status) == MAX_VIEWS


def test_what_drew_a_size_goes_with_the_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer that follows its window's size would end the node by its memory, 25 MB at a time."""
    made: weakref.WeakSet[Drawer] = weakref.WeakSet()

    def make(backend: str, width: int, height: int) -> Drawer:
        drawer = Drawer(backend, width, height)
        made.add(drawer)
        return drawer

    monkeypatch.setattr(views_module, "Drawer", make)
    views, clocks = opened(0.005, a=10, b=10)
    for width in range(40, 60):
        views.open(asked("a", width=width), plane_result())
        assert "a" in run(views, clocks, 0.2, {"a", "b"})
    gc.collect()
    assert len(made) == 2


@pytest.mark.fault("memory: none is left for a view that a consumer asked for")
def test_what_cannot_be_drawn_costs_its_view_alone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    views, clocks = opened(0.005, a=10, b=10)
    with monkeypatch.context() as full:
        full.setattr(views_module, "Drawer", Mock(side_effect=MemoryError))
        views.open(asked("a", width=48), plane_result())
        assert set(run(views, clocks, 2, {"a", "b"})) == {"b"}
        assert views.status["a"].limited_by == "it cannot be drawn: MemoryError"
        (record,) = caplog.records
        assert record.message == "view 'a': it cannot be drawn: MemoryError" and record.exc_info
        with pytest.raises(MemoryError):
            views.open(asked("c", width=64), plane_result())
        assert set(views.status) == {"a", "b"}
    assert "a" in run(views, clocks, 0.2, {"a", "b"}) and views.status["a"].limited_by == ""


def test_a_view_of_strain_that_nobody_measures_is_one_line_in_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    views, clocks = opened(0.005)
    views.open(asked("a", show="strain"), None)  # it waits for a frame
    assert not run(views, clocks, 2, {"a"})
    (record,) = caplog.records
    assert "send start_strain first" in record.message and not record.exc_info


@pytest.mark.parametrize(
    ("late_of_ten", "share"), [(0, SHARE), (5, (SHARE + LEAST_SHARE) / 2), (10, LEAST_SHARE)]
)
def test_work_that_is_not_shared_out_keeps_to_its_allowance(late_of_ten: int, share: float) -> None:
    """As thin images do: 12 ms for each frame at 30 Hz would be 36 % of a core."""
    allowance, worked = Allowance(), 0
    pace = Pace(allowance)
    for number in range(100):
        allowance.frame(0.0, number % 10 < late_of_ten)
    for number in range(3000):
        allowance.frame(0.0, number % 10 < late_of_ten)
        if pace.is_due(number / 30):
            pace.worked(number / 30, 0.012)
            worked += 1
    assert 0.012 * worked == pytest.approx(100 * share, rel=0.02)


def test_a_view_opened_before_the_first_frame_is_drawn_with_it() -> None:
    views, clocks = opened(0.005)
    assert views.open(asked("a"), None) is None
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
    for name, ahead_ms, seconds in (("now", 0, 0.0), ("far", 500, 0.1), ("own", "auto", 0.05)):
        drawn = views.open(asked(name, ahead_ms=ahead_ms, width=64, height=48), scene)
        assert drawn is not None and drawn.ahead_s == pytest.approx(seconds)
        assert drawn.eyes[""].t_capture_ns == plane.snapshot.t_capture_ns
        if name == "far":
            camera = drawn.eyes[""].camera
            apart = drawn.eyes[""].rgb.astype(int) - rasterize(there, camera).rgb
            assert np.abs(apart).max() <= 1
    with pytest.raises(SagsError, match="ahead_ms"):
        asked("a", ahead_ms="soon")


@pytest.mark.parametrize("error", [RuntimeError("CUDA error"), Exception("a kernel cannot be loaded")])
def test_a_view_is_drawn_on_the_gpu_and_on_the_cpu_where_that_fails(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    use_warp_on_cpu(monkeypatch)
    scene = plane_result()
    views = Views(Allowance(), lambda: 0.0, lambda: 0.0, backend="warp")
    gpu = views.open(asked("gpu", width=64, height=48), scene)
    monkeypatch.setattr(DeviceRasterizer, "forward", Mock(side_effect=error))
    cpu = views.open(asked("cpu", width=64, height=48), scene)
    assert gpu is not None and cpu is not None
    one, other = gpu.eyes[""], cpu.eyes[""]
    assert one.alpha.mean() > 0.5
    assert np.abs(one.rgb.astype(int) - other.rgb).max() <= 1 and not np.array_equal(one.depth, other.depth)
