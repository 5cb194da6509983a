"""The publisher over real sockets, judged by a client that knows only the wire contract."""

import json
import re
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import independent_client as client
import numpy as np
import pytest
from places import ROOT
from synthetic import (
    BASELINE,
    HEIGHT,
    WIDTH,
    at_frame,
    health,
    losing_nothing,
    plane_depth,
    plane_instruments,
    plane_result,
    publisher,
    stream,
)
from waiting import heard, repeating, until

from sags_node.geometry import project
from sags_node.messaging import content, topics
from sags_node.messaging.publisher import Publisher
from sags_node.types import FrameResult

pytestmark = pytest.mark.live

FRAME_TOPICS = [t.name for t in topics.TOPICS if t.name not in ("status", "diagnostics", "parameters")]


Topics = dict[str, list[client.Received]]


@pytest.fixture(scope="module")
def received(tmp_path_factory: pytest.TempPathFactory) -> Topics:
    """Five messages of every topic but `parameters`, as the independent client gets them over tcp."""
    names = [t.name for t in topics.TOPICS if t.name != "parameters"]
    run_dir = tmp_path_factory.mktemp("run", numbered=True) / "sags"
    with losing_nothing(), publisher(run_dir) as running, stream(running):
        endpoint = running.connection.data[-1]
        assert endpoint.startswith("tcp://")
        return client.collect(endpoint, names, count=5, timeout=60)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Publisher]:
    with publisher(tmp_path / "run") as one:
        yield one


# ---- what the frame topics say -------------------------------------------------------------------------


def test_every_topic_arrives_complete_in_order_and_stamped(received: Topics) -> None:
    stamps: dict[int, int] = {}
    for name, messages in received.items():
        assert len(messages) == 5, name
        for message in messages:
            client.check_meta(message, topics.BY_NAME[name].type)
            assert message.meta["session"] == "session-1"
            if name in FRAME_TOPICS:
                stamp_ns = message.meta["stamp_ns"]
                assert stamps.setdefault(message.meta["frame_id"], stamp_ns) == stamp_ns, name
        assert client.check_sequence(messages) == 0, name
    assert len(stamps) < 2 * len(FRAME_TOPICS)  # so most of the five of each are of the same frames


def test_pictures_and_mask_are_those_of_the_frame(received: Topics) -> None:
    truth = plane_result()
    left = client.check_image(received["left/image_rect_color"][0], "rgb8", WIDTH, HEIGHT)
    right = client.check_image(received["right/image_rect_color"][0], "rgb8", WIDTH, HEIGHT)
    mask = client.check_image(received["left/tissue_mask"][0], "mono8", WIDTH, HEIGHT)
    assert np.array_equal(left, truth.pair.left) and np.array_equal(right, truth.pair.right)
    assert np.array_equal(mask, np.where(truth.observation.tissue, 255, 0))
    for name in ("left/render/image", "right/render/image"):
        render = client.check_image(received[name][0], "rgba8", WIDTH, HEIGHT)
        assert np.abs(render[..., :3].astype(int) - truth.pair.left).max() <= 1
        assert np.abs(render[..., 3].astype(int) - 191).max() <= 1  # 0.75


@pytest.mark.parametrize("name", ["left/depth", "left/render/depth"])
def test_depth_is_metric(received: Topics, name: str) -> None:
    depth = client.check_image(received[name][0], "32FC1", WIDTH, HEIGHT)
    truth = plane_depth(plane_result().pair.camera)
    median, p90, coverage = client.depth_error(depth, truth)
    assert p90 < 1e-7 and median < 1e-7
    assert coverage == pytest.approx((HEIGHT - 1) / HEIGHT)
    assert np.isnan(depth[0]).all()


