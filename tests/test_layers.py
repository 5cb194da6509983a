"""Imports point down only, and in no circle, so that every part can be read, replaced and tested alone.

Modules are looked at, and every import in them: at the top, in a function, and for types only.
"""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from places import ROOT

PACKAGE = ROOT / "sags_node"
PICTURE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8").split("## Layers")[1].split("```")[1]
# Folders, and files that stand beside them, the lowest first.
LAYERS = [line.split("   ")[0].split() for line in reversed(PICTURE.strip().splitlines())]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
# What turns frames into messages stands at the top; the other two parts are built on it.
PARTS = {"clients": 1, "tools": 2}  # and how far up each is
PLACES = {
    init.parent.name: init.parent
    for folder in (PACKAGE, *(PACKAGE / name for name in PARTS))
    for init in folder.glob("*/__init__.py")
    if init.parent.name not in PARTS
}
FOLDERS = sorted(PLACES)

# Lines of Python that a folder may have. What needs more raises its number, and its message says why;
# one that needs less lowers it.
LINES = {
    "benchmarks": 9192,
    "sags_lab": 5_007,
    "sags_node": 1_331,
    "sags_node/bags": 1_001,
    "sags_node/cli": 3_682,
    "sags_node/clients": 1,
    "sags_node/clients/bridge": 2_540,
    "sags_node/clients/latency": 423,
    "sags_node/clients/overlay": 3_154,
    "sags_node/clients/recording": 1_500,
    "sags_node/clients/registration": 518,
    "sags_node/clients/viewer": 1_591,
    "sags_node/config": 1_533,
    "sags_node/detail": 968,
    "sags_node/engine": 4_052,
    "sags_node/instruments": 812,
    "sags_node/field": 1_963,
    "sags_node/kernels": 1_219,
    "sags_node/mapping": 5_552,
    "sags_node/media": 960,
    "sags_node/messaging": 5_435,
    "sags_node/model": 1_077,
    "sags_node/node": 1_837,
    "sags_node/phantom": 1_552,
    "sags_node/pipeline": 926,
    "sags_node/quality": 263,
    "sags_node/rig": 1_183,
    "sags_node/ros": 319,
    "sags_node/sources": 6_019,
    "sags_node/terminal": 415,
    "sags_node/tools": 579,
    "sags_node/tools/calibration": 1_940,
    "sags_node/tools/evaluation": 3_087,
    "sags_node/tools/export": 959,
    "sags_node/tools/fitting": 1_955,
    "sags_node/tools/importing": 1_168,
    "sags_node/vision": 5_368,
    "tests": 46_243,
}
SPARE = 40  # lines between a number and what is there: beyond, it is lowered


def name_of(file: Path) -> str:
    return ".".join(("sags_node", *file.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")


FILES = {name_of(file): file for file in PACKAGE.rglob("*.py")}


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
    return module.split(".")[2 if module.split(".")[1] in PARTS else 1]


def height(module: str) -> int:
    """Of the part of the package that it belongs to; what starts everything is the highest."""
    top = module.split(".")[1]
    return len(PARTS) + 1 if top in ("cli", "__main__") else PARTS.get(top, 0)


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
    parts = {"sags_node", *(f"sags_node.{name}" for name in PARTS)}
    assert {part(name) for name in FILES if name not in parts} == LEVEL.keys()


def points_down(name: str, other: str) -> bool:
    """The node knows no client and no tool, and clients know no tool."""
    is_lower = part(name) == part(other) or LEVEL[part(name)] > LEVEL[part(other)]
    return is_lower and height(name) >= height(other)


def test_imports_point_down() -> None:
    pairs = ((name, other) for name, others in IMPORTS.items() if name != "sags_node" for other in others)
    assert [f"{name} imports {other}" for name, other in pairs if not points_down(name, other)] == []


def test_modules_import_each_other_in_no_circle() -> None:
    try:
        TopologicalSorter(IMPORTS).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_the_package_imports_nothing_that_stands_beside_it() -> None:
    lines = re.compile(r"^\s*(?:from|import) (?:benchmarks|sags_lab|tests)\b", re.MULTILINE)
    assert [name for name, file in FILES.items() if lines.search(file.read_text())] == []


# Private names that tests use. The first is Numba's; the package has such a name, too.
REACHED_INTO = {
    ("kernels/test_kernel_cache.py", "_cache"),
    ("model/test_model.py", "_LEAST_STIFFNESS"),  # without stiffness: the twin that it must be better than
}
PRIVATE = re.compile(r"\b_[a-zA-Z]\w*")
NAMED_TUPLES = {"_asdict", "_fields", "_make", "_replace"}


def reached_into(code: str) -> set[str]:
    """Private names of others that some code uses."""
    found = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Attribute):
            if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
                found.add(node.attr)
        elif isinstance(node, ast.ImportFrom):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("setattr", "getattr")):
            names = [arg.value for arg in node.args if isinstance(arg, ast.Constant)]
            found |= {name.split(".")[-1] for name in names if isinstance(name, str)}
    return {name for name in found if PRIVATE.fullmatch(name)} - NAMED_TUPLES


