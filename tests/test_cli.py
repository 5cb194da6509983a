"""The command line under a user's mistakes: one clear message, the right exit code, nothing lost."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result

from sags_node.apps import overlay, topic
from sags_node.calibration import read_rig, save_rig
from sags_node.cli import main
from sags_node.messaging.subscriber import Subscriber

ROOT = Path(__file__).parent.parent
START_SECONDS = 90  # the first start on a machine compiles kernels
PROMPT_SECONDS = 5  # to end after Ctrl-C
FREE_PORTS = ("publish.data:=[tcp://127.0.0.1:*]", "publish.control:=tcp://127.0.0.1:*")
SHORT = 6  # frames of the right video that ends too early


@pytest.fixture(autouse=True)
def run_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Away from a node that may run on this machine; and the process keeps its signal handlers."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    handler = signal.getsignal(signal.SIGTERM)
    yield tmp_path / "sags"
    signal.signal(signal.SIGTERM, handler)


def sags(*arguments: str | Path) -> Result:
    """The command in this process, with any exception that it did not turn into a message."""
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def refused(code: int, *arguments: str | Path, said: tuple[str, ...]) -> None:
    """One message on stderr, that says all of this, and nothing on stdout."""
    result = sags(*arguments)
    assert result.exit_code == code, result.output
    assert result.stdout == ""
    assert result.stderr.lower().count("error:") == 1, result.stderr
    for part in said:
        assert part in result.stderr


def pure_json(text: str) -> Any:
    """Strict JSON and nothing else; NaN is none."""

    def no_constant(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=no_constant)


# ---- what users have lying about -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def place(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of recordings and calibrations, most of them wrong in one way."""
    folder = tmp_path_factory.mktemp("place")
    pictures = {
        side: [cv2.imread(str(file)) for file in sorted((phantom_session / side).glob("*.jpg"))[: 2 * SHORT]]
        for side in ("left", "right")
    }
    write_video(folder / "left.mp4", pictures["left"])
    write_video(folder / "right.mp4", pictures["right"])
    write_video(folder / "short.mp4", pictures["right"][:SHORT])
    write_video(folder / "small.mp4", [cv2.resize(picture, (160, 128)) for picture in pictures["right"]])
    (folder / "garbage.mp4").write_bytes(np.random.default_rng(0).bytes(20_000))
    (folder / "empty").mkdir()
    (folder / "file").write_text("mine")
    (folder / "small").mkdir()
    for file in (phantom_session / "left").glob("*.jpg"):
        cv2.imwrite(str(folder / "small" / file.name), np.zeros((128, 160, 3), np.uint8))

    rig = read_rig(phantom_session / "calib")
    save_rig(rig, folder / "calib")
    save_rig(rig, folder / "one_eyed")
    (folder / "one_eyed/right.yaml").unlink()
    for name, factor in (("millimetres", 1000.0), ("positive", -1.0)):
        P = rig.right.P.copy()
        P[0, 3] *= factor
        save_rig(replace(rig, right=replace(rig.right, P=P)), folder / name)
    double = {
        side: replace(eye, width=640, height=512, K=doubled(eye.K), P=doubled(eye.P))
        for side, eye in (("left", rig.left), ("right", rig.right))
    }
    save_rig(replace(rig, **double), folder / "double")
    return folder


def doubled(matrix: np.ndarray) -> np.ndarray:
    return np.diag([2.0, 2.0, 1.0]) @ matrix


def write_video(file: Path, pictures: list[np.ndarray]) -> None:
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (width, height))
    for picture in pictures:
        writer.write(picture)
    writer.release()


def videos(place: Path, left: str = "left.mp4", right: str = "right.mp4", rig: str = "calib") -> list[str]:
    return [
        "source.kind:=videos", f"source.left:={place / left}", f"source.right:={place / right}",
        f"rig:={place / rig}", *FREE_PORTS,
    ]  # fmt: skip


