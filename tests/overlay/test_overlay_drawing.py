"""What the overlay draws: meshes over tissue, in both eyes, and the colour key."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sags_node.clients.overlay.draw import NEAREST, UNDER, Body, Placed, color_key, draw, over
from sags_node.clients.overlay.frame import TissueFrame
from sags_node.clients.overlay.mesh import Mesh
from sags_node.clients.overlay.raster import fill
from sags_node.clients.overlay.run import REMEMBERED, Durations
from sags_node.clients.overlay.stream import OverlayStream
from sags_node.geometry import quat_to_matrix
from sags_node.types import Camera

K = np.array([[300.0, 0, 80], [0, 300, 60], [0, 0, 1]])
SIZE = (120, 160)
RED, KEY = (250, 0, 0), (0, 0, 255)


def wall(z: float = 0.05) -> TissueFrame:
    """A wall of tissue, everything in the camera's own coordinates."""
    camera = Camera(SIZE[1], SIZE[0], K, np.eye(4))
    depth = np.full(SIZE, z, np.float32)
    return TissueFrame(1, 1, "s", 0, camera, 0.005, depth, np.ones(SIZE, bool), {})


def ball(z: float, radius: float = 0.002, opacity: float = 1.0, label: str | None = None) -> Placed:
    """A red ball on the optical axis."""
    import open3d

    made = open3d.geometry.TriangleMesh.create_sphere(radius, 30)
    triangles = np.asarray(made.triangles, np.int32)
    color = np.tile(np.array(RED, np.float32), (len(triangles), 1))
    T = np.eye(4)
    T[2, 3] = z
    return Placed(Body(Mesh(np.asarray(made.vertices, np.float32), triangles, color), opacity, label), T)


def centre(rgba: np.ndarray) -> np.ndarray:
    """Middle (u, v) of what is drawn."""
    return np.argwhere(rgba[..., 3] > 0).mean(0)[::-1]


# ---- drawing ---------------------------------------------------------------------------------------------


def test_where_the_depth_is_not_sure_all_is_as_faint_as_what_lies_under_the_tissue() -> None:
    """Neither before it nor behind it: nobody knows."""
    confidence = np.full(SIZE, 0.5, np.float32)
    confidence[:, 80:] = 0.49
    drawn = draw(replace(wall(), confidence=confidence), [ball(0.04, radius=0.004)])[..., 3]
    left, right = drawn[:, :80], drawn[:, 80:]
    assert left.any() and right.any()
    assert set(np.unique(left)) == {0, 255} and set(np.unique(right)) == {0, round(UNDER * 255)}


@pytest.mark.parametrize("z", [0.04, 0.06], ids=["before the tissue", "under it"])
def test_an_object_whose_place_is_not_sure_is_faint_everywhere(z: float) -> None:
    unsure = replace(ball(z, opacity=0.8), is_sure=False)
    alone = draw(wall(), [unsure])[..., 3]
    assert set(np.unique(alone)) == {0, round(UNDER * 204)}
    nearer = draw(wall(), [ball(z - 0.005, radius=0.0005), unsure])  # and what is sure beside it is not
    assert nearer[60, 80, 3] == (255 if z < 0.05 else round(UNDER * 255))
    assert set(np.unique(nearer[..., 3])) == {0, round(UNDER * 204), nearer[60, 80, 3]}
    assert np.array_equal(nearer, draw(wall(), [unsure, ball(z - 0.005, radius=0.0005)]))


def test_the_label_of_what_is_not_sure_has_a_question_mark() -> None:
    label, T = Body(None, 1.0, "vessel"), ball(0.05).T_world_body
    asked = draw(wall(), [Placed(Body(None, 1.0, "vessel ?"), T)])
    assert np.array_equal(draw(wall(), [Placed(label, T, is_sure=False)]), asked)
    assert not np.array_equal(draw(wall(), [Placed(label, T)]), asked)


