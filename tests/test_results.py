"""Where committed figures come from: a result that nobody can place is not one."""

from __future__ import annotations

import json
import re
import subprocess
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

from sags_node.cli.launching import write_json
from sags_node.tools.evaluation.provenance import provenance, revision

RESULTS = sorted((ROOT / "benchmarks/results").glob("*.json"))
# They measure time, bytes or memory. `soak` judges single pictures of a phantom that never ends.
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
        subprocess.run(["git", *who, *arguments], cwd=tmp_path, check=True, capture_output=True)

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
