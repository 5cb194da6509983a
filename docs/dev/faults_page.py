"""Writes docs/dev/faults.md from tests/faults.toml and the marks of the tests: `make docs`.

A test that shows what a fault does carries `@pytest.mark.fault("place: what")`; tests/faults.toml says what
then happens. The marks are read from the source, so nothing needs to run, and nothing that a test needs must
be there.
"""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

PAGE = Path(__file__).with_name("faults.md")
ROOT = PAGE.parents[2]
CELLS = ("sees", "says", "back", "left")
HEAD = """# Faults

<!-- Written by `make docs` from tests/faults.toml and the marks of the tests. Change it there. -->

What the tests break, and what then happens. Each row is what its test asserts, and no more: an
empty field means that the test does not check it. [warnings.md](../warnings.md) says what to do about each
warning, [security.md](../security.md#exit-codes) what the exit codes mean.

- **sees**: what a consumer of the node, or the user of the command, gets meanwhile.
- **says**: which warning, error or count reports it.
- **works again**: how long that takes, or what it takes.
- **left**: what is unchanged afterwards, or is not left behind.
"""


class Mark(NamedTuple):
    name: str  # of the fault: "place: what"
    test: str  # the function
    file: str  # seen from the repository


def table() -> dict[str, dict[str, str]]:
    """What each fault does, by its name: the cells of its row."""
    return tomllib.loads((ROOT / "tests/faults.toml").read_text(encoding="utf-8"))


def marks() -> list[Mark]:
    """All marks, in the order of their names."""
    found = [mark for file in (ROOT / "tests").rglob("test_*.py") for mark in _marks(file)]
    return sorted(found, key=lambda mark: (_place(mark).lower(), mark.name))


def _marks(file: Path) -> Iterator[Mark]:
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if not isinstance(node, ast.FunctionDef):
            continue
        for call in node.decorator_list:
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "pytest.mark.fault":
                (name,) = map(ast.literal_eval, call.args)
                yield Mark(name, node.name, file.relative_to(ROOT).as_posix())


def _place(mark: Mark) -> str:
    return mark.name.partition(": ")[0]


def page() -> str:
    """The whole page: one table for each place where faults are."""
    cells, marked = table(), marks()
    tests = {(mark.file, mark.test) for mark in marked}
    lines = [HEAD, f"{len(marked)} faults, shown by {len(tests)} tests.\n"]
    for place, ones in groupby(marked, key=_place):
        lines += [f"## {place[0].upper()}{place[1:]}\n"]
        lines += ["| fault | sees | says | works again | left | test |", "|---|---|---|---|---|---|"]
        for mark in ones:
            row = [mark.name.partition(": ")[2], *(cells[mark.name].get(key, "") for key in CELLS)]
            test = f"[{mark.test.removeprefix('test_')}](../../{mark.file})"
            lines.append(f"| {' | '.join([*row, test])} |")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