def test_cameras_and_pose_project_the_splats_to_their_pixels(received: Topics) -> None:
    """Camera info, tf and splats together put every Gaussian on the pixel it was made from."""
    left = client.camera_info(received["left/camera_info"][0])
    T_world_cam = client.camera_pose(received["tf"][0])
    splats = client.check_splats(received["splats"][0])
    means = np.stack([splats[axis] for axis in "xyz"], axis=1).astype(np.float64)
    local = (means - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    pixels = (local @ left["K"].T)[:, :2] / local[:, 2:]
    expected = np.stack(np.meshgrid(np.arange(2, WIDTH, 4), np.arange(2, HEIGHT, 4)), -1).reshape(-1, 2)
    assert np.abs(pixels - expected).max() < 1e-3
    assert (left["width"], left["height"], left["frame"]) == (WIDTH, HEIGHT, "left_optical_frame")
    right = client.camera_info(received["right/camera_info"][0])
    assert right["frame"] == "right_optical_frame" and np.array_equal(right["K"], left["K"])
    assert -right["P"][0, 3] / right["P"][0, 0] == pytest.approx(BASELINE)
    assert left["P"][0, 3] == 0


def test_splats_hold_activated_values(received: Topics) -> None:
    gaussians = plane_result().snapshot.gaussians
    splats = client.check_splats(received["splats"][0])
    assert np.allclose(client.splat_colors(splats), gaussians.colors, atol=1e-5)
    assert np.allclose(splats["opacity"], gaussians.opacities)
    assert np.allclose([splats[f"scale_{axis}"][0] for axis in range(3)], [1e-3, 2e-3, 5e-4])
    assert np.allclose(splats["rot_z"], 1.5 / np.sqrt(3))
    assert np.array_equal(splats["id"], gaussians.ids)


def test_instruments_are_rows_and_what_is_not_known_of_them_is_nan(received: Topics) -> None:
    message = received["instruments"][0]
    rows = message.array()
    found = dict(zip(message.meta["encoding"].split(","), rows.T, strict=True))
    truth = plane_instruments()
    assert found["id"].view(np.uint32).tolist() == [2, 5]
    assert found["source"].tolist() == truth.sources.tolist()
    names = (*"xyz", "axis_x", "axis_y", "axis_z", "u", "v", "near_x", "near_y", "near_z")
    told = np.stack([found[name] for name in names], 1)
    expected = np.hstack([truth.tips, truth.axes, truth.pixels, truth.nearest])
    assert np.array_equal(told, expected, equal_nan=True)
    for name in ("confidence", "distance", "distance_confidence", "clearance", "clearance_confidence"):
        assert np.array_equal(found[name], getattr(truth, name), equal_nan=True), name


def test_what_is_told_of_depth_says_how_sure_it_is(received: Topics) -> None:
    """error = 3 mm * log2(1 / confidence), in every topic that tells of depth."""
    truth = plane_result()
    errors = truth.snapshot.gaussians.depth_errors
    for name in ("splats", "points"):
        message = received[name][0]
        column = message.meta["encoding"].split(",").index("confidence")
        told = 0.003 * np.log2(1 / message.array()[:, column])
        nearest = np.abs(told[:, None] - errors).argmin(1)
        assert np.allclose(told, errors[nearest], atol=1e-6) and len(np.unique(nearest)) == len(told), name
    drawn = client.check_image(received["left/render/depth"][0], "32FC1", WIDTH, HEIGHT)
    sure = client.check_image(received["left/render/depth_confidence"][0], "32FC1", WIDTH, HEIGHT)
    assert np.array_equal(sure > 0, np.isfinite(drawn)) and sure.max() <= 1


def test_points_are_coloured(received: Topics) -> None:
    truth = plane_result()
    message = received["points"][0]
    xyz = message.array()[:, :3]
    pixels, _ = project(truth.pair.camera, xyz.astype(np.float64))
    u, v = np.rint(pixels).astype(int).T
    assert np.abs(client.point_colors(message).astype(int) - truth.pair.left[v, u]).max() <= 1


def test_status_is_json_and_says_what_was_skipped(received: Topics) -> None:
    status = json.loads(client.text(received["status"][0]))
    assert status["state"] == "running" and status["rate_hz"] == 30.0
    assert status["latency_ms"] == {"p50": 40.0, "max": None}
    assert status["last_frame"]["skipped"] == {"keyframe": "budget spent"}
    told = (ROOT / "docs/wire.md").read_text().split("### Keys of `status`")[1].split("###")[0]
    assert set(status) == {
        name for row in re.findall(r"^\| (`.*?) \|", told, re.M) for name in re.findall(r"`(\w+)`", row)
    }


# ---- who asks, and when --------------------------------------------------------------------------------


def test_a_late_subscriber_gets_the_last_values(running: Publisher) -> None:
    """No frame is published any more: only the cached topics come, with their old stamps."""
    old = time.time_ns() - 5_000_000_000
    running.publish_result(plane_result(stamp_ns=old), dropped=0)
    running.publish_health(health())
    running.publish_parameters({"mapping": {"budget_ms": 33.0}})
    names = ["left/camera_info", "splats", "parameters", "status", "left/depth", "points"]

    def cached(seconds: float) -> Topics | None:
        got = client.collect(running.connection.data[-1], names, count=2, timeout=seconds)
        return got if sum(map(bool, got.values())) >= 4 else None

    with repeating(lambda _: running.poll(20)):
        got = heard(cached, 1.0)
    assert [len(got[name]) for name in names] == [1, 1, 1, 1, 0, 0]
    assert got["splats"][0].meta["stamp_ns"] == old and got["splats"][0].meta["seq"] == 1
    assert json.loads(client.text(got["parameters"][0])) == {"mapping": {"budget_ms": 33.0}}


def test_only_what_is_subscribed_to_is_encoded(running: Publisher, monkeypatch: pytest.MonkeyPatch) -> None:
    """A prefix subscribes to all below it."""
    encoded: list[str] = []
    counted = {
        name: (lambda result, name=name, build=build: (encoded.append(name), build(result))[1])
        for name, build in content.FRAME_CONTENT.items()
    }
    monkeypatch.setattr(content, "FRAME_CONTENT", counted)
    wanted = {f"left/render/{name}" for name in ("image", "depth", "depth_confidence")}
    with client.subscribed(running.connection.data[-1], "sags/left/render") as peer:
        _poll_until(running, lambda: running.wanted("left/render/depth"))
        running.publish_result(plane_result(), dropped=0)
        came = {peer.recv_multipart()[0].decode() for _ in wanted if peer.poll(60_000)}
    assert set(encoded) == wanted and came == {f"sags/{name}" for name in wanted}
    _poll_until(running, lambda: not running.wanted("left/render/depth"))  # the peer is gone
    encoded.clear()
    running.publish_result(plane_result(), dropped=0)
    assert encoded == []


def test_a_frame_without_time_for_depth_sends_none_and_leaves_no_gap(running: Publisher) -> None:
    """A hole in `seq` means a lost message; depth of another frame under this stamp would be a lie."""
    plane = plane_result()

    def every_other(i: int) -> FrameResult:
        return replace(at_frame(plane, i, time.time_ns()), hurried=bool(i % 2))

    wanted = ["left/depth", "tf"]
    with stream(running, every_other):
        got = client.collect(running.connection.data[-1], wanted, count=4, timeout=60)
    assert all(message.meta["frame_id"] % 2 == 0 for message in got["left/depth"])
    assert np.diff([message.meta["seq"] for message in got["left/depth"]]).tolist() == [1, 1, 1]
    assert np.diff([message.meta["frame_id"] for message in got["tf"]]).tolist() == [1, 1, 1]


def test_while_the_camera_is_lost_no_model_goes_out_under_a_new_stamp(running: Publisher) -> None:
    """Not even to who subscribes just then and is sent the last values."""
    result = plane_result()
    running.publish_result(at_frame(result, 0, time.time_ns()), dropped=0)
    lost = replace(at_frame(result, 1, time.time_ns()), held="too dark")
    running.publish_result(lost, dropped=0)
    with client.subscribed(running.connection.data[0], "sags/") as peer:
        _poll_until(running, lambda: running.wanted("splats"))
        running.publish_result(lost, dropped=0)
        names = set()
        while peer.poll(500 if names else 60_000):
            names.add(peer.recv_multipart()[0].decode().removeprefix("sags/"))
    assert {"left/image_rect_color", "left/tissue_mask", "left/camera_info"} <= names
    assert not names & set(content.OF_THE_MODEL)


def test_restart_and_loop_are_visible(running: Publisher) -> None:
    result = plane_result(epoch=4, step=11)
    with stream(running, lambda i: at_frame(result, i, i + 1, 4 + i)):
        got = client.collect(running.connection.data[-1], ["tf"], count=3, timeout=60)["tf"]
    assert [m.meta["epoch"] - m.meta["frame_id"] for m in got] == [4, 4, 4]
    assert {m.meta["step"] for m in got} == {11}
    assert [m.meta["dropped"] for m in got] == [m.meta["frame_id"] // 2 for m in got]


# ---- bad peers -----------------------------------------------------------------------------------------


@pytest.mark.fault("socket: a subscriber never reads")
def test_a_subscriber_that_never_reads_harms_nobody(running: Publisher) -> None:
    """Publishing goes on, memory stays bounded, and a good peer beside it gets every message."""
    big = plane_result()
    frames = 400
    with client.subscribed(running.connection.data[0], "sags/tf") as good:
        _poll_until(running, lambda: running.wanted("tf"))
        with client.subscribed(running.connection.data[-1], "sags/", high_water=1):
            _poll_until(running, lambda: running.wanted("splats"))
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            seen = []
            for i in range(frames):
                running.publish_result(at_frame(big, i, i + 1), dropped=0)
                running.poll(0)
                if good.poll(60_000):
                    seen.append(good.recv_multipart(copy=False))
            grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    sent_mb = frames * 10 * WIDTH * HEIGHT * 4 / 1e6  # had it all been kept
    assert len(seen) == frames
    assert grown_mb < sent_mb / 3


# ---- the loop ------------------------------------------------------------------------------------------


def _poll_until(running: Publisher, condition: Any) -> None:
    until(lambda: running.poll(10) or condition())
