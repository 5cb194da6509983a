"""A node in a process of its own, as users start it."""

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Self

from command_line import RUN_HERE, wait_for


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
        try:
            wait_for(self.process, (self.run_dir / "sags.json").exists)
        except BaseException:
            self.process.kill()
            raise
        self.connection = json.loads((self.run_dir / "sags.json").read_text())
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
