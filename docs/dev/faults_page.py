"""Writes docs/dev/faults.md from the marks of the tests: `make docs`.

A test that shows what a fault does carries `@pytest.mark.fault("place: what")`. The marks are read from the
source, so nothing needs to run, and nothing that a test needs must be there.
"""

import ast
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

PAGE = Path(__file__).with_name("faults.md")
TESTS = PAGE.parents[2] / "tests"
HEAD = """# Faults

<!-- Written by `make docs` from the marks of the tests. Change it there. -->

What the tests break. Each test says what then happens: what a consumer sees, what reports it, and when all
works again. [warnings.md](../warnings.md) says what to do about each warning,
[security.md](../security.md#exit-codes) what the exit codes mean.
"""


class Mark(NamedTuple):
    place: str  # where the fault is
    fault: str
    test: str  # the function
    file: str  # seen from the folder of tests


def marks() -> list[Mark]:
    """The marks of all tests, in the order of their names."""
    found = [mark for file in TESTS.rglob("test_*.py") for mark in _marks(file)]
    return sorted(found, key=lambda mark: (mark.place.lower(), mark.fault))


def _marks(file: Path) -> Iterator[Mark]:
    source = file.read_text(encoding="utf-8")
    for test in ast.parse(source if "mark.fault" in source else "").body:
        for call in ast.walk(test):
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "pytest.mark.fault":
                assert isinstance(test, ast.FunctionDef), f"{file}:{call.lineno}: a mark without its test"
                place, fault = ast.literal_eval(call.args[0]).split(": ", 1)
                yield Mark(place, fault, test.name, file.relative_to(TESTS).as_posix())


def page() -> str:
    """The whole page: one table for each place where faults are."""
    marked = marks()
    lines = [HEAD, f"{len(marked)} faults, shown by {len({mark[2:] for mark in marked})} tests.\n"]
    for place, ones in groupby(marked, key=lambda mark: mark.place):
        lines += [f"## {place[0].upper()}{place[1:]}\n", "| fault | test |", "|---|---|"]
        lines += [f"| {one.fault} | [{one.test[5:]}](../../tests/{one.file}) |" for one in ones]
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
