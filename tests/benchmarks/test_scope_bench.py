"""`benchmarks scope`: two breaths of a small phantom."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.quality import scope
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import FoldersSource, PhantomSource
from sags_node.errors import UsageError
from sags_node.phantom import PhantomScene

SMALL = [
    *("source.width:=160", "source.height:=128", "source.rate:=2.5", "mapping.max_gaussians:=1500"),
]


def test_what_is_told_is_exact_and_what_a_robot_is_off_by_is_what_was_planted() -> None:
    config = load_launch(None, SMALL)
    assert isinstance(config.source, PhantomSource)
    still = PhantomScene.of(config.source).model_copy(update={"still_tissue": True})
    config = config.model_copy(update={"source": still})
    measured = scope.measure_scope(config, ["zoom"], 8.0, lambda done, of, what: None)
    rows = {row["way"]: row for row in measured["rows"]}
    assert set(rows) == {"session", "estimate", "refine", "robot", "rigid", "points"}
    assert rows["session"]["ate_mm"] == pytest.approx(0, abs=1e-9) and rows["session"]["psnr"] > 25
    # Still points, seen exactly, leave no doubt; a hand turned by a degree turns 15 mm of way by that.
    assert rows["points"]["max_mm"] < 1e-2
    assert rows["robot"]["max_mm"] > 15 * np.sin(np.linalg.norm(scope.HAND_EYE))
    assert scope.table(measured).row_count == len(rows)


def test_only_the_phantom_knows_its_scope() -> None:
    config = load_launch(None, SMALL)
    other = config.model_copy(update={"source": FoldersSource(left=Path("left"), right=Path("right"))})
    with pytest.raises(UsageError, match="phantom"):
        scope.measure_scope(other, ["zoom"], 8.0, lambda done, of, what: None)
    with pytest.raises(UsageError, match="breaths"):
        scope.measure_scope(config, ["zoom"], 5.0, lambda done, of, what: None)
