"""Ctrl-C ends every command that takes long: at once, with exit code 130, and leaves nothing behind."""

import ctypes
import importlib
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from command_line import RUN_HERE, sags, start, stopped, wait_for
from llvmlite import binding as llvm
from waiting import START_SECONDS, until

from sags_node.cli.main import main
from sags_node.messaging.publisher import Publisher
from sags_node.node.node import Node
from sags_node.node.service_manager import ServiceManager
from sags_node.terminal import console as terminal
from sags_node.terminal.console import interrupt, on_stop_signals

pytestmark = [pytest.mark.live, pytest.mark.usefixtures("run_dir")]


@pytest.mark.fault("process: Ctrl-C during a measurement")
@pytest.mark.parametrize(
    ("command", "begun"),
    [
        ("eval --pace step SESSION source.rate:=2", "sags-eval-*/*.*"),
        ("demo --json --out OUT/demo SESSION source.rate:=2", "sags-eval-*/*.*"),
        ("phantom OUT/session seconds:=60 width:=320 height:=256", ".sags-*/*/left/*.jpg"),
    ],
)
def test_ctrl_c_ends_what_takes_long_and_leaves_nothing(
    command: str, begun: str, phantom_session: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    temporary = tmp_path_factory.mktemp("t")  # short: a socket's path has at most 107 letters
    words = command.replace("SESSION", str(phantom_session)).replace("OUT", str(tmp_path)).split()
    process = start(words, TMPDIR=temporary)
    wait_for(process, lambda: any(temporary.glob(begun)) or any(tmp_path.glob(begun)))
    stdout, stderr = stopped(process)
    assert process.returncode == 130 and "stopped" in stderr
    assert stdout == "" and not any(temporary.iterdir())
    assert all(path.name == "demo" for path in tmp_path.iterdir()), "but the folder that was asked for"


def test_a_ctrl_c_that_comes_while_a_kernel_is_loaded_is_one_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python turns it into a SystemError when it passes through C code; any other of those is a defect."""

    def interrupted(*arguments: object) -> None:
        said = "returned a result with an exception set"
        try:
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt as cause:
                raise SystemError(said) from cause
        except SystemError as inner:
            raise SystemError(said) from inner

    def broken(*arguments: object) -> None:
        raise SystemError("broken")

    monkeypatch.setattr("sags_node.tools.doctor.examine", interrupted)
    assert CliRunner().invoke(main, ["doctor"]).exit_code == 130
    monkeypatch.setattr("sags_node.tools.doctor.examine", broken)
    assert isinstance(CliRunner().invoke(main, ["doctor"]).exception, SystemError)


SLOW = """
import sys, time
print("loading", flush=True)
try:
    time.sleep(0.5)
except BaseException:
    raise ImportError("initialization failed")  # as C code has it

def __getattr__(name):
    if name.startswith("__"):
        raise AttributeError(name)
    time.sleep(10)
"""


@pytest.mark.fault("process: Ctrl-C while it starts")
def test_a_ctrl_c_while_modules_are_loaded_is_one_word(run_dir: Path, tmp_path: Path) -> None:
    """In the first moments of the command itself."""
    slow = tmp_path / "modules/click/__init__.py"
    slow.parent.mkdir(parents=True)
    slow.write_text(SLOW)
    process = start(["doctor"], PYTHONPATH=f"{tmp_path / 'modules'}:{os.environ.get('PYTHONPATH', '')}")
    assert process.stdout is not None and process.stdout.readline() == "loading\n"
    stdout, stderr = stopped(process)
    assert process.returncode == 130 and (stdout, stderr) == ("", "stopped\n")


@ctypes.CFUNCTYPE(None)
def _called() -> None:
    signal.raise_signal(signal.SIGINT)


class _Finalised:
    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


def _compile() -> None:
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly("define void @kernel() { ret void }"), machine)
    engine.set_object_cache(lambda module, code: signal.raise_signal(signal.SIGINT))
    engine.finalize_object()


@pytest.fixture
def interrupting() -> Iterator[None]:
    """Ctrl-C does what it does in a command."""
    before = signal.signal(signal.SIGINT, interrupt)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interrupting")
@pytest.mark.parametrize("lose", [_called, _Finalised, _compile], ids=["c code", "finaliser", "compiler"])
def test_a_ctrl_c_that_is_lost_comes_through_after_it(
    lose: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What calls of ZeroMQ raise is told as ignored; LLVM calls back with what it has compiled, and there an
    exception is printed and forgotten."""
    monkeypatch.setattr(sys, "unraisablehook", interrupt.unraisable)
    with pytest.raises(KeyboardInterrupt):
        lose()
        time.sleep(10)


@pytest.mark.usefixtures("interrupting")
def test_a_ctrl_c_that_comes_while_it_is_sent_again_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine the thread that sends it may do so before it is known to have begun."""
    waits = [0.1]

    class Delayed(threading.Timer):
        def start(self) -> None:
            super().start()
            time.sleep(waits.pop() if waits else 0)

    monkeypatch.setattr(sys, "unraisablehook", interrupt.unraisable)
    monkeypatch.setattr(threading, "Timer", Delayed)
    with pytest.raises(KeyboardInterrupt):
        _called()
        time.sleep(10)
    assert not waits


@pytest.mark.usefixtures("interrupting")
def test_an_import_that_hangs_is_broken_off_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "hanging.py").write_text(
        "import signal, time\nsignal.raise_signal(signal.SIGINT)\ntime.sleep(10)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(terminal, "LONGEST_WAIT", 0.1)
    with pytest.raises(KeyboardInterrupt):
        importlib.import_module("hanging")


@pytest.mark.fault("process: Ctrl-C or SIGTERM between two steps of a node's start or end")
@pytest.mark.parametrize(
    ("of", "step"),
    [(Publisher, "__init__"), (Node, "__init__"), (ServiceManager, "ready"), (Node, "start"),
     (ServiceManager, "stopping")],
)  # fmt: skip
def test_a_node_that_has_begun_ends_in_order(
    of: type, step: str, phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It starts step by step: an exception between two of them would leave sockets and threads behind."""
    original, signals = getattr(of, step), iter([signal.SIGTERM])

    def interrupted(*arguments: object, **named: object) -> None:
        original(*arguments, **named)
        for number in signals:
            signal.raise_signal(number)

    monkeypatch.setattr(of, step, interrupted)
    before = set(threading.enumerate())
    private = f"publish.run_dir:={tmp_path}"
    result = sags("run", phantom_session, "source.frames:=2", "source.pace:=fast", *RUN_HERE, private)
    assert result.exit_code == 0, result.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["sags.lock"]
    until(lambda: not set(threading.enumerate()) - before)


BROKEN_OFF = """
import sys, threading, time
import cv2, numpy as np
import sags_node.cli.main
from sags_node.__main__ import main

class Kept:
    def __del__(self):  # while Python finalises
        time.sleep(1.0)

def work(picture=np.zeros((1000, 1000), np.uint8)):
    while True:
        cv2.blur(picture, (9, 9))
        began.set()

def command():
    threading.Thread(target=work, daemon=True).start()
    began.wait()
    print("said", end="")
    sys.exit(7)

began, sys.modules["kept"] = threading.Event(), Kept()
sags_node.cli.main.main = command
main()
"""


@pytest.mark.fault("process: it ends while a thread is busy in OpenCV, as after a second Ctrl-C")
def test_a_thread_that_is_given_up_does_not_abort_the_process() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", BROKEN_OFF], capture_output=True, text=True, timeout=START_SECONDS, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (7, "said", "")


CAUGHT = """
import sys
import sags_node.cli.main
from sags_node.__main__ import main

def command():
    try:
        exec("raise KeyboardInterrupt")  # as where `dataclasses` writes a class
    except KeyboardInterrupt:
        sys.exit(130)

sags_node.cli.main.main = command
main()
"""


def test_a_ctrl_c_that_was_caught_is_no_death_by_a_signal(tmp_path: Path) -> None:
    (tmp_path / "caught.py").write_text(CAUGHT)
    command = [sys.executable, "-m", "caught"]
    where = os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    assert subprocess.run(command, timeout=START_SECONDS, check=False, env=where).returncode == 130


@pytest.fixture
def stop() -> Iterator[threading.Event]:
    """Set by Ctrl-C, as in commands that run until then."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    event = threading.Event()
    on_stop_signals(event.set)
    yield event
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_ctrl_c_that_meets_a_finaliser_is_not_lost(stop: threading.Event) -> None:
    """An exception there is printed and forgotten; a socket that is closed is such a place."""
    _Finalised()
    assert stop.wait(60)


@pytest.mark.fault("process: Ctrl-C and SIGTERM at the same moment")
def test_a_signal_that_meets_the_lock_of_the_event_it_sets_is_not_waiting_for_ever(
    stop: threading.Event,
) -> None:
    """SIGTERM of a script beside the terminal's Ctrl-C: the second meets the event amid `set`."""
    lock = threading.Lock()
    on_stop_signals(lambda: stop.set() if lock.acquire(timeout=5) else None)
    with lock:
        signal.raise_signal(signal.SIGTERM)
    assert stop.wait(60)


def test_a_script_stops_with_sigint_what_it_started_in_the_background(
    phantom_session: Path, run_dir: Path
) -> None:
    """A shell lets what it starts with `&` ignore it; so would Python."""
    node = [sys.executable, "-m", "sags_node", "run", str(phantom_session), "source.loop:=true", *RUN_HERE]
    runs = f"until [ -e {run_dir}/sags.json ]; do sleep 0.1; done"
    script = f"{shlex.join(node)} --seconds 60 & {runs}; kill -INT $!; wait $!"
    done = subprocess.run(
        ["sh", "-c", script], check=True, capture_output=True, text=True, timeout=START_SECONDS + 60
    )
    assert "\nstopping\n" in done.stderr


def test_a_second_ctrl_c_breaks_off(stop: threading.Event, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that a wrapper hands on right after the first is the same one."""
    now = [100.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    signal.raise_signal(signal.SIGINT)
    now[0] += terminal.SAME_SIGNAL
    signal.raise_signal(signal.SIGINT)
    now[0] += 0.01
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
