"""A recorder in a process of its own, started by the node: whatever the disk does, the node does not feel it.

The child is `sags bag record --stdin`: it ends when its standard input does, so also when the node is killed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import msgspec

from sags_node.errors import SagsError


class _Request(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of `start_recording`."""

    path: str
    topics: list[str] = []
    compression: Literal["none", "jpeg", "png"] = "none"
    max_cache_mb: float | None = None
    snapshot_seconds: float | None = None
    max_bag_size: int | None = None
    max_bag_duration: float | None = None


class RecorderProcess:
    """One recording at a time. Each method gives a future at once, for the control socket.

    Args:
        ns: of the node.
        endpoint: where the child subscribes; ipc, so that it needs no keys. None: recording is refused.
    """

    def __init__(self, ns: str, endpoint: str | None) -> None:
        self._ns = ns
        self._endpoint = endpoint
        self._process: subprocess.Popen[str] | None = None
        self._waiting = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recorder")

    def start(self, args: Mapping[str, Any]) -> Future[Any]:
        """Record to the new folder `path`; the answer is `{"recording": folder}`."""
        return self._waiting.submit(self._start, args)

    def snapshot(self) -> Future[Any]:
        """Write the last seconds of a recording with `snapshot_seconds`; the answer names the folder."""
        return self._waiting.submit(self._snapshot)

    def stop(self) -> Future[Any]:
        """Finish the recording; the answer is its summary."""
        return self._waiting.submit(self._stop)

    def close(self) -> None:
        """Finish a recording that is still running."""
        if self._process is not None:
            self.stop()
        self._waiting.shutdown(wait=True)

    def _start(self, args: Mapping[str, Any]) -> Any:
        if self._process is not None and self._process.poll() is None:
            raise SagsError("a recording is running already; stop_recording ends it")
        if self._endpoint is None:
            raise SagsError("recording needs the node's ipc socket; start the node with publish.ipc:=true")
        try:
            request = msgspec.convert(dict(args), _Request)
        except msgspec.ValidationError as error:
            raise SagsError(f"{error}; start_recording takes path and what sags bag record takes") from None
        command = [sys.executable, "-m", "sags_node", "bag", "record", "--stdin", "--json"]
        command += ["--endpoint", self._endpoint, "--ns", self._ns, "--compression", request.compression]
        command += ["-o", str(Path(request.path).absolute())]
        for name in request.topics:
            command += ["--topics", name]
        for option, value in (
            ("--max-cache", request.max_cache_mb),
            ("--snapshot-mode", request.snapshot_seconds),
            ("--max-bag-size", request.max_bag_size),
            ("--max-bag-duration", request.max_bag_duration),
        ):
            if value is not None:
                command += [option, str(value)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        return self._next_line(self._process)

    def _snapshot(self) -> Any:
        process = self._running()
        assert process.stdin is not None
        try:
            process.stdin.write("snapshot\n")
            process.stdin.flush()
        except OSError:
            pass  # it has ended; what it said is read below
        return self._next_line(process)

    def _stop(self) -> Any:
        process = self._running()
        self._process = None
        said, errors = process.communicate()
        if process.returncode != 0:
            raise SagsError(_last_words(errors))
        return json.loads(said.splitlines()[-1])

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None:
            raise SagsError("nothing is being recorded; start_recording {path} begins")
        return self._process

    def _next_line(self, process: subprocess.Popen[str]) -> Any:
        assert process.stdout is not None
        line = process.stdout.readline()
        if line:
            return json.loads(line)
        _, errors = process.communicate()
        self._process = None
        raise SagsError(_last_words(errors))


def _last_words(errors: str) -> str:
    """The message of a command that failed."""
    said = " ".join(errors.split())
    return said.partition("error: ")[2] or said or "the recorder ended without a word"
