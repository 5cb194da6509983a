"""Prints all that is stale in the documents, at once: `make check-docs`.

Each check yields a line for everything that is not as the code has it. tests/test_documents.py runs them.
"""

import ast
import re
import runpy
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import faults_page
import figures_page
import launch_page

from sags_node.findings import STAGES

ROOT = Path(__file__).parents[2]
ARCHITECTURE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
FOLDERS = (
    ".ci", "benchmarks", "calib", "docs", "examples", "launch", "replay", "sags_lab", "sags_node", "tests",
)  # fmt: skip
SOURCES = {
    file.relative_to(ROOT).as_posix(): file.read_text("utf-8")
    for package in ("sags_node", "sags_lab")
    for file in (ROOT / package).rglob("*.py")
}
STARTS = {
    "Thread", "Timer", "Process", "Popen", "ThreadPoolExecutor", "ProcessPoolExecutor", "Pool", "to_thread",
    "run_in_executor", "ThreadAuthenticator",
}  # fmt: skip


def pages() -> list[Path]:
    places = ("*.md", "docs/**/*.md", "benchmarks/*.md", "calib/*.md")
    return sorted(page for place in places for page in ROOT.glob(place))


def section(title: str) -> str:
    """Of docs/architecture.md, up to the next title of any level."""
    return re.split(r"^##", ARCHITECTURE.split(f"# {title}\n")[1], maxsplit=1, flags=re.MULTILINE)[0]


def titles(page: Path) -> set[str]:
    """What may stand behind `#` in a link to a page: its titles as GitHub writes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    found = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in found}


def paths(text: str) -> set[str]:
    """The files and folders that a text names."""
    return set(re.findall(r"`([\w./-]+(?:\.py|/))`", text))


def missing_files(page: Path) -> Iterator[str]:
    named = paths(page.read_text(encoding="utf-8"))
    for path in sorted(path for path in named if path.partition("/")[0] in FOLDERS):
        if not (ROOT / path).exists():
            yield f"{page.name} names {path}, which is not there"


def dead_links(page: Path) -> Iterator[str]:
    text = page.read_text(encoding="utf-8")
    for link, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]*))?\)", text):
        target = page.parent / link if link else page
        if not target.exists() or (anchor and anchor not in titles(target)):
            yield f"{page.name} links to {link}{anchor and '#'}{anchor}, which is not there"


def missing_tests(page: Path) -> Iterator[str]:
    """Tests that a page links to by their names, without `test_`."""
    for name, link in re.findall(
        r"\[([a-z0-9_]+)\]\(([^)]*/test_\w+\.py)\)", page.read_text(encoding="utf-8")
    ):
        file = page.parent / link
        if file.exists() and f"\ndef test_{name}(" not in file.read_text(encoding="utf-8"):
            yield f"{page.name} names {name}, which is not in {link}"


def check_pages() -> Iterator[str]:
    for page in pages():
        yield from missing_files(page)
        yield from dead_links(page)
        yield from missing_tests(page)


def check_scripts() -> Iterator[str]:
    for script in ("Makefile", ".ci/run", ".ci/nightly"):
        run = re.findall(r"(?:tests|docs)/[\w/]+\.(?:py|sh)", (ROOT / script).read_text(encoding="utf-8"))
        yield from (
            f"{script} runs {file}, which is not there" for file in run if not (ROOT / file).is_file()
        )
    for file in runpy.run_path(str(ROOT / "tests/targets.py"))["TESTS"]:
        if not file.is_file():
            yield f"tests/targets.py runs {file}, which is not there"


def check_index() -> Iterator[str]:
    index = (ROOT / "docs/README.md").read_text(encoding="utf-8")
    there = {page.relative_to(ROOT / "docs").as_posix() for page in ROOT.glob("docs/**/*.md")}
    listed = {link for link in re.findall(r"\]\(([^)#]+\.md)", index) if not link.startswith("..")}
    yield from (f"docs/README.md does not list {page}" for page in there - {"README.md"} - listed)
    for place in ("sags_node", "sags_lab", "benchmarks", "examples", "launch", "tests"):
        for file in (ROOT / place).rglob("*"):
            if file.suffix in {".py", ".js", ".yaml", ".cpp", ".cs", ".md"}:
                named = set(re.findall(r"docs/([\w/-]+\.md)", file.read_text("utf-8")))
                yield from (f"{file.relative_to(ROOT)} names docs/{page}" for page in named - there)


def check_house() -> Iterator[str]:
    """The drawing in docs/architecture.md has the folders that there are."""
    drawn = section("Folders").split("sags_lab/")[0].split("sags_node/\n")[1]
    package, parts = ROOT / "sags_node", ("", "clients/", "tools/")
    there = {file.name for part in parts for file in package.glob(f"{part}*.py")} - {"__init__.py"}
    there |= {f"{init.parent.name}/" for part in parts for init in package.glob(f"{part}*/__init__.py")}
    for name in set(re.findall(r"(?:^ {2,4}| )(\w+/|\w+\.py)(?=[ \n])", drawn, re.MULTILINE)) ^ there:
        yield f"architecture.md, folders: {name} is {'not drawn' if name in there else 'gone'}"


def check_names() -> Iterator[str]:
    """A name in brackets stands in the file that is named before it."""
    text = ARCHITECTURE + (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for path, names in re.findall(r"`([\w./]+\.py)` \(((?:`[\w.]+`(?:, )?)+)\)", text):
        for name in re.findall(r"\w+(?=`|\.)", names):
            defined = rf"^\s*(def|class) {name}\b|^{name}\b.* = "
            if not re.search(defined, SOURCES.get(path, ""), re.MULTILINE):
                yield f"a page names {path} ({name}), which is not there"


def started(source: str) -> list[ast.Call]:
    """Where a module starts threads or processes."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            *module, name = ast.unparse(node.func).split(".")
            if name in STARTS or (module == ["subprocess"] and name in {"run", "call", "check_output"}):
                found.append(node)
    return found


