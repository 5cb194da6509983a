"""Points handed from frame to frame, and the phantom written in the layout of StereoMIS-Tracking."""

import json
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from command_line import figures_of, refused
from places import SESSION

from sags_lab.protocols.point_tracker import PointTracker, raw_pair, to_raw
from sags_lab.protocols.tracked_points import CONVERT, tracked_sequence
from sags_node.config.launch_file import load_launch
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import project
from sags_node.types import F64, Bool, StereoFrame, StereoRig
from sags_node.vision.rectify import Rectifier

FRAMES = 8
BORDER = 40  # px


@pytest.fixture(scope="module")
def frames(played: list[StereoFrame]) -> list[StereoFrame]:
    return played[:FRAMES]


def truth(frames: list[StereoFrame], rig: StereoRig) -> tuple[F64, Bool]:
    """Pixels [P, T, 2] in the rectified left image and whether they are seen [P, T]: of points in the
    middle of the first image."""
    camera = Rectifier(rig, rig.left.width, rig.left.height).camera
    said = [frame.reference for frame in frames if frame.reference is not None]
    pixels = np.stack([project(camera, each.points)[0] for each in said if each.points is not None], 1)
    seen = np.stack([each.points_visible for each in said if each.points_visible is not None], 1)
    size = np.array([rig.left.width, rig.left.height])
    middle = (pixels[:, 0] > BORDER).all(1) & (pixels[:, 0] < size - BORDER).all(1) & seen[:, 0]
    return pixels[middle].astype(np.float64), seen[middle]


def raw(rig: StereoRig, pixels: F64) -> F64:
    return to_raw(rig.left, Rectifier(rig, rig.left.width, rig.left.height).camera, pixels)


def tracker(rig: StereoRig) -> PointTracker:
    return PointTracker(load_launch(SESSION, ["mapping.iterations:=1", "source.pace:=step"]), rig)


def test_points_lie_in_space_in_the_frame_that_they_are_pinned_in(
    frames: list[StereoFrame], rig: StereoRig
) -> None:
    """They stay there, and go on as the same points. A point outside the image is not found."""
    pixels, _ = truth(frames, rig)
    places = np.concatenate([raw(rig, pixels[:6, 0]), [[-5.0, -5.0]]])
    follower = tracker(rig)
    first = follower.pin(places, frames[0])
    assert first.found[:6].sum() >= 5 and first.visible[first.found].all()
    assert not first.found[6] and not first.visible[6]
    np.testing.assert_allclose(first.pixels, places, atol=0.02)
    np.testing.assert_allclose(raw_pair(rig, first.points[first.found])[0], places[first.found], atol=0.02)
    second = follower.follow(first.pixels, frames[0], frames[1])
    np.testing.assert_array_equal(second.anchors, first.anchors)


def test_points_are_handed_from_frame_to_frame(frames: list[StereoFrame], rig: StereoRig) -> None:
    """Those that come back unchanged keep their anchors, in any order and as any type of number; what is new
    gets one, and what is left out loses its."""
    pixels, _ = truth(frames, rig)
    places = raw(rig, pixels[:6, 0])
    follower = tracker(rig)
    first = follower.follow(places, frames[0], frames[1])
    assert first.found.sum() >= 5
    order = [3, 1, 0]
    again = first.pixels[order].astype(np.float32).astype(np.float64)
    second = follower.follow(again, frames[1], frames[2])
    np.testing.assert_array_equal(second.anchors, first.anchors[order])
    np.testing.assert_allclose(second.pixels, raw(rig, pixels[order, 2]), atol=4)
    moved = second.pixels + 3.0
    third = follower.follow(np.vstack([moved, first.pixels[[2]]]), frames[2], frames[3])
    assert not np.isin(third.anchors, first.anchors).any()  # that of the last one is gone: it was left out
    np.testing.assert_allclose(third.pixels[:3], moved, atol=2)  # in a tenth of a second tissue moves less
    camera_z = third.points[third.found, 2]
    assert ((camera_z > 0.03) & (camera_z < 0.2)).all()


def test_a_jump_in_the_recording_and_what_cannot_be_pinned(frames: list[StereoFrame], rig: StereoRig) -> None:
    follower = tracker(rig)
    pixels, _ = truth(frames, rig)
    outside = np.array([[-50.0, 10.0]])
    places = np.vstack([raw(rig, pixels[:1, 0]), outside])
    found = follower.follow(places, frames[0], frames[1])
    assert found.found.tolist() == [True, False]
    np.testing.assert_array_equal(found.pixels[1:], outside)
    assert np.isnan(found.points[1]).all()
    later = follower.follow(found.pixels, frames[4], frames[5])  # frames 2 and 3 are left out
    assert later.found[0]
    with pytest.raises(SagsError, match="not later"):
        follower.follow(places, frames[5], frames[4])
    with pytest.raises(SagsError, match="256 at most"):
        follower.follow(np.zeros((257, 2)), frames[5], frames[6])
    assert follower.follow(np.zeros((0, 2)), frames[5], frames[6]).pixels.shape == (0, 2)


