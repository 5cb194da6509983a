"""A program that speaks OpenIGTLink by Debian's own library."""

import shutil
import subprocess
import threading
from pathlib import Path

import pytest
from places import ROOT

from sags_node.messaging.sockets import Closes

PEER = ROOT / "tests/bridge/igtl_peer.cxx"


def built(source: Path, folder: Path) -> Path:
    """A C++ program with Debian's library."""
    if shutil.which("g++") is None or not Path("/usr/include/openigtlink/igtlImageMessage.h").exists():
        pytest.skip("no peer without the Debian packages g++ and libopenigtlink-dev")
    program = folder / source.stem
    made = subprocess.run(
        ["g++", "-o", program, source, "-I/usr/include/openigtlink", "-lOpenIGTLink"],
        check=False, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    return program


class Peer(Closes):
    """The program; what it prints is taken in as it comes: the fields of each line."""

    def __init__(self, program: Path, port: int, *order: object) -> None:
        self.came: list[list[str]] = []
        self._process = subprocess.Popen(
            [program, "127.0.0.1", str(port), *map(str, order)], stdout=subprocess.PIPE, text=True
        )
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        for line in self._process.stdout:
            self.came.append(line.split())

    def newest(self, device: str) -> list[str] | None:
        """The fields after kind, device and stamp."""
        return next((fields[3:] for fields in reversed(self.came) if fields[1] == device), None)

    def close(self) -> None:
        self._process.kill()
        self._process.wait(10)
        self._thread.join(60)
