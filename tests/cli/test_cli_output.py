"""What a command says and writes: nothing of the user's is lost, tables are whole, JSON is JSON."""

import logging
import os
import re
import resource
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from ctypes.util import find_library
from datetime import datetime
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import click
import numpy as np
import pytest
import zmq
from command_line import RUN_HERE, pure_json, refused, sags
from onnx_networks import save_matcher
from places import ROOT
from ports import free_port
from rich.markup import escape
from user_files import videos, words_of

from sags_node.cli.launching import write_json
from sags_node.cli.main import main, sags_group
from sags_node.errors import SagsError
from sags_node.files import check_file, check_results, whole
from sags_node.terminal import console as terminal
from sags_node.terminal import text
from sags_node.tools.doctor import OPEN3D_LIBRARIES
from sags_node.tools.evaluation.report import check_report

pytestmark = [pytest.mark.live, pytest.mark.usefixtures("run_dir")]


# ---- where results go ------------------------------------------------------------------------------------


WRITERS = [  # commands, and their options for one file
    ("eval", "--out"),
    ("eval --protocol stir DATA", "--out"),
    ("archive scan SESSION", "--out"),
    ("archive costs SESSION --frames 4", "--out"),
    *(("export", option) for option in ("--splats", "--points", "--mesh", "--orbit")),
    *(("export --session SESSION", option) for option in ("--tracks", "--render")),
    *(("overlay", option) for option in ("--out", "--layers")),
    ("calib live SESSION", "--out"),
    ("bridge foxglove", "--layout"),
]
ENDINGS = {"--splats": "ply", "--points": "ply", "--mesh": "ply", "--orbit": "mp4"}


BOARD = "--squares 10x7 --square-mm 4.5"
IN_A_FOLDER = [
    ("fit", "--out", "model.ply"),
    ("fit", "--out", "figures.json"),
    ("eval", "--report", "report.html"),
    ("eval", "--report", "sheet.png"),
    ("demo", "--out", "overlay.mp4"),
    (f"calib convert {ROOT}/calib/d4d", "--out", "left.yaml"),
    (f"calib stereo left right {BOARD}", "--out", "right.yaml"),
    (f"calib hand-eye {BOARD}", "--out", "hand_eye.yaml"),
]


@pytest.mark.parametrize(("command", "option", "name"), [*((*each, "") for each in WRITERS), *IN_A_FOLDER])
def test_no_command_overwrites_what_it_did_not_make(
    tmp_path: Path, phantom_session: Path, command: str, option: str, name: str
) -> None:
    """Before any work: the file that is named, or one in the folder that is."""
    mine = tmp_path / (name or f"mine.{ENDINGS.get(option, 'csv' if 'scan' in command else 'png')}")
    mine.write_text("source: {kind: videos}")
    words = [*command.replace("SESSION", str(phantom_session)).split(), option, tmp_path if name else mine]
    refused(2, *words, said=(str(mine), "exists already", "choose another"))
    assert mine.read_text() == "source: {kind: videos}"


