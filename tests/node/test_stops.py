"""A node's start may be broken off at any moment, from Python's first imports until frames are published.

`make stops` tries two hundred moments, half of them beside a process that burns a core. Of a node that aborts
or does not end it prints where its threads were. For C code: `ulimit -c unlimited` before it, and then
`gdb .venv/bin/python core`.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from typing import NamedTuple

import pytest
from command_line import RUN_HERE, start, wait_for

from benchmarks.kernels.contention import burning_core
from sags_node.config.schema import PhantomSource
from sags_node.phantom import write_session

pytestmark = pytest.mark.live


class Stop(NamedTuple):
    ending: signal.Signals
    seconds: float  # after its start
    found: bool = False  # or after its connection file is there


def break_off(stop: Stop, session: Path, run_dir: Path) -> None:
    """Start a node and stop it.

    Raises:
        AssertionError: it did not end as it should, or left something behind.
    """
    connection = run_dir / "sags.json"
    connection.unlink(missing_ok=True)  # of one that was killed
    command = ["run", session, "source.loop:=true", *RUN_HERE, f"publish.run_dir:={run_dir}"]
    process = start(command, PYTHONFAULTHANDLER="1")
    try:
        if stop.found:
            wait_for(process, connection.exists)
        time.sleep(stop.seconds)
        process.send_signal(stop.ending)
        _, stderr = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)  # then it says where each of its threads is
        raise AssertionError(f"{stop}: it does not end: {process.communicate()[1]}") from None
    finally:
        process.kill()
    killed = stop.ending == signal.SIGKILL
    codes = {-stop.ending} if killed else {0} if stop.found else {0, 130, -stop.ending}
    assert process.returncode in codes, f"{stop}: exit code {process.returncode}: {stderr}"
    assert "Traceback" not in stderr, f"{stop}: {stderr}"
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)  # of its group
    assert killed or not connection.exists(), f"{stop}: it can still be found"


@pytest.mark.fault("process: SIGTERM or SIGKILL at any moment of the start")
@pytest.mark.fault("process: Ctrl-C, SIGTERM or SIGHUP to the node")
def test_a_start_may_be_broken_off_at_any_moment(phantom_session: Path, tmp_path: Path) -> None:
    term, kill = signal.SIGTERM, signal.SIGKILL
    for stop in (
        Stop(term, 0.2), Stop(term, 1.2), Stop(term, 3.0), Stop(kill, 3.0),
        Stop(signal.SIGINT, 0.01, found=True), Stop(signal.SIGHUP, 1.0, found=True),
    ):  # fmt: skip
        break_off(stop, phantom_session, tmp_path / "run")


def random_stop(chance: random.Random) -> Stop:
    if chance.random() < 0.5:  # when its sockets are bound and its threads start
        return Stop(chance.choice((signal.SIGINT, signal.SIGTERM)), chance.uniform(0, 0.05), found=True)
    return Stop(chance.choice((signal.SIGTERM, signal.SIGKILL)), chance.uniform(0, 4))


def main(count: int, seed: int = 0) -> int:
    """Try so many moments; how many went wrong."""
    chance, failed = random.Random(seed), 0
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session"
        write_session(PhantomSource(seconds=4.0, width=320, height=256, seed=1), session, rate=10.0)
        for beside in (nullcontext, burning_core):
            with beside():
                for _ in range(count // 2):
                    try:
                        break_off(random_stop(chance), session, Path(folder) / "run")
                    except AssertionError as error:
                        failed += 1
                        print(error, flush=True)
    print(f"{count} starts, {failed} failed")
    return failed


if __name__ == "__main__":
    sys.exit(min(1, main(*map(int, sys.argv[1:]))))