def test_triangles_are_drawn_as_rays_see_them() -> None:
    """Against Open3D's ray casting: the same pixels, the same depths, the same triangles."""
    import open3d

    made = open3d.geometry.TriangleMesh.create_torus(0.012, 0.004, 60, 30)
    R = quat_to_matrix(np.array([0.8, 0.4, -0.2, 0.3]))
    vertices = np.asarray(made.vertices) @ R.T + [0.002, 0.001, 0.06]
    triangles = np.asarray(made.triangles, np.int32)
    pixels = np.ascontiguousarray((vertices / vertices[:, 2:] @ K.T)[:, :2])
    colors = np.random.default_rng(0).integers(0, 255, (len(triangles), 4), dtype=np.uint8)
    z, rgba = np.full(SIZE, np.inf, np.float32), np.zeros((*SIZE, 4), np.uint8)
    fill(pixels, np.ascontiguousarray(vertices[:, 2]), triangles, colors, z, rgba)

    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.zeros((*SIZE, 6), np.float32)
    rays[..., 3:] = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    hits = scene.cast_rays(open3d.core.Tensor.from_numpy(rays))
    truth, faces = hits["t_hit"].numpy(), hits["primitive_ids"].numpy()
    hit = np.isfinite(truth)
    assert hit.sum() > 3000
    assert (np.isfinite(z) != hit).sum() < 0.002 * hit.sum()
    both = hit & np.isfinite(z)
    assert np.percentile(np.abs(z[both] - truth[both]), 99) < 1e-6
    same = (rgba[both] == colors[faces[both]]).all(1)
    assert same.mean() > 0.99


def test_what_reaches_behind_the_eye_or_outside_the_picture_is_left_out() -> None:
    for place in ([0, 0, -0.03], [5.0, 0, 0.03], [0, -5.0, 0.03]):
        placed = ball(0.0)
        placed.T_world_body[:3, 3] = place
        assert draw(wall(), [placed])[..., 3].sum() == 0


def test_a_ball_in_front_of_tissue_is_a_full_disc_and_shaded() -> None:
    rgba = draw(wall(), [ball(0.03)])
    drawn = rgba[..., 3] > 0
    assert drawn.sum() == pytest.approx(np.pi * (300 * 0.002 / 0.03) ** 2, rel=0.03)
    assert set(np.unique(rgba[..., 3])) == {0, 255}
    assert rgba[60, 80, 0] > 240 and 100 < rgba[60, 99, 0] < 180  # lit from the eye
    assert not rgba[drawn, 1:3].any()


def test_what_lies_under_the_tissue_shows_through_faintly() -> None:
    rgba = draw(wall(0.05), [ball(0.06)])
    assert set(np.unique(rgba[..., 3])) == {0, round(UNDER * 255)}
    on_it = draw(wall(0.05), [ball(0.05 + 0.0025)])  # its top is 0.5 mm under: it counts as on the surface
    assert on_it[60, 80, 3] == 255 and on_it[60, 91, 3] == round(UNDER * 255)
    picture = np.full((*SIZE, 3), 100, np.uint8)
    shown = over(picture, rgba)
    assert shown[60, 80, 0] == pytest.approx(100 + UNDER * (rgba[60, 80, 0] - 100), abs=1)
    assert (shown[rgba[..., 3] == 0] == 100).all() and (picture == 100).all()


def test_the_nearer_of_two_objects_wins() -> None:
    near, far = ball(0.03, 0.001), ball(0.04, 0.003, opacity=0.5)
    for both in ([near, far], [far, near]):
        rgba = draw(wall(), both)
        assert rgba[60, 80, 3] == 255 and rgba[60, 95, 3] == 128


@pytest.mark.parametrize("what", ["instrument", "unknown depth"])
def test_nothing_is_drawn_over_instruments_or_unknown_depth(what: str) -> None:
    frame = wall()
    if what == "instrument":
        frame.tissue[:, 80:] = False
    else:
        frame.depth[:, 80:] = np.nan
    thing = ball(0.03, label="vessel")
    whole, rgba = draw(wall(), [thing], note="12 ms"), draw(frame, [thing], note="12 ms")
    assert not rgba[:, 80:, 3].any() and whole[:, 80:, 3].any()
    assert np.array_equal(rgba[:, :80], whole[:, :80])