def check_threads() -> Iterator[str]:
    """The table of threads has each file that starts one, and each name that one is given."""
    table = "\n".join(re.findall(r"^\|.*", section("Threads and processes"), re.MULTILINE))
    starting = {path: calls for path, source in SOURCES.items() if (calls := started(source))}
    for path in paths(table) ^ starting.keys():
        yield f"architecture.md, threads: {path} starts {'one, not listed' if path in starting else 'none'}"
    for path, calls in starting.items():
        for call in (call for call in calls if re.search("Thread(PoolExecutor)?$", ast.unparse(call.func))):
            for said in (*call.args, *(keyword.value for keyword in call.keywords)):
                name = said.value if isinstance(said, ast.Constant) else None
                if isinstance(name, str) and f"`{name}`" not in table:
                    yield f"architecture.md, threads: {path} starts {name}, not listed"


def explained(page: str) -> Counter[str]:
    """The codes that stand in a row of docs/warnings.md with a cause and a remedy of some words."""
    found = Counter[str]()
    for line in page.splitlines():
        first, *others = (cell.strip() for cell in line.strip("|").split("|"))
        if re.fullmatch(r"(`[a-z_]+`\s*)+", first) and len(others) == 2 and min(map(len, others)) > 10:
            found.update(re.findall(r"[a-z_]+", first))
    return found


def check_warnings() -> Iterator[str]:
    rows = explained((ROOT / "docs/warnings.md").read_text(encoding="utf-8"))
    yield from (f"docs/warnings.md has {rows[code]} rows for `{code}`" for code in STAGES if rows[code] != 1)
    yield from (f"docs/warnings.md explains `{code}`, which does not exist" for code in rows.keys() - STAGES)


def check_launch_keys() -> Iterator[str]:
    for row in launch_page.page().splitlines():
        if row.startswith("| `") and not row.split(" | ")[-1].strip(" |"):
            yield f"sags_node/config/schema.py: a key without a description: {row}"


def check_faults() -> Iterator[str]:
    for fault, times in Counter(mark[:2] for mark in faults_page.marks()).items():
        if times > 1:
            yield f"the fault '{': '.join(fault)}' is shown by {times} tests"


def check_made_pages() -> Iterator[str]:
    made = {
        launch_page.PAGE: launch_page.page(),
        faults_page.PAGE: faults_page.page(),
        **figures_page.pages(),
    }
    for page, text in made.items():
        if page.read_text(encoding="utf-8") != text:
            yield f"{page.relative_to(ROOT)} is stale; write it anew with: make docs"


def check_results() -> Iterator[str]:
    """Each file of results is claimed; a claim without its file ends in `check_made_pages`."""
    claimed = {name for line in figures_page.lines("claims.txt") for name in figures_page.claimed(line)}
    for file in figures_page.RESULTS.glob("*.json"):
        if file.stem not in claimed:
            yield f"docs/dev/claims.txt has no line for {file.name}"


CHECKS: list[Any] = [check for name, check in list(globals().items()) if name.startswith("check_")]

if __name__ == "__main__":
    found = [print(line) for check in CHECKS for line in check()]
    sys.exit(bool(found))
