"""A node in a process of its own, as users start it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Self

from command_line import RUN_HERE
from waiting import START_SECONDS


class RunningNode:
    """`sags run` in its own process."""

    def __init__(self, session: Path, folder: Path, *overrides: str) -> None:
        self.run_dir = folder / "run"
        self.process = subprocess.Popen(
            [
                sys.executable, "-m", "sags_node", "run", str(session), "source.loop:=true",
                *RUN_HERE, f"publish.run_dir:={self.run_dir}", *overrides,
            ],
            stderr=subprocess.PIPE,
            text=True,
        )  # fmt: skip
        file = self.run_dir / "sags.json"
        deadline = time.monotonic() + START_SECONDS
        while not file.exists():
            assert self.process.poll() is None, self.said()
            assert time.monotonic() < deadline, "the node did not start"
            time.sleep(0.05)
        self.connection = json.loads(file.read_text())
        self.data = next(e for e in self.connection["data"] if e.startswith("tcp"))

    def said(self) -> str:
        """Everything on stderr, once it has ended."""
        return self.process.stderr.read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> int:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(30)
        finally:
            self.process.kill()  # a node that does not end must not disturb the tests that follow
