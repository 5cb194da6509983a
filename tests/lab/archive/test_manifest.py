"""The list of recordings: what is found, what is refused, and that both kinds of file say the same."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import figures_of
from tiny_archive import TINY_FRAMES
from user_files import write_video

from sags_lab.archive.launching import arguments, counterpart, split
from sags_lab.archive.manifest import Recording, beside, read_manifest, write_manifest
from sags_lab.archive.scan import Scan, scan
from sags_node.errors import UsageError
from sags_node.pipeline.session import open_session

FRAMES = 3


@pytest.fixture(scope="module")
def archive(tiny_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings in all forms that need no other reader, and what is none."""
    folder = tmp_path_factory.mktemp("archive")
    pictures = {
        eye: [cv2.imread(str(file)) for file in sorted((tiny_session / eye).glob("*.jpg"))[:FRAMES]]
        for eye in ("left", "right")
    }
    shutil.copytree(tiny_session / "calib", folder / "calib")
    (folder / "case1").mkdir()
    write_video(folder / "case1/scope_left.mp4", pictures["left"])
    write_video(folder / "case1/scope_right.mp4", pictures["right"])
    (folder / "case2").mkdir()
    both = [np.hstack(pair) for pair in zip(pictures["left"], pictures["right"], strict=True)]
    write_video(folder / "case2/both.mp4", both)
    write_video(folder / "case2/one eye.mp4", pictures["left"])
    (folder / "case2/broken.mp4").write_bytes(b"no video" * 100)
    for eye in ("left", "right"):
        (folder / "case3" / eye).mkdir(parents=True)
        for number, picture in enumerate(pictures[eye]):
            cv2.imwrite(str(folder / f"case3/{eye}/{number}.png"), picture)
    (folder / "case4").symlink_to(tiny_session)
    (folder / "case5").mkdir()
    (folder / "case5/live.yaml").write_text("source: {kind: v4l2}\nrig: ../calib\n")
    (folder / "case5/notes.txt").write_text("no recording")
    return folder


@pytest.fixture(scope="module")
def found(archive: Path) -> Scan:
    return scan(archive)


def test_all_that_can_be_played_is_found_and_the_rest_explained(found: Scan) -> None:
    assert {each.name: each.overrides for each in found.recordings} == {
        "case1/scope_left.mp4": ("source.kind:=videos",),
        "case2/both.mp4": ("source.kind:=videos", "source.geometry.layout:=side_by_side"),
        "case3": (),
        "case4": (),
    }
    why = {each.path: each.why for each in found.refused}
    assert why.keys() == {"case2/one eye.mp4", "case2/broken.mp4", "case5/live.yaml"}
    assert "right eye" in why["case2/one eye.mp4"]
    assert "cannot be read as a video" in why["case2/broken.mp4"]
    assert "record them first" in why["case5/live.yaml"]


def test_what_was_found_plays_with_both_eyes(found: Scan) -> None:
    for recording in found.recordings:
        rig = None if recording.rig is None else Path(recording.rig)
        with open_session(
            *split(arguments(Path(recording.place), rig, recording.overrides))
        ).source as source:
            frame = next(iter(source))
        assert frame.right is not None and not np.array_equal(frame.left, frame.right), recording.name


def test_a_longer_recording_weighs_more(found: Scan) -> None:
    weights = {each.name: each.weight for each in found.recordings}
    assert weights["case4"] == pytest.approx(weights["case3"] * TINY_FRAMES / FRAMES, rel=1e-3)


def test_without_a_calibration_it_says_how_to_name_one(archive: Path, tmp_path: Path) -> None:
    shutil.copytree(archive / "case3", tmp_path / "case")
    assert "--rig" in scan(tmp_path).refused[0].why
    named = scan(tmp_path, archive / "calib").recordings[0]
    assert named.rig == str((archive / "calib").resolve())


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_manifest_reads_as_it_was_written(tmp_path: Path, suffix: str) -> None:
    if suffix == "parquet":
        pytest.importorskip("pyarrow", reason="the extra archive is not installed")
    folder = str(tmp_path)
    recordings = [
        Recording("case 1/a.mp4", folder, "calib", ("source.kind:=videos", "segments:={a: [0, 4]}"), 2.5),
        Recording("s3://bucket/b.mcap", folder),
    ]
    write_manifest(f"{folder}/m.{suffix}", recordings)
    assert read_manifest(f"file://{folder}/m.{suffix}")[1] == Recording(
        "s3://bucket/b.mcap", f"file://{folder}"
    )
    read = read_manifest(f"{folder}/m.{suffix}")
    assert read == recordings
    assert [each.place for each in read] == [f"{folder}/case 1/a.mp4", "s3://bucket/b.mcap"]


@pytest.mark.parametrize(
    ("row", "said"),
    [
        (",,,", "row 2: no recording"),
        ("b,,mapping.rung=2,", "'mapping.rung=2' is not key:=value"),
        ("b,,,heavy", "row 2"),
        ("b,,,-1", "weight -1.0 should be above 0"),
        ("a,,,", "row 2 is row 1 again"),
    ],
)
def test_a_wrong_row_is_named(tmp_path: Path, row: str, said: str) -> None:
    (tmp_path / "m.csv").write_text(f"recording,rig,overrides,weight\na,,,\n{row}\n")
    with pytest.raises(UsageError, match=said):
        read_manifest(str(tmp_path / "m.csv"))


def test_an_id_stays_when_the_archive_is_moved_and_differs_by_overrides() -> None:
    one = Recording("case1/left.mp4", "/data")
    assert one.id == Recording("case1/left.mp4", "s3://lab/data").id
    assert one.id != Recording("case1/left.mp4", "/data", None, ("source.start:=10",)).id
    assert one.id != Recording("case1_left.mp4", "/data").id


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("left.mp4", "right.mp4"),
        ("Scope_Left_2.avi", "Scope_Right_2.avi"),
        ("LEFT.mkv", "RIGHT.mkv"),
        ("case_L.mp4", "case_R.mp4"),
        ("gall.mp4", None),
        ("both.mp4", None),
    ],
)
def test_the_right_eyes_name(left: str, right: str | None) -> None:
    assert counterpart(left) == right


def test_a_video_that_does_not_say_how_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"source\.geometry\.layout:=side_by_side"):
        arguments(tmp_path / "a.mp4", None, ())
    said = arguments(tmp_path / "a.mp4", None, ("source.kind:=videos", "source.geometry.layout:=panes"))
    assert f"source.left:={tmp_path}/a.mp4" in said


def test_the_command_leaves_a_manifest(archive: Path, found: Scan, tmp_path: Path) -> None:
    said = figures_of("archive", "scan", archive, "--out", tmp_path / "m.csv", "--json")
    read = read_manifest(str(tmp_path / "m.csv"))
    assert [each["id"] for each in said["recordings"]] == [each.id for each in read]
    assert [each.place for each in read] == [each.place for each in found.recordings]
    assert read[0].rig == str(archive / "calib")  # found from where the manifest lies
    assert len(said["refused"]) == 3


def test_names_are_relative_to_a_manifest_above_them() -> None:
    row = Recording("case1/left.mp4", "/data/theatre", "calib")
    above = beside(row, "/data/m.csv")
    assert (above.name, above.rig_name) == ("theatre/case1/left.mp4", "theatre/calib")
    assert (above.place, above.rig) == (row.place, row.rig)
    assert beside(row, "/data/theatre/m.csv") == row
    assert beside(row, "s3://lab/m.csv").place == row.place
