"""The phantom written in the layout of D4D: its surface is what structured light saw."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import figures_of, refused

from sags_lab.protocols.d4d_files import d4d_clips, instruments_are_white
from sags_lab.protocols.d4d_population import LEFT_OUT, in_population
from sags_lab.protocols.d4d_scan import check_scan, read_surface, scan_depth
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import invert, transform, unproject
from sags_node.rig import eye_text
from sags_node.types import F32, F64, Camera, Eye, StereoFrame, StereoRig
from sags_node.vision.rectify import Rectifier

FRAMES = 9  # the first and the last of them have depth
THEIRS = 1e-3  # m that the data set's own stereo is too far
SCANNER = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
HIDDEN = np.s_[100:150, 120:180]  # that masks call instrument, and the scan tissue
ON_SCANNER = np.s_[225:235, 310:330]  # that the mask over the scanner's image calls instrument


def scanner_pose() -> F64:
    """The scanner is half a metre behind the endoscope, turned by 10 degrees: points of the left rectified
    camera in its frame."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.radians([6.0, 8.0, 0.0]))[0]
    T[:3, 3] = 0.02, -0.01, 0.5
    return T


def write_cloud(file: Path, points: F64) -> None:
    """As Open3D writes it."""
    row = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3)])
    values = np.zeros(len(points), row)
    values["xyz"] = points
    header = [b"ply", b"format binary_little_endian 1.0", b"element vertex %d" % len(points)]
    header += [b"property double " + axis for axis in (b"x", b"y", b"z")]
    header += [b"property uchar " + colour for colour in (b"red", b"green", b"blue")]
    file.write_bytes(b"\n".join([*header, b"end_header", values.tobytes()]))


@pytest.fixture(scope="module")
def d4d(tmp_path_factory: pytest.TempPathFactory, rig: StereoRig, played: list[StereoFrame]) -> Path:
    root = tmp_path_factory.mktemp("d4d")
    session = root / "specimen_1/2025_03_06-16_49_40"
    clip = session / "clips/Clip_1"
    for name in ("left_images_rect", "right_images_rect", "left_images_rect_masks", "stereo_depth"):
        (clip / name).mkdir(parents=True)
    for name in ("camera_info", "clips/Clip_1/camera_info", "clips/Clip_1/zivid_masks", "pointcloud"):
        (session / name).mkdir(exist_ok=True)
    rectifier = Rectifier(rig, rig.left.width, rig.left.height)
    for side, eye in (("left", rig.left), ("right", rig.right)):
        rectified = Eye(eye.width, eye.height, eye.P[:, :3], np.zeros(5), np.eye(3), eye.P)
        (clip / f"camera_info/{side}_rect.yaml").write_text(eye_text(rectified, side))
    (session / "camera_info/color_camera_info.yaml").write_text(json.dumps({"K": SCANNER.ravel().tolist()}))
    truths: list[F32] = []
    for number, frame in enumerate(played[:FRAMES]):
        pair, name = rectifier(frame), f"{1741275000 + number // 15}_{number % 15 * 66666666:09d}"
        if frame.reference.depth is not None:
            truths.append(frame.reference.depth)
        cv2.imwrite(str(clip / f"left_images_rect/{name}.png"), pair.left[..., ::-1])
        cv2.imwrite(str(clip / f"right_images_rect/{name}.png"), pair.right[..., ::-1])
        mask = np.zeros(pair.left.shape[:2], np.uint8)
        mask[HIDDEN] = 255
        cv2.imwrite(str(clip / f"left_images_rect_masks/{name}.png"), mask)
        theirs = np.where(truths[-1] > 0, truths[-1] + THEIRS, np.nan)
        np.save(clip / f"stereo_depth/{name}.npy", theirs)
    said: dict[str, Any] = {"name": "Clip_1"}
    for when, truth in (("start", truths[0]), ("end", truths[-1])):
        rows, columns = np.nonzero(truth)
        pixels = np.stack([columns, rows], 1).astype(np.float64)
        seen: F64 = unproject(rectifier.camera, pixels, truth[rows, columns].astype(np.float64))
        write_cloud(session / f"pointcloud/{when}.ply", transform(scanner_pose(), seen))
        np.savetxt(clip / f"curated_camera_pose_{when}.txt", scanner_pose())
        said[f"{when}_geometry"] = f"pointcloud/{when}.ply"
        mask = np.zeros((480, 640), np.uint8)
        mask[ON_SCANNER] = 255
        cv2.imwrite(str(clip / f"zivid_masks/{when}.png"), mask)
    (session / "clips.json").write_text(json.dumps({"clips": [said]}))
    return root


