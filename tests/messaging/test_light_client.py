"""A program that uses a node needs nothing of what maps: `pip install .` does not bring it."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from places import ROOT

from sags_node.cli.main import OF_THE_NODE
from sags_node.errors import install

BLOCKED = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {blocked}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Blocked())
"""
CLIENT = """
from sags_node.client import *
image = TopicName("left/render/depth", ReceivedImage)
with Subscriber([image], endpoint="tcp://127.0.0.1:1") as node:
    assert node.wait(image, 0.01) is None
with ControlClient("tcp://127.0.0.1:1") as control:
    pass
"""
COMMAND = "from sags_node.__main__ import main; sys.argv[0] = 'sags'; main()"


def without_the_node(code: str, *arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    blocked = BLOCKED.format(blocked=set(OF_THE_NODE))
    command = [sys.executable, "-c", blocked + code, *arguments]
    return subprocess.run(command, check=False, cwd=folder, capture_output=True, text=True, timeout=120)


def requirements(extra: str = "") -> set[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    said = project["optional-dependencies"][extra] if extra else project["dependencies"]
    return {each.partition(">")[0] for each in said}


def test_the_front_door_opens_without_it(tmp_path: Path) -> None:
    done = without_the_node(CLIENT, folder=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", [
    "topic list", "anchor list", "measure 1 2", "param get", "health", "pause", "reset", "export --help",
    "--help",
])  # fmt: skip
def test_commands_that_ask_a_node_work_without_it(command: str, tmp_path: Path) -> None:
    asked = command.split() if "help" in command else [*command.split(), "--ns", "other"]
    done = without_the_node(COMMAND, *asked, folder=tmp_path)
    assert done.returncode == (0 if "help" in command else 1), done.stderr
    assert "help" in command or "no node runs as 'other'" in done.stderr


@pytest.mark.parametrize("command", ["run", "demo", "overlay", "doctor", "bag info x", "import --check ."])
def test_what_needs_it_says_how_to_install_it(command: str, tmp_path: Path) -> None:
    done = without_the_node(COMMAND, *command.split(), folder=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "is not installed" in line and "pip install '.[node]'" in line


def test_the_package_asks_for_it_in_an_extra_alone() -> None:
    modules = {"opencv-contrib-python-headless": "cv2", "pillow": "PIL"}
    assert {modules.get(name, name) for name in requirements("node")} == OF_THE_NODE
    assert not requirements() & requirements("node")
    assert "sags-node[node]" in requirements("dev")


def test_what_is_advised_works_in_a_clone() -> None:
    """The package's name is on no index yet: whoever takes it there would be installed."""
    places = (*ROOT.glob("sags_*/**/*.py"), *ROOT.glob("docs/**/*.md"), ROOT / "README.md")
    assert not [file for file in places if "pip install 'sags-node" in file.read_text("utf-8")]
    assert install("viewer").startswith("pip install '.[viewer]'")
