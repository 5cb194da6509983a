"""The running node, seen from outside: real processes, real sockets, real faults."""

import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import independent_client as client
import msgpack
import numpy as np
import pytest
from engine_scenes import rasterize
from places import ROOT
from running_node import RunningNode
from waiting import START_SECONDS, until

from sags_node.errors import SagsError
from sags_node.mapping.ladder import RUNGS
from sags_node.messaging.control import ControlClient
from sags_node.messaging.roles import needed
from sags_node.types import Camera, Gaussians

pytestmark = pytest.mark.live

WHOLE = next(number for number, rung in enumerate(RUNGS) if rung.scale == 1)
ANCHOR_FIELDS = ["x", "y", "z", "id", "u", "v", "visibility", "age", "confidence"]
CLOSE_UP = [[0.995, 0, 0.1, -0.003], [0, 1, 0, 0.002], [-0.1, 0, 0.995, 0.012], [0, 0, 0, 1]]


@pytest.fixture(scope="module")
def node(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    # No frame is left out and the rung is given, so what is shown does not depend on how busy the machine is.
    # On this rung the node's renders are drawn at full size, as views always are. Views are the model alone.
    options = ["source.pace:=fast", f"mapping.rung:={WHOLE}", "publish.detail:=false"]
    with RunningNode(phantom_session, tmp_path_factory.mktemp("node"), *options) as running:
        yield running


@pytest.fixture
def control(node: RunningNode) -> Iterator[ControlClient]:
    with ControlClient(node.connection["control"]) as asker:
        until(lambda: asker.request("get_status")["gaussians"], START_SECONDS)
        yield asker


def collect(node: RunningNode, names: list[str], count: int = 1, timeout: float = 60) -> dict[str, list[Any]]:
    return client.collect(node.data, names, count, timeout)


def comes(node: RunningNode, name: str, count: int = 1) -> bool:
    """Whether so many messages of a topic come in half a second."""
    return len(collect(node, [name], count, timeout=0.5)[name]) == count


def by_stamp(messages: list[client.Received]) -> dict[int, client.Received]:
    return {message.meta["stamp_ns"]: message for message in messages}


def anchor_rows(message: client.Received) -> dict[int, np.ndarray]:
    """Rows by anchor id."""
    client.check_meta(message, "sensor_msgs/msg/PointCloud2")
    assert message.meta["encoding"].split(",")[: len(ANCHOR_FIELDS)] == ANCHOR_FIELDS
    rows = message.array()
    ids = rows.view(np.uint32)[:, ANCHOR_FIELDS.index("id")]
    return {int(one): row for one, row in zip(ids, rows, strict=True)}


def test_each_operation_has_its_role(control: ControlClient) -> None:
    """One that was forgotten takes the highest, and no client of a lower one could use it."""
    with pytest.raises(SagsError) as refused:
        control.request("what is there?")
    names = str(refused.value).split("this node knows: ")[1].split(", ")
    assert len(names) > 15
    for name in names:
        reads = name in ("ping", "measure") or name.startswith("get_")
        writes = "recording" in name or "save" in name or "snapshot" in name
        assert needed(name) == ("listen" if reads else "files" if writes else "control"), name


def truth_depth(session: Path, frame_id: int) -> np.ndarray:
    import cv2

    files = sorted((session / "depth").glob("*.png"))
    return cv2.imread(str(files[frame_id % len(files)]), cv2.IMREAD_UNCHANGED) * np.float32(2.5e-6)


@pytest.mark.usefixtures("control")  # there is a model
def test_a_stranger_reads_pictures_depth_points_and_splats(node: RunningNode, phantom_session: Path) -> None:
    """Everything a consumer needs, from the contract alone, in metres against the phantom's truth."""
    names = [
        "left/image_rect_color", "right/image_rect_color", "left/render/image", "right/render/image",
        "left/render/depth", "left/depth", "left/tissue_mask", "left/camera_info", "right/camera_info",
        "points", "splats", "tf", "status",
    ]  # fmt: skip
    width, height = 320, 256

    def covered() -> tuple[dict[str, list[client.Received]], float, float] | None:
        """A model that is young, or had little time, does not cover everything yet."""
        by_name = client.collect(node.data, names, count=12, timeout=40)
        assert not [name for name, messages in by_name.items() if not messages]
        rendered = by_name["left/render/depth"][-1]
        depth = client.check_image(rendered, "32FC1", width, height)
        truth = truth_depth(phantom_session, rendered.meta["frame_id"])
        median, p90, coverage = client.depth_error(depth, truth)
        return (by_name, median, p90) if coverage > 0.9 else None

    by_name, median, p90 = until(covered)
    assert median < 0.8e-3 and p90 < 4e-3
    for messages in by_name.values():
        client.check_sequence(messages)
    left = client.camera_info(by_name["left/camera_info"][-1])
    splats = by_name["splats"][-1]
    columns = client.check_splats(splats)
    pose = client.camera_pose(by_name["tf"][-1])
    means = np.stack([columns[k] for k in "xyz"], 1)
    local = (means - pose[:3, 3]) @ pose[:3, :3]
    K = left["K"]
    u = np.rint(K[0, 0] * local[:, 0] / local[:, 2] + K[0, 2]).astype(int)
    v = np.rint(K[1, 1] * local[:, 1] / local[:, 2] + K[1, 2]).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    surface = truth_depth(phantom_session, splats.meta["frame_id"])[v[inside], u[inside]]
    error = np.abs(local[inside, 2] - surface)[surface > 0]
    assert inside.mean() > 0.9 and np.median(error) < 1e-3
    assert len(by_name["points"][-1].array()) <= len(means)


def test_control_socket_reads_changes_and_saves(control: ControlClient, tmp_path: Path) -> None:
    file = tmp_path / "model.ply"
    assert control.request("ping") is not None
    assert control.request("get_status")["gaussians"] > 1000
    saved = control.request("save_model", {"path": str(file)})
    assert saved["gaussians"] > 1000 and file.stat().st_size > 1000 * 68
    still = "cannot be changed while running"
    for op, args, why in (
        ("set_parameters", {"source.loop": False}, still),
        ("set_parameters", {"mapping.budget_ms": 50, "mapping.skip_still": False}, f"skip_still {still}"),
        ("set_parameters", {"mapping.budget_ms": -1}, "budget_ms"),
        ("save_model", {"path": str(file)}, "exists already"),
        ("save_model", {"path": "a\0b.ply"}, "zero character"),
        ("make_coffee", {}, "unknown"),
    ):
        with pytest.raises(SagsError, match=why) as refused:
            control.request(op, args)
    for op in str(refused.value).rpartition("knows: ")[2].split(", "):
        with pytest.raises(SagsError, match="sugar"):  # no operation takes what would have no effect
            control.request(op, {"sugar": 2})
    assert control.request("get_status")["state"] == "running"
    for budget_ms in (50, None):
        assert control.request("get_parameters")["mapping"]["budget_ms"] != budget_ms
        said = control.request("set_parameters", {"mapping.budget_ms": budget_ms})
        assert said["mapping"]["budget_ms"] == budget_ms


def test_anchors_are_added_followed_and_removed(node: RunningNode, control: ControlClient) -> None:
    by_pixel = control.request("add_anchor", {"u": 162.5, "v": 199})["id"]  # it looks alike in all frames
    point = anchor_rows(collect(node, ["anchors"])["anchors"][0])[by_pixel][:3]
    by_point = control.request("add_anchor", dict(zip("xyz", map(float, point), strict=True)))["id"]
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
    assert "no anchor 999" in control.request("measure", {"anchors": [by_pixel, 999]})["unsure"]
    session = messages[-1].meta["session"]
    assert control.request("remove_anchor", {"id": by_pixel, "session": session}) == {}
    left = anchor_rows(collect(node, ["anchors"], count=3)["anchors"][-1])
    assert by_pixel not in left and by_point in left
    for op, args, why in (
        ("measure", {"anchors": [by_point]}, "2 anchors or more"),
        ("measure", {"anchors": [by_point, by_point]}, "the same anchor twice"),
        ("remove_anchor", {"id": by_point, "session": "another"}, "start before"),
        ("remove_anchor", {"id": by_pixel}, f"no anchor {by_pixel}"),
    ):
        with pytest.raises(SagsError, match=why):
            control.request(op, args)
    control.request("remove_anchor", {"id": by_point})


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
    status = control.request("get_status")["views"]["close"]
    assert status["held_hz"] > 0 and status["draw_ms"] > 0
    images, depths, sure, infos, splats = (by_stamp(got[name]) for name in (*names, "splats"))
    both = images.keys() & depths.keys() & splats.keys()
    assert both, "no view of a frame whose splats came"
    stamp = max(both)
    info = client.camera_info(infos[max(infos)])
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
    shown = client.check_image(images[stamp], "rgba8", 240, 200).astype(float)
    solid = expected.alpha > 0.5
    assert solid.mean() > 0.9
    assert np.abs(shown[..., :3] - expected.rgb)[solid].max() < 2
    assert np.abs(shown[..., 3] / 255 - expected.alpha).max() < 2 / 255
    depth = client.check_image(depths[stamp], "32FC1", 240, 200)
    stated = solid & np.isfinite(depth)
    assert stated.sum() > 0.8 * solid.sum()
    assert np.allclose(depth[stated], expected.depth[stated], atol=2e-5)
    assert np.isnan(depth[expected.depth == 0]).all()
    if stamp in sure:  # each topic was collected by itself
        confidence = client.check_image(sure[stamp], "32FC1", 240, 200)
        assert np.array_equal(confidence > 0, np.isfinite(depth))

    control.request("close_view", {"name": "close"})
    assert not comes(node, "view/close/image") and "close" not in control.request("get_status")["views"]
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
    topics = "view/eyes/left", "left/render", "view/eyes/right", "right/render"
    shown = [by_stamp(got[f"{topic}/image"]) for topic in topics]
    stamp = max(set.intersection(*(set(images) for images in shown)))
    left, left_render, right, right_render = (
        client.check_image(images[stamp], "rgba8", 320, 256).astype(float) for images in shown
    )
    assert np.mean(np.abs(left - left_render)) < 1
    assert np.array_equal(right, right_render)
    P = client.camera_info(got["view/eyes/right/camera_info"][-1])["P"]
    assert np.allclose(P, client.camera_info(got["right/camera_info"][-1])["P"])
    control.request("close_view", {"name": "eyes"})


def test_a_static_view_is_sent_again_to_who_comes_later_and_nothing_of_before(
    node: RunningNode, control: ControlClient
) -> None:
    view = {"name": "still", "width": 64, "height": 48}
    old = [f"view/still/left/{kind}" for kind in ("image", "depth", "camera_info")]
    opened = control.request("open_view", view | {"static": True, "stereo": True, "depth": True})
    assert (opened["asked_hz"], opened["limited_by"]) == (0, "")
    assert all(collect(node, old).values())
    control.request("open_view", view | {"static": True})  # with less
    first, again = (collect(node, ["view/still/image"])["view/still/image"][0] for _ in range(2))
    assert not any(collect(node, old, timeout=0.5).values())
    assert first.meta["stamp_ns"] == again.meta["stamp_ns"] and first.parts == again.parts
    assert not comes(node, "view/still/image", count=2)
    control.request("open_view", view)
    later = collect(node, ["view/still/image"])["view/still/image"][0]
    assert later.meta["stamp_ns"] > first.meta["stamp_ns"], "it is drawn again and again"
    control.request("close_view", {"name": "still"})
    assert not comes(node, "view/still/image")


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
        assert newest is None or all(meta[key] == newest[key] + 1 for key in ("seq", "frame_id"))
    until(lambda: control.request("get_status")["state"] == "running")


def test_the_consumer_of_the_readme_runs_as_it_stands(
    node: RunningNode, control: ControlClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Depth in metres, in five lines and their imports."""
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len([line for line in code.splitlines() if line]) <= 6
    (node.run_dir.parent / "sags").symlink_to(node.run_dir)  # where clients look by themselves
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(node.run_dir.parent))
    command = [sys.executable, "-u", "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as consumer:
        try:
            assert consumer.stdout is not None
            said_first = islice(consumer.stdout, 50)
            lines = list(islice((line for line in said_first if not line.startswith("depth nan")), 5))
            control.request("pause")
            said = consumer.communicate(timeout=60)[1]  # nothing comes any more, so it ends
            control.request("resume")
        finally:
            consumer.kill()
    assert consumer.returncode == 0 and len(lines) == 5, said
    for line in lines:
        found = re.fullmatch(r"depth (\S+) m\n", line)
        assert found is not None and 0.05 < float(found[1]) < 0.1, line
