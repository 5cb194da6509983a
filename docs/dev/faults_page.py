"""Writes docs/dev/faults.md from the marks of the tests: `make docs`.

A test that shows what a fault does carries `@pytest.mark.fault(name, sees=, says=, back=, left=)`. The marks
are read from the source, so nothing needs to run, and nothing that a test needs must be there.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

PAGE = Path(__file__).with_name("faults.md")
ROOT = PAGE.parents[2]
HEAD = """# Faults

<!-- Written by `make docs` from the marks of the tests. Change it there. -->

What the tests break, and what then happens. Each row is what its test asserts, and no more: an
empty field means that the test does not check it. [warnings.md](../warnings.md) says what to do about each
warning, [security.md](../security.md#exit-codes) what the exit codes mean.

- **sees**: what a consumer of the node, or the user of the command, gets meanwhile.
- **says**: which warning, error or count reports it.
- **works again**: how long that takes, or what it takes.
- **left**: what is unchanged afterwards, or is not left behind.
"""


class Fault(NamedTuple):
    """One mark: `name` is "where: what", the other texts are cells of the table."""

    name: str
    sees: str
    says: str
    back: str
    left: str
    test: str  # the function
    file: str  # seen from the repository

    @property
    def place(self) -> str:
        return self.name.partition(": ")[0]


def faults() -> list[Fault]:
    """All marks, in the order of their names.

    Raises:
        ValueError: a mark is written in a form that cannot be read without running it.
    """
    found = [fault for file in (ROOT / "tests").rglob("test_*.py") for fault in _marks(file)]
    return sorted(found, key=lambda fault: (fault.place.lower(), fault.name))


def _marks(file: Path) -> Iterator[Fault]:
    body = ast.parse(file.read_text(encoding="utf-8")).body
    constants = {
        node.targets[0].id: node.value
        for node in body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }

    def text(node: ast.expr) -> Any:
        return ast.literal_eval(constants[node.id] if isinstance(node, ast.Name) else node)

    for node in body:
        if not isinstance(node, ast.FunctionDef):
            continue
        for mark in node.decorator_list:
            if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.fault":
                names = [text(argument) for argument in mark.args]
                cells = {str(word.arg): text(word.value) for word in mark.keywords}
                if len(names) != 1 or not cells.keys() <= {"sees", "says", "back", "left"}:
                    raise ValueError(f"{file}: {node.name}: a fault has one name, sees, says, back and left")
                where = dict(test=node.name, file=file.relative_to(ROOT).as_posix())
                yield Fault(
                    names[0], *(cells.get(key, "") for key in ("sees", "says", "back", "left")), **where
                )


def page() -> str:
    """The whole page: one table for each place where faults are."""
    marked = faults()
    tests = {(fault.file, fault.test) for fault in marked}
    lines = [HEAD, f"{len(marked)} faults, shown by {len(tests)} tests.\n"]
    for place, ones in groupby(marked, key=lambda fault: fault.place):
        lines += [f"## {place[0].upper()}{place[1:]}\n"]
        lines += ["| fault | sees | says | works again | left | test |", "|---|---|---|---|---|---|"]
        for fault in ones:
            what = fault.name.partition(": ")[2]
            test = f"[{fault.test.removeprefix('test_')}](../../{fault.file})"
            lines.append(f"| {' | '.join([what, *fault[1:5], test])} |")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