def test_d4d_end_to_end(d4d: Path) -> None:
    found = figures_of("eval", "--protocol", "d4d", str(d4d), "--iterations", "2", "--json")
    assert found["clips"] == 1 and list(found["of_each"]) == ["specimen_1/2025_03_06-16_49_40/Clip_1"]
    clip = found["of_each"]["specimen_1/2025_03_06-16_49_40/Clip_1"]
    assert clip["masks"] == "white is instrument" and clip["moved"] is False and clip["frames"] == FRAMES
    for when in ("start", "end"):
        figures = found[when]
        assert figures["agrees_with_stereo"] > 0.9
        for region in ("visible", "occluded"):
            assert figures[region]["data_set_stereo"]["bias_mm"] == pytest.approx(THEIRS * 1e3, abs=0.01)
            assert figures[region]["data_set_stereo"]["mae_mm"] == pytest.approx(THEIRS * 1e3, abs=0.01)
        assert figures["visible"]["measured"]["median_mm"] < 1
        assert figures["visible"]["model"]["given"] > 0.5
        assert "measured" not in figures["occluded"]  # stereo is not asked where an instrument is
    assert found["psnr"]["drawn"] > 20 and found["psnr"]["frame_before"] > 20
    population = found["population"]
    assert (population["scans"], population["left_out"]) == (2, 0)
    assert population["start"]["visible"] == found["start"]["visible"]


def test_a_recording_of_which_no_scan_fits_is_refused(d4d: Path, tmp_path: Path) -> None:
    """Of the frames that are played: one scan that is elsewhere stops no other."""
    clip = copied(d4d, tmp_path / "wrong")
    np.savetxt(clip / "curated_camera_pose_start.txt", invert(scanner_pose()))
    command = ("eval", "--protocol", "d4d", clip, "--iterations", 1, "source.frames:=1")
    refused(1, *command, said=("the other way round",))


def test_the_public_population() -> None:
    """487 of 542 scans, 269 of 271 clips: two have lost both."""
    starts, ends = (
        {(session, clip) for session, clips in LEFT_OUT[when].items() for clip in clips}
        for when in ("start", "end")
    )
    assert 542 - len(starts) - len(ends) == 487 and 271 - len(starts & ends) == 269
    assert in_population("specimen_1/2025_03_06-16_56_00/Clip_3", "start")
    assert not in_population("specimen_1/2025_03_06-16_56_00/Clip_4", "start")
    assert in_population("specimen_1/2025_03_06-16_56_00/Clip_4", "end")


def test_the_population_asks_no_stereo(d4d: Path, tmp_path: Path) -> None:
    """Of a clip the public list leaves the scan before it out, and stereo disagrees with the one after it,
    whose pose is 30 mm too far back: by our rule more than half of it is more than a tenth off."""
    session = tmp_path / "specimen_5/2025_09_09-15_28_11"
    shutil.copytree(d4d / "specimen_1/2025_03_06-16_49_40", session)
    back = np.eye(4)
    back[2, 3] = -0.03
    np.savetxt(session / "clips/Clip_1/curated_camera_pose_end.txt", scanner_pose() @ back)
    asked = ("--iterations", 1, "vision.pose:=session", "--json")
    found = figures_of("eval", "--protocol", "d4d", tmp_path, *asked)
    assert (found["scans"], found["refused"]) == (1, 1)
    assert found["end"] == {} and found["start"]["visible"]["measured"]["median_mm"] < 1
    population = found["population"]
    assert (population["scans"], population["left_out"]) == (1, 1) and "start" not in population
    (clip,) = d4d_clips(tmp_path)
    points, _ = read_surface(clip.scans[1])
    nearest = transform(invert(scanner_pose()), points)[:, 2].min()
    assert population["end"]["visible"]["measured"]["median_mm"] > 0.1 * nearest * 1e3


def test_clips_of_d4d(d4d: Path, rig: StereoRig) -> None:
    session = d4d / "specimen_1/2025_03_06-16_49_40"
    for folder in (d4d, d4d / "specimen_1", session, session / "clips/Clip_1"):
        (clip,) = d4d_clips(folder)
        assert clip.rig.baseline == pytest.approx(rig.baseline) and clip.rate == pytest.approx(15, rel=1e-3)
        assert [scan.when for scan in clip.scans] == ["start", "end"] and len(clip.masks) == FRAMES
        assert not clip.is_moved


def test_principal_points_that_differ_are_brought_together(d4d: Path, tmp_path: Path) -> None:
    """What lies 2 px farther to the right in the right image, because its principal point does, lies at the
    same depth."""
    folder = copied(d4d, tmp_path / "apart")
    rig = d4d_clips(folder)[0].rig
    P = rig.right.P.copy()
    P[0, 2] += 2
    moved = Eye(rig.right.width, rig.right.height, P[:, :3], np.zeros(5), np.eye(3), P)
    (folder / "camera_info/right_rect.yaml").write_text(eye_text(moved, "right"))
    picture = np.zeros((rig.right.height, rig.right.width, 3), np.uint8)
    picture[:, 100] = 255
    shifted = np.roll(picture, 2, axis=1)
    pairs = [
        Rectifier(each, rig.left.width, rig.left.height)(StereoFrame(0, 0, 0, picture, right))
        for each, right in ((rig, picture), (d4d_clips(folder)[0].rig, shifted))
    ]
    np.testing.assert_array_equal(pairs[1].right[:, 10:-10], pairs[0].right[:, 10:-10])


