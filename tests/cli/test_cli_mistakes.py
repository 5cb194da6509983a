"""What a user gives a command, with every mistake: one clear message and the right exit code."""

import errno
import json
import os
import shlex
from pathlib import Path
from typing import Any

import pytest
from command_line import refused, sags, start
from places import ROOT
from user_files import SHORT, videos, words_of
from waiting import START_SECONDS

pytestmark = [pytest.mark.live, pytest.mark.usefixtures("run_dir")]

LAUNCH = ROOT / "launch"


def named(rows: list[Any]) -> list[Any]:
    """Rows of a table by their commands."""
    return [pytest.param(*row[:2], row[2:], id=row[0].replace(str(ROOT), "")) for row in rows]


# ---- launch files and overrides --------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["run", "demo", "eval", "doctor"])
@pytest.mark.parametrize(
    ("launch", "said"),
    [
        ("nowhere.yaml", ("nowhere.yaml", "No such file", "check the path")),
        ("[/bold]:x:.yaml", ("[/bold]:x:.yaml", "check the path")),  # no markup and no emoji of rich
        (f"{LAUNCH}/d4d_pul.yaml", ("No such file", f"did you mean {LAUNCH}/d4d_pull.yaml?")),
        ("a.yaml b.yaml", ("one launch file", "a.yaml, b.yaml", "sags new LEFT RIGHT")),
        ("budget_ms:=25", ("'budget_ms'", "did you mean 'mapping.budget_ms'")),
        ("source.kind:=videos source.left:=a.mp4",
         ("source.right is missing", "vision.onnx.declared_depth", "docs/networks.md")),
        ("clip.MP4", ("clip.MP4 does not exist", "check the path")),
        ("mapping.budget_ms=25", ("'mapping.budget_ms=25'", "write mapping.budget_ms:=25")),
        (":=25", ("':=25'", "write key:=value")),
    ],
)  # fmt: skip
def test_a_wrong_launch(command: str, launch: str, said: tuple[str, ...]) -> None:
    refused(2, command, *launch.split(), said=said)


EMPTY = ("mine.yaml is empty", "write source:")
NO_PHANTOM = ("FILES/calib", "built-in phantom", "name the launch file")


@pytest.mark.parametrize(
    ("content", "overrides", "said"),
    [
        *(("mapping: {max_gaussians: 1000}", *row) for row in (
            ("mapping.bugdet_ms:=3", ("command line: unknown key 'mapping.bugdet_ms'",)),
            ("mapping.budget_ms:=soon", ("command line: mapping.budget_ms", "valid number", "'soon'")),
            ("'mapping:={bugdet_ms: 3}'", ("command line: unknown key 'mapping.bugdet_ms'",)),
            ("source.kind:=video", ("command line: source.kind: should be one of",)),
        )),
        ("mapping: {max_gausians: 1}", "", ("mine.yaml: unknown key 'mapping.max_gausians'",)),
        ("mapping: {max_gausians: 1}", "mapping.budget_ms:=3", ("mine.yaml: unknown key",)),
        ("mapping: {budget_ms: fast}\nvison: {}\n", "",  # every mistake is named
         ("mine.yaml: mapping.budget_ms", "did you mean 'vision'")),
        *((nothing, "", EMPTY) for nothing in ("", "# source: {kind: videos}\n", "{}")),
        ("rig: FILES/calib", "", NO_PHANTOM),
    ],
)  # fmt: skip
def test_a_mistake_is_named_where_it_was_made(
    user_files: Path, tmp_path: Path, content: str, overrides: str, said: tuple[str, ...]
) -> None:
    """What says nothing, or no source, is not taken for the phantom."""
    (tmp_path / "mine.yaml").write_text(content.replace("FILES", str(user_files)))
    expected = tuple(words.replace("FILES", str(user_files)) for words in said)
    refused(2, "run", tmp_path / "mine.yaml", *shlex.split(overrides), said=expected)
    if "command line" in said[0]:
        refused(2, "run", *shlex.split(overrides), said=expected)


# ---- everything else -------------------------------------------------------------------------------------

