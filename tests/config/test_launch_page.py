"""The page of launch keys says what the configuration says."""

from __future__ import annotations

import runpy

import pytest
from places import ROOT

DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def made() -> str:
    """The page as `make docs` would write it now."""
    return str(runpy.run_path(str(DOCS / "dev/launch_page.py"))["page"]())


def test_the_page_is_of_this_configuration(made: str) -> None:
    written = (DOCS / "launch.md").read_text(encoding="utf-8")
    assert written == made, "docs/launch.md is stale; write it anew with: make docs"


def test_every_key_says_what_it_does(made: str) -> None:
    rows = [row.split(" | ") for row in made.splitlines() if row.startswith("| `")]
    assert len(rows) > 80  # tables were found
    assert [row[0] for row in rows if not row[-1].strip(" |")] == []
