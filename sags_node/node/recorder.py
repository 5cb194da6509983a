"""A recorder in a process of its own, started by the node, so that a slow disk does not slow the node.

The child is `sags bag record --stdin`: it ends when its standard input does, so also when the node is killed.
A disk may hang, so nothing here waits for the child without a limit.
"""

from __future__ import annotations

import json
import logging
import shlex
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Literal

import msgspec

from sags_node.errors import SagsError
from sags_node.files import check_name
from sags_node.processes import KILL_SECONDS, end
from sags_node.types import Finding

START_SECONDS = 60.0  # longest wait for the child to load and to open its file
SNAPSHOT_SECONDS = 60.0  # longest wait for it to write what the ring buffer holds
FINISH_SECONDS = 60.0  # longest wait for it to write what is queued, and the index
PATIENCE = 1.0  # s after which a node that ends says what it waits for
SILENT_SECONDS = 3.0  # without a message, after which it warns; a node sends `status` each second
LOW_SECONDS = 300.0  # of recording; with less room on the disk, it warns
WHOLE = 0.9  # share of the snapshot seconds asked for; fewer kept are warned of

log = logging.getLogger(__name__)


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
        endpoint: to which the child subscribes; ipc, so that it needs no keys. None: recording is refused.
    """

    def __init__(self, ns: str, endpoint: str | None) -> None:
        self._ns = ns
        self._endpoint = endpoint
        self._child: _Child | None = None
        self._begun: _Child | None = None  # the one whose recording `status` describes
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recorder")

    def start(self, args: Mapping[str, Any]) -> Future[Any]:
        """Record to the new folder `path`; the answer is `{"recording": folder}`."""
        return self._worker.submit(self._start, args)

    def snapshot(self) -> Future[Any]:
        """Write the last seconds of a recording with `snapshot_seconds`; the answer names the folder."""
        return self._worker.submit(self._snapshot)

    def stop(self) -> Future[Any]:
        """Finish the recording; the answer is its summary."""
        return self._worker.submit(self._stop)

    def status(self) -> dict[str, Any] | None:
        """The last state that the recorder reported, and under `ended` why it ended by itself. None: nothing
        is being recorded. Any thread may call this."""
        child = self._begun
        if child is None:
            return None
        return {"folder": str(child.folder), **child.progress, "ended": child.ended}

    def findings(self) -> Iterator[Finding]:
        """Yield the warnings about the recording. Any thread may call this."""
        said = self.status()
        if said is not None and said["ended"] is not None:
            text = f"the recording to {said['folder']} has ended: {said['ended']}; begin another one"
            yield Finding("recording_ended", text)
        elif said is not None and "seconds" in said:
            yield from findings(said)

    def close(self) -> None:
        """Finish a recording that is still running. A Ctrl-C meanwhile kills the recorder at once."""
        child = self._child
        try:
            if child is not None:
                self._wait_for(self._worker.submit(self._stop_if_running), child)
        except BaseException:
            if child is not None:
                child.kill()
            raise
        finally:
            self._worker.shutdown(wait=False)  # each of its requests has a time limit

    def _wait_for(self, stopped: Future[Any], child: _Child) -> None:
        try:
            try:
                stopped.result(PATIENCE)
            except TimeoutError:
                log.warning("waiting for the recorder of %s; Ctrl-C breaks off", child.folder)
                stopped.result(SNAPSHOT_SECONDS + FINISH_SECONDS + KILL_SECONDS)  # with earlier requests
        except (SagsError, TimeoutError) as error:
            log.warning("%s", error)

    def _start(self, args: Mapping[str, Any]) -> Any:
        if self._child is not None and self._child.is_running:
            raise SagsError("a recording is running already; stop_recording ends it")
        if self._endpoint is None:
            raise SagsError("recording needs the node's ipc socket; start the node with publish.ipc:=true")
        try:
            request = msgspec.convert(dict(args), _Request)
        except msgspec.ValidationError as error:
            raise SagsError(f"{error}; start_recording takes path and what sags bag record takes") from None
        check_name(folder := Path(request.path).absolute())
        command = [sys.executable, "-m", "sags_node", "bag", "record", "--stdin", "--json"]
        command += ["--endpoint", self._endpoint, "--ns", self._ns, "--compression", request.compression]
        command += ["-o", str(folder)]
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
        self._child = _Child(command, folder, has_ring=request.snapshot_seconds is not None)
        try:
            answer = self._child.answer(START_SECONDS)
            self._begun = self._child
            return answer
        except SagsError:  # the child has said why, and ends
            self._child.kill()
            raise
        except TimeoutError:
            self._child.kill()
            raise SagsError(
                f"the recorder did not begin in {START_SECONDS:g} s; does the disk of {folder} answer?"
            ) from None
        finally:
            self._child = self._begun  # after a failure the last one, until another begins

    def _snapshot(self) -> Any:
        child = self._running()
        if not child.has_ring:
            raise SagsError(
                "this recording writes all that comes and keeps nothing for a snapshot; begin one with "
                "start_recording with snapshot_seconds"
            )
        child.ask("snapshot")
        try:
            return child.answer(SNAPSHOT_SECONDS)
        except TimeoutError:
            raise SagsError(
                f"no snapshot came from the recorder in {SNAPSHOT_SECONDS:g} s; does the disk of "
                f"{child.folder} answer?"
            ) from None

    def _stop(self) -> Any:
        child = self._running()
        self._child = self._begun = None
        try:
            return child.finish(FINISH_SECONDS)
        except TimeoutError:
            child.kill()
            raise SagsError(
                f"the recorder did not finish in {FINISH_SECONDS:g} s and was ended; save what it wrote "
                f"with: sags bag recover {shlex.quote(str(child.folder))} -o OUT"
            ) from None

    def _stop_if_running(self) -> None:
        if self._child is not None:  # a request that came before may have stopped it
            self._stop()

    def _running(self) -> _Child:
        if self._child is None:
            raise SagsError("nothing is being recorded; start_recording {path} begins")
        return self._child


class _Child:
    """The recorder's process, and what it answers, line by line.

    Args:
        folder: of the recording.
        has_ring: it was started to take snapshots.

    Raises:
        SagsError: it cannot be started.
    """

    def __init__(self, command: list[str], folder: Path, has_ring: bool) -> None:
        if any("\0" in part for part in command):
            raise SagsError("path and topics cannot hold a zero character")
        self.folder = folder
        self.has_ring = has_ring
        self.progress: dict[str, Any] = {}  # updated once a second
        self.ended: str | None = None  # why it ended unasked; None: it runs
        self._owes = False  # whether it still owes an answer
        self._errors = tempfile.TemporaryFile("w+", errors="replace")  # a full pipe would stop the child
        self._lines: SimpleQueue[dict[str, Any] | None] = SimpleQueue()  # None: there will be no more
        pipe = subprocess.PIPE
        try:
            self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=self._errors, text=True)
        except OSError as error:
            raise SagsError(f"the recorder cannot be started: {error.strerror}") from None
        threading.Thread(target=self._listen, name="recorder-lines", daemon=True).start()

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    def ask(self, line: str) -> None:
        """Send a line. A late answer to the line before is discarded.

        Raises:
            SagsError: that answer has not come yet; it would be taken for the answer to this line.
        """
        while not self._lines.empty() and self._next_line(0.0) is not None:
            self._owes = False
        if self._owes and self.is_running:
            raise SagsError(
                f"the recorder of {self.folder} still writes the snapshot before; ask again later"
            )
        self._owes = True
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{line}\n")
            self._process.stdin.flush()
        except OSError:
            pass  # it has ended; `answer` says why

    def answer(self, seconds: float) -> Any:
        """Return the next line of its output.

        Raises:
            SagsError: it has ended instead.
            TimeoutError: no line came.
        """
        line = self._next_line(seconds)
        self._owes = False
        return self._said(line)

    def finish(self, seconds: float) -> Any:
        """Let it end, and return its last line.

        Raises:
            SagsError: it has failed.
            TimeoutError: it does not end.
        """
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except OSError:
            pass  # it has ended already
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            raise TimeoutError from None
        said = None
        while (line := self._next_line(KILL_SECONDS)) is not None:
            said = line
        summary = self._said(said)
        if self._process.returncode != 0:
            raise SagsError(self.ended)
        return summary

    def kill(self) -> None:
        """End it at once. What it wrote can be recovered."""
        if not end(self._process, grace=0.0):
            log.warning("the recorder of %s cannot be ended; does its disk answer?", self.folder)

    def _listen(self) -> None:
        assert self._process.stdout is not None
        error = None
        try:
            for line in self._process.stdout:
                said = json.loads(line)
                if "progress" in said:
                    self.progress = said["progress"]
                else:
                    error = said.get("error")
                    self._lines.put(said)
        except ValueError:  # no JSON
            log.exception("the recorder of %s says what nobody understands", self.folder)
        finally:
            self.ended = error or self._last_words()
            self._lines.put(None)

    def _next_line(self, seconds: float) -> dict[str, Any] | None:
        """The next line; None, at every call, when there will be no more."""
        try:
            line = self._lines.get(timeout=seconds)
        except Empty:
            raise TimeoutError from None
        if line is None:
            self._lines.put(None)
        return line

    def _said(self, said: dict[str, Any] | None) -> Any:
        """Return the line; raise `SagsError` if it holds an error, or if there is none."""
        if said is None:
            raise SagsError(self.ended)
        if "error" in said:
            raise SagsError(said["error"])
        return said

    def _last_words(self) -> str:
        """Why the recorder ended without an `error` line on stdout, from its stderr."""
        try:
            self._process.wait(KILL_SECONDS)
        except subprocess.TimeoutExpired:
            return "the recorder closed its output and did not end"
        self._errors.seek(0)
        said = " ".join(self._errors.read().split())
        if said:
            return f"the recorder failed: {said}"
        folder = shlex.quote(str(self.folder))
        return f"the recorder was ended; save what it wrote with: sags bag recover {folder} -o OUT"


def findings(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield the warnings that follow from a `Recorder.summary`."""
    folder, silent, free = summary["folder"], summary["silent_s"], summary["free_bytes"]
    if silent > SILENT_SECONDS:
        yield Finding(
            "recording_silent",
            f"nothing has come to {folder} for {silent:.0f} s: does the node run, and do frames come?",
        )
    missing, asked, kept = summary["lost"], summary["snapshot_seconds"], summary["kept_s"]
    if asked is None:
        missing += summary["dropped"]
    elif summary["dropped"] and kept < WHOLE * asked:
        yield Finding(
            "recording_loses",
            f"the last {asked:g} s do not fit into memory, {kept:.2f} s are kept for a snapshot: raise "
            "--max-cache (max_cache_mb), or record fewer topics",
        )
    if missing:
        yield Finding(
            "recording_loses",
            f"{missing} messages are missing in {folder}: the disk, the machine or the network is too slow, "
            "or was away; record fewer topics, or with compression jpeg",
        )
    if summary["rejected"]:
        yield Finding(
            "recording_rejects",
            f"{summary['rejected']} messages are not in {folder}: {summary['rejected_why']}",
        )
    if free is not None and free < LOW_SECONDS * 1e6 * summary["mb_per_s"]:
        yield Finding(
            "recording_disk_low",
            f"the disk of {folder} is full in {free / 1e6 / summary['mb_per_s']:.0f} s at "
            f"{summary['mb_per_s']} MB/s: make room, record fewer topics, or with compression jpeg",
        )
