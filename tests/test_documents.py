"""Documents name files, threads, folders, warnings and each other as they are: docs/dev/check_docs.py."""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

from sags_node.cli.launching import write_json
from sags_node.tools.evaluation.provenance import provenance, revision

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


# ---- Where committed figures come from: a result that nobody can place is not one. ----


RESULTS = sorted((ROOT / "benchmarks/results").glob("*.json"))
# They measure time, bytes or memory. `soak` judges single images of a phantom that never ends.
COMPARE_NOTHING = set("archive_costs archive_costs_fit bridges crowd inputs kernels soak thin".split())


def receipts(found: Any) -> list[Any]:
    """All receipts in a result, wherever they lie."""
    if isinstance(found, dict) and {"frames", "values", "calibration"} <= set(found):
        return [found]
    parts = found.values() if isinstance(found, dict) else found if isinstance(found, list) else []
    return [receipt for part in parts for receipt in receipts(part)]


@pytest.mark.parametrize("file", RESULTS, ids=lambda file: file.stem)
def test_every_result_says_where_it_comes_from_and_what_it_compares(file: Path) -> None:
    result = json.loads(file.read_text())
    origin = result["provenance"]
    assert re.fullmatch("[0-9a-f]{12}", origin["revision"])  # not `-changed`
    assert datetime.fromisoformat(origin["date"]).tzinfo is not None
    assert origin["machine"] and origin["peak"]["operations_per_s"] > 1e9
    assert origin["command"].startswith(("sags ", "python -m benchmarks "))
    assert not re.search(r"(^|[ =])/", origin["command"])
    found = receipts(result)
    assert bool(found) == (file.stem not in COMPARE_NOTHING)
    for receipt in found:
        assert receipt["frames"]["count"] >= 1 and re.fullmatch("[0-9a-f]{16}", receipt["frames"]["digest"])


def test_results_are_written_with_their_origin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["/somewhere/benchmarks/__main__.py", "masks", "a b"])
    write_json(tmp_path / "rows.json", [{"a": 1}])
    found = json.loads((tmp_path / "rows.json").read_text())
    assert found.pop("provenance")["command"] == "python -m benchmarks masks 'a b'" and found == {
        "rows": [{"a": 1}]
    }
    assert set(provenance()) == {"revision", "date", "machine", "peak", "command"}


def test_changed_sources_are_told_from_committed_ones(tmp_path: Path) -> None:
    def git(*arguments: str) -> None:
        who = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", *who, *arguments], cwd=tmp_path, check=True, capture_output=True, timeout=300)

    for name in ("sags_node", "benchmarks", "launch"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text("")
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    clean = revision(tmp_path)
    assert re.fullmatch("[0-9a-f]{12}", clean)
    (tmp_path / "result.json").write_text("{}")
    revision.cache_clear()
    assert revision(tmp_path) == clean
    (tmp_path / "launch/file").write_text("changed")
    revision.cache_clear()
    assert revision(tmp_path) == f"{clean}-changed"
