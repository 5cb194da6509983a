"""Tables of figures for people: some keys of what was measured, named as in its file."""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from numbers import Integral, Real
from typing import Any

from rich.table import Table

from sags_node.terminal import text

FIGURE = re.compile(r"-|nan|[-+.e\d]+")


def tables(measured: Any, *keys: str) -> Iterator[Table]:
    """Make a table for each string of keys with spaces between: "name depth.p90_mm" shows p90_mm of depth.

    Every mapping that has the last key is a row, wherever it lies; with "settings: " in front, if it lies
    below that name. Other keys may be those of a mapping that it lies in. The names below which the rows lie
    stand in front, as far as they tell them apart.
    """
    for line in keys:
        below, _, asked = line.rpartition(": ")
        columns = asked.split()
        found = _rows(measured, columns[-1].partition(".")[0], {}, ())
        rows = [(names, row) for names, row in found if not below or below in names]
        if rows:
            yield _table(columns, rows)


def _rows(
    found: Any, last: str, above: Mapping[str, Any], names: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
    if isinstance(found, Mapping):
        row = {**above, **found}
        if last in found:
            yield names, row
            return
        for name, part in found.items():
            yield from _rows(part, last, row, (*names, str(name)))
    elif isinstance(found, list):
        for part in found:
            yield from _rows(part, last, above, names)


def _table(columns: Sequence[str], rows: list[tuple[tuple[str, ...], dict[str, Any]]]) -> Table:
    """Columns of figures are right-aligned; those of which nothing is known are left out."""
    by_depth = zip_longest(*(names for names, _ in rows), fillvalue="")
    told = [names for names in by_depth if len(set(names)) > 1]
    made = text.table(*("" for _ in told))
    made.show_header = True
    cells: list[Sequence[str]] = [*told]
    for column in columns:
        values = [_cell(row, column) for _, row in rows]
        if set(values) != {"-"}:
            heading = column.replace("_", " ").replace(".", " ")
            made.add_column(heading, justify="right" if all(map(FIGURE.fullmatch, values)) else "left")
            cells.append(values)
    for line in zip(*cells, strict=True):
        made.add_row(*line)
    return made


def _cell(row: Mapping[str, Any], column: str) -> str:
    """A dash for what is unknown: None, missing, or in a group that is None."""
    value = _at(row, column)
    if isinstance(value, list | tuple):
        value = ", ".join(map(str, value))
    if value is None or isinstance(value, str):
        return value or "-"
    return str(value) if isinstance(value, Integral) or not isinstance(value, Real) else f"{value:.4g}"


def _at(found: Any, key: str) -> Any:
    if not isinstance(found, Mapping) or key in found:
        return found[key] if isinstance(found, Mapping) else None
    group, _, rest = key.partition(".")
    return _at(found.get(group), rest) if rest else None
