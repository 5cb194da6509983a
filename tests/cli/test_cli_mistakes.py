"""What a user gives a command, with every mistake: one clear message and the right exit code."""

import errno
import json
import os
from pathlib import Path
from typing import Any

import pytest
from command_line import RUN_HERE, refused, sags, start
from places import ROOT
from user_files import SHORT, videos
from waiting import START_SECONDS

pytestmark = [pytest.mark.live, pytest.mark.usefixtures("run_dir")]


# ---- launch files and overrides --------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["run", "demo", "eval", "doctor"])
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere.yaml"], ("nowhere.yaml", "No such file", "check the path")),
        (["[/bold]:x:.yaml"], ("[/bold]:x:.yaml", "check the path")),  # no markup and no emoji of rich
        ([f"{ROOT}/launch/d4d_pul.yaml"], ("No such file", f"did you mean {ROOT}/launch/d4d_pull.yaml?")),
        (["a.yaml", "b.yaml"], ("one launch file", "a.yaml, b.yaml", "sags new LEFT RIGHT")),
        (["mapping.budgt_ms:=25"], ("mapping.budgt_ms", "did you mean 'budget_ms'")),
        (["budget_ms:=25"], ("'budget_ms'", "did you mean 'mapping.budget_ms'")),
        (["mapping.budget_ms:=soon"], ("mapping.budget_ms", "valid number", "'soon'")),
        (["publish.data:=tcp://127.0.0.1:5"], ("publish.data", "a list", "'tcp://127.0.0.1:5'")),
        (
            ["source.kind:=videos", "source.left:=a.mp4"],
            ("source.right is missing", "vision.onnx.declared_depth", "docs/networks.md"),
        ),
        (["clip.MP4"], ("clip.MP4 does not exist", "check the path")),
        (["mapping.budget_ms=25"], ("'mapping.budget_ms=25'", "write mapping.budget_ms:=25")),
        ([":=25"], ("':=25'", "write key:=value")),
    ],
)
def test_a_wrong_launch(command: str, arguments: list[str], said: tuple[str, ...]) -> None:
    refused(2, command, *arguments, said=said)


def test_what_is_there_and_no_file_is_not_taken_for_a_slip_of_the_pen() -> None:
    refused(2, "run", "/dev/null", said=("/dev/null: it is a device, no file; check the path",))


@pytest.mark.parametrize("content", ["", "# source: {kind: videos}\n", "{}"])
def test_a_launch_file_that_says_nothing_is_not_taken_for_the_phantom(tmp_path: Path, content: str) -> None:
    (tmp_path / "mine.yaml").write_text(content)
    refused(2, "run", tmp_path / "mine.yaml", said=("mine.yaml is empty", "write source:"))


def test_a_folder_that_is_no_session(user_files: Path) -> None:
    said = (f"{user_files / 'empty'} is an empty folder", "give the folder that holds the recording")
    refused(2, "run", user_files / "empty", said=said)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["mapping.bugdet_ms:=3"], "command line: unknown key 'mapping.bugdet_ms'"),
        (["mapping.budget_ms:=soon"], "command line: mapping.budget_ms"),
        (["mapping:={bugdet_ms: 3}"], "command line: unknown key 'mapping.bugdet_ms'"),
        (["source.kind:=video"], "command line: source.kind: should be one of"),
        ([], "mine.yaml: unknown key 'mapping.max_gausians'"),
        (["mapping.budget_ms:=3"], "mine.yaml: unknown key 'mapping.max_gausians'"),
    ],
)
def test_a_mistake_is_named_where_it_was_made(tmp_path: Path, overrides: list[str], said: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        "mapping: {max_gaussians: 1000}" if "command line" in said else "mapping: {max_gausians: 1}"
    )
    refused(2, "run", file, *overrides, said=(said,))
    if "command line" in said:
        refused(2, "run", *overrides, said=(said,))


def test_a_calibration_is_not_taken_for_that_of_the_phantom(user_files: Path, tmp_path: Path) -> None:
    """The launch file was forgotten, or names no source."""
    rig = f"rig:={user_files / 'calib'}"
    said = (str(user_files / "calib"), "built-in phantom", "name the launch file")
    for command in ("run", "eval", "doctor"):
        refused(2, command, rig, said=said)
    (tmp_path / "mine.yaml").write_text(f"rig: {user_files / 'calib'}")
    refused(2, "run", tmp_path / "mine.yaml", said=said)


def test_what_is_played_is_said(user_files: Path) -> None:
    played = ("source.frames:=2", "source.pace:=fast")
    said = f"source: videos {user_files / 'left.mp4'}, {user_files / 'right.mp4'}"
    assert said in sags("run", *videos(user_files), *played).stderr.splitlines()
    assert said in sags("eval", *videos(user_files), *played[:1], "--pace", "step").stderr.splitlines()
    small = ("source.width:=160", "source.height:=128", "source.seconds:=0.2")
    phantom = sags("run", *small, *RUN_HERE, "source.loop:=false", *played)
    assert "source: the built-in phantom" in phantom.stderr.splitlines()


def test_every_mistake_of_a_launch_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "two.yaml"
    file.write_text("mapping: {budget_ms: fast}\nvison: {}\n")
    refused(2, "run", file, said=("two.yaml: mapping.budget_ms", "did you mean 'vision'"))


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "--seconds", "0"],
        ["topic", "hz", "tf", "--seconds", "-1"],
        ["topic", "echo", "tf", "--count", "0"],
        ["bag", "record", "--max-cache", "inf"],
        ["bag", "play", "bag", "--start-offset", "nan"],
        ["eval", "--every", "0"],
        ["eval", "--hold-out", "-1"],
        ["eval", "--iterations", "-1"],
    ],
)
def test_numbers_out_of_range(arguments: list[str]) -> None:
    refused(2, *arguments, said=(arguments[-2], "is not in the range"))


