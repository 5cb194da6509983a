"""Imports point down only, and in no circle, so that every part can be read, replaced and tested alone.

Modules are looked at, and every import in them: at the top, in a function, and for types only.
"""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent / "sags_node"
# Folders, and files that stand beside them. Each may import what stands in lines above its own.
LAYERS = [
    {"types", "errors", "config", "files", "latest", "native_output", "processes", "kernels"},
    {
        "confidence",
        "findings",
        "geometry",
        "picture_file",
        "plotting",
        "terminal",
        "video_file",
        "yaml_reader",
    },
    {"calibration", "engine", "health", "launch_file", "messaging"},
    {"client", "doctor", "model", "overlay", "phantom", "recording", "topic", "views"},
    {"disturbances", "sources", "vision"},
    {"calibrate", "mapping", "repeats", "session"},
    {"pipeline"},
    {"node_operations", "warm_up"},
    {"node"},
    {"evaluation", "foreground"},
    {"demo", "fitting", "viewer"},
    {"benchmark", "export"},
    {"cli"},
    {"__main__"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
FOLDERS = sorted(init.parent.name for init in ROOT.glob("*/__init__.py"))


def name_of(file: Path) -> str:
    return ".".join(("sags_node", *file.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")


FILES = {name_of(file): file for file in ROOT.rglob("*.py")}


def imported(code: str) -> set[str]:
    """The modules of the package that some code imports. A folder stands for the names in its `__init__`."""
    found = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= modules & FILES.keys() or {node.module}
    return found & FILES.keys() - {"sags_node"}


IMPORTS = {name: imported(file.read_text()) for name, file in FILES.items()}


def part(module: str) -> str:
    """The folder, or the file beside the folders."""
    return module.split(".")[1]


@pytest.mark.parametrize(
    "code",
    [
        "import sags_node.engine.device",
        "from sags_node.engine import device",
        "from sags_node.engine.device import Device",
        "def later():\n    from sags_node.engine.device import Device",
        "if TYPE_CHECKING:\n    from sags_node.engine.device import Device",
    ],
)
def test_no_way_to_import_goes_unseen(code: str) -> None:
    assert imported(code) == {"sags_node.engine.device"}


def test_every_part_has_its_layer() -> None:
    assert {part(name) for name in FILES if name != "sags_node"} == LEVEL.keys()


def test_imports_point_down() -> None:
    assert [
        f"{name} imports {other}"
        for name, others in IMPORTS.items()
        for other in others
        if name != "sags_node" and part(name) != part(other) and LEVEL[part(name)] <= LEVEL[part(other)]
    ] == []


def test_modules_import_each_other_in_no_circle() -> None:
    try:
        TopologicalSorter(IMPORTS).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_says_which_it_imports(folder: str) -> None:
    said = (ast.get_docstring(ast.parse((ROOT / folder / "__init__.py").read_text())) or "").split("\n\n")[-1]
    assert said.startswith("Imports ")
    inside = [others for name, others in IMPORTS.items() if name.startswith(f"sags_node.{folder}.")]
    used = {part(other) for others in inside for other in others} - {folder}
    assert set(re.findall(r"\w+", said)) & set(FOLDERS) == used & set(FOLDERS)


def test_every_folder_says_in_a_line_what_it_holds() -> None:
    said = {
        init.parent.name: ast.get_docstring(ast.parse(init.read_text())) for init in ROOT.rglob("__init__.py")
    }
    assert [
        name for name, text in said.items() if not text or not text.split("\n")[0].endswith((".", ":"))
    ] == []
