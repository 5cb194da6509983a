"""What is said of a recording's cameras: by camera_info, by names, and by the rows of the images."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import bag_files as files
import cv2
import numpy as np
import pytest
from bag_files import BASELINE, HEIGHT, MS, ROS2, START, WIDTH, Row, eye_of, picture, play
from command_line import ran
from places import SESSION

from sags_node.config.launch_file import load_launch
from sags_node.errors import UsageError
from sags_node.pipeline.session import open_session
from sags_node.rig import load_rig, save_rig
from sags_node.sources.pictures import read_picture
from sags_node.sources.rectified import as_named, named_rectified
from sags_node.tools.calibration.guess import guess_rig
from sags_node.tools.importing.check import check_folder, overrides_of
from sags_node.types import Eye, RectifiedPair, StereoFrame, StereoRig
from sags_node.vision.rectify import Rectifier

# ---- images that are rectified already -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "rectified"),
    [
        *((name, True) for name in ("/stereo/left/image_rect", "/stereo/left/image_rect_color",
                                    "/camera/infra1/image_rect_raw", "/zed/left/color/rect/image")),
        *((name, False) for name in ("/stereo/left/image_raw", "/rect_test/left/image_raw",
                                     "/rig/left/rectangle")),
        *((Path(name), True) for name in ("case/left_rectified", "case/leftRectified", "rectified.mp4",
                                          "hamlyn/rectified01/image01", "case/rect/left")),
        *((Path(name), False) for name in ("case/left", "rect_resection/left", "case/left_unrectified",
                                           "test_what_is_rectified/left", "/data/rect_resection_3.mp4",
                                           "case/not_rectified/left", "case/rectified/left_raw")),
    ],
)  # fmt: skip
def test_names_that_say_it(name: Path | str, rectified: bool) -> None:
    assert named_rectified(name) is rectified


@pytest.mark.parametrize("converted", [False, True])
@pytest.mark.parametrize("says_P", [False, True])
def test_a_calibration_that_does_not_say_P_is_told_of(
    says_P: bool, converted: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Who rectified the images may have kept all of them, with another focal length."""
    rig, file = load_rig(SESSION / "calib"), tmp_path / "stereo.yml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    T, size = rig.T_right_left, (rig.left.width, rig.left.height)
    matrices = {"R": T[:3, :3], "T": T[:3, 3], "imageSize": np.array(size, np.float64)}
    for number, eye in (("1", rig.left), ("2", rig.right)):
        matrices |= {f"M{number}": eye.K, f"D{number}": eye.distortion}
        matrices |= {f"R{number}": eye.R, f"P{number}": eye.P} if says_P else {}
    for name, matrix in matrices.items():
        storage.write(name, matrix)
    storage.release()
    if converted:
        code, _, said = ran("calib", "convert", file, "-o", tmp_path / "converted", "--scale", "0.5")
        assert code == 0, said
        file = tmp_path / "converted"
    as_named(load_rig(file), Path("left_rectified"), Path("right_rectified"))
    assert ("does not say how images were rectified" in caplog.text) != says_P


@pytest.fixture(scope="module")
def scope() -> tuple[StereoRig, list[StereoFrame], list[RectifiedPair]]:
    """Turned eyes with distortion: frames as their cameras give them, and rectified."""
    rig = load_rig(SESSION / "calib")
    frames = []
    for index in (0, 20):
        left, right = (read_picture(SESSION / f"{side}/{index:04}.jpg") for side in ("left", "right"))
        frames.append(StereoFrame(index, 0, 0, left, right))
    rectifier = Rectifier(rig, rig.left.width, rig.left.height)
    return rig, frames, [rectifier(frame) for frame in frames]


Pairs = Sequence[StereoFrame | RectifiedPair]