# ---- recordings and calibrations -------------------------------------------------------------------------


@pytest.mark.fault("calibration: missing, one eye only, in mm, of another size")
@pytest.mark.parametrize(
    ("code", "overrides", "said"),
    [
        (2, {"left": "gone.mp4"}, ("gone.mp4", "does not exist", "check the path")),
        (2, {"left": "garbage.mp4"}, ("garbage.mp4", "cannot be read as a video")),
        (2, {"right": "small.mp4"}, ("320x256", "160x128", "left.mp4", "small.mp4")),
        (2, {"rig": "gone"}, ("gone/left.yaml", "a rig is a folder with left.yaml and right.yaml")),
        (2, {"rig": "calb"}, ("no calibration", "did you mean /", "/calib?")),
        (2, {"rig": "one_eyed"}, ("one_eyed/right.yaml", "No such file")),
        (2, {"rig": "millimetres"}, ("millimetres", "projection_matrix[3]", "by 1000")),
        (2, {"rig": "positive"}, ("projection_matrix[3]", "negative")),
        (2, {"rig": "double"}, ("320x256", "640x512")),
    ],
)
def test_a_wrong_recording_or_calibration(
    user_files: Path, code: int, overrides: dict[str, str], said: tuple[str, ...]
) -> None:
    refused(code, "run", *videos(user_files, **overrides), said=said)
    refused(code, "eval", "--pace", "step", *videos(user_files, **overrides), said=said)


@pytest.mark.parametrize("command", [["run"], ["import", "--check"], ["calib", "check"]])
def test_a_path_that_cannot_be_looked_up(command: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    refused(2, *command, "x" * 300, said=("xxx: File name too long; check the path",))

    usual = Path.stat

    def private(path: Path, **how: Any) -> os.stat_result:
        if "private" in path.parts:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return usual(path, **how)

    monkeypatch.setattr(Path, "stat", private)
    refused(2, *command, "/private/case", said=("cannot open /private/case", "Permission denied"))


def test_a_video_is_no_picture(user_files: Path) -> None:
    pair = (user_files / "left.mp4", user_files / "right.mp4")
    said = ("left.mp4 is a video", "--session")
    refused(2, "calib", "check", user_files / "calib", "--images", *pair, said=said)


def test_a_calibration_is_not_converted_onto_itself(user_files: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig"
    convert = ("calib", "convert", user_files / "calib", "-o", rig, "--scale", "2")
    assert sags(*convert).exit_code == 0
    before = [(rig / f"{eye}.yaml").read_text() for eye in ("left", "right")]
    for same in (rig, rig / "../rig"):
        refused(2, "calib", "convert", rig, "-o", same, "--scale", "2", said=("rig", "name another folder"))
    assert [(rig / f"{eye}.yaml").read_text() for eye in ("left", "right")] == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["left/render/depth"], "--topics left/render/depth; without --topics all are recorded"),
        (["--topics", "left/depth", "no_such"], "unknown topic 'no_such'"),
        (["--all", "--topics", "left/depth"], "--all or --topics, not both"),
        (["rig:=x"], "rig:=x: key:=value needs a recording"),
    ],
)
def test_topics_to_record_are_named_by_an_option(arguments: list[str], said: str) -> None:
    refused(2, "bag", "record", *arguments, said=(said,))


def test_no_library_adds_lines_of_its_own(user_files: Path) -> None:
    process = start(["run", *videos(user_files, left="garbage.mp4")])
    _, stderr = process.communicate(timeout=START_SECONDS)
    assert process.returncode == 2
    assert stderr == f"error: {user_files / 'garbage.mp4'} cannot be read as a video; is it complete?\n"


def test_a_camera_that_is_not_there() -> None:
    camera = "source.left:=/dev/no-camera"
    refused(1, "run", ROOT / "launch/v4l2.yaml", camera, said=("/dev/no-camera", "does not exist"))
    refused(2, "demo", ROOT / "launch/v4l2.yaml", said=("plays recordings", "sags run"))
    refused(2, "eval", ROOT / "launch/v4l2.yaml", said=("live cameras", "record them first"))


@pytest.mark.fault("file: the right eye's video is shorter")
def test_a_right_video_that_ends_too_early_is_refused_before_it_plays(
    user_files: Path, tmp_path: Path
) -> None:
    """Following the message's advice fixes it."""
    session, file = videos(user_files, right="short.mp4"), tmp_path / "out.json"
    command = ["eval", *session, "--hold-out", "0", "--pace", "step", "--out", file]
    for refused_one in (["run", *session], command):
        said = f"short.mp4 has {SHORT} images", f"play what is there with source.frames:={SHORT}"
        refused(2, *refused_one, said=said)
    assert not file.exists()
    assert sags("run", *session, f"source.frames:={SHORT}").exit_code == 0
    result = sags("eval", *session, f"source.frames:={SHORT}", *command[-6:])
    assert result.exit_code == 0 and json.loads(file.read_text())["processed"] == SHORT


def test_lpips_weights_that_are_not_there(user_files: Path) -> None:
    session = [*videos(user_files), "source.frames:=2", "--pace", "step", "--lpips-weights", "gone.npz"]
    refused(2, "eval", *session, said=("no file of LPIPS weights at ", "gone.npz"))