def copied(d4d: Path, folder: Path) -> Path:
    shutil.copytree(d4d, folder)
    return folder / "specimen_1/2025_03_06-16_49_40/clips/Clip_1"


def test_a_moved_endoscope_is_known_by_its_poses(d4d: Path, tmp_path: Path) -> None:
    clip = copied(d4d, tmp_path / "moved")
    step = np.eye(4)
    step[0, 3] = 0.006
    np.savetxt(clip / "curated_camera_pose_end.txt", scanner_pose() @ step)
    assert d4d_clips(clip)[0].is_moved


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("inverted", "the pose taken the other way round it would in 100%"),
        ("points", "with the points in mm it would"),
        ("pose", "with the pose in mm it would"),
        ("other", "do pose and scan belong together"),
    ],
)
def test_a_scan_that_is_elsewhere_is_refused_with_what_would_fit(
    what: str, said: str, d4d: Path, tmp_path: Path
) -> None:
    """Nothing is turned or scaled in silence."""
    clip = copied(d4d, tmp_path / "wrong")
    (right,) = d4d_clips(clip)
    points, _ = read_surface(right.scans[0])
    camera = Camera(right.rig.left.width, right.rig.left.height, right.rig.left.K, np.eye(4))
    truth = scan_depth(points, right.scans[0].T_cloud_cam, camera)
    check_scan(right.scans[0], points, camera, truth)
    pose = scanner_pose()
    millimetres, elsewhere = pose.copy(), pose.copy()
    millimetres[:3, 3] *= 1e3
    elsewhere[:3, 3] += 0.1
    given = {"inverted": invert(pose), "points": pose, "pose": millimetres, "other": elsewhere}[what]
    np.savetxt(clip / "curated_camera_pose_start.txt", given)
    if what == "points":
        write_cloud(clip.parents[1] / "pointcloud/start.ply", points * 1e3)
    scan = d4d_clips(clip)[0].scans[0]
    with pytest.raises(SagsError, match=said):
        check_scan(scan, read_surface(scan)[0], camera, truth)


def test_points_seen_through_others_are_left_out() -> None:
    """A wall at 60 mm with a point for every third pixel, before one at 80 mm with a point for each: what is
    left behind it is farther than two pixels from any point of the first."""
    camera = Camera(60, 40, np.array([[100.0, 0, 30], [0, 100, 20], [0, 0, 1]]), np.eye(4))
    grid = np.stack(np.meshgrid(np.arange(60.0), np.arange(40.0)), -1).reshape(-1, 2)
    near = grid[(grid[:, 0] < 30) & (grid % 3 == 0).all(1)]
    points = np.concatenate(
        [unproject(camera, each, np.full(len(each), z)) for each, z in ((near, 0.06), (grid, 0.08))]
    )
    depth = scan_depth(points, np.eye(4), camera)
    assert np.count_nonzero(np.isclose(depth, 0.06)) == len(near)
    assert not np.isclose(depth[:, :30], 0.08).any() and np.isclose(depth[:, 30:], 0.08).all()


def test_the_scanners_mask_takes_its_instruments_away(d4d: Path) -> None:
    scan = d4d_clips(d4d)[0].scans[0]
    points, tissue = read_surface(scan)
    pixels = np.rint((points @ SCANNER.T)[:, :2] / points[:, 2:]).astype(int)
    marked = np.zeros((480, 640), bool)
    marked[ON_SCANNER] = True
    np.testing.assert_array_equal(tissue, ~marked[pixels[:, 1], pixels[:, 0]])
    assert 0 < np.count_nonzero(~tissue) < len(points) / 4


def test_which_colour_is_instrument(tmp_path: Path) -> None:
    for share, white in ((0.2, True), (0.8, False), (0.5, None)):
        mask = np.zeros((10, 10), np.uint8)
        mask.flat[: round(100 * share)] = 255
        cv2.imwrite(str(tmp_path / "mask.png"), mask)
        if white is None:
            with pytest.raises(SagsError, match="not clear which colour"):
                instruments_are_white([tmp_path / "mask.png"])
        else:
            assert instruments_are_white([tmp_path / "mask.png"]) is white
    assert instruments_are_white([]) is None


def test_wrong_files_are_named(d4d: Path, tmp_path: Path, rig: StereoRig) -> None:
    clip = copied(d4d, tmp_path / "wrong")
    eye, P = "camera_info/right_rect.yaml", float(rig.right.P[0, 3])
    good = (clip / eye).read_text()
    for name, text, said in (
        (eye, good.replace("projection_matrix", "P3"), r"right_rect\.yaml is no camera_info"),
        (eye, good.replace(str(P), str(P * 1e3)), "P is in metres times pixels"),
        ("curated_camera_pose_end.txt", "1 2 3", "is no pose: 16 numbers"),
        ("../../clips.json", "[]", r"clips\.json is no table"),
    ):
        (clip / eye).write_text(good)
        (clip / name).write_text(text)
        with pytest.raises(UsageError, match=said):
            d4d_clips(clip)