def bag(folder: Path, rig: StereoRig, pairs: Pairs, name: str) -> tuple[Path, list[str]]:
    rows: list[Row] = []
    for number, pair in enumerate(pairs):
        for side, eye, rgb in (("left", rig.left, pair.left), ("right", rig.right, pair.right)):
            assert rgb is not None
            stamp = START + number * 40 * MS
            rows.append((f"/rig/{side}/{name}", files.image(ROS2, rgb, stamp), stamp))
            rows.append((f"/rig/{side}/camera_info", files.camera_info(ROS2, stamp, eye), stamp))
    return files.write_rosbag2(folder / "bag", rows), []


def folders(folder: Path, rig: StereoRig, pairs: Pairs, name: str) -> tuple[Path, list[str]]:
    for number, pair in enumerate(pairs):
        for side, rgb in (("left", pair.left), ("right", pair.right)):
            assert rgb is not None
            file = folder / name.format(side) / f"{number}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), rgb[..., ::-1])
    save_rig(rig, folder / "calib")
    return folder, overrides_of(folder)


@pytest.mark.parametrize(
    ("write", "name"),
    [(bag, "image_rect"), (bag, "image_rect_color"), (folders, "{}_rectified"), (folders, "{}")],
)
def test_what_is_rectified_already_is_never_rectified_twice(
    scope: tuple[StereoRig, list[StereoFrame], list[RectifiedPair]], tmp_path: Path, write, name: str
) -> None:
    """By its name, or without one by its rows. A rectifier then has nothing to do, and depth is right."""
    rig, raw, rectified = scope
    path, overrides = write(tmp_path / "case", rig, rectified, name)
    session = open_session(path, [*overrides, "source.pace:=step"])
    np.testing.assert_array_equal(session.rig.right.K, rig.right.P[:, :3])
    assert session.rig.baseline == pytest.approx(rig.baseline)
    with session.source as source:
        frame = next(iter(source))
    seen = Rectifier(session.rig, rig.left.width, rig.left.height)(frame)
    np.testing.assert_array_equal(seen.left, frame.left)
    assert all(finding.level != "error" for finding in check_folder(path))
    unlike = open_session(path, [*overrides, "rectified:=false", "source.pace:=step"])
    np.testing.assert_array_equal(unlike.rig.left.K, rig.left.K)  # whoever knows better has the last word
    path, overrides = write(tmp_path / "other", rig, raw, name.replace("rect_color", "raw").split("_rect")[0])
    assert open_session(path, [*overrides, "source.pace:=step"]).rig.left.distortion.any()


def test_a_calibration_that_was_made_with_rectified_pictures_stays_as_it_is(
    scope: tuple[StereoRig, list[StereoFrame], list[RectifiedPair]], tmp_path: Path
) -> None:
    rig, _, rectified = scope
    left, right = (
        replace(eye, K=np.diag([1.1, 1.1, 1]) @ eye.P[:, :3], R=np.eye(3), distortion=np.zeros(5))
        for eye in (rig.left, rig.right)
    )
    path, overrides = folders(tmp_path / "case", StereoRig("own", left, right), rectified, "{}_rectified")
    np.testing.assert_array_equal(open_session(path, overrides).rig.left.K, left.K)


# ---- camera_info -----------------------------------------------------------------------------------------


def said_bag(
    folder: Path,
    said: Sequence[tuple[Eye, Eye]],
    rois: Sequence[tuple[int, int, int, int]] = 2 * [(0, 0, 0, 0)],
    **options: object,
) -> Path:
    """A bag whose camera_info says one after the other of these, each with a pair of images."""
    rows: list[Row] = []
    for number, eyes in enumerate(said):
        stamp = START + number * 40 * MS
        for eye, side in enumerate(("left", "right")):
            info = files.camera_info(ROS2, stamp, eyes[eye], roi=rois[eye], **options)
            rows.append((f"/rig/{side}/camera_info", info, stamp))
            rows.append((f"/rig/{side}/image_raw", files.image(ROS2, picture(number, eye), stamp), stamp))
    return files.write_rosbag2(folder / "bag", rows)


def eyes(focal: float) -> tuple[Eye, Eye]:
    return eye_of(0, focal), eye_of(1, focal)


