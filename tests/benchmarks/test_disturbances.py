"""Disturbances do what they say, only then, and always the same; `benchmarks disturbances` measures them."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from frames import played
from places import ROOT

from benchmarks.disturbances import DISTURBANCES, Scene, disturbed
from benchmarks.disturbances.light import GRAIN, to_linear
from benchmarks.disturbances.tissue import SMOKE_VEIL
from benchmarks.quality.disturbances import frames_to_recover, warning_times
from sags_node.phantom.camera import SMOKE_COLOR
from sags_node.pipeline.session import Session, open_session
from sags_node.rig import rectified_rig
from sags_node.types import F32, U8, StereoFrame

SESSION = ROOT / "replay/phantom_pull"
NAMES = (
    "clean smoke blood fog_right fog_left black_right frozen_right frozen late_right swapped equal drops "
    "dark flicker flash cut blur lost_frames jpeg knocked"
)
LEFT_STAYS = {"fog_right", "black_right", "frozen_right", "late_right", "equal", "knocked"}
DURING = range(5, 9)
WIDTH, HEIGHT, FOCAL, BASELINE = 192, 128, 200.0, 0.005


@pytest.fixture(scope="module")
def session() -> Session:
    return open_session(SESSION, ["source.pace:=step", "source.frames:=12"])


@pytest.fixture(scope="module")
def frames(session: Session) -> list[StereoFrame]:
    return played(session.config.source)


def scene_of(session: Session, frames: list[StereoFrame]) -> Scene:
    depths = {frame.frame_id: frame.reference.depth for frame in frames if frame.reference is not None}
    return Scene(session.rig, {number: depth for number, depth in depths.items() if depth is not None})


def play(name: str, frames: list[StereoFrame], scene: Scene) -> list[StereoFrame | None]:
    return [given for _, given in disturbed(DISTURBANCES[name], frames, DURING, 30.0, scene)]


def made(left: U8, right: U8 | None = None, count: int = 30) -> list[StereoFrame]:
    """The same pair again and again."""
    return [StereoFrame(i, i, i, left, left if right is None else right) for i in range(count)]


def on_plane(depths: dict[int, F32]) -> Scene:
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    return Scene(rectified_rig("plane", WIDTH, HEIGHT, K, BASELINE), depths)


def changed(name: str, frames: list[StereoFrame], scene: Scene) -> Iterator[StereoFrame]:
    """All frames disturbed."""
    for _, given in disturbed(DISTURBANCES[name], frames, range(len(frames)), 30.0, scene):
        assert given is not None
        yield given


def test_all_are_there() -> None:
    assert [each.name for each in DISTURBANCES.values()] == list(DISTURBANCES) == NAMES.split()


@pytest.mark.parametrize("name", NAMES.split())
def test_each_changes_what_it_says_only_then_and_always_alike(
    name: str, session: Session, frames: list[StereoFrame]
) -> None:
    first, again = (play(name, frames, scene_of(session, frames)) for _ in range(2))
    for number, (frame, given, repeated) in enumerate(zip(frames, first, again, strict=True)):
        if number not in DURING:
            assert given is frame
            continue
        if given is None or repeated is None:
            assert name == "lost_frames" and given is repeated
            continue
        assert np.array_equal(given.left, repeated.left) and np.array_equal(given.right, repeated.right)
        same_left = np.array_equal(given.left, frame.left)
        same_right = np.array_equal(given.right, frame.right)
        assert same_left == (name in LEFT_STAYS or name in ("clean", "lost_frames"))
        assert same_right == (name in ("clean", "lost_frames", "fog_left"))
        assert given.left.dtype == np.uint8 and given.left.shape == frame.left.shape
        truth = replace(given, left=frame.left, right=frame.right, tissue=frame.tissue)
        for field in ("frame_id", "t_capture_ns", "t_capture_right_ns", "reference", "T_world_cam"):
            assert getattr(truth, field) is getattr(frame, field) or name == "clean"


def test_faults_of_the_right_eye(session: Session, frames: list[StereoFrame]) -> None:
    scene = scene_of(session, frames)
    late, frozen, swapped, equal, black = (
        play(name, frames, scene)
        for name in ("late_right", "frozen_right", "swapped", "equal", "black_right")
    )
    for number in DURING:
        frame = frames[number]
        assert np.array_equal(late[number].right, frames[number - 3].right)
        assert np.array_equal(frozen[number].right, frames[DURING.start - 1].right)
        assert np.array_equal(swapped[number].right, frame.left)
        assert np.array_equal(swapped[number].left, frame.right)
        assert np.array_equal(equal[number].right, frame.left)
        assert not black[number].right.any()


def test_how_long_each_lasts() -> None:
    lengths = {name: each.length(30, 30.0) for name, each in DISTURBANCES.items()}
    assert (lengths.pop("dark"), lengths.pop("flash"), lengths.pop("cut")) == (15, 2, 10)
    assert set(lengths.values()) == {30}
    assert DISTURBANCES["cut"].length(4, 30.0) == 4


def test_a_fifth_of_the_frames_is_lost() -> None:
    frames = made(np.zeros((HEIGHT, WIDTH, 3), np.uint8), count=400)
    scene = on_plane({0: np.full((HEIGHT, WIDTH), np.float32(0.06))})
    came = [given for _, given in disturbed(DISTURBANCES["lost_frames"], frames, range(400), 30.0, scene)]
    assert came.count(None) == pytest.approx(80, abs=4 * np.sqrt(400 * 0.2 * 0.8))  # four standard deviations


def test_light(session: Session, frames: list[StereoFrame]) -> None:
    scene = scene_of(session, frames)
    dark, flash, flicker = (play(name, frames, scene) for name in ("dark", "flash", "flicker"))
    clean = frames[DURING.start].left
    middle = (clean > 60) & (clean < 120)  # neither black nor white at three times the light
    assert dark[DURING.start].left.mean() < 20
    assert np.median(flash[DURING.start].left.max(-1)) == 255
    brighter, darker = flicker[DURING.start].left, flicker[DURING.start + 1].left
    for picture, true, gain in ((brighter, clean, 3), (darker, frames[DURING.start + 1].left, 1 / 3)):
        ratio = np.median(to_linear(picture)[middle] / to_linear(true)[middle])
        assert ratio == pytest.approx(gain, rel=0.05)  # half a grey level of 60 to the power of 2.2 is 2 %


def test_smoke_thickens_with_depth_and_in_time() -> None:
    """Stripes at twice the distance, which the smooth clouds do not tell from those beside them."""
    near = np.indices((HEIGHT, WIDTH))[1] // 8 % 2 == 0
    scene = on_plane({0: np.where(near, np.float32(0.04), np.float32(0.08))})
    frames = made(np.zeros((HEIGHT, WIDTH, 3), np.uint8))

    def thickness(picture: U8) -> F32:
        blurred = cv2.GaussianBlur(picture, (0, 0), 0.8)  # grain
        return -np.log(1 - np.clip(to_linear(blurred)[..., 0] / SMOKE_COLOR[0], 0, 0.95))

    pictures = [frame.left for frame in changed("smoke", frames, scene)]
    stripes = thickness(pictures[18]).reshape(HEIGHT, -1, 8)[..., 2:6].mean(-1)  # [H, stripes]
    ratio = stripes[:, 1:-1:2] / (0.5 * (stripes[:, 0:-2:2] + stripes[:, 2::2]))
    assert np.median(ratio) == pytest.approx(2.0, rel=0.1)
    grown = [float(thickness(picture).mean()) for picture in pictures]
    assert all(later > earlier for earlier, later in zip(grown[:15:3], grown[3:18:3], strict=False))
    assert grown[-1] < 0.5 * max(grown)
    veils = 1 - np.exp(-stripes[:, 1::2])
    assert np.median(veils) == pytest.approx(SMOKE_VEIL, abs=0.15)  # clouds differ by about a half


def test_blood_lies_on_the_tissue() -> None:
    """On a plane 10 px of disparity away, the right eye sees it 10 px farther left; it hides the texture."""
    disparity = 10
    depth = np.full((HEIGHT, WIDTH), np.float32(FOCAL * BASELINE / disparity))
    texture = np.random.default_rng(0).integers(110, 240, (HEIGHT, WIDTH + disparity, 3), np.uint8)
    left, right = texture[:, :WIDTH], texture[:, disparity:]
    frames = made(np.ascontiguousarray(left), np.ascontiguousarray(right))
    given = list(changed("blood", frames, on_plane({0: depth})))[20]
    assert given.right is not None
    covered_left, covered_right = (np.median(cv2.blur(p, (5, 5)), -1) < 70 for p in (given.left, given.right))
    assert covered_left.mean() == pytest.approx(0.5, abs=0.12)  # its front is not straight
    beside = covered_left[:, disparity:] != covered_right[:, :-disparity]
    unshifted = covered_left != covered_right
    assert beside.mean() < 0.01 and beside.mean() < 0.4 * unshifted.mean()
    thick = given.left[-20:].astype(np.float32)
    rough = thick - cv2.GaussianBlur(thick, (0, 0), 3)
    assert rough.std() < 1.5 * GRAIN < 0.2 * left[-20:].std()


def test_instruments_stand_out_of_blood(session: Session, frames: list[StereoFrame]) -> None:
    scene = scene_of(session, frames)
    frame = frames[6]
    given = play("blood", frames, scene)[6]
    tool = cv2.erode((~frame.tissue).view(np.uint8), np.ones((5, 5), np.uint8)) > 0
    difference = np.abs(given.left.astype(int) - frame.left)[tool]
    assert tool.sum() > 1000 and np.percentile(difference, 99) <= 4 * GRAIN + 1


def test_the_right_eye_knows_its_depths(session: Session, frames: list[StereoFrame]) -> None:
    """Against the phantom's true points: a pixel sees 0.25 mm of tissue, which is no steeper than 2:1 in most
    places."""
    scene, frame = scene_of(session, frames), frames[6]
    assert frame.reference is not None and frame.reference.points_visible is not None
    points = frame.reference.points[frame.reference.points_visible]
    local = (points - frame.T_world_cam[:3, 3]) @ frame.T_world_cam[:3, :3]
    seen = (local[:, :2] - [session.rig.baseline, 0]) / local[:, 2:]
    rays = scene.rays[1].reshape(-1, 2)
    depths = scene.depths(6)[1].ravel()
    nearest = [int(np.argmin(np.square(rays - place).sum(1))) for place in seen]
    assert np.median(np.abs(depths[nearest] - local[:, 2])) < 0.25e-3
    flat = np.median(np.abs(np.median(depths) - local[:, 2]))
    assert flat > 1e-3  # else it says nothing


def test_depth_between_references_is_interpolated() -> None:
    near, far = (np.full((HEIGHT // 2, WIDTH // 2), np.float32(z)) for z in (0.05, 0.09))
    near[:20] = 0  # unknown
    scene = on_plane({10: near, 20: far})
    expected = {3: 0.05, 10: 0.05, 15: 0.07, 20: 0.09, 30: 0.09}
    for frame_id, depth in expected.items():
        assert scene.depths(frame_id)[0] == pytest.approx(depth, rel=1e-4)
    assert np.isfinite(on_plane({}).depths(0)[1]).all()


def test_the_other_scene_fits_the_rig(session: Session, frames: list[StereoFrame]) -> None:
    """Upside down twice is the right way up, for each eye with its own lens."""
    for mirror in scene_of(session, frames).mirrors:
        height, width = mirror.shape[:2]
        inside = ((mirror > 1) & (mirror < [width - 2, height - 2])).all(-1)
        twice = cv2.remap(mirror, mirror, None, cv2.INTER_LINEAR)
        error = np.abs(twice - np.dstack(np.indices((height, width))[::-1]))[inside]
        assert inside.mean() > 0.9 and error.max() < 0.1


def test_frames_to_recover() -> None:
    clean = dict.fromkeys(range(20), 36.0)
    psnr = clean | {10: 20.0, 11: 36.0, 12: 30.0, 13: 35.1, 14: 36.0, 15: 36.0}
    assert frames_to_recover(psnr, clean, 10, 36.0) == 3  # one good frame between bad ones is not enough
    assert frames_to_recover(clean, clean, 10, 40.0) == 0  # the scene itself has become harder
    assert frames_to_recover(dict.fromkeys(range(20), 30.0), clean, 10, 36.0) is None
    assert frames_to_recover(clean, clean, 10, None) is None


def test_warning_times() -> None:
    none, eyes = frozenset[str](), frozenset({"eyes"})
    quiet = dict.fromkeys(range(40), none)
    during = range(10, 20)
    assert warning_times(quiet, during, 10.0) == (None, None)
    assert warning_times(quiet | dict.fromkeys(range(13, 24), eyes), during, 10.0) == (0.3, 0.4)
    assert warning_times(quiet | dict.fromkeys(range(13, 16), eyes), during, 10.0) == (0.3, 0.0)
    assert warning_times(quiet | dict.fromkeys(range(21, 40), eyes), during, 10.0) == (1.1, None)
    assert warning_times(quiet | {3: eyes}, during, 10.0) == (None, None)
