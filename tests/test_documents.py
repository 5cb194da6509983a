"""Documents name files, threads, rooms, warnings and each other as they are: docs/dev/check_docs.py."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from places import ROOT

sys.path.insert(0, str(ROOT / "docs/dev"))

import check_docs
import faults_page


@pytest.mark.parametrize("check", check_docs.CHECKS, ids=lambda check: check.__name__)
def test_documents_are_not_stale(check: Callable[[], Iterator[str]]) -> None:
    assert list(check()) == []


def test_what_is_not_there_is_found(tmp_path: Path) -> None:
    """In a page: else the searches may have lost what they look for."""
    page = tmp_path / "page.md"
    page.write_text(
        "# A title\n`sags_node/gone.py` [a](page.md#a-title) [b](page.md#b) [c](gone.md) [d](#d)\n"
        "[there](tests/test_a.py) [gone](tests/test_a.py)\n"
    )
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/test_a.py").write_text("\ndef test_there() -> None: ...\n")
    assert [line.split()[2] for line in check_docs.missing_tests(page)] == ["gone,"]
    assert [line.split()[2] for line in check_docs.missing_files(page)] == ["sags_node/gone.py,"]
    assert [line.split()[3] for line in check_docs.dead_links(page)] == ["page.md#b,", "gone.md,", "#d,"]


@pytest.mark.parametrize(
    "source",
    ["Thread(target=f)", "threading.Timer(1, f)", "asyncio.to_thread(f)", "subprocess.run([])", "Popen([])"],
)
def test_no_way_to_start_a_thread_or_a_process_goes_unseen(source: str) -> None:
    assert len(check_docs.started(source)) == 1
    assert check_docs.started("run(); call(); self.process()") == []


def test_rows_of_warnings_and_of_faults_are_read() -> None:
    words = "| what causes it | what helps then |"
    page = f"| `a` `b` {words}\n| `c` | | |\n| `a` {words}"
    assert check_docs.explained(page) == {"a": 2, "b": 1}
    assert len(faults_page.marks()) > 100