def test_what_is_not_known_is_null_in_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As the place of an anchor that is lost."""
    row = {"id": 1, "x": float("nan"), "z": [float("inf"), 0.25]}
    terminal.show([row])
    write_json(tmp_path / "rows.json", [row])
    told = [{"id": 1, "x": None, "z": [None, 0.25]}]
    assert pure_json(capsys.readouterr().out) == told
    assert pure_json((tmp_path / "rows.json").read_text())["rows"] == told


def test_figures_and_results_of_before_are_replaced_also_when_they_come_late(tmp_path: Path) -> None:
    file, result = tmp_path / "out.json", '{"provenance": "another run beside this one"}'
    check_file(file)
    with whole(file) as partial:
        file.write_text(result)
        partial.write_text("new")
    assert file.read_text() == "new"
    check_results(tmp_path, ("figures.json",), ours=False)
    with pytest.raises(SagsError, match="meanwhile"), whole(tmp_path / "figures.json") as partial:
        partial.write_text("new")
        (tmp_path / "figures.json").write_text("theirs")
    check_file(file, force=True)
    with whole(file) as partial:
        file.write_text("theirs")
        partial.write_text("told to")
    assert file.read_text() == "told to"


def test_a_file_after_json_is_no_launch_file_and_stays(tmp_path: Path, user_files: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("sorce: {kind: phantom}")
    refused(2, "eval", "--json", mine, "source.frames:=2", said=("mine.yaml: unknown key 'sorce'",))
    assert mine.read_text() == "sorce: {kind: phantom}"
    for name in ("out.json", "-"):
        refused(2, "eval", mine, "--json", name, said=(f"'{name}'", "--out FILE"))


# ---- reports ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("family", "host"), [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "[::1]")])
def test_doctor_finds_what_the_node_needs(
    family: int, host: str, user_files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SAGS_DATA", str(user_files / "gone"))
    free = f"tcp://{host}:{free_port()}"
    with socket.socket(family) as taken:
        taken.bind((host.strip("[]"), 0))
        taken.listen()
        mine = f"tcp://{host}:{taken.getsockname()[1]}"
        result = sags("doctor", "--json", f'publish.data:=["{mine}"]', f"publish.control:={free}")
    checks = {check["name"]: check for check in pure_json(result.stdout)}
    assert result.exit_code == 0 and checks["numba"]["level"] == "ok"
    assert checks[mine]["level"] == "warning" and "in use" in checks[mine]["found"]
    assert "stop the other node" in checks[mine]["fix"] and checks[free]["found"] == "free"
    data = checks["SAGS_DATA"]
    assert data["level"] == "warning" and str(user_files / "gone") in data["found"]
    assert sags("doctor", "publish.data:=[nonsense]").exit_code == 1


CAMERAS = f"{ROOT}/launch/v4l2.yaml source.left:=/dev/null source.right:=/dev/zero"
LIVE = "source.kind:=push rig:=FILES/calib"
PUSHED = f"{LIVE} robot.kind:=push robot.hand_eye:=FILES/gone.yaml"
TISSUE = "vision.tissue.tissue_is:=white vision.tissue.method:="
TOPIC = f"{LIVE} {TISSUE}topic vision.tissue.endpoint:=tcp"
GST = "source.kind:=gst rig:=FILES/calib source.right:=videotestsrc"
NAMED_IN_A_LAUNCH = {  # what it names -> the launch, the row that says how that is, and what it says
    "a video": ("VIDEOS source.left:=FILES/gone.mp4", "source", "gone.mp4 does not exist"),
    "a video cut short": ("VIDEOS source.right:=FILES/short.mp4", "source", "short.mp4 has 6 images"),
    "videos that play": ("VIDEOS", "source", "^ok: 12 frames of 320x256 px at 10 Hz;"),
    "a calibration": ("VIDEOS rig:=FILES/gone", "calibration", "gone/left.yaml"),
    "a calibration of another size": ("VIDEOS rig:=FILES/double", "calibration", "640x512"),
    "a calibration that fits": ("VIDEOS", "calibration", "^ok: "),
    "no calibration": ("VIDEOS rig:=null", "calibration", "^warning: no calibration; .*no unit"),
    "a camera": (f"{CAMERAS} source.left:=/dev/no-camera", "/dev/no-camera", "no such camera"),
    "a camera's size": (f"{CAMERAS} rig:=FILES/calib", "calibration", "320x256 px, an eye's images are 640x"),
    "a hand-eye calibration": (PUSHED, "hand-eye", "gone.yaml"),
    "a depth network": ("VIDEOS vision.onnx.path:=FILES/gone.onnx", "depth network", "gone.onnx"),
    "a tissue network": (
        f"VIDEOS vision.tissue.path:=FILES/file {TISSUE}onnx", "tissue network", "is no ONNX model"),
    "an interface": (
        "source.kind:=ros2 source.interface:=nowhere0", "source", "no network interface nowhere0"),
    # What `sags run` refuses only when it makes the pipeline is said before the camera is there.
    "a live network": (f"{LIVE} vision.onnx.path:=NETWORK", "pipeline", "network.onnx .* is not described"),
    "a live box": (
        f"{LIVE} vision.tissue.exclude:=[[0,0,9000,5]]", "pipeline", "not inside the raw image of 320x256"),
    "masks of another machine": (f"{TOPIC}://10.0.0.1:5600", "tissue masks", "is not on this machine"),
    "masks that may come": (f"{TOPIC}://127.0.0.1:5600", "pipeline", "^ok: "),
    # GStreamer reads the launch string itself.
    "a gst element": (f"{GST} source.left:=nosuchsrc", "source", 'no element "nosuchsrc"'),
    "a gst pattern": (f"{GST} 'source.left:=videotestsrc pattern=nonsense'", "source", "pattern"),
    "a gst source": (f"{GST} source.left:=videotestsrc", "source", "^ok: "),
}  # fmt: skip


def doctor(user_files: Path, launch: str) -> tuple[int, dict[str, dict[str, str]]]:
    """Exit code, and the rows by name."""
    result = sags("doctor", "--json", "device:=cpu", *words_of(launch, user_files))
    return result.exit_code, {check["name"]: check for check in pure_json(result.stdout)}


@pytest.mark.parametrize("what", NAMED_IN_A_LAUNCH)
def test_doctor_looks_at_all_that_a_launch_file_names(user_files: Path, tmp_path: Path, what: str) -> None:
    if " gst " in what and find_library("gstapp-1.0") is None:
        pytest.skip("GStreamer is not installed")
    launch, row, said = NAMED_IN_A_LAUNCH[what]
    network = save_matcher(tmp_path / "network.onnx") if "NETWORK" in launch else ""
    code, checks = doctor(user_files, launch.replace("NETWORK", str(network)))
    level, found, fix = (checks[row][each] for each in ("level", "found", "fix"))
    assert (code, level) == ((0, level) if said.startswith(("^ok", "^warning")) else (1, "error"))
    assert re.search(said, f"{level}: {found}; {fix}")


def test_doctor_asks_for_the_packages_that_a_launch_file_needs(
    user_files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sags_node.tools.doctor.find_spec", lambda name: None)
    code, checks = doctor(user_files, f"{ROOT}/launch/ros2.yaml")
    assert code == 1 and "cyclonedds" in checks["source"]["found"] and "[ros2]" in checks["source"]["fix"]


def test_a_missing_library_of_the_system_is_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    error = ImportError("libidn2.so.0: cannot open shared object file: No such file or directory")
    monkeypatch.setattr("sags_node.tools.doctor.examine", Mock(side_effect=error))
    refused(2, "doctor", said=("libidn2.so.0 is missing on this system; sags doctor says which package",))


def _a_thread() -> None:
    before = threading.stack_size(1 << 46)  # bytes: more than there are addresses
    try:
        threading.Thread(target=print).start()
    finally:
        threading.stack_size(before)


@pytest.mark.fault("process: it may open no more files, start no more threads or take no more memory")
@pytest.mark.parametrize(
    ("ask", "said"),
    [
        ("file", "ulimit -n"),
        ("socket", "ulimit -n"),
        (_a_thread, "ulimit -u"),
        (lambda: np.empty(1 << 50), "ulimit -v"),
    ],
)
def test_what_a_limit_refuses_is_one_message(ask: Any, said: str) -> None:
    @click.command()
    def greedy() -> None:
        ask()

    command = sags_group(lambda verbose, form: None)
    command.add_command(greedy)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with zmq.Context() as context, context.socket(zmq.PUB):
        ask = {"file": lambda: open(os.devnull), "socket": lambda: context.socket(zmq.SUB)}.get(ask, ask)
        try:
            if said == "ulimit -n":
                resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
            result = sags("greedy", command=command)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert result.exit_code == 1 and said in result.stderr
    assert result.stderr.count("error:") == len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize("file", ["Makefile", "README.md", "examples/container/Containerfile"])
def test_what_open3d_needs_is_installed_wherever_it_is(file: str) -> None:
    assert " ".join(OPEN3D_LIBRARIES.values()) in (ROOT / file).read_text(encoding="utf-8")


def test_a_long_path_in_a_table_for_another_program_is_whole(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    table, path = text.table(), f"/{'long/' * 100}[/red]:x:.html"
    table.add_row("report", path)
    terminal.show(table)
    assert path in capsys.readouterr().out


@pytest.mark.parametrize("control", ["\t", "\r", "\b", "\x1b[31m", "\x1b]0;title\a", "\x9b2J", "\0"])
def test_a_name_cannot_steer_the_terminal(
    capsys: pytest.CaptureFixture[str], control: str, tmp_path: Path
) -> None:
    """Whatever way it comes there; JSON holds it as it is."""
    spelled = control.encode("unicode_escape").decode()
    name = f"a{control}b"
    table = text.table(name)
    table.add_row(name)
    for told in (table, text.rows_table([{"file": name}]), name):
        terminal.show(told)
    terminal.tell(name)
    terminal.console.print(f"[bold]{escape(name)}[/]", soft_wrap=True)
    file = name.replace("\0", "\x01")  # which no file's name holds
    results = [sags("import", "--check", tmp_path / file), sags("calib", "check", ".", file)]
    out, err = capsys.readouterr()
    assert out.count(f"a{spelled}b") == 4 and err.count(f"a{spelled}b") == 2
    for line in "\n".join([out, err, *(each.output for each in results)]).split("\n"):
        assert line.isprintable(), line
    assert all(each.exit_code and "a\\" in each.output for each in results)

    terminal.show({"name": name})
    assert pure_json(capsys.readouterr().out) == {"name": name}


def test_where_no_terminal_is_progress_is_a_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    """With the time that is left, by what was done since the count began: another count is another work. One
    step tells nothing: the first may compile."""
    times = iter([0.0, 5.0, 10.0, 20.0, 30.0, 31.0, 41.0, 42.0, 52.0, 62.0])
    with terminal.progress("fitting", lambda: next(times)) as advance:
        for done in (1, 2, 3):
            advance(done, 9)
        advance(4, None, "drawing")
        for done in (5, 10):
            advance(done, 100, "measuring")
        for done in (1, 51):
            advance(done, 100, "hiding")
        advance(52, 100, "hiding", 600.0)  # the work knows of more to come
    said = [line.split(" ", 2)[2] for line in capsys.readouterr().err.splitlines()]
    assert said == [
        "fitting: 2 of 9",
        "fitting: 3 of 9, about 45 s left",
        "drawing: 4",
        "measuring: 10 of 100, about 3 min left",
        "hiding: 51 of 100, about 10 s left",
        "hiding: 52 of 100, about 10 min left",
    ]


@pytest.mark.fault("process: stdin, stdout or stderr is closed, or on a full disk")
@pytest.mark.parametrize(
    ("command", "code", "where"),
    [("keygen mine", 0, "<&- >&- 2>&-"), ("calib check gone", 2, "2>/dev/full"), ("nonsense", 2, "2>&-")],
)
def test_messages_that_nobody_can_read_end_nothing(
    tmp_path: Path, where: str, command: str, code: int
) -> None:
    shell = f'exec "$0" -m sags_node {command} {where}'
    words = ["sh", "-c", shell, sys.executable]
    ended = subprocess.run(words, cwd=tmp_path, capture_output=True, check=False, timeout=300)
    assert (ended.returncode, ended.stdout, ended.stderr) == (code, b"", b"")
    assert (tmp_path / "mine.key").exists() == (code == 0)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("--help", "cannot write what was asked for: No space left on device"),
        ("doctor --json device:=cpu", "No space left on device"),
    ],
)
def test_what_a_full_disk_cannot_take_is_one_message(command: str, said: str) -> None:
    words = [sys.executable, "-m", "sags_node", *command.split()]
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            words, stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=300
        )
    (line,) = ended.stderr.splitlines()
    assert ended.returncode == 1 and line.startswith("error: ") and line.endswith(said)


def every_command(command: click.Command, *path: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    yield path, command
    for name, part in command.commands.items() if isinstance(command, click.Group) else ():
        yield from every_command(part, *path, name)


@pytest.mark.parametrize(
    ("path", "command"), [pytest.param(*each, id=" ".join(each[0])) for each in every_command(main)]
)
def test_help_mentions_every_argument_and_option(path: tuple[str, ...], command: click.Command) -> None:
    """All are spelled alike: --json prints, whatever else; a file or folder to be written is -o or --out."""
    result = sags(*path, "--help")
    assert not re.search(r"^  \w.* {4,}--", result.stdout, re.M), "an example lost its line break"
    assert result.exit_code == 0
    if isinstance(command, click.Group):
        assert "..." not in result.stdout.split("--help")[1], "a summary is cut off"
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"{parameter.opts} says nothing of itself"
            assert all(option in result.stdout for option in parameter.opts)
            assert parameter.is_flag or "--json" not in parameter.opts
            if {"-o", "--out", "--output"} & {*parameter.opts}:
                assert parameter.opts[:2] == ["-o", "--out"]
        else:
            unwrapped = " ".join(result.stdout.split())
            assert parameter.make_metavar(click.Context(command)) in unwrapped


def test_run_prints_nothing_but_json(user_files: Path) -> None:
    result = sags("run", *videos(user_files), "source.frames:=3", "--json")
    assert result.exit_code == 0 and pure_json(result.stdout)["gaussians"] > 100
    played = f"source: videos {user_files / 'left.mp4'}, {user_files / 'right.mp4'}\n"
    assert re.search(rf"{played}.* \d+x\d+ px at 10 frames/s, .* calibration \S+\n", result.stderr)
    small = ("source.width:=160", "source.height:=128", "source.seconds:=0.2", "source.frames:=2")
    phantom = sags("run", *small, *RUN_HERE, "source.loop:=false", "source.pace:=fast")
    assert "source: the built-in phantom" in phantom.stderr.splitlines()
    ended = sags("run", *videos(user_files), "source.frames:=3", "source.pace:=step").stdout
    assert re.search(r"^state +ended, 3 of 3 frames published$", ended, re.MULTILINE)
    assert re.search(r"^latency p50 / p99 +–$", ended, re.MULTILINE), "stamps are no times of day"
    looped = sags("run", *videos(user_files), "source.loop:=true", "--seconds", "0.3").stdout
    assert re.search(r"^state +ended, \d+ frames published$", looped, re.MULTILINE)


def test_demo_prints_nothing_but_json(user_files: Path, tmp_path: Path) -> None:
    """It plays for as long as asked, at the recording's own rate."""
    result = sags("demo", *videos(user_files), "--seconds", "3.5", "--out", tmp_path / "demo", "--json")
    assert result.exit_code == 0, result.stderr
    summary = pure_json(result.stdout)
    assert summary["frames"] == 35 and summary["overlay"]["frames"] > 0
    assert {"revision", "machine"} < set(summary["provenance"]) and summary["receipt"]["frames"]["count"] > 0
    assert summary["overlay"]["saved"] == str(tmp_path / "demo/overlay.mp4")
    assert "images of {width}x{height} px".format_map(summary["settings"]) in result.stderr
    assert {file.name for file in (tmp_path / "demo").iterdir()} >= {"report.html", "overlay.mp4"}
    check_report(tmp_path / "demo", "overlay.mp4")  # the next one may replace it


