"""Processes that send images in the place of cameras."""

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from command_line import killed
from places import HELPERS


@contextmanager
def sending(
    command: Sequence[object], stderr: int | None = None, **variables: str
) -> Iterator[subprocess.Popen[bytes]]:
    """A process that sends; has begun when this returns, since imports take seconds."""
    words, environment = [str(word) for word in command], {**os.environ, **variables}
    started = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=stderr)
    with killed(started) as process:
        assert process.stdout is not None
        while (line := process.stdout.readline()) != b"sending\n":
            assert line, "it has ended"
        yield process


def stereo_sender(way: str, where: object, *settings: str) -> list[object]:
    """The command of `stereo_sender.py`."""
    return [sys.executable, HELPERS / "stereo_sender.py", way, where, *settings]
