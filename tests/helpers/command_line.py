"""The command `sags`: in this process with what it said, or in one of its own."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click
import pytest
from click.testing import CliRunner, Result
from waiting import START_SECONDS, until

from sags_node.cli.main import main

S = TypeVar("S", str, bytes)

# For a node that a test starts: ports that are free, and images of one size, however busy the machine is.
RUN_HERE = ("publish.data:=[tcp://127.0.0.1:*]", "publish.control:=tcp://127.0.0.1:*", "vision.scale:=1")


def sags(*arguments: object, command: click.Command = main) -> Result:
    """A command in this process, with any exception that it did not turn into a message; the process keeps
    its signal handlers."""
    handled = signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1
    before = {number: signal.getsignal(number) for number in handled}
    try:
        result = CliRunner().invoke(command, [str(argument) for argument in arguments])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def ran(*arguments: object, command: click.Command = main) -> tuple[int, str, str]:
    """Its exit code, and what it said on stdout and stderr."""
    result = sags(*arguments, command=command)
    return result.exit_code, result.stdout, result.stderr


def figures_of(*arguments: object, command: click.Command = main) -> Any:
    """What a command that does well says as strict JSON."""
    code, stdout, stderr = ran(*arguments, command=command)
    assert code == 0, stdout + stderr
    return pure_json(stdout)


def figures_at_last(*arguments: object) -> Any:
    """As `figures_of`, as soon as it does well: where the machine stood still a node sees little."""

    def done() -> tuple[int, str, str] | None:
        result = ran(*arguments)
        return result if result[0] == 0 else None

    return pure_json(until(done)[1])


def refused(code: int, *arguments: object, said: tuple[str, ...], command: click.Command = main) -> None:
    """One message on stderr, that says all of this, and nothing on stdout."""
    result = sags(*arguments, command=command)
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


@contextmanager
def killed(process: subprocess.Popen[S]) -> Iterator[subprocess.Popen[S]]:
    """A process that has ended when this is left, whatever comes of the test."""
    with process:
        try:
            yield process
        finally:
            process.kill()


def wait_for(process: subprocess.Popen[str], ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + START_SECONDS
    while not ready():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "it did not start"
        time.sleep(0.02)


def stopped(process: subprocess.Popen[str]) -> tuple[str, str]:
    """What it says after Ctrl-C; it and all its children have ended."""
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
    assert "Traceback" not in stderr, stderr
    return stdout, stderr
