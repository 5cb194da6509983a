"""The table of faults is what the tests say."""

from __future__ import annotations

import runpy
from collections import Counter
from typing import Any

import pytest
from places import ROOT


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