# ---- launch files and overrides --------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["run", "demo", "eval", "doctor"])
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere.yaml"], ("nowhere.yaml", "No such file", "check the path")),
        (["[/bold].yaml"], ("[/bold].yaml", "check the path")),  # is not taken for rich's markup
        (["a.yaml", "b.yaml"], ("one launch file", "a.yaml, b.yaml")),
        (["mapping.budgt_ms:=25"], ("mapping.budgt_ms", "did you mean 'budget_ms'")),
        (["budget_ms:=25"], ("'budget_ms'", "did you mean 'mapping.budget_ms'")),
        (["mapping.budget_ms:=soon"], ("mapping.budget_ms", "valid number", "'soon'")),
        (["publish.data:=tcp://127.0.0.1:5"], ("publish.data", "a list", "'tcp://127.0.0.1:5'")),
        (["source.kind:=videos", "source.left:=a.mp4"], ("source.right is missing",)),
        (["mapping.budget_ms=25"], ("'mapping.budget_ms=25'", "write mapping.budget_ms:=25")),
        ([":=25"], ("':=25'", "write key:=value")),
    ],
)
def test_a_wrong_launch(command: str, arguments: list[str], said: tuple[str, ...]) -> None:
    refused(2, command, *arguments, said=said)


def test_a_folder_that_is_no_session(place: Path) -> None:
    refused(2, "run", place / "empty", said=(str(place / "empty/launch.yaml"), "check the path"))


def test_every_mistake_of_a_launch_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "two.yaml"
    file.write_text("mapping: {budget_ms: fast}\nvison: {}\n")
    refused(2, "run", file, said=("two.yaml: mapping.budget_ms", "did you mean 'vision'"))


# ---- recordings and calibrations -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("code", "overrides", "said"),
    [
        (2, {"left": "gone.mp4"}, ("gone.mp4", "does not exist", "check the path")),
        (2, {"left": "garbage.mp4"}, ("garbage.mp4", "cannot be read as a video")),
        (2, {"right": "small.mp4"}, ("320x256", "160x128", "left.mp4", "small.mp4")),
        (2, {"rig": "gone"}, ("gone/left.yaml", "a rig is a folder with left.yaml and right.yaml")),
        (2, {"rig": "one_eyed"}, ("one_eyed/right.yaml", "No such file")),
        (2, {"rig": "millimetres"}, ("millimetres", "projection_matrix[3]", "by 1000")),
        (2, {"rig": "positive"}, ("projection_matrix[3]", "negative")),
        (1, {"rig": "double"}, ("320x256", "640x512")),
    ],
)
def test_a_wrong_recording_or_calibration(
    place: Path, code: int, overrides: dict[str, str], said: tuple[str, ...]
) -> None:
    refused(code, "run", *videos(place, **overrides), said=said)
    refused(code, "eval", "--pace", "step", *videos(place, **overrides), said=said)


def test_no_library_adds_lines_of_its_own(place: Path) -> None:
    process = start(["run", *videos(place, left="garbage.mp4")])
    _, stderr = process.communicate(timeout=START_SECONDS)
    assert process.returncode == 2
    assert stderr == f"error: {place / 'garbage.mp4'} cannot be read as a video; is it complete?\n"


@pytest.mark.parametrize(
    ("code", "overrides", "said"),
    [
        (2, ["source.left:=gone"], ("picture folder gone", "does not exist")),
        (2, ["source.left:=empty"], ("picture folder empty", "no .jpg or .png")),
        (1, ["source.right:=small"], ("320x256", "160x128", "small/0000.jpg")),
        (2, ["rig:=null"], ("no calibration", "set rig")),
        (2, ["source.start:=1000"], ("source.start", "behind the recording's end", "4.00 s")),
    ],
)
def test_wrong_picture_folders(
    place: Path,
    phantom_session: Path,
    monkeypatch: pytest.MonkeyPatch,
    code: int,
    overrides: list[str],
    said: tuple[str, ...],
) -> None:
    monkeypatch.chdir(place)
    refused(code, "run", phantom_session, "source.tools:=null", *overrides, said=said)


def test_a_crop_outside_the_picture(place: Path) -> None:
    boxes = ["source.left:=[0, 0, 200, 256]", "source.right:=[200, 0, 200, 256]"]
    source = ["source.kind:=panes", f"source.video:={place / 'left.mp4'}", f"rig:={place / 'calib'}"]
    refused(2, "run", *source, *boxes, said=("pane 'right'", "leaves the picture", "320x256"))


def test_a_camera_that_is_not_there() -> None:
    camera = "source.left:=/dev/no-camera"
    refused(1, "run", ROOT / "launch/v4l2.yaml", camera, said=("/dev/no-camera", "does not exist"))
    refused(2, "demo", ROOT / "launch/v4l2.yaml", said=("plays recordings", "sags run"))
    refused(2, "eval", ROOT / "launch/v4l2.yaml", said=("live cameras", "record them first"))