NOBODY = "no node runs as 'other'"
LISTENERS = ("topic list", "topic echo tf", "topic hz tf", "topic bw tf", "topic delay tf")
REFUSED = [  # command, exit code, what is said; FILES: of `write_user_files`; NEW: nothing is there
    ("run /dev/null", 2, "/dev/null: it is a device, no file; check the path"),
    ("run FILES/empty", 2, "FILES/empty is an empty folder", "give the folder that holds the recording"),
    *((f"{command} rig:=FILES/calib", 2, *NO_PHANTOM) for command in ("run", "eval", "doctor")),
    (f"run {LAUNCH}/v4l2.yaml source.left:=/dev/no-camera", 1, "/dev/no-camera", "does not exist"),
    (f"demo {LAUNCH}/v4l2.yaml", 2, "plays recordings", "sags run"),
    (f"eval {LAUNCH}/v4l2.yaml", 2, "live cameras", "record them first"),
    ("calib check FILES/calib --images FILES/left.mp4 FILES/right.mp4", 2, "left.mp4 is a video",
     "--session"),
    ("eval VIDEOS source.frames:=2 --pace step --lpips-weights gone.npz", 2, "no file of LPIPS weights at ",
     "gone.npz"),
    # Numbers out of range.
    *((f"{command} {option} {number}", 2, option, "is not in the range") for command, option, number in (
        ("run", "--seconds", 0), ("topic hz tf", "--seconds", -1), ("topic echo tf", "--count", 0),
        ("bag record", "--max-cache", "inf"), ("bag play bag", "--start-offset", "nan"),
        ("eval", "--every", 0), ("eval", "--hold-out", -1), ("eval", "--iterations", -1),
    )),
    # Topics to record are named by an option.
    ("bag record left/render/depth", 2, "--topics left/render/depth; without --topics all are recorded"),
    ("bag record --topics left/depth no_such", 2, "unknown topic 'no_such'"),
    ("bag record --all --topics left/depth", 2, "--all or --topics, not both"),
    ("bag record rig:=x", 2, "rig:=x: key:=value needs a recording"),
    # What cannot be kept is noticed before the run.
    *((f"eval nowhere.yaml {option} FILES/file/inside", 1, "cannot write FILES/file")
      for option in ("--out", "--report")),
    ("eval nowhere.yaml --out FILES/empty", 2, "empty", "is a directory"),
    ("eval nowhere.yaml --report FILES/file", 1, "cannot write"),
    ("demo --out FILES/file", 1, "cannot write"),
    ("phantom FILES seconds:=0.1", 2, "FILES", "not empty", "another folder"),
    ("phantom FILES/file", 2, "FILES/file", "exists"),
    ("phantom FILES/file/new seconds:=0.1", 1, "cannot write FILES/file: "),
    ("phantom NEW secnds:=1", 2, "secnds", "did you mean 'seconds'"),
    ("phantom NEW kind:=v4l2", 2, "kind: ", "'phantom'", "v4l2"),
    ("overlay --save NEW.avi", 2, "new.avi", ".mp4 or .png"),
    ("overlay --save NEW/x.mp4", 2, "there is no folder", "new"),
    # Beside no node.
    *((f"{command} --ns other", 1, NOBODY, "/sags/other.json", "start one with: sags run")
      for command in (*LISTENERS, "pause", "reset", "anchor list", "param get")),
    ("overlay --ns other --seconds 0.3", 1, NOBODY, "waiting (Ctrl-C ends): "),
    ("topic hz tf --endpoint nonsense", 1, "nonsense", "e.g. tcp://127.0.0.1:5556"),
    ("bridge gst", 2, "--left", "--right"),
]  # fmt: skip


@pytest.mark.parametrize(("command", "code", "said"), named(REFUSED))
def test_a_mistake_is_one_message_and_changes_nothing(
    user_files: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    code: int,
    said: tuple[str, ...],
) -> None:
    monkeypatch.setattr(os, "nice", lambda by: 0)  # this process goes on
    words = words_of(command.replace("NEW", str(tmp_path / "new")), user_files)
    refused(code, *words, said=tuple(each.replace("FILES", str(user_files)) for each in said))
    assert (user_files / "file").read_text() == "mine" and not any((user_files / "empty").iterdir())
    assert not (tmp_path / "new").exists()


@pytest.mark.fault("calibration: missing, one eye only, in mm, of another size")
@pytest.mark.parametrize("command", ["run", "eval --pace step"])
@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"left": "gone.mp4"}, ("gone.mp4", "does not exist", "check the path")),
        ({"right": "small.mp4"}, ("320x256", "160x128", "left.mp4", "small.mp4")),
        ({"rig": "calb"}, ("no calibration", "did you mean /", "/calib?")),
        ({"rig": "one_eyed"}, ("one_eyed/right.yaml", "No such file")),
        ({"rig": "millimetres"}, ("millimetres", "projection_matrix[3]", "by 1000")),
        ({"rig": "double"}, ("320x256", "640x512")),
    ],
    ids=str,
)
def test_a_wrong_recording_or_calibration(
    user_files: Path, command: str, overrides: dict[str, str], said: tuple[str, ...]
) -> None:
    refused(2, *command.split(), *videos(user_files, **overrides), said=said)


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


def test_a_calibration_is_not_converted_onto_itself(user_files: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig"
    convert = ("calib", "convert", user_files / "calib", "-o", rig, "--scale", "2")
    assert sags(*convert).exit_code == 0
    before = [(rig / f"{eye}.yaml").read_text() for eye in ("left", "right")]
    for same in (rig, rig / "../rig"):
        refused(2, "calib", "convert", rig, "-o", same, "--scale", "2", said=("rig", "name another folder"))
    assert [(rig / f"{eye}.yaml").read_text() for eye in ("left", "right")] == before


def test_no_library_adds_lines_of_its_own(user_files: Path) -> None:
    process = start(["run", *videos(user_files, left="garbage.mp4")])
    _, stderr = process.communicate(timeout=START_SECONDS)
    assert process.returncode == 2
    assert stderr == f"error: {user_files / 'garbage.mp4'} cannot be read as a video; is it complete?\n"


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