def test_a_label_is_readable_over_tissue_and_follows_its_object() -> None:
    one = draw(wall(0.03), [Placed(Body(None, 1.0, "A"), ball(0.05).T_world_body)])
    rows, columns = np.nonzero(one[..., 3])
    assert len(rows) > 20 and one[rows, columns, :3].max() > 240 and one[rows, columns, :3].min() == 0
    assert abs(rows.mean() - 60) < 10 and 0 < columns.mean() - 80 < 20


# ---- the right eye ---------------------------------------------------------------------------------------


def test_both_eyes_agree_with_the_disparity() -> None:
    baseline = 0.005
    thing = ball(0.04)
    left, right = draw(wall(), [thing]), draw(wall(), [thing], baseline)
    shift = 300 * baseline / 0.04
    assert centre(left)[0] - centre(right)[0] == pytest.approx(shift, abs=0.3)
    assert centre(left)[1] == pytest.approx(centre(right)[1], abs=0.1)
    faint = draw(wall(0.03), [thing], baseline)
    assert set(np.unique(faint[..., 3])) == {0, round(UNDER * 255)}


def test_in_the_right_eye_no_instrument_at_any_depth_is_drawn_over() -> None:
    """A real instrument is put at several depths, and its silhouette in the right eye stays free."""
    baseline, thing = 0.005, ball(0.05, 0.006)
    frame = wall()
    frame.tissue[:, 86:92] = False
    rgba = draw(frame, [thing], baseline)
    assert (rgba[..., 3] > 0).sum() > 200
    for z in (NEAREST, 0.035, 0.04, 0.044):
        shift = 300 * baseline / z
        columns = np.arange(int(np.floor(86 - shift)), int(np.ceil(91 - shift)) + 1)
        assert not rgba[:, columns, 3].any(), z


def test_what_the_left_eye_does_not_see_stays_free_in_the_right_one() -> None:
    baseline, thing = 0.005, ball(0.04, 0.1)
    rgba = draw(wall(0.06), [thing], baseline)
    assert not rgba[:, SIZE[1] - int(300 * baseline / NEAREST) :, 3].any()


# ---- the colour key --------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", [KEY, (0, 255, 0), (0, 0, 0)])
def test_the_colour_key_is_exact(key: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(0)
    rgba = np.zeros((*SIZE, 4), np.uint8)
    rgba[20:80, 20:90] = rng.integers(0, 256, (60, 70, 4))
    rgba[30, 30] = (*key, 255)
    rgba[31, 31] = (*key, 40)
    keyed = color_key(rgba, key)
    is_key = (keyed == key).all(2)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    alpha = rgba[..., 3]
    drawn = (alpha >= 128) | ((alpha > 0) & ((u + v) % 2 == 0))
    assert np.array_equal(is_key, ~drawn)
    difference = np.abs(keyed.astype(int) - rgba[..., :3])[drawn]
    assert difference.sum(1).max() == 1 and (difference > 0).sum() >= 2  # only where it would be the key


# ---- what the overlay remembers of its own speed -------------------------------------------------------


def test_the_newest_are_kept_in_their_order() -> None:
    durations = Durations()
    assert durations.percentiles() == {"p50": None, "p90": None, "p99": None}
    for ms in range(REMEMBERED + 10):
        durations.add(float(ms))
    last = REMEMBERED + 9
    assert durations.last().tolist() == list(range(10, REMEMBERED + 10))
    assert durations.percentiles(101) == {"p50": last - 50, "p90": last - 10, "p99": last - 1}


def test_a_blank_overlay_says_why_for_some_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first image is empty, at once, and so are those after 5.5 s; a new reason is said again."""
    now, said = 0.0, []
    with OverlayStream("overlay", tmp_path, KEY) as stream, monkeypatch.context() as patched:
        patched.setattr("sags_node.clients.overlay.stream.time.monotonic", lambda: now)
        for tenths in range(200):
            now = tenths / 10
            stream.blank("lost: the model was started anew" if now < 10 else "stale tf", (120, 160))
            said += [tenths] if stream.notice().any() else []
    assert said == [*range(5, 55), *range(105, 155)]
