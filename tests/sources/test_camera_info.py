"""What is said of a recording's cameras: by camera_info, by names, and by the rows of the images."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import bag_files as files
import cv2
import numpy as np
import pytest
from bag_files import BASELINE, HEIGHT, MS, ROS2, START, WIDTH, Row, eye_of, picture, play
from command_line import ran
from numbered_pictures import write_png
from places import SESSION

from sags_node.config.launch_file import load_launch
from sags_node.errors import UsageError
from sags_node.pipeline.session import open_session
from sags_node.rig import load_rig, save_rig
from sags_node.sources.pictures import read_picture
from sags_node.sources.rectified import as_named, named_rectified
from sags_node.tools.calibration.guess import guess_rig
from sags_node.tools.importing.check import check_folder, overrides_of
from sags_node.types import U8, Eye, StereoFrame, StereoRig
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


Shown = Sequence[tuple[U8, U8]]  # images of the left and the right eye
Scope = tuple[StereoRig, Shown, Shown]


@pytest.fixture(scope="module")
def scope() -> Scope:
    """Turned eyes with distortion: images as their cameras give them, and rectified."""
    rig = load_rig(SESSION / "calib")
    rectifier = Rectifier(rig, rig.left.width, rig.left.height)
    raw, rectified = [], []
    for index in (0, 20):
        left, right = (read_picture(SESSION / f"{side}/{index:04}.jpg") for side in ("left", "right"))
        pair = rectifier(StereoFrame(index, 0, 0, left, right))
        raw.append((left, right))
        rectified.append((pair.left, pair.right))
    return rig, raw, rectified


NOTHING = 0, 0, 0, 0


def bag_of(
    folder: Path,
    said: Sequence[tuple[Eye, Eye]],
    shown: Shown = (),
    name: str = "image_raw",
    ahead_ms: int = 0,
    rois: Sequence[tuple[int, int, int, int]] = (NOTHING, NOTHING),
    **options: object,
) -> Path:
    """A bag whose camera_info says one after the other of these, if any, each with a pair of images of one
    moment; the right one is stamped by a clock that may be ahead."""
    rows: list[Row] = []
    for number, pair in enumerate(shown or numbered(len(said))):
        taken = START + number * 40 * MS
        for eye, side in enumerate(("left", "right")):
            stamp = taken + eye * ahead_ms * MS
            if said:
                info = files.camera_info(ROS2, stamp, said[number][eye], roi=rois[eye], **options)
                rows.append((f"/rig/{side}/camera_info", info, taken))
            rows.append((f"/rig/{side}/{name}", files.image(ROS2, pair[eye], stamp), taken))
    return files.write_rosbag2(folder / "bag", rows)


def numbered(count: int) -> list[tuple[U8, U8]]:
    return [(picture(number, 0), picture(number, 1)) for number in range(count)]


def bag(folder: Path, rig: StereoRig, shown: Shown, name: str) -> tuple[Path, list[str]]:
    return bag_of(folder, [(rig.left, rig.right)] * len(shown), shown, name), []


def folders(folder: Path, rig: StereoRig, shown: Shown, name: str) -> tuple[Path, list[str]]:
    for number, pair in enumerate(shown):
        for side, rgb in zip(("left", "right"), pair, strict=True):
            write_png(folder / name.format(side) / f"{number}.png", rgb)
    save_rig(rig, folder / "calib")
    return folder, overrides_of(folder)


@pytest.mark.parametrize(
    ("write", "name"),
    [(bag, "image_rect"), (bag, "image_rect_color"), (folders, "{}_rectified"), (folders, "{}")],
)
def test_nothing_is_rectified_twice(scope: Scope, tmp_path: Path, write: Any, name: str) -> None:
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


def test_a_calibration_made_with_rectified_pictures_stays_as_it_is(scope: Scope, tmp_path: Path) -> None:
    rig, _, rectified = scope
    left, right = (
        replace(eye, K=np.diag([1.1, 1.1, 1]) @ eye.P[:, :3], R=np.eye(3), distortion=np.zeros(5))
        for eye in (rig.left, rig.right)
    )
    path, overrides = folders(tmp_path / "case", StereoRig("own", left, right), rectified, "{}_rectified")
    np.testing.assert_array_equal(open_session(path, overrides).rig.left.K, left.K)


# ---- camera_info -----------------------------------------------------------------------------------------


def eyes(focal: float = 80.0, factor: float = 1.0, **changed: int) -> tuple[Eye, Eye]:
    """Both, of a sensor that may have another size; their matrices times a factor."""
    left, right = (
        replace(eye, K=factor * eye.K, R=factor * eye.R, P=factor * eye.P, **changed)
        for eye in (eye_of(0, focal), eye_of(1, focal))
    )
    return left, right


def test_zeros_are_passed_over(tmp_path: Path) -> None:
    zeros = eyes(factor=0)
    path = bag_of(tmp_path, [zeros, zeros, eyes(), zeros, eyes()])
    assert open_session(path).rig.left.K[0, 0] == 80


def test_a_calibration_that_changes_is_refused_and_its_parts_can_be_played(tmp_path: Path) -> None:
    path = bag_of(tmp_path, [eyes(100.0)] * 2 + [eyes(80.0)] * 3)
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
    first binned pixel is the middle of 2 x 3 pixels of the sensor. The right eye begins two columns later."""
    sensor = eyes(width=160, height=200)
    rois = [(20 + more, 30, 2 * WIDTH, 3 * HEIGHT) for more in (0, 4)]
    rig = open_session(bag_of(tmp_path, [sensor], rois=rois, binning=(2, 3))).rig
    assert (rig.left.width, rig.left.height) == (WIDTH, HEIGHT)
    ray = np.array([0.21, -0.13, 1.0])
    for eye, raw, columns in ((rig.left, sensor[0], 20), (rig.right, sensor[1], 24)):
        expected = ((raw.K @ ray)[:2] - [columns, 30] - [0.5, 1.0]) / [2, 3]
        for matrix in (eye.K, eye.P[:, :3]):
            np.testing.assert_allclose((matrix @ ray)[:2], expected)
    assert rig.baseline == pytest.approx(BASELINE)