def zeros() -> tuple[Eye, Eye]:
    left, right = (replace(eye, K=0 * eye.K, R=0 * eye.R, P=0 * eye.P) for eye in eyes(80.0))
    return left, right


def test_zeros_are_passed_over(tmp_path: Path) -> None:
    path = said_bag(tmp_path, [zeros(), zeros(), eyes(80.0), zeros(), eyes(80.0)])
    assert open_session(path).rig.left.K[0, 0] == 80


def test_a_calibration_that_changes_is_refused_and_its_parts_can_be_played(tmp_path: Path) -> None:
    path = said_bag(tmp_path, [eyes(100.0)] * 2 + [eyes(80.0)] * 3)
    with pytest.raises(UsageError, match=r"changes while it is played .*0\.08 s .*fx 100 to 80 px") as error:
        open_session(path)
    remedies = [word.strip(",") for word in str(error.value).split() if ":=" in word]
    assert remedies == ["source.frames:=2", "source.start:=0.08"]
    for remedy, focal, first in zip(remedies, (100, 80), (0, 2), strict=True):
        session = open_session(path, [remedy, "source.pace:=step"])
        with session.source as source:
            assert session.rig.left.K[0, 0] == focal
            assert np.array_equal(next(iter(source)).left, picture(first, 0))
    assert any("changes while it is played" in finding.what for finding in check_folder(path))


def test_what_is_read_out_and_binned(tmp_path: Path) -> None:
    """A point of the sensor lies in the image where offset and division put it, REP 104: the middle of the
    first binned pixel is the middle of 2 x 3 pixels of the sensor."""
    sensor = [replace(eye, width=160, height=200) for eye in eyes(80.0)]
    roi, binning = (20, 30, 2 * WIDTH, 3 * HEIGHT), (2, 3)
    path = said_bag(tmp_path, [(sensor[0], sensor[1])], [roi, roi], binning=binning)
    rig = open_session(path).rig
    assert (rig.left.width, rig.left.height) == (WIDTH, HEIGHT)
    ray = np.array([0.21, -0.13, 1.0])
    at = (sensor[0].K @ ray)[:2]
    expected = ((at - [20, 30]) - [0.5, 1.0]) / [2, 3]
    for matrix in (rig.left.K, rig.left.P[:, :3]):
        np.testing.assert_allclose((matrix @ ray)[:2], expected)
    assert rig.baseline == pytest.approx(BASELINE)
    impossible = said_bag(tmp_path / "b", [(sensor[0], sensor[1])], 2 * [(150, 0, 20, 20)])
    with pytest.raises(UsageError, match=r"roi 150,0 20x20 .* is no part of 160x200 px"):
        open_session(impossible)


def test_eyes_that_read_out_other_rows_are_told_so_and_other_columns_are_applied(tmp_path: Path) -> None:
    left, right = (replace(eye, width=2 * WIDTH, height=2 * HEIGHT) for eye in eyes(80.0))
    size = WIDTH, HEIGHT
    columns = said_bag(tmp_path / "a", [(left, right)], [(3, 9, *size), (5, 9, *size)])
    rig = open_session(columns).rig
    assert rig.left.P[0, 2] - rig.right.P[0, 2] == left.P[0, 2] - right.P[0, 2] + 2
    rows = said_bag(tmp_path / "b", [(left, right)], [(3, 9, *size), (3, 4, *size)])
    with pytest.raises(UsageError, match=r"begin 5 rows apart \(roi.*same rows.*or calibrate .*set rig"):
        open_session(rows)
    save_rig(rig, tmp_path / "told")
    assert open_session(rows, [f"rig:={tmp_path / 'told'}"]).rig.right.P[1, 2] == rig.right.P[1, 2]


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "kannala_brandt4"])
def test_other_models_are_refused(model: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"distortion model '{model}' is not supported"):
        open_session(said_bag(tmp_path, [eyes(80.0)], model=model))