@pytest.mark.parametrize(
    "code",
    [
        "from sags_node.engine.device import _made",
        "thing._made = 3",
        "super()._made()",
        "assert things[0]._made",
        "monkeypatch.setattr(thing, '_made', 3)",
        "monkeypatch.setattr('sags_node.engine.device._made', 3)",
    ],
)
def test_no_way_to_reach_into_the_package_goes_unseen(code: str) -> None:
    assert reached_into(code) == {"_made"}


def test_tests_use_what_is_public() -> None:
    """Else the inside of a part could not be changed without its tests."""
    files = [file for part in ("sags_node", "sags_lab", "benchmarks") for file in (ROOT / part).rglob("*.py")]
    private = {name for file in files for name in PRIVATE.findall(file.read_text())}
    assert {
        (file.relative_to(ROOT / "tests").as_posix(), name)
        for file in (ROOT / "tests").rglob("*.py")
        for name in reached_into(file.read_text()) & private
    } <= REACHED_INTO


def said_in(folder: Path) -> str:
    return ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or ""


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_says_which_it_imports(folder: str) -> None:
    last = said_in(PLACES[folder]).split("\n\n")[-1]
    assert last.startswith("Imports ")
    home = name_of(PLACES[folder] / "__init__.py")
    inside = [others for name, others in IMPORTS.items() if name.startswith(f"{home}.")]
    used = {part(other) for others in inside for other in others} - {folder}
    assert set(re.findall(r"\w+", last)) & set(FOLDERS) == used & set(FOLDERS)


def test_every_folder_says_in_a_line_what_it_holds() -> None:
    firsts = {init.parent: said_in(init.parent).split("\n")[0] for init in PACKAGE.rglob("__init__.py")}
    assert [str(folder) for folder, first in firsts.items() if not first.endswith((".", ":"))] == []


def lines_of(folder: str) -> int:
    """Of the package itself, and of a part of it: of the files beside its folders."""
    beside = folder == "sags_node" or folder.removeprefix("sags_node/") in PARTS
    files = (ROOT / folder).glob("*.py") if beside else (ROOT / folder).rglob("*.py")
    return sum(len(file.read_bytes().splitlines()) for file in files)


def test_every_folder_has_a_budget_of_lines() -> None:
    inside = {path.relative_to(ROOT).as_posix() for path in PLACES.values()}
    parts = {f"sags_node/{name}" for name in PARTS}
    assert inside | parts | {"sags_node", "sags_lab", "benchmarks", "tests"} == {*LINES}


@pytest.mark.parametrize("folder", LINES)
def test_a_folder_keeps_its_budget_of_lines(folder: str) -> None:
    there = lines_of(folder)
    assert there <= LINES[folder], f"{folder} has {there} lines: shorten it, or raise LINES and say why"
    assert there >= LINES[folder] - SPARE, f"{folder} has {there} lines: lower LINES"