def test_a_right_video_that_ends_too_early_ends_the_node_at_that_frame(place: Path, run_dir: Path) -> None:
    """What comes before is processed and published; following the message's advice mends it."""
    session = videos(place, right="short.mp4")
    depth = "left/render/depth"
    with Subscriber([depth], endpoint=f"ipc://{run_dir}/sags.ipc") as subscriber:
        result = sags("run", *session, "source.rate:=5")
        last = subscriber.latest(depth)
        while last is not None and last.meta.frame_id < SHORT - 1:
            last = subscriber.wait(depth, timeout=5, after=last)
    assert last is not None, "the last good frame never came"
    assert result.exit_code == 1
    assert f"short.mp4 ends at frame {SHORT}" in result.stderr and "set source.frames" in result.stderr
    assert sags("run", *session, f"source.frames:={SHORT}").exit_code == 0


def test_a_right_video_that_ends_too_early_cannot_be_measured_to_its_end(place: Path, tmp_path: Path) -> None:
    session = videos(place, right="short.mp4")
    file = tmp_path / "out.json"
    for pace in ("realtime", "step"):
        command = ["eval", *session, "--hold-out", "0", "--pace", pace, "--json", file]
        refused(1, *command, said=(f"short.mp4 ends at frame {SHORT}", "set source.frames"))
        assert not file.exists()
    result = sags("eval", *session, f"source.frames:={SHORT}", *command[-6:])
    assert result.exit_code == 0 and json.loads(file.read_text())["processed"] == SHORT


# ---- where results go ------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["--json", "--report"])
def test_a_result_that_cannot_be_kept_is_noticed_before_the_run(place: Path, option: str) -> None:
    target = place / "file/inside"
    refused(1, "eval", "nowhere.yaml", option, target, said=(f"cannot write {place / 'file'}",))
    assert (place / "file").read_text() == "mine"


def test_a_folder_is_no_json_file_and_a_file_no_folder(place: Path) -> None:
    refused(1, "eval", "nowhere.yaml", "--json", place / "empty", said=(f"cannot write {place / 'empty'}",))
    refused(1, "eval", "nowhere.yaml", "--report", place / "file", said=("cannot write",))
    refused(1, "demo", "--out", place / "file", said=("cannot write",))
    assert not any((place / "empty").iterdir()) and (place / "file").read_text() == "mine"


def test_older_figures_stay_when_the_run_fails(tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    file.write_text("older figures")
    refused(2, "eval", "nowhere.yaml", "--json", file, said=("nowhere.yaml",))
    assert file.read_text() == "older figures"


def test_phantom_overwrites_nothing(tmp_path: Path, place: Path) -> None:
    mine = tmp_path / "full"
    mine.mkdir()
    (mine / "mine.txt").write_text("mine")
    refused(2, "phantom", mine, "seconds:=0.1", said=(str(mine), "not empty", "another folder"))
    assert [file.name for file in mine.iterdir()] == ["mine.txt"]
    refused(2, "phantom", place / "file", said=(str(place / "file"), "exists"))
    refused(2, "phantom", tmp_path / "new", "secnds:=1", said=("secnds", "did you mean 'seconds'"))
    refused(2, "phantom", tmp_path / "new", "kind:=v4l2", said=("kind:=v4l2",))
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "--seconds", "0"],
        ["topic", "hz", "tf", "--seconds", "-1"],
        ["topic", "echo", "tf", "--count", "0"],
        ["eval", "--every", "0"],
        ["eval", "--hold-out", "-1"],
        ["eval", "--iterations", "-1"],
    ],
)
def test_numbers_out_of_range(arguments: list[str]) -> None:
    refused(2, *arguments, said=(arguments[-2], "is not in the range"))


def test_lpips_weights_that_are_not_there(place: Path) -> None:
    session = [*videos(place), "source.frames:=2", "--pace", "step", "--lpips-weights", "gone.npz"]
    refused(2, "eval", *session, said=("gone.npz",))


# ---- reports ---------------------------------------------------------------------------------------------


def test_calib_check_tells_good_from_bad(place: Path) -> None:
    good = sags("calib", "check", ROOT / "calib/d4d")
    assert good.exit_code == 0 and "baseline 4.27 mm" in good.stdout and good.stderr == ""
    bad = sags("calib", "check", place / "millimetres", "--json")
    assert bad.exit_code == 1 and "cannot be used" in bad.stderr
    assert pure_json(bad.stdout)[-1]["level"] == "error"
    refused(2, "calib", "check", place / "gone", said=("gone/left.yaml",))


