"""A program that uses a node needs nothing of what maps: `pip install .` does not bring it along."""

import json
import subprocess
import sys
import tomllib
from collections.abc import Set
from pathlib import Path

from places import ROOT

from sags_node.cli.main import OF_THE_NODE
from sags_node.errors import install

HEAVY = {"numba", "llvmlite", "torch", "cv2", "open3d", "onnxruntime", "scipy", "pydantic", "matplotlib"}
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
COMMANDS = """
import json
from click.testing import CliRunner
from sags_node.cli.main import main
for command in sys.argv[1:]:
    ended = CliRunner().invoke(main, command.split())
    print(json.dumps([command, ended.exit_code, ended.stderr]))
"""
OF_CLIENTS = ("topic list", "anchor list", "measure 1 2", "param get", "health", "pause", "reset")
NEED_IT = ("run", "demo", "overlay", "doctor", "bag info x", "import --check .")


def ran(code: str, *arguments: str, folder: Path, blocked: Set[str] = OF_THE_NODE) -> str:
    """What a new process says that cannot load some packages."""
    command = [sys.executable, "-c", BLOCKED.format(blocked=blocked) + code, *arguments]
    done = subprocess.run(command, check=False, cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def requirements(extra: str = "") -> set[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    said = project["optional-dependencies"][extra] if extra else project["dependencies"]
    return {each.partition(">")[0] for each in said}


def test_commands_work_without_it_or_say_how_to_install_it(tmp_path: Path) -> None:
    asked = [f"{command} --ns other" for command in OF_CLIENTS]
    said = ran(COMMANDS, *asked, "--help", "export --help", *NEED_IT, folder=tmp_path)
    for command, code, error in map(json.loads, said.splitlines()):
        if command in NEED_IT:
            (line,) = error.splitlines()
            assert code == 2 and "is not installed" in line and "pip install '.[node]'" in line, command
        else:
            assert code == (0 if "help" in command else 1), (command, error)
            assert "help" in command or "no node runs as 'other'" in error, command


def loaded(code: str, folder: Path, blocked: Set[str] = frozenset()) -> set[str]:
    """Packages that a fresh interpreter has loaded after this."""
    printing = f"{code}\nprint(*{{name.partition('.')[0] for name in sys.modules}})"
    return set(ran(printing, folder=folder, blocked=blocked).splitlines()[-1].split())


def test_a_client_works_without_it_and_loads_nothing_that_maps(tmp_path: Path) -> None:
    found = loaded(CLIENT, tmp_path, OF_THE_NODE)
    assert {"zmq", "numpy", "msgspec"} <= found
    assert not found & HEAVY


def test_help_loads_no_numerics(tmp_path: Path) -> None:
    asked = (["--help"], ["topic", "--help"], ["bag", "--help"])
    helped = [f"main({arguments}, standalone_mode=False)" for arguments in asked]
    found = loaded("\n".join(["from sags_node.cli.main import main", *helped]), tmp_path)
    assert "click" in found
    assert not found & (HEAVY | {"numpy"})


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
