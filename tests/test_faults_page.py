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


def test_each_fault_is_shown_once_and_says_something(made: dict[str, Any]) -> None:
    faults = made["faults"]()
    assert len(faults) >= 35
    assert [name for name, count in Counter(fault.name for fault in faults).items() if count > 1] == []
    assert [fault.name for fault in faults if not any(fault[1:5])] == []
    assert [fault.name for fault in faults if "|" in "".join(fault[:5]) or ": " not in fault.name] == []


def test_no_mark_is_overlooked(made: dict[str, Any]) -> None:
    marks = sum(
        file.read_text("utf-8").count("@pytest.mark.fault(") for file in (ROOT / "tests").rglob("test_*.py")
    )
    assert len(made["faults"]()) == marks - 1  # the word in this file
