"""Clips in the layout of EndoNeRF: read back exactly, refused when they cannot be right, measured."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import figures_of, refused
from frames import played
from mistakes import frames_until_error, refused_at_opening
from numbered_pictures import write_png
from test_scared import DISTANCE, Eye, seen

from sags_node.config import schema as cfg
from sags_node.config.launch_file import load_launch
from sags_node.errors import UsageError
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.sources.replay import Replay
from sags_node.sources.source import findings_of, open_source
from sags_node.tools.importing.check import check_folder
from sags_node.types import U8, StereoFrame

WIDTH, HEIGHT, FOCAL = 160, 128, 150.0
FRAMES = 12


def left_picture(number: int) -> U8:
    """Texture (RGB) that moves right by one pixel per frame."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    columns -= number
    waves = np.sin(columns / 5) * np.sin(rows / 7) + 0.5 * np.sin(columns / 17 + rows / 11)
    return np.stack([150 + 40 * waves, 80 + 20 * waves, 70 - 15 * waves], -1).astype(np.uint8)


def instrument(number: int) -> U8:
    """255 = instrument: a bar that grows by a column per frame."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[40:60, : 20 + number] = 255
    return mask


def depth_counts(number: int) -> U8:
    """Millimetres: a step from 60 to 80, half a frame each."""
    counts = np.full((HEIGHT, WIDTH), 60, np.uint8)
    counts[:, WIDTH // 2 :] = 80
    return counts


def poses_bounds(count: int = FRAMES) -> np.ndarray:
    """Identity poses as the data set has them."""
    matrix = np.column_stack([np.eye(3), np.zeros(3), [HEIGHT, WIDTH, FOCAL]])
    return np.tile(np.concatenate([matrix.ravel(), [60, 80]]), (count, 1))


IMAGES, RIGHT, MASKS, DEPTHS = (
    *(f"{folder}/{{:06d}}.png" for folder in ("images", "images_right", "masks")),
    "depth/frame-{}.png",  # not padded, as in some copies
)


def draw(clip: Path, name: str, make: Callable[[int], np.ndarray]) -> None:
    for number in range(FRAMES):
        write_png(clip / name.format(number), make(number))


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    folder = tmp_path / "pulling_soft_tissues"
    for name, make in ((IMAGES, left_picture), (MASKS, instrument), (DEPTHS, depth_counts)):
        draw(folder, name, make)
    np.save(folder / "poses_bounds.npy", poses_bounds())
    return folder


def play(clip: Path, **options: Any) -> list[StereoFrame]:
    return played(cfg.EndoNerfSource(folder=clip, pace="step", **options))


# ---- what is read ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("stride", "passes"), [(1, 1), (5, 2)])
def test_every_frame_comes_as_it_was_written(clip: Path, stride: int, passes: int) -> None:
    numbers = [*range(0, FRAMES, stride)] * passes
    options: Any = {"stride": stride, "loop": passes > 1, "frames": len(numbers)}
    with open_source(cfg.EndoNerfSource(folder=clip, pace="step", **options)) as source:
        frames = list(source)
        assert source.rate == 15 / stride and source.frame_count == len(frames)
    for at, (number, frame) in enumerate(zip(numbers, frames, strict=True)):
        assert frame.frame_id == at and frame.epoch == at * passes // len(numbers)
        assert frame.t_capture_ns == round(at * stride * 1e9 / 15)
        assert (frame.left == left_picture(number)).all()
        assert frame.right is None and frame.reference is None
        assert frame.tissue is not None and (frame.tissue == (instrument(number) == 0)).all()
        assert frame.depth is not None and frame.depth.dtype == np.float32
        assert np.array_equal(frame.depth, (depth_counts(number) * 1e-3).astype(np.float32))
        assert frame.T_world_cam is not None and (frame.T_world_cam == np.eye(4)).all()


def around(number: int) -> np.ndarray:
    """A camera that goes right and down, and turns to keep the scene in view; camera to world, mm."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([0.01, -0.015, 0.02]) * number)[0]
    T[:3, 3] = np.array([0.5, 0.4, 0.2]) * number
    return T


FILES: dict[str, Callable[[np.ndarray], np.ndarray]] = {  # what other tools write of such a pose
    "opencv": lambda T: T,
    "llff": lambda T: np.column_stack([T[:, 1], T[:, 0], -T[:, 2], T[:, 3]]),
    "opengl": lambda T: np.column_stack([T[:, 0], -T[:, 1], -T[:, 2], T[:, 3]]),
    "world_to_camera": np.linalg.inv,
}


