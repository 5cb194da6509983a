"""The phantom written in the layout of STIR 2026, with points that are known in some frames."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import figures_of, refused
from numbered_pictures import write_video

from sags_lab.protocols.stir_2026 import stir_2026_sequences
from sags_node.errors import UsageError
from sags_node.geometry import project
from sags_node.types import StereoFrame, StereoRig
from sags_node.vision.rectify import Rectifier

# Of thirteen frames; the latency of the first eleven does not count.
KNOWN = (0, 4, 12)
BORDER = 40  # px


@pytest.fixture(scope="module")
def stir(tmp_path_factory: pytest.TempPathFactory, rig: StereoRig, played: list[StereoFrame]) -> Path:
    rectifier, size = Rectifier(rig, rig.left.width, rig.left.height), (rig.left.width, rig.left.height)
    folder = tmp_path_factory.mktemp("stir") / "test/00"
    folder.mkdir(parents=True)
    pairs = [rectifier(frame) for frame in played]
    write_video(folder / "left.mp4", [pair.left for pair in pairs])
    write_video(folder / "right.mp4", [pair.right for pair in pairs if pair.right is not None])
    K = rectifier.camera.K.tolist()
    said: dict[str, Any] = {
        f"{what}_{side}": value for side in ("left", "right") for what, value in (("K", K), ("D", [0.0] * 5))
    }
    said |= {"R_left_to_right": np.eye(3).tolist(), "t_left_to_right": [-rig.baseline, 0.0, 0.0]}
    (folder / "calib.json").write_text(json.dumps(said))
    truth = {}
    for number in KNOWN:
        reference, camera = played[number].reference, rectifier.camera
        left, right = (
            project(eye, reference.points)[0] for eye in (camera, camera.moved_right(rig.baseline))
        )
        if number == 0:
            middle = (
                (left > BORDER).all(1) & (left < np.array(size) - BORDER).all(1) & reference.points_visible
            )
        seen = reference.points_visible[middle]
        row = {"left_x": left[middle, 0], "left_y": left[middle, 1], "disparity": (left - right)[middle, 0]}
        row |= {"left_visibility": seen, "right_visibility": seen & (right[middle, 0] >= 0)}
        truth[f"{number}/0"] = {name: values.tolist() for name, values in row.items()}
    truth["4/1"] = {}  # another instance: theirs leaves it out unread
    (folder / "annotations.json").write_text(json.dumps(truth))
    asked = {name: truth["0/0"][name] for name in ("left_x", "left_y")}
    (folder / "queries.json").write_text(json.dumps({"0/0": asked}))
    return folder.parent


def test_a_sequence_of_2026(stir: Path, rig: StereoRig) -> None:
    (sequence,) = stir_2026_sequences(stir)
    assert sequence.rig.baseline == pytest.approx(rig.baseline) and tuple(sequence.truth) == KNOWN
    first = sequence.truth[0]
    np.testing.assert_array_equal(sequence.queries, first.left)
    assert (first.left[:, 0] > first.right[:, 0]).all() and first.in_left.all()


def test_a_point_must_be_seen_by_both_eyes(stir: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(stir / "00", tmp_path / "00"))
    said = json.loads((folder / "annotations.json").read_text())
    row = said["4/0"]
    row["left_visibility"][:4], row["right_visibility"][:4] = [1, 1, 0, 0], [1, 0, 1, 0]
    (folder / "annotations.json").write_text(json.dumps(said))
    (sequence,) = stir_2026_sequences(folder)
    truth = sequence.truth[4]
    assert truth.in_left[:4].tolist() == [True, True, False, False]
    assert truth.in_both[:4].tolist() == [True, False, False, False]
    assert truth.right[0].tolist() == [row["left_x"][0] - row["disparity"][0], row["left_y"][0]]


def test_stir_2026_end_to_end(stir: Path) -> None:
    found = figures_of("eval", "--protocol", "stir", str(stir), "--iterations", "1", "--json")
    (sequence,) = stir_2026_sequences(stir)
    assert (found["rules"], found["sequences"], found["points"]) == (2026, 1, len(sequence.queries))
    for name in ("mono", "stereo", "stereo_first_frame"):
        # A point that is right within a threshold and said to be visible is within it, whatever is said.
        assert 0 < found[name]["average_jaccard"] <= found[name]["average_tracking_accuracy"] <= 1
    assert found["mono"]["average_tracking_accuracy"] >= found["unmoved"]["average_tracking_accuracy"]
    # Half of the depths within 2 mm, so within each threshold.
    assert found["stereo_first_frame"]["average_tracking_accuracy"] > 0.5
    assert found["latency_p95_ms"] > 0


def test_without_what_follows_the_first_frame_nothing_is_measured(stir: Path) -> None:
    command, said = (
        ("eval", "--protocol", "stir", stir),
        ("no annotated frame after the first", "source.frames"),
    )
    refused(1, *command, "source.frames:=2", said=said)
    refused(2, *command, "source.start:=0.2", said=("source.start: points are marked",))


def test_wrong_files_of_2026(stir: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(stir / "00", tmp_path / "00"))
    queries, truth = folder / "queries.json", folder / "annotations.json"
    good = queries.read_text()
    for text, said in (
        ("[]", "holds no points"),
        ('{"0": {}}', "holds no points"),
        ('{"0/0": {"left_x": [1, 2], "left_y": [1]}}', "holds no points"),
        ('{"0/0": {"left_x": [1], "left_y": [1]}}', "do they belong together"),
        ('{"1/0": {"left_x": [1], "left_y": [1]}}', "no point of frame 0"),
    ):
        queries.write_text(text)
        with pytest.raises(UsageError, match=said):
            stir_2026_sequences(folder)
    queries.write_text(good)
    truth.unlink()
    with pytest.raises(UsageError, match="public validation sequences"):
        stir_2026_sequences(folder)
