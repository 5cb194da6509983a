"""`benchmarks ablation`: every variant is fitted and measured alike, on frames it never saw."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import pytest
from command_line import figures_of

from benchmarks.__main__ import main
from benchmarks.quality import ablation
from sags_node.tools.fitting import start
from sags_node.tools.fitting.fit import Fit
from sags_node.tools.fitting.settings import FieldShape


def test_all_variants_are_measured_on_the_same_frames(
    phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = {
        name: dataclasses.replace(settings, shape=FieldShape(cells=8, channels=16))
        for name, settings in ablation.VARIANTS.items()
    }
    monkeypatch.setattr(ablation, "VARIANTS", small)
    monkeypatch.setattr(start, "PATH_STEPS", 20)
    learnt: list[list[int]] = []
    begin = Fit.start

    def noted(fit: Fit, progress: Any) -> None:
        learnt.append([frame.frame_id for frame in fit.clip.train])
        begin(fit, progress)

    monkeypatch.setattr(Fit, "start", noted)
    out = tmp_path / "ablation.json"
    arguments = ["source.frames:=12", "--warm-up", "2", "--iterations", "3", "--seeds", "2"]
    arguments += ["--set", "max_gaussians=800"]
    arguments += [f"--variant={name}" for name in small if name != "nodes"] + ["--out", str(out), "--json"]
    found = figures_of("ablation", str(phantom_session), *arguments, command=main)
    assert json.loads(out.read_text()) == {"provenance": ANY} | found
    assert found["receipt"]["frames"]["count"] == 12
    del small["nodes"]
    assert list(found["variants"]) == list(small)
    assert learnt == [[0, 2, 3, 4, 5, 6, 7, 8]] * len(small) * 2
    for name, rows in found["variants"].items():
        assert len(rows) == 2 and rows[0]["heldout"] != rows[1]["heldout"], name  # of other seeds
        row = rows[0]
        assert row["heldout"]["frames"] == 1 and row["ahead"]["frames"] == ablation.AHEAD, name
        assert row["gaussians"] <= 800
        used = found["settings"][name]
        assert used["iterations"] == 3 and used["warm_up"] == (0 if used["schedule"] == "online" else 2)
        assert row["track"]["median_mm"] > 0 and row["track_with_ahead"]["median_mm"] > 0
        assert row["train"]["frames"] >= 1 and row["between"]["mean"]["frames"] == 1
        assert row["smaller"].keys() == {"half", "quarter"}
    base, online = (found["variants"][name][0]["heldout"]["psnr"] for name in ("base", "online"))
    assert online > base
    filters = found["parts"]["both filters, without the block"]
    gains = [
        a["heldout"]["psnr"] - b["heldout"]["psnr"]
        for a, b in zip(found["variants"]["no_adaptive"], found["variants"]["base"], strict=True)
    ]
    assert filters["paper_db"] == 0.9
    assert filters["heldout"]["lowest"] == pytest.approx(min(gains), abs=1e-3)
    assert filters["heldout"]["mean"] == pytest.approx(sum(gains) / 2, abs=1e-3)