@pytest.fixture(scope="module")
def moving_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A textured plane, 62 mm in front of the first camera, seen as it goes around; depth in 10 um."""
    folder = tmp_path_factory.mktemp("moving")
    K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    for number in range(FRAMES):
        points, picture = seen(Eye(K, np.zeros(5)), np.linalg.inv(around(number)))
        write_png(folder / f"images/{number:03}.png", picture)
        write_png(folder / f"masks/{number:03}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
        write_png(folder / f"depth/{number:03}.png", np.rint(points[..., 2] * 100).astype(np.uint16))
    return folder


@pytest.mark.parametrize("tool", FILES)
def test_poses_are_read_as_they_explain_the_pictures(
    moving_clip: Path, tool: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever the tool, the camera moves as it did; what is not usual is said, and the key has the last
    word."""
    table = poses_bounds()
    for number in range(FRAMES):
        T = FILES[tool](around(number))
        T[:3, 3] *= 100  # in the unit of the depth
        table[number, :15] = np.column_stack([T[:3], [HEIGHT, WIDTH, FOCAL]]).ravel()
    np.save(moving_clip / "poses_bounds.npy", table)
    session = open_session(moving_clip, ["source.depth_unit:=1e-5", "source.pace:=step"])
    assert (f"fit as {tool}" in caplog.text) is (tool != "opencv")
    with session.source as source:
        frames = list(source)
        assert findings_of(source) == ()  # it was said; a node warns of what goes on
    poses = [frame.T_world_cam for frame in frames]
    assert frames[0].depth[HEIGHT // 2, WIDTH // 2] == pytest.approx(DISTANCE * 1e-3, abs=1e-3)
    for number, T in enumerate(poses):
        moved = np.linalg.inv(poses[0]) @ T
        moved[:3, 3] *= 1e3
        np.testing.assert_allclose(moved, around(number), atol=1e-6)
    raw = play(moving_clip, depth_unit=1e-5, pose_axes="opencv")[3].T_world_cam
    np.testing.assert_allclose(raw[:3, :3], FILES[tool](around(3))[:3, :3], atol=1e-9)


def test_the_published_clips_have_the_baseline_that_their_author_states(clip: Path) -> None:
    """By their camera; a clip of another one that was converted to the layout has none."""
    draw(clip, RIGHT, lambda number: left_picture(number + 5))
    assert play(clip)[0].right is None
    table = poses_bounds(3)
    table[:, [4, 9, 14]] = 512, 640, 569.46820041
    np.save(clip / "poses_bounds.npy", table)
    for folder in ("images", "images_right", "masks", "depth"):
        for file in (clip / folder).iterdir():
            if int(file.stem.removeprefix("frame-")) < len(table):
                shown = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
                assert cv2.imwrite(str(file), cv2.resize(shown, (640, 512)))
            else:
                file.unlink()
    session = open_session(clip, ["source.pace:=step"])
    assert session.rig.baseline == pytest.approx(4.324e-3)
    assert session.rig.left.K[0, 0] == pytest.approx(569.4682)
    with session.source as source:
        assert next(iter(source)).right is not None
    assert any("as their author states" in finding.what for finding in check_folder(clip))


def test_zero_is_unknown_and_outliers_are_drawn_to_the_percentiles(clip: Path) -> None:
    counts, deep = depth_counts(0), depth_counts(1).astype(np.uint16)
    counts[:3, :5] = [[255], [2], [0]]
    deep[:3] = 65535
    for number, shown in ((0, counts), (1, deep), (3, np.zeros_like(counts))):
        write_png(clip / DEPTHS.format(number), shown)
    depth, full, _, without = (frame.depth for frame in play(clip, frames=4))
    assert depth is not None and without is not None and not without.any()
    assert np.allclose(depth[0, :5], 0.080) and np.allclose(depth[1, :5], 0.060)
    assert (depth[2, :5] == 0).all() and np.count_nonzero(depth == 0) == 5
    assert full is not None and (full[:3] == 0).all() and 0 < full[3:].min() and full.max() < 0.1


def test_right_pictures_are_used_when_the_baseline_is_known(clip: Path) -> None:
    """Then they may take the place of depth."""
    draw(clip, RIGHT, lambda number: left_picture(number + 3))
    assert play(clip)[2].right is None
    refused(2, "run", clip, "publish.right:=true", said=("there is no right eye; set source.baseline",))
    frame = play(clip, baseline=0.0042)[2]
    assert frame.right is not None and (frame.right == left_picture(5)).all()
    assert open_session(clip, ["source.baseline:=0.0042"]).rig.baseline == pytest.approx(0.0042)
    shutil.rmtree(clip / "depth")
    with pytest.raises(UsageError, match=r"holds no depth/; set source\.baseline"):
        play(clip)
    frame = play(clip, baseline=0.0042)[0]
    assert frame.depth is None and frame.right is not None


def test_a_folder_is_known_by_its_files_and_a_launch_file_wins(clip: Path) -> None:
    session = open_session(clip, ["source.stride:=3"])
    source, left = session.config.source, session.rig.left
    assert isinstance(source, cfg.EndoNerfSource) and source.folder == clip and source.stride == 3
    assert session.rig.name == "pulling_soft_tissues" and (left.width, left.height) == (WIDTH, HEIGHT)
    expected = [[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]]
    assert (left.K == expected).all() and (left.P[:, :3] == expected).all()
    with pytest.raises(UsageError, match="recording brings its own"):
        open_session(clip, [f"rig:={clip}"])
    (clip / "launch.yaml").write_text("source: {kind: endonerf, folder: ., depth_unit: 0.002}\n")
    source = load_launch(clip).source
    assert isinstance(source, cfg.EndoNerfSource) and source.depth_unit == 0.002
    assert source.folder.resolve() == clip.resolve()


# ---- polarity of the masks -------------------------------------------------------------------------------


def test_masks_of_the_other_polarity_are_refused_and_can_be_flipped(clip: Path) -> None:
    """In one frame instruments may fill the image."""
    for right, wrong in (("black", "white"), ("white", "black")):
        draw(clip, MASKS, instrument if right == "white" else lambda number: 255 - instrument(number))
        refusal = rf"masks would take 98% of the image for instruments.*source\.instruments:={right}"
        with pytest.raises(UsageError, match=refusal):
            play(clip, instruments=wrong)
        write_png(clip / MASKS.format(4), np.full((HEIGHT, WIDTH), 255 * (right == "white"), np.uint8))
        for number, frame in enumerate(play(clip, instruments=right)):
            expected = (instrument(number) == 0) & (number != 4)
            assert frame.tissue is not None and (frame.tissue == expected).all()


# ---- mistakes --------------------------------------------------------------------------------------------


def one_depth(picture: np.ndarray, number: int = 0) -> Callable[[Path], None]:
    return lambda clip: write_png(clip / DEPTHS.format(number), picture)


def posed(table: np.ndarray) -> Callable[[Path], None]:
    return lambda clip: np.save(clip / "poses_bounds.npy", table)


def changed(rows: Any, columns: Any, value: float, factor: float = 0.0) -> np.ndarray:
    """The poses with some numbers set to `value`, or multiplied."""
    table = poses_bounds()
    table[rows, columns] = value + factor * table[rows, columns]
    return table


@pytest.mark.parametrize(
    ("factor", "dtype", "unit", "said"),
    [
        (1, np.uint8, None, ["with 0.001 m per count, of only 8 bit, which the files do not say"]),
        (1, np.uint16, None, ["with 0.001 m per count, which the files do not say"]),
        (1, np.uint16, 1e-3, []),
        (10, np.uint16, None, [r"700 mm .*an endoscope sees 0.01 to 0.3 m; .*\(0.0001 makes 70 mm\)"]),
        (10, np.uint16, 1e-3, [r"700 mm .*an endoscope sees 0.01 to 0.3 m; .*\(0.0001 makes 70 mm\)"]),
        (10, np.uint16, 1e-4, []),
    ],
)
def test_a_unit_that_nobody_said_is_told_and_one_that_does_not_fit(
    clip: Path, factor: int, dtype: type, unit: float | None, said: list[str]
) -> None:
    draw(clip, DEPTHS, lambda number: depth_counts(number).astype(dtype) * dtype(factor))
    options: Any = {} if unit is None else {"depth_unit": unit}
    with open_source(cfg.EndoNerfSource(folder=clip, pace="step", **options)) as source:
        assert isinstance(source, Replay)
        found = [f"{each.what}; {each.fix}" for each in source.pairs.findings]
    assert len(found) == len(said)
    assert all(re.search(one, other) for one, other in zip(said, found, strict=True))


EVERY = np.s_[:]
MISTAKES: list[tuple[Callable[[Path], object], str]] = [
    (lambda clip: shutil.rmtree(clip / "masks"), "masks does not exist; check the path"),
    (lambda clip: (clip / "masks/000005.png").unlink(), "1 images of .*images and .*masks have no partner"),
    (lambda clip: (clip / "depth/frame-5.png").unlink(), "images holds 12 images but .*depth holds 11"),
    (lambda clip: draw(clip, MASKS, lambda number: instrument(number) // 255),
     "masks/000000.png holds the values 0, 1, .*set 'source.instruments:=.1.'"),
    (lambda clip: write_png(clip / "masks/000000.png", instrument(0)[:-2]),
     "masks/000000.png is 160x126 px but .*images/000000.png is 160x128"),
    (one_depth(depth_counts(0)[:, :-4]), "depth/frame-0.png is 156x128 px but the images are 160x128"),
    (one_depth(left_picture(0)), "frame-0.png has 3 channels; a depth image is a grey PNG of 8 or 16 bit"),
    (lambda clip: draw(clip, DEPTHS, lambda number: depth_counts(number).astype(np.uint16) * 500),
     r"frame-0.png: the median depth would be \d+ m, .*set source.depth_unit"),
    (lambda clip: (clip / "poses_bounds.npy").unlink(), "poses_bounds.npy does not exist; check the path"),
    (posed(poses_bounds()[:, :12]), r"poses_bounds.npy is float64 \[12, 12\], wanted numbers \[any, 17\]"),
    (lambda clip: (clip / "poses_bounds.npy").write_bytes(b"hello"), "npy is not a readable npy file"),
    (posed(poses_bounds(FRAMES - 2)), "npy holds 10 poses but .*images 12 images; there must be one pose"),
    (posed(poses_bounds() * np.nan), "poses_bounds.npy holds no poses, or values that are not finite"),
    (posed(changed(EVERY, [4, 9], 0, 2)), "npy is for 320x256 px but the images are 160x128; scale"),
    (posed(changed(EVERY, 14, 0.004)), "poses_bounds.npy: camera: fx = 0.004 px is not plausible"),
    (posed(changed(np.s_[3:], 14, 0, 2)), "npy: size and focal length must be the same for all frames"),
    (posed(changed(6, 1, 0.5)), "npy: the pose of frame 6 is not a rotation and a translation"),
]  # fmt: skip


@pytest.mark.parametrize(("mistake", "message"), MISTAKES)
def test_mistakes_are_named(clip: Path, mistake: Callable[[Path], object], message: str) -> None:
    mistake(clip)
    refused_at_opening(lambda: load_launch(clip).source, message)


def test_a_depth_picture_of_wrong_form_in_the_middle_ends_the_clip_there(clip: Path) -> None:
    one_depth(depth_counts(7)[:-2], 7)(clip)
    frames, said = frames_until_error(cfg.EndoNerfSource(folder=clip, pace="step"))
    assert [frame.frame_id for frame in frames] == list(range(7)) and "frame-7.png is 160x126 px" in said


# ---- through the node ------------------------------------------------------------------------------------


def test_the_pipeline_takes_the_given_depth_instead_of_stereo(clip: Path) -> None:
    overrides = ["source.pace:=step", "vision.width:=80", "vision.height:=64", "vision.tissue.dilate:=0"]
    session = open_session(clip, overrides)
    pipeline = Pipeline(session.config, session.rig)
    with session.source as source:
        result = pipeline.process(next(iter(source)), StepBudget(1))
    observation = result.observation
    bar = np.zeros((64, 80), bool)
    bar[20:30, :10] = True
    assert (observation.tissue == ~bar).all()
    expected = np.where(bar, 0, np.where(np.arange(80) < 40, 0.060, 0.080)).astype(np.float32)
    assert np.array_equal(observation.depth, expected)
    assert np.array_equal(observation.depth_confidence, (expected > 0).astype(np.float32))
    assert result.pair.right is None and len(result.snapshot.gaussians) > 200


def test_a_clip_is_measured_by_its_path_alone(clip: Path) -> None:
    found = figures_of("eval", clip, "--pace", "step", "--iterations", "2", "--paper-psnr", "--json")
    assert found["session"] == "pulling_soft_tissues"
    # The literature's test split: frames 1 and 9.
    assert [found[key] for key in ("frames", "processed", "held_out", "dropped")] == [12, 10, 2, 0]
    assert min(found["online"]["psnr"], found["online"]["paper_psnr"]) > 45
    assert found["heldout"]["psnr"] > 40 and found["predict"]["psnr"] > found["predict"]["copy_psnr"]
    assert found["novel"] is None and found["depth"] is None  # no right eye, no reference


def test_it_is_measured_by_its_own_protocol(clip: Path) -> None:
    """Held out are frames 1 and 9. Pixels masked black in both images count, which by arithmetic adds the
    share of the tissue to the PSNR."""
    found = figures_of("eval", "--protocol", "endonerf", clip, "--iterations", "2", "--json")
    shares = [np.mean(instrument(number) < 128) for number in (1, 9)]
    gained = found["causal"]["paper_psnr"] - found["causal"]["psnr"]
    assert gained == pytest.approx(np.mean(-10 * np.log10(shares)), abs=1e-3)
    assert found["causal"]["ssim"] < found["causal"]["paper_ssim"] < 1 and found["held_out"] == 2
