"""The table of what is claimed in benchmarks/README.md: `claims.txt` with figures from benchmarks/results."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
RESULTS = HERE.parents[1] / "benchmarks/results"
HEAD = "| | this | beside it | run | `results/` |\n|---|---|---|---|---|\n"


@cache
def result(name: str) -> dict[str, Any]:
    """A committed result. FileNotFoundError: there is none of that name."""
    found: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return found


class Figure:
    """A part of a result, found by what stands in brackets behind it, as `str.format` does.

    Of a list: a place, the row in which one of the values is that word, or `*` for all rows. What is asked of
    all rows is written as the range of its values.
    """

    def __init__(self, found: Any, all_rows: bool = False) -> None:
        self._found = found
        self._all_rows = all_rows

    def __getitem__(self, key: str | int) -> Figure:
        if self._all_rows:
            return Figure([each[key] for each in self._found], all_rows=True)
        if not isinstance(self._found, list):
            return Figure(self._found[key])
        if key == "*":
            return Figure(self._found, all_rows=True)
        if isinstance(key, int):
            return Figure(self._found[key])
        return Figure(
            next(row for row in self._found if key in (v for v in row.values() if isinstance(v, str)))
        )

    def __format__(self, how: str) -> str:
        if self._all_rows:
            values = [value for value in self._found if value is not None]
            return f"{min(values):{how}} to {max(values):{how}}"
        return f"{self._found:{how}}"


def claimed(line: str) -> Sequence[str]:
    """The results that a line of `claims.txt` takes its figures from."""
    return list(dict.fromkeys(re.findall(r"\{(\w+)", line)))


def lines() -> list[str]:
    """Of `claims.txt`, without its comments."""
    text = (HERE / "claims.txt").read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def table() -> str:
    rows = []
    for line in lines():
        names = claimed(line)
        filled = line.format(**{name: Figure(result(name)) for name in names})
        rows.append(f"| {filled} | {', '.join(f'`{name}`' for name in names)} |\n")
    return HEAD + "".join(rows) + f"\n{origin('revision')} {origin('machine')}\n"


def origin(key: str) -> str:
    """What most results are of by this key of their provenance, and those of another one by name."""
    found: dict[str, list[str]] = {}
    for file in sorted(RESULTS.glob("*.json")):
        found.setdefault(result(file.stem)["provenance"][key], []).append(f"`{file.stem}`")
    most, *others = sorted(found, key=lambda value: -len(found[value]))
    apart = "".join(f" Of `{value}`: {', '.join(found[value])}." for value in others)
    return f"{len(found[most])} of {sum(map(len, found.values()))} files are of {key} `{most}`.{apart}"