@pytest.mark.fault("process: the node of a demo takes longer to start than it plays")
def test_a_demo_on_a_slow_machine_has_its_report(user_files: Path, tmp_path: Path) -> None:
    result = sags("demo", *videos(user_files), "--seconds", "0.2", "--out", tmp_path / "demo", "--json")
    assert result.exit_code == 0 and pure_json(result.stdout)["frames"] == 2, result.stderr


def test_eval_says_what_it_found_in_a_dozen_lines(user_files: Path, tmp_path: Path) -> None:
    """Figures in groups only when asked for, and never as Python prints a dictionary."""
    session = [*videos(user_files), "source.frames:=4", "--pace", "step"]
    result = sags("eval", *session, "--report", tmp_path / "report")
    assert result.exit_code == 0, result.stderr
    lines = result.stdout.splitlines()
    assert f"source: videos {user_files / 'left.mp4'}, {user_files / 'right.mp4'}\n" in result.stderr
    assert 5 <= len(lines) <= 12 and lines[-1].split() == ["report", f"{tmp_path}/report/report.html"]
    said = dict(line.split(None, 1) for line in lines)
    assert "dB PSNR of the next frame" in said["image"] and "ms (p99)" in said["latency"]
    assert "The image before, shown again:" in said["image"]
    all_figures = sags("eval", *session, "--verbose").stdout
    assert "of that, median of: rectify" in all_figures and len(all_figures.splitlines()) > 30
    assert "{" not in all_figures + result.stdout and "None" not in all_figures


def test_what_is_told_and_what_is_logged_are_one_line_each_in_one_form(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a file each with its time, however long it is."""
    monkeypatch.setenv("COLUMNS", "80")
    handler, long = terminal.log_handler(), "no new image of both for 2 s, [bold] " * 9
    terminal.tell(f"warning: {long}")
    handler.handle(logging.LogRecord("sags_node", logging.WARNING, "a.py", 1, "no new %s", (long,), None))
    told, logged = capsys.readouterr().err.splitlines()
    for line, said in ((told, f"warning: {long}"), (logged, f"warning: no new {long}")):
        when, rest = line[:25], line[26:]
        assert rest == said and datetime.fromisoformat(when).tzinfo is not None
