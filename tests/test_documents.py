"""Documents name files, threads, rooms and each other as they are."""

from __future__ import annotations

import ast
import re
import runpy
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

PACKAGE = ROOT / "sags_node"
PAGES = sorted(
    page for place in ("*.md", "docs/**/*.md", "benchmarks/*.md", "calib/*.md") for page in ROOT.glob(place)
)
ARCHITECTURE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
FILES = [*PACKAGE.rglob("*.py"), *(ROOT / "sags_lab").rglob("*.py")]
SOURCES = {file.relative_to(ROOT).as_posix(): file.read_text("utf-8") for file in FILES}
FOLDERS = {
    "sags_node",
    "sags_lab",
    "tests",
    "docs",
    "benchmarks",
    "launch",
    "calib",
    "replay",
    "examples",
    ".ci",
}
STARTS = {
    "Thread", "Timer", "Process", "Popen", "ThreadPoolExecutor", "ProcessPoolExecutor", "Pool", "to_thread",
    "run_in_executor", "ThreadAuthenticator",
}  # fmt: skip


def section(title: str) -> str:
    """Of docs/architecture.md, up to the next title of any level."""
    found = re.search(rf"^#+ {title}$(.*?)(?=^##|\Z)", ARCHITECTURE, re.MULTILINE | re.DOTALL)
    assert found is not None, f"no section '{title}'"
    return found[1]


def paths(text: str) -> set[str]:
    return set(re.findall(r"`([\w./-]+(?:\.py|/))`", text))


def anchors(page: Path) -> set[str]:
    """What may stand behind `#` in a link to a page: its titles as GitHub writes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


def starts_one(source: str) -> bool:
    """Whether a module starts a thread or a process."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            *module, name = ast.unparse(node.func).split(".")
            if name in STARTS or (module == ["subprocess"] and name in {"run", "call", "check_output"}):
                return True
    return False


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_is_named_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = {path for path in paths(text) if path.partition("/")[0] in FOLDERS}
    assert sorted(path for path in named if not (ROOT / path).exists()) == []


@pytest.mark.parametrize("script", ["Makefile", ".ci/run", ".ci/nightly"])
def test_every_file_that_a_script_runs_exists(script: str) -> None:
    run = set(re.findall(r"(?:tests|docs)/[\w/]+\.(?:py|sh)", (ROOT / script).read_text(encoding="utf-8")))
    assert sorted(path for path in run if not (ROOT / path).is_file()) == []


def test_the_tests_for_other_processors_exist() -> None:
    files = runpy.run_path(str(ROOT / "tests/targets.py"))["TESTS"]
    assert [file.name for file in files if not file.is_file()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_to_a_file_and_to_a_title_in_it(page: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]*))?\)", page.read_text(encoding="utf-8"))
    for link, anchor in links:
        target = page.parent / link if link else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), f"{link}#{anchor}"


def test_every_page_is_in_the_index_and_every_page_that_a_program_names_exists() -> None:
    index = (ROOT / "docs/README.md").read_text(encoding="utf-8")
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in ROOT.glob("docs/**/*.md")} - {"README.md"}
    assert pages == {link for link in re.findall(r"\]\(([^)#]+\.md)", index) if not link.startswith("..")}
    places = ("sags_node", "sags_lab", "benchmarks", "examples", "launch", "tests")
    endings = {".py", ".js", ".yaml", ".cpp", ".cs", ".md"}
    files = [file for place in places for file in (ROOT / place).rglob("*") if file.suffix in endings]
    named = {name for file in files for name in re.findall(r"docs/([\w/-]+\.md)", file.read_text("utf-8"))}
    assert len(named) > 8  # they were found
    assert named - pages - {"README.md"} == set()


def test_the_house_has_the_rooms_that_are_drawn() -> None:
    drawn = section("The house").split("sags_lab/")[0].split("sags_node/\n")[1]
    there = {file.name for file in PACKAGE.glob("*.py")} - {"__init__.py"}
    there |= {f"{init.parent.name}/" for init in PACKAGE.glob("*/__init__.py")}
    assert set(re.findall(r"(?:^ {4}| )(\w+/|\w+\.py)(?=[ \n])", drawn, re.MULTILINE)) == there


def test_every_name_stands_in_the_file_that_is_named_before_it() -> None:
    assert len(paths(ARCHITECTURE)) > 60  # they were found
    text = ARCHITECTURE + (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`([\w./]+\.py)` \(((?:`[\w.]+`(?:, )?)+)\)", text)
    assert len(named) > 20
    missing = []
    for path, names in named:
        for name in re.findall(r"\w+(?=`|\.)", names):
            if not re.search(
                rf"^\s*(def|class) {name}\b|^{name}\b.* = ", SOURCES.get(path, ""), re.MULTILINE
            ):
                missing.append(f"{path}: {name}")
    assert missing == []


def test_every_thread_and_process_is_named() -> None:
    named = set[str]()
    for title in ("Threads of a running node", "Threads of commands and clients", "Processes"):
        named |= paths(section(title))
    assert named == {path for path, source in SOURCES.items() if starts_one(source)}


def test_names_of_threads_are_as_they_are_started() -> None:
    rows = section("Threads of a running node") + section("Threads of commands and clients")
    for path, source in SOURCES.items():
        for node in ast.walk(ast.parse(source if "Thread" in source else "")):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(
                ("Thread", "ThreadPoolExecutor")
            ):
                said = [*node.args, *(keyword.value for keyword in node.keywords)]
                for name in (one.value for one in said if isinstance(one, ast.Constant)):
                    assert not isinstance(name, str) or f"`{name}`" in rows, f"{path} starts {name}"


# ---- the table of faults is what the tests say ---------------------------------------------------------


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    """What `make docs` writes the page with."""
    return runpy.run_path(str(ROOT / "docs/dev/faults_page.py"))


def test_the_page_is_of_these_tests(made: dict[str, Any]) -> None:
    written = (ROOT / "docs/dev/faults.md").read_text(encoding="utf-8")
    assert written == made["page"](), "docs/dev/faults.md is stale; write it anew with: make docs"


def test_each_fault_is_shown_by_one_test_and_each_mark_has_its_entry(made: dict[str, Any]) -> None:
    table = made["table"]()
    assert len(table) >= 35
    assert Counter(mark.name for mark in made["marks"]()) == Counter(table.keys())


def test_each_entry_says_something_that_fits_its_cell(made: dict[str, Any]) -> None:
    for name, cells in made["table"]().items():
        assert cells and cells.keys() <= set(made["CELLS"]), name
        assert ": " in name and "|" not in name + "".join(cells.values())


def test_no_mark_is_overlooked(made: dict[str, Any]) -> None:
    """One that is not on a function of a file is not read."""
    marks = sum(
        file.read_text("utf-8").count("@pytest.mark.fault(") for file in (ROOT / "tests").rglob("test_*.py")
    )
    assert len(made["marks"]()) == marks - 1  # the word in this file
