"""Python code in a new process that has loaded Numba already, which is most of a short one's time."""

import multiprocessing
import os
import sys
import traceback
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numba

SECONDS = 120  # that it may take
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["numba"])


class Said(NamedTuple):
    stdout: str
    stderr: str


class Forked:
    """Code that runs, in a folder that comes first among those of modules."""

    def __init__(self, folder: Path, code: str, **environment: str) -> None:
        self._answer, other = CONTEXT.Pipe(duplex=False)
        self._process = CONTEXT.Process(target=_run, args=(str(folder), code, environment, other))
        self._process.start()
        other.close()

    def said(self) -> Said:
        """What it said, once it has ended; an exception is on stderr."""
        try:
            assert self._answer.poll(SECONDS), "it does not end"
            said: Said = self._answer.recv()
            self._process.join(SECONDS)
            return said
        finally:
            self._process.kill()
            self._process.join()


def _run(folder: str, code: str, environment: dict[str, str], answer: Connection) -> None:
    os.environ.update(environment)
    os.chdir(folder)
    sys.path.insert(0, folder)
    sys.dont_write_bytecode = True
    numba.core.config.reload_config()
    stdout, stderr = StringIO(), StringIO()
    with redirect_stdout(stdout), redirect_stderr(stderr):
        try:
            exec(code, {"__name__": "__main__"})
        except BaseException:
            traceback.print_exc()
    answer.send(Said(stdout.getvalue(), stderr.getvalue()))