def test_doctor_finds_what_the_node_needs(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SAGS_DATA", str(place / "gone"))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        mine = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        result = sags("doctor", "--json", f"publish.data:=[{mine}]", "publish.control:=null")
    checks = {check["name"]: check for check in pure_json(result.stdout)}
    assert result.exit_code == 0 and checks["numba"]["level"] == "ok"
    assert checks[mine]["level"] == "warning" and "in use" in checks[mine]["found"]
    assert checks["SAGS_DATA"]["level"] == "warning" and str(place / "gone") in checks["SAGS_DATA"]["found"]
    assert sags("doctor", "publish.data:=[nonsense]").exit_code == 1


def test_a_table_for_another_program_is_not_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    assert (
        "rotations, focal lengths and principal points are plausible"
        in sags("calib", "check", ROOT / "calib/d4d").stdout
    )


def every_command(group: click.Group, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for name, command in group.commands.items():
        yield (*path, name)
        if isinstance(command, click.Group):
            yield from every_command(command, (*path, name))


@pytest.mark.parametrize("path", [(), *every_command(main)], ids=" ".join)
def test_help_mentions_every_argument_and_option(path: tuple[str, ...]) -> None:
    command: Any = main
    for name in path:
        command = command.commands[name]
    result = sags(*path, "--help")
    assert result.exit_code == 0
    if isinstance(command, click.Group):
        assert "..." not in result.stdout.split("Commands:")[1], "a summary is cut off"
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"{parameter.opts} says nothing of itself"
            assert all(option in result.stdout for option in parameter.opts)
        else:
            assert parameter.make_metavar(click.Context(command)) in result.stdout


@pytest.mark.parametrize("pace", ["realtime", "step"])
def test_eval_prints_nothing_but_json(place: Path, pace: str) -> None:
    session = [*videos(place), "source.frames:=4", "--pace", pace, "--json", "-"]
    assert pure_json(sags("eval", *session).stdout)["settings"]["pace"] == pace


def test_run_prints_nothing_but_json(place: Path) -> None:
    result = sags("run", *videos(place), "source.frames:=3", "--json")
    assert result.exit_code == 0 and pure_json(result.stdout)["gaussians"] > 100
    assert "state" in sags("run", *videos(place), "--seconds", "0.3").stdout


def test_demo_prints_nothing_but_json(place: Path, tmp_path: Path) -> None:
    """It plays for as long as asked, at the recording's own rate."""
    result = sags("demo", *videos(place), "--seconds", "2", "--out", tmp_path / "demo", "--json")
    assert result.exit_code == 0, result.stderr
    summary = pure_json(result.stdout)
    assert summary["frames"] == 20 and summary["overlay"]["frames"] > 0
    assert {file.name for file in (tmp_path / "demo").iterdir()} >= {"report.html", "overlay.mp4"}


def test_torch_and_open3d_stay_out_of_the_start(place: Path) -> None:
    """Together they cost seconds, and nothing but LPIPS, the reference engine and meshes needs them."""
    session = videos(place)
    commands = [["run", *session, "source.frames:=2"], ["eval", *session, "source.frames:=2"]]
    code = (
        f"import sys; from sags_node.cli import main\n"
        f"for command in {commands}: main(command, standalone_mode=False)\n"
        f"import sags_node.apps.overlay, sags_node.apps.topic, sags_node.apps.demo\n"
        f"print(sorted({{'torch', 'open3d', 'onnxruntime'}} & set(sys.modules)))"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.splitlines()[-1] == "[]"


# ---- beside no node --------------------------------------------------------------------------------------

LISTENERS = [
    ["topic", "list"],
    ["topic", "echo", "tf"],
    ["topic", "hz", "tf"],
    ["topic", "bw", "tf"],
    ["topic", "delay", "tf"],
    ["overlay"],
]


@pytest.mark.parametrize("arguments", LISTENERS, ids=" ".join)
def test_no_node_runs(arguments: list[str], run_dir: Path) -> None:
    said = ("no node runs as 'other'", str(run_dir / "other.json"), "start one with: sags run")
    refused(1, *arguments, "--ns", "other", said=said)


@pytest.mark.parametrize("arguments", LISTENERS, ids=" ".join)
def test_a_node_that_has_died_without_a_word(
    arguments: list[str], run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its connection file is still there, and nobody answers."""
    run_dir.mkdir(mode=0o700)
    endpoint = f"ipc://{run_dir}/sags.ipc"
    dead = {"protocol": "1.0", "ns": "sags", "session": "a", "pid": 1, "data": [endpoint], "control": None}
    (run_dir / "sags.json").write_text(json.dumps(dead))
    monkeypatch.setattr(topic, "PATIENCE", 0.2)
    monkeypatch.setattr(overlay, "PATIENCE", 0.2)
    seconds = ["--seconds", "0.2"] if arguments[-1] != "overlay" and "echo" not in arguments else []
    refused(1, *arguments, *seconds, said=("no ", endpoint, "is the node running"))


def test_an_endpoint_that_is_none() -> None:
    refused(1, "topic", "hz", "tf", "--endpoint", "nonsense", said=("nonsense", "e.g. tcp://127.0.0.1:5556"))


def test_a_place_for_the_overlay_that_cannot_be(tmp_path: Path) -> None:
    refused(2, "overlay", "--save", tmp_path / "x.avi", said=("x.avi", ".mp4 or .png"))
    refused(2, "overlay", "--save", tmp_path / "gone/x.mp4", said=("there is no folder", "gone"))


# ---- beside a node ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def node(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where a running node's run directory lies: the folder `XDG_RUNTIME_DIR` should name."""
    runtime = tmp_path_factory.mktemp("runtime")
    process = start(["run", phantom_session, "source.loop:=true", *FREE_PORTS], XDG_RUNTIME_DIR=runtime)
    until(process, (runtime / "sags/sags.json").exists)
    yield runtime
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=20)


@pytest.fixture
def beside_node(node: Path, run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The connection file of a running node that every command finds by itself."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(node))
    connection: dict[str, Any] = json.loads((node / "sags/sags.json").read_text())
    return connection


@pytest.mark.parametrize("tool", ["echo", "hz", "bw", "delay"])
def test_an_unknown_topic_names_the_nearest(tool: str, beside_node: dict[str, Any]) -> None:
    said = ("unknown topic 'left/rendr/depth'", "did you mean 'left/render/depth'")
    refused(2, "topic", tool, "left/rendr/depth", said=said)


def test_a_topic_that_says_too_little(beside_node: dict[str, Any]) -> None:
    listen = ("--seconds", "0.3")
    refused(1, "topic", "hz", "parameters", *listen, said=("sags/parameters", "too few", "--seconds"))
    refused(1, "topic", "hz", "right/camera_info", *listen, said=("no messages", "publish.right:=true"))


def test_topic_tools_in_words_and_in_json(beside_node: dict[str, Any]) -> None:
    listen = ("--seconds", "1.2")  # a busy machine delivers the first late
    rows = {row["topic"]: row for row in pure_json(sags("topic", "list", *listen, "--json").stdout)}
    assert 5 < rows["sags/left/depth"]["rate_hz"] < 20
    assert rows["sags/parameters"]["messages"] == 1 and rows["sags/parameters"]["rate_hz"] is None
    assert rows["sags/right/camera_info"]["messages"] == 0
    assert "sags/left/depth" in sags("topic", "list", *listen).stdout
    for tool, key, unit in (
        ("hz", "average_rate", " Hz"),
        ("bw", "bytes_per_s", "MB/s"),
        ("delay", "min_s", " ms"),
    ):
        command = ("topic", tool, "left/depth", *listen)
        assert pure_json(sags(*command, "--json").stdout)[key] > 0
        assert unit in sags(*command).stdout


def test_echo_in_words_and_in_json(beside_node: dict[str, Any]) -> None:
    lines = sags("topic", "echo", "left/depth", "--count", "2", "--json").stdout.splitlines()
    assert [pure_json(line)["topic"] for line in lines] == ["sags/left/depth"] * 2
    transform = sags("topic", "echo", "/sags/tf", "--count", "1").stdout
    assert "rotation: {x: " in transform and transform.endswith("---\n") and "msgtype" not in transform


def test_overlay_in_words_and_in_json(beside_node: dict[str, Any], tmp_path: Path) -> None:
    still, video = tmp_path / "still.png", tmp_path / "video.mp4"
    summary = pure_json(sags("overlay", "--seconds", "1.5", "--save", still, "--json").stdout)
    assert summary["frames"] > 3 and summary["saved"] == str(still)
    assert cv2.imread(str(still)).shape == (256, 320, 3)
    assert "with the overlay" in sags("overlay", "--seconds", "1.5", "--save", video).stdout
    assert cv2.VideoCapture(str(video)).read()[0]
    refused(2, "overlay", "--pin", "5000", "3", said=("pin 5000 3", "320x256"))


def test_a_second_node_of_the_same_name(beside_node: dict[str, Any], phantom_session: Path) -> None:
    said = ("another node already runs as 'sags'", "ns:=NAME")
    refused(1, "run", phantom_session, *FREE_PORTS, said=said)


def test_a_port_that_another_node_has(beside_node: dict[str, Any], phantom_session: Path) -> None:
    taken = next(endpoint for endpoint in beside_node["data"] if endpoint.startswith("tcp"))
    overrides = ("ns:=second", f"publish.data:=[{taken}]", "publish.control:=null")
    refused(1, "run", phantom_session, *overrides, said=(taken, "in use", "publish.data:="))


def test_a_run_directory_that_others_can_enter(phantom_session: Path, tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    override = f"publish.run_dir:={tmp_path}"
    refused(2, "run", phantom_session, *FREE_PORTS, override, said=("open to other users", "chmod 700"))


def test_a_socket_for_other_machines(phantom_session: Path) -> None:
    override = "publish.data:=[tcp://0.0.0.0:5556]"
    refused(2, "run", phantom_session, override, said=("0.0.0.0", "other machines", "publish.insecure"))


# ---- Ctrl-C ----------------------------------------------------------------------------------------------


def start(arguments: list[Any], **environment: str | Path) -> subprocess.Popen[str]:
    """The command as a process in a group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "sags_node", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {key: str(value) for key, value in environment.items()},
    )


def until(process: subprocess.Popen[str], ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + START_SECONDS
    while not ready():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "it did not start"
        time.sleep(0.02)


def stopped(process: subprocess.Popen[str]) -> tuple[str, str]:
    """What it says after Ctrl-C; it and all its children have ended."""
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=PROMPT_SECONDS)
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
    assert "Traceback" not in stderr
    return stdout, stderr


@pytest.mark.parametrize("command", [["eval", "--json", "-"], ["eval", "--pace", "step"], ["demo", "--json"]])
def test_ctrl_c_ends_a_measured_run(command: list[str], phantom_session: Path, tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    if command[0] == "demo":
        command = [*command, "--out", str(tmp_path / "demo")]
    process = start([*command, phantom_session, "source.rate:=2"], TMPDIR=temporary)
    until(process, lambda: any(temporary.glob("sags-eval-*/*.frame")))
    stdout, stderr = stopped(process)
    assert process.returncode == 130 and "stopped" in stderr and stdout == ""
    assert not any(temporary.iterdir())


def test_a_ctrl_c_that_comes_while_a_kernel_is_loaded_is_one_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python turns it into a SystemError when it passes through C code; any other of those is a defect."""

    def interrupted(*arguments: object) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as cause:
            raise SystemError("returned a result with an exception set") from cause

    def broken(*arguments: object) -> None:
        raise SystemError("broken")

    monkeypatch.setattr("sags_node.apps.doctor.examine", interrupted)
    assert CliRunner().invoke(main, ["doctor"]).exit_code == 130
    monkeypatch.setattr("sags_node.apps.doctor.examine", broken)
    assert isinstance(CliRunner().invoke(main, ["doctor"]).exception, SystemError)


def test_ctrl_c_ends_the_rendering_of_a_phantom(tmp_path: Path) -> None:
    process = start(["phantom", tmp_path / "session", "seconds:=60", "width:=320", "height:=256"])
    until(process, lambda: any(tmp_path.glob("*.partial/left/*.jpg")))
    stopped(process)
    assert process.returncode == 130
    assert not any(tmp_path.iterdir())


def test_ctrl_c_ends_the_overlay_with_its_figures(beside_node: dict[str, Any], tmp_path: Path) -> None:
    video = tmp_path / "video.mp4"
    process = start(["overlay", "--save", video, "--json"])
    until(process, lambda: video.exists() and video.stat().st_size > 0)
    stdout, _ = stopped(process)
    assert process.returncode == 0 and pure_json(stdout)["frames"] > 0
    assert cv2.VideoCapture(str(video)).read()[0]


def test_ctrl_c_ends_a_topic_tool(beside_node: dict[str, Any]) -> None:
    process = start(["topic", "echo", "tf"])
    assert process.stdout is not None
    assert process.stdout.readline() == "topic: sags/tf\n"
    stopped(process)
    assert process.returncode == 130
