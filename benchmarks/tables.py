"""Tables of figures for people."""

from collections.abc import Iterable, Mapping
from string import Formatter
from typing import Any

from rich.table import Table

Row = Mapping[str, Any]


class _Cell(Formatter):
    """`str.format` for figures that may be unknown: None, missing, or in a group that is None."""

    def __init__(self, unknown: str) -> None:
        self._unknown = unknown

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> Any:
        try:
            return super().get_field(field_name, args, kwargs)
        except (KeyError, TypeError):
            return None, field_name

    def format_field(self, value: Any, format_spec: str) -> Any:
        return self._unknown if value is None else super().format_field(value, format_spec)


def filled(made: Table, rows: Iterable[Row], *cells: str, unknown: str = "-") -> Table:
    """Add a line for each row to a table; `cells` are format strings: "{depth[p90_mm]:.2f}"."""
    cell = _Cell(unknown)
    for row in rows:
        made.add_row(*(cell.vformat(each, (), row) for each in cells))
    return made


def plain_table(first: str, *others: str, title: str | None = None) -> Table:
    """Make an empty table without rules; columns of figures are right-aligned."""
    made = Table(box=None, padding=(0, 3, 0, 0), pad_edge=False, title=title, title_justify="left")
    made.add_column(first)
    for heading in others:
        made.add_column(heading, justify="right")
    return made