SENSOR, SIZE = eyes(width=2 * WIDTH, height=2 * HEIGHT), (WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("said", "how", "words"),
    [
        *((eyes(), {"model": model}, f"distortion model '{model}' is not supported")
          for model in ("equidistant", "fisheye", "kannala_brandt4")),
        (SENSOR, {"rois": 2 * [(120, 0, 20, 20)]}, r"roi 120,0 20x20 .* is no part of 128x96 px"),
        (SENSOR, {"rois": [(3, 9, *SIZE), (3, 4, *SIZE)]},
         r"begin 5 rows apart \(roi.*same rows.*or calibrate .*set rig"),
        # As images that are cut need a calibration of their own: camera_info is of what the cameras send.
        (eyes(), {}, r"camera_info is of .*flip: both turns .*leave flip out.*set rig"),
    ],
)  # fmt: skip
def test_camera_info_that_does_not_fit_is_refused_where_no_calibration_is_told(
    said: tuple[Eye, Eye], how: dict[str, Any], words: str, tmp_path: Path
) -> None:
    path = bag_of(tmp_path, [said], **how)
    turned = [] if how else ["source.geometry.flip:=both"]
    with pytest.raises(UsageError, match=words):
        open_session(path, turned)
    save_rig(StereoRig("told", *eyes()), tmp_path / "told")
    assert open_session(path, [*turned, f"rig:={tmp_path / 'told'}"]).rig.left.K[0, 0] == 80


# ---- topics and clocks -----------------------------------------------------------------------------------


def topic_of_both(folder: Path, high: int = 1) -> Path:
    """Beside each other."""
    rows: list[Row] = []
    for number, pair in enumerate(numbered(3)):
        both = np.repeat(np.hstack(pair), high, axis=0)
        rows.append(("/scope/image_raw", files.image(ROS2, both, START + number * 40 * MS), START))
    return files.write_rosbag2(folder / "bag", rows)


def test_a_topic_of_both_eyes_is_split_as_a_live_one(tmp_path: Path) -> None:
    path = topic_of_both(tmp_path)
    with pytest.raises(UsageError, match=r"source\.geometry\.layout"):
        play(path)
    for first, said in ((0, {}), (0, {"left": "scope/image_raw"}), (1, {})):
        geometry = {"layout": "side_by_side", "first": ("left", "right")[first]}
        for number, frame in enumerate(play(path, geometry=geometry, **said)):
            assert np.array_equal(frame.left, picture(number, first))
            assert frame.right is not None and np.array_equal(frame.right, picture(number, 1 - first))


def test_squeezed_eyes_of_a_topic_are_told_of_and_guessed_so(tmp_path: Path) -> None:
    """Each at half of its width, as a 3D mixer sends them."""
    bag, said = topic_of_both(tmp_path, high=2), ["source.geometry.layout:=side_by_side"]
    assert any("2 times as wide as high" in finding.what for finding in check_folder(bag, said))
    K = guess_rig(load_launch(bag, said).source).left.K
    assert K[1, 1] == 2 * K[0, 0]


@pytest.mark.parametrize("ahead_ms", [-400, 400, 3200, 3_600_000])
def test_clocks_that_differ_are_told_and_can_be_set(ahead_ms: int, tmp_path: Path) -> None:
    path = bag_of(tmp_path, [], numbered(100), ahead_ms=ahead_ms)
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
