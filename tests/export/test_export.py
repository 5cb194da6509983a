"""`sags export`: files that other programs open, true to the surface they show, and never half written."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import open3d
import pytest
from command_line import figures_of, refused, sags
from engine_scenes import rasterize, rows
from running_node import RunningNode
from splat_files import splats_of
from warp_on_cpu import use_warp_on_cpu

from sags_node.config.schema import PhantomSource
from sags_node.engine.gpu.rasterizer import DeviceRasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import SagsError
from sags_node.geometry import project, unproject
from sags_node.mapping import mapper
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.control import ControlClient
from sags_node.messaging.received import ReceivedImage, TopicName
from sags_node.messaging.subscriber import Subscriber
from sags_node.model.constant_colours import with_constant_colours
from sags_node.phantom.scene import Phantom
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.tools.export import export
from sags_node.tools.export import scene as export_scene
from sags_node.tools.export import surface as export_surface
from sags_node.tools.export.orbit import orbit
from sags_node.tools.export.scene import Scene, from_fit, from_node, from_session, scenes_of_session
from sags_node.tools.export.surface_files import Surface
from sags_node.tools.fitting import start
from sags_node.types import SH_DEGREE_0

pytestmark = pytest.mark.usefixtures("run_dir")

STEP = ("source.pace:=step", "mapping.iterations:=2")
FRAME, FRAMES = 20, 40  # the lift, at 2 s
MM = 1e3
SeenAt = Callable[[Scene, np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def scene(phantom_session: Path) -> Scene:
    return from_session(open_session(phantom_session, STEP), 2.0, lambda *said: None)


@pytest.fixture(scope="module")
def seen_at(phantom_session: Path) -> SeenAt:
    """Colours [N, 3] 0..1 that the left camera really saw where points [N, 3] (m) are."""
    session = open_session(phantom_session, [*STEP, f"source.start:={FRAME / 10}", "source.frames:=1"])
    with session.source as source:
        (frame,) = source
    picture = Pipeline(session.config, session.rig).rectifier(frame).left / 255

    def at(scene: Scene, points: np.ndarray) -> np.ndarray:
        pixels = np.rint(project(scene.camera, points)[0]).astype(int)
        u, v = np.clip(pixels, 0, (scene.camera.width - 1, scene.camera.height - 1)).T
        return np.asarray(picture[v, u])

    return at


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    """What `phantom_session` shows."""
    return Phantom(PhantomSource(seconds=4.0, width=320, height=256, seed=1))


class Truth:
    """The tissue's true surface at one frame."""

    def __init__(self, phantom: Phantom, frame: int) -> None:
        tissue = phantom.tissue
        self.surface = raycasting(tissue.vertices(frame / FRAMES).reshape(-1, 3), tissue.faces)
        self.depth = phantom.frame(frame, FRAMES).depth

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Of points [N, 3] (m), mm."""
        return self.surface.compute_distance(tensor(points)).numpy() * MM


def raycasting(vertices: np.ndarray, triangles: np.ndarray) -> Any:
    made = open3d.t.geometry.RaycastingScene()
    made.add_triangles(tensor(vertices), open3d.core.Tensor.from_numpy(triangles.astype(np.uint32)))
    return made


def tensor(values: np.ndarray) -> Any:
    return open3d.core.Tensor.from_numpy(np.ascontiguousarray(values, np.float32))


@pytest.fixture(scope="module")
def truth(phantom: Phantom) -> Truth:
    return Truth(phantom, FRAME)


# ---- what is written -------------------------------------------------------------------------------------


def test_splats_are_read_by_another_program(phantom_session: Path, scene: Scene, tmp_path: Path) -> None:
    file = tmp_path / "model.ply"
    (row,) = figures_of("export", phantom_session, *STEP, "--at", "2", "--splats", file, "--json")
    gaussians, columns = with_constant_colours(scene.gaussians), splats_of(file)
    holds = len(columns["x"])  # in the file, where one of several colours is written as several
    assert row == {"file": str(file), "kind": "splats", "holds": holds, "bytes": file.stat().st_size}

    def of(*names: str) -> np.ndarray:
        return np.stack([columns[name] for name in names], axis=1)

    assert np.array_equal(of("x", "y", "z"), gaussians.means)
    assert np.allclose(np.exp(of("scale_0", "scale_1", "scale_2")), gaussians.scales, rtol=1e-5)
    assert np.allclose(1 / (1 + np.exp(-columns["opacity"])), gaussians.opacities, atol=1e-5)
    colors = 0.5 + SH_DEGREE_0 * of("f_dc_0", "f_dc_1", "f_dc_2")
    assert np.allclose(colors, gaussians.colors, atol=1e-5)
    assert np.array_equal(np.float32(open3d.io.read_point_cloud(file).points), gaussians.means)


@pytest.mark.parametrize("ending", [".ply", ".pcd"])
def test_points_are_true(scene: Scene, truth: Truth, seen_at: SeenAt, tmp_path: Path, ending: str) -> None:
    file = tmp_path / f"points{ending}"
    count = export_surface.write_points(file, scene)
    cloud = open3d.io.read_point_cloud(file)
    points, colors = np.asarray(cloud.points), np.asarray(cloud.colors)
    assert len(points) == count > 0.8 * scene.camera.width * scene.camera.height
    assert np.median(truth.distances(points)) < 0.5
    assert np.abs(colors - seen_at(scene, points)).mean(axis=0).max() < 0.04


@pytest.mark.parametrize("ending", [".ply", ".pcd", ".obj", ".stl"])
def test_colours_beyond_white_are_white(scene: Scene, tmp_path: Path, ending: str, capfd: Any) -> None:
    """Live, the light of a moment ago leaves some."""
    bright = replace(scene, gaussians=replace(scene.gaussians, colors=scene.gaussians.colors + np.float32(2)))
    write = export_surface.write_points if ending == ".pcd" else export_surface.write_mesh
    write(tmp_path / f"bright{ending}", bright)
    assert capfd.readouterr() == ("", "")
    if ending == ".pcd":
        assert np.asarray(open3d.io.read_point_cloud(tmp_path / "bright.pcd").colors).min() == 1.0


def test_a_gpu_draws_it_and_the_cpu_where_that_fails(
    phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_warp_on_cpu(monkeypatch)
    first = ("source.pace:=step", "mapping.iterations:=0", "mapping.max_gaussians:=1000", "source.frames:=1")
    monkeypatch.setattr(mapper, "FIRST_STEPS", 1)  # Warp's CPU device is slow
    (scene,) = scenes_of_session(open_session(phantom_session, [*first, "device:=cuda"]))
    asked = Mock(side_effect=[None, RuntimeError("CUDA error")])
    median = DeviceRasterizer.median
    monkeypatch.setattr(DeviceRasterizer, "median", lambda drawer: asked() or median(drawer))

    clouds = []
    for name in ("gpu", "cpu"):
        file = tmp_path / f"{name}.ply"
        export_surface.write_points(file, scene)
        clouds.append(open3d.io.read_point_cloud(file))
    gpu, cpu = clouds
    assert asked.call_count == 2 and len(gpu.points) > 0.5 * scene.camera.width * scene.camera.height
    apart = np.concatenate([gpu.compute_point_cloud_distance(cpu), cpu.compute_point_cloud_distance(gpu)])
    assert np.median(apart) < 1e-6 and np.quantile(apart, 0.99) < 1e-4  # m


@pytest.mark.parametrize("ending", [".ply", ".obj", ".stl"])
def test_the_mesh_is_true(scene: Scene, truth: Truth, seen_at: SeenAt, tmp_path: Path, ending: str) -> None:
    file = tmp_path / f"mesh{ending}"
    count = export_surface.write_mesh(file, scene)
    mesh = open3d.io.read_triangle_mesh(file)
    assert len(mesh.triangles) == count
    to_truth = truth.distances(np.asarray(mesh.sample_points_uniformly(20_000).points))
    assert np.median(to_truth) < 0.4 and np.quantile(to_truth, 0.9) < 1.5

    v, u = np.nonzero(truth.depth)
    seen = unproject(scene.camera, np.stack([u, v], -1).astype(float), truth.depth[v, u].astype(float))
    surface = raycasting(np.asarray(mesh.vertices), np.asarray(mesh.triangles))
    to_mesh = surface.compute_distance(tensor(seen)).numpy() * MM
    assert np.median(to_mesh) < 0.4 and np.quantile(to_mesh, 0.9) < 1.5

    mesh.compute_triangle_normals()
    centres = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)].mean(axis=1)
    towards = scene.camera.T_world_cam[:3, 3] - centres
    assert np.mean(np.sum(np.asarray(mesh.triangle_normals) * towards, axis=1) > 0) > 0.9
    if ending == ".stl":
        return
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    away = np.sum(normals * (scene.camera.T_world_cam[:3, 3] - vertices), axis=1) < 0
    assert mesh.has_vertex_normals() and away.mean() < 0.1
    apart = np.asarray(mesh.vertex_colors) - seen_at(scene, vertices)
    assert np.median(np.abs(apart), axis=0).max() < 0.04


def test_a_hole_of_the_model_is_a_hole_of_the_mesh(scene: Scene, tmp_path: Path) -> None:
    camera, middle, radius = scene.camera, np.array([150.0, 120.0]), 32.0
    pixels, _ = project(camera, scene.gaussians.means)
    kept = np.linalg.norm(pixels - middle, axis=1) > radius
    export_surface.write_mesh(tmp_path / "hole.ply", replace(scene, gaussians=rows(scene.gaussians, kept)))
    mesh = open3d.io.read_triangle_mesh(tmp_path / "hole.ply")
    surface = raycasting(np.asarray(mesh.vertices), np.asarray(mesh.triangles))

    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    far = unproject(camera, np.stack([u, v], -1), np.ones_like(u))
    origin = np.broadcast_to(camera.T_world_cam[:3, 3], far.shape)
    hits = surface.cast_rays(tensor(np.concatenate([origin, far - origin], -1)))["t_hit"].numpy()
    distance = np.hypot(u - middle[0], v - middle[1])
    inside, around = distance < radius - 8, (distance > radius + 8) & (distance < radius + 20)
    assert not np.isfinite(hits[inside]).any()
    assert np.isfinite(hits[around]).mean() > 0.95


def frames_of(video: Path) -> np.ndarray:
    """RGB [N, H, W, 3]."""
    capture, frames = cv2.VideoCapture(str(video)), []
    while (read := capture.read())[0]:
        frames.append(read[1][..., ::-1])
    return np.array(frames)


def test_the_video_goes_around_and_comes_back(scene: Scene, tmp_path: Path) -> None:
    file = tmp_path / "orbit.mp4"
    targets, orbiting = {"orbit": file}, export.Orbit(degrees=20, seconds=0.8)
    (row,) = export.export(scene, targets, orbiting, lambda *said: None)
    frames = frames_of(file).astype(np.float32)
    assert frames.shape == (24, 256, 320, 3) and row["holds"] == 24
    steps = np.abs(frames - np.roll(frames, 1, axis=0)).mean((1, 2, 3))
    assert frames.std((1, 2, 3)).min() > 10 and steps.min() > 1
    assert steps[0] < 1.5 * steps[1:].max()  # from the last image to the first
    assert np.abs(frames - np.roll(frames, 12, axis=0)).mean() > 2 * steps.mean()  # the other side

    still = tmp_path / "still.mp4"
    export.export(scene, {"orbit": still}, export.Orbit(degrees=0, seconds=0.1), lambda *said: None)
    view = rasterize(scene.gaussians, scene.camera)
    apart = np.abs((frames_of(still)[0].astype(int) - view.rgb) / 255)[view.alpha > 0.99]
    assert apart.mean(axis=0).max() < 0.02


def test_all_cameras_of_the_video_look_at_the_same_point(scene: Scene) -> None:
    camera, distance = scene.camera, 0.07
    middle = camera.T_world_cam[:3, 3] + distance * camera.T_world_cam[:3, 2]
    for eye in orbit(camera, distance, 25.0, 12):
        pixel, depth = project(eye, middle)
        assert np.allclose(pixel, camera.K[:2, 2]) and depth == pytest.approx(distance)
        assert np.degrees(np.arccos(eye.T_world_cam[:3, 2] @ camera.T_world_cam[:3, 2])) == pytest.approx(25)


# ---- where it comes from ---------------------------------------------------------------------------------


@pytest.mark.live
def test_a_node_is_exported(phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Where time is short, a part of the image is as it was before the frame's step.
    depth = TopicName("left/render/depth", ReceivedImage)
    with RunningNode(phantom_session, tmp_path, "mapping.iterations:=1") as node:
        with Subscriber([depth], run_dir=node.run_dir) as subscriber:
            assert subscriber.wait(depth, 60) is not None
            drawn = {}
            taken = from_node(NodeAddress(run_dir=node.run_dir))
            while taken.t_capture_ns not in drawn:  # the same frame, as the node drew it
                newest = subscriber.latest(depth)
                drawn[newest.stamp_ns if newest else 0] = newest
                if newest is not None and newest.stamp_ns > taken.t_capture_ns:
                    taken = from_node(NodeAddress(run_dir=node.run_dir))
        theirs = drawn[taken.t_capture_ns].array
        mine = rasterize(taken.gaussians, taken.camera).depth
        both = np.isfinite(theirs) & (mine > 0)
        assert both.mean() > 0.8 and np.quantile(np.abs(mine - theirs)[both], 0.99) < 1e-4

        file = tmp_path / "now.ply"
        done = sags("export", "--endpoint", node.data, "--mesh", file, "--json")
        assert done.exit_code == 0 and json.loads(done.stdout)[0]["holds"] > 1000, done.stderr

        monkeypatch.setattr(export_scene, "PATIENCE", 1.5)
        with ControlClient(run_dir=node.run_dir) as control:
            control.request("pause")
        with pytest.raises(SagsError, match="nothing fresh came"):
            from_node(NodeAddress(run_dir=node.run_dir))
    refused(1, "export", "--mesh", tmp_path / "none.ply", said=("no node runs as 'sags'",))


def test_a_fit_is_exported_at_any_time(
    phantom_session: Path, phantom: Phantom, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start, "PATH_STEPS", 100)  # ten frames are learnt sooner than a clip
    session, fit = (phantom_session, "source.frames:=10"), tmp_path / "fit"
    figures = figures_of("fit", *session, *"--iterations 3 --max-gaussians 6000 --json --out".split(), fit)
    splats, points = tmp_path / "splats.ply", tmp_path / "points.ply"
    for at, here, elsewhere in (("0.0", 0, 9), ("0.9", 9, 0)):
        files = ("--splats", splats, "--points", points, "--force")
        done = sags("export", *session, "--fit", fit, "--at", at, *files)
        assert done.exit_code == 0, done.stderr
        cloud = np.asarray(open3d.io.read_point_cloud(points).points)
        near, far = (np.median(Truth(phantom, frame).distances(cloud)) for frame in (here, elsewhere))
        assert near < 0.5 and near < 0.5 * far  # the tissue moves by 0.9 mm between the two
    count = figures["gaussians"]
    assert count < len(splats_of(splats)["x"]) <= 2 * count  # steep ones in two
    for frames in (9, 11):
        other = (phantom_session, f"source.frames:={frames}", "--fit", fit)
        refused(2, "export", *other, "--splats", tmp_path / "new.ply", said=("frames",))


def test_a_fit_without_filters_is_drawn_without_them(phantom_session: Path, tmp_path: Path) -> None:
    options = "--schedule paper --warm-up 2 --iterations 1 --max-gaussians 2000 --no-alias-free".split()
    done = sags("fit", phantom_session, "source.frames:=4", "--out", tmp_path, *options)
    assert done.exit_code == 0, done.output
    session = open_session(phantom_session, ["source.pace:=step", "source.loop:=false", "source.frames:=4"])
    scene = from_fit(tmp_path, session, 0.1, lambda done, of, what: None)
    shown = cv2.imread(str(tmp_path / "test/000001.png"))[..., ::-1].astype(float)  # held out

    def off(each: Scene) -> float:
        drawn = colours_of(each.drawer().forward(each.gaussians, each.camera))
        return float(np.abs(255 * np.clip(drawn, 0, 1) - shown).max())

    assert off(scene) < 0.51  # rounded
    assert off(replace(scene, antialias=True)) > 2


# ---- mistakes --------------------------------------------------------------------------------------------


def test_mistakes_are_one_message_before_any_work(phantom_session: Path, tmp_path: Path) -> None:
    session = ("export", phantom_session)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "empty").mkdir()
    ply = tmp_path / "f.ply"
    for arguments, said in (
        (session, ("nothing to export", "--splats")),
        ((*session, "--mesh", tmp_path / "m.glb"), ("--mesh", "m.glb", ".ply or .obj or .stl")),
        ((*session, "--splats", tmp_path / "s.pcd"), ("--splats", "must end in .ply")),
        ((*session, "--orbit", tmp_path / "o.avi"), ("must end in .mp4",)),
        ((*session, "--mesh", tmp_path / "no/m.ply"), ("there is no folder", "no")),
        ((*session, "--mesh", tmp_path / "file/m.ply"), ("there is no folder",)),
        ((*session, "--mesh", tmp_path / "folder.ply"), ("is a directory",)),
        ((*session, "--mesh", ply, "--points", ply), ("the same file",)),
        ((*session, "--mesh", ply, "--at", "99"), ("--at 99", "ends after 3.90 s")),
        ((*session, "--mesh", ply, "--at", "-1"), ("--at", "-1")),
        ((*session, "--mesh", ply, "--orbit-degrees", "90"), ("--orbit-degrees",)),
        ((*session, "--mesh", ply, "--fit", tmp_path / "empty"), ("checkpoint.npz", "sags fit")),
        ((*session, "--mesh", ply, "sorce.start:=1"), ("sorce", "source")),
        (("export", tmp_path / "gone.yaml", "--mesh", ply), ("gone.yaml",)),
        (("export", "--mesh", ply, "--at", "1"), ("need a recording",)),
        (("export", "--mesh", ply, "source.start:=1"), ("need a recording",)),
    ):
        refused(2, *arguments, said=said)
    (tmp_path / "empty/checkpoint.npz").write_bytes(b"PK\x03\x04 not a checkpoint")
    (tmp_path / "empty/figures.json").write_text("{}")
    refused(1, *session, "--mesh", ply, "--fit", tmp_path / "empty", said=("cannot be read",))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["empty", "file", "folder.ply"]


def test_what_exists_is_replaced_only_when_told_and_only_by_something_whole(
    phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    file = folder / "mesh.ply"
    file.write_text("mine")
    command = ("export", phantom_session, *STEP, "--at", "0", "--mesh", file)
    refused(2, *command, said=("exists already", "--force"))
    assert file.read_text() == "mine"

    encode = export_surface.encoded

    def interrupted(suffix: str, surface: Surface) -> bytes:
        (part,) = folder.glob(".sags-*")
        (part / "mesh.ply").write_bytes(encode(suffix, surface)[:100])
        raise KeyboardInterrupt

    monkeypatch.setattr(export_surface, "encoded", interrupted)
    done = sags(*command, "--force")
    assert done.exit_code == 130 and "stopped" in done.stderr
    assert file.read_text() == "mine" and list(folder.iterdir()) == [file]

    monkeypatch.setattr(export_surface, "encoded", encode)
    assert sags(*command, "--force").exit_code == 0
    assert file.read_bytes().startswith(b"ply") and list(folder.iterdir()) == [file]