def test_turned_pictures_need_a_calibration_of_their_own(tmp_path: Path) -> None:
    """As images that are cut need one: camera_info is of what the cameras send."""
    path, turned = said_bag(tmp_path, [eyes(80.0)]), "source.geometry.flip:=both"
    with pytest.raises(UsageError, match=r"camera_info is of .*flip: both turns .*leave flip out.*set rig"):
        open_session(path, [turned])
    save_rig(open_session(path).rig, tmp_path / "rig")
    assert open_session(path, [turned, f"rig:={tmp_path / 'rig'}"]).rig.left.K[0, 0] == 80


# ---- topics and clocks -----------------------------------------------------------------------------------


def test_a_topic_of_both_eyes_is_split_as_a_live_one(tmp_path: Path) -> None:
    rows: list[Row] = []
    for number in range(3):
        both = np.concatenate([picture(number, 0), picture(number, 1)], axis=1)
        rows.append(("/scope/image_raw", files.image(ROS2, both, START + number * 40 * MS), START))
    path = files.write_rosbag2(tmp_path / "bag", rows)
    with pytest.raises(UsageError, match=r"source\.geometry\.layout"):
        play(path)
    for said in ({}, {"left": "scope/image_raw"}):
        frames = play(path, geometry={"layout": "side_by_side"}, **said)
        for number, frame in enumerate(frames):
            assert np.array_equal(frame.left, picture(number, 0))
            assert frame.right is not None and np.array_equal(frame.right, picture(number, 1))
    right_first = play(path, geometry={"layout": "side_by_side", "first": "right"})
    assert np.array_equal(right_first[0].left, picture(0, 1))


def test_squeezed_eyes_of_a_topic_are_told_of_and_guessed_so(tmp_path: Path) -> None:
    """Beside each other, each at half of its width, as a 3D mixer sends them."""
    rows: list[Row] = []
    for number in range(3):
        eyes = (np.repeat(picture(number, eye), 2, axis=0) for eye in (0, 1))
        rows.append(("/scope/image_raw", files.image(ROS2, np.hstack([*eyes]), START + number * MS), START))
    bag, said = files.write_rosbag2(tmp_path / "bag", rows), ["source.geometry.layout:=side_by_side"]
    config = load_launch(bag, said)
    assert any("2 times as wide as high" in finding.what for finding in check_folder(bag, said))
    K = guess_rig(config.source).left.K
    assert K[1, 1] == 2 * K[0, 0]


def clocks(folder: Path, count: int, ahead_ms: int) -> Path:
    """Images of one moment in both eyes, of which the right one is stamped by a clock that is ahead."""
    rows: list[Row] = []
    for number in range(count):
        for eye, side in enumerate(("left", "right")):
            taken = START + number * 40 * MS
            message = files.image(ROS2, picture(number, eye), taken + eye * ahead_ms * MS)
            rows.append((f"/rig/{side}/image_raw", message, taken))
    return files.write_rosbag2(folder / "bag", rows)


@pytest.mark.parametrize("ahead_ms", [-400, 400, 3200, 3_600_000])
def test_clocks_that_differ_are_told_and_can_be_set(ahead_ms: int, tmp_path: Path) -> None:
    path = clocks(tmp_path, 100, ahead_ms)
    said = [finding for finding in check_folder(path) if "source.clocks:=two" in finding.fix]
    assert len(said) == 1 and "clocks" in said[0].what
    for number, frame in enumerate(play(path, clocks="two")):
        assert frame.right is not None and np.array_equal(frame.right, picture(number, 1))
        assert frame.t_capture_ns == frame.t_capture_right_ns == START + number * 40 * MS


def test_eyes_that_are_not_of_one_moment_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = files.write_rosbag2(tmp_path / "bag", files.stereo_rows(ROS2, skew_ms=16.4))
    said = "right images were taken 16.4 ms after the left ones"
    open_session(path)  # says it once in a process; a check says it in its own way
    assert said in caplog.text
    assert any(said in finding.what and finding.level == "warning" for finding in check_folder(path))