@pytest.fixture(scope="module")
def tracked(frames: list[StereoFrame], rig: StereoRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracked") / "P3_1"
    for name in ("video_frames", "masks"):
        (folder / name).mkdir(parents=True)
    rectifier = Rectifier(rig, rig.left.width, rig.left.height)
    for number, frame in enumerate(frames):
        pair = rectifier(frame)
        assert pair.right is not None
        for side, picture in (("l", pair.left), ("r", pair.right)):
            cv2.imwrite(str(folder / f"video_frames/{number:06d}{side}.png"), picture[..., ::-1])
    mask = np.full((rig.left.height, rig.left.width), 255, np.uint8)
    mask[:, :10] = 0
    cv2.imwrite(str(folder / "masks/000002l.png"), mask)
    rows = "\n".join(f"{number} 0.1 0.2 0.3 0 0 0 1" for number in range(FRAMES))
    (folder / "groundtruth.txt").write_text(rows)
    P = rig.left.P
    cam = {"W": rig.left.width, "H": rig.left.height, "fx": float(P[0, 0]), "fy": float(P[1, 1])}
    product = float(P[0, 0] * rig.baseline * 1e3)
    cam |= {"cx": float(P[0, 2]), "cy": float(P[1, 2]), "stereo_baseline": product}
    said = {"dataset": "stereoMIS", "cam": cam, "data": {"start": 0, "stop": 200, "step": 1}}
    (folder / "P3_1.yaml").write_text(yaml.safe_dump(said))
    pixels, seen = truth(frames, rig)
    points = [
        [at if visible else None for at, visible in zip(*each, strict=True)]
        for each in zip(pixels, seen, strict=True)
    ]
    points.append([None] * FRAMES)  # never seen
    hidden = [(~each).tolist() for each in seen] + [[True] * FRAMES]
    published = {"points": points, "not_visible": hidden}
    (folder / "track_pts.pckl").write_bytes(pickle.dumps(published))
    subprocess.run([sys.executable, "-c", CONVERT], cwd=folder, check=True, timeout=60)
    return folder


def test_stereomis_tracking_end_to_end(tracked: Path, frames: list[StereoFrame], rig: StereoRig) -> None:
    pixels, seen = truth(frames, rig)
    sequence = tracked_sequence(tracked)
    np.testing.assert_allclose(sequence.pixels[seen], pixels[seen])
    np.testing.assert_array_equal(sequence.visible, seen)
    assert sequence.rig.baseline == pytest.approx(rig.baseline)
    np.testing.assert_array_equal(sequence.poses, np.tile(np.eye(4), (FRAMES, 1, 1)))
    for key in ("source.start:=0.1", "source.stride:=2"):
        refused(2, "eval", "--protocol", "stereomis", tracked, key, said=("points are marked in frames",))
    found = figures_of("eval", "--protocol", "stereomis", tracked, "--iterations", "1", "--json")
    assert found["frames"] == FRAMES and found["points"] == len(pixels) and found["masks"] is True
    assert found["tracked"]["survival"] == 1 and found["tracked"]["delta"] >= found["unmoved"]["delta"] > 0
    assert found["tracked"]["mte_px"] < found["unmoved"]["mte_px"]


def test_a_pickle_is_not_opened(tracked: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(tracked, tmp_path / "P3_1"))
    (folder / "track_pts.json").unlink()
    (folder / "track_pts.pckl").write_bytes(b"cos\n_exit\n(I7\ntR.")  # ends the process that opens it
    with pytest.raises(UsageError, match=r"is a pickle.*import json, pickle"):
        tracked_sequence(folder)


@pytest.mark.parametrize(
    "content",
    ["", "{", "[1]", '{"points": 3, "not_visible": []}', '{"points": [], "not_visible": []}', "[" * 100_000,
     json.dumps({"points": [[[1, 2], [1]]], "not_visible": [[False, False]]}),
     json.dumps({"points": [[[1, 2], None]], "not_visible": [[False]]})],
)  # fmt: skip
def test_damaged_points_are_said(tracked: Path, tmp_path: Path, content: str) -> None:
    folder = Path(shutil.copytree(tracked, tmp_path / "P3_1"))
    (folder / "track_pts.json").write_text(content)
    with pytest.raises(UsageError, match=r"track_pts\.json holds no tracked points"):
        tracked_sequence(folder)


def test_what_is_missing_is_said(tracked: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(tracked, tmp_path / "P3_1"))
    (folder / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    with pytest.raises(UsageError, match=r"not whole: \{'poses': 2\}, of 8"):
        tracked_sequence(folder)
    (folder / "video_frames/000003r.png").unlink()
    with pytest.raises(UsageError, match="lacks images"):
        tracked_sequence(folder)
    (folder / "P3_1.yaml").unlink()
    with pytest.raises(UsageError, match=r"configs/StereoMIS/P3_1\.yaml"):
        tracked_sequence(folder)
