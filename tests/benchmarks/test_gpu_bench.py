"""`benchmarks kernels --device cuda` with gsplat's stages in torch: everything but the speed."""

from __future__ import annotations

import json
from pathlib import Path
from unittest.mock import ANY

import pytest
from command_line import refused, sags

pytest.importorskip("gsplat", reason="it is optional: pip install 'sags-node[gsplat]'")

from gsplat_on_cpu import use_gsplat_on_cpu

from benchmarks.__main__ import main
from benchmarks.kernels import gpu
from sags_node.engine import device
from sags_node.engine.gsplat_backend import Drawing
from sags_node.errors import SagsError

COMMAND = ("kernels", "--device", "cuda")


def test_a_gpu_is_compared_with_the_cpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_gsplat_on_cpu(monkeypatch)
    file = tmp_path / "gpu.json"
    result = sags(*COMMAND, "--quick", "--json", "--out", file, command=main)
    assert result.exit_code == 0, result.output
    table = json.loads(result.stdout)
    assert json.loads(file.read_text()) == {"provenance": ANY} | table
    (row,) = table["refine"]
    assert row["n"] == 8 and (row["width"], row["height"]) == (32, 16)
    assert all(row[f"{where}_{what}_ms"] > 0 for where in ("cpu", "gpu") for what in ("frame", "step"))
    assert row["planes_apart"] < 1e-5 and row["colors_apart"] < 1e-3
    shown = str(gpu.gpu_table(table).columns[0].header)
    assert table["device"] in shown and table["gsplat"] in shown


def test_a_wrong_drawing_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    use_gsplat_on_cpu(monkeypatch)
    backward = Drawing.backward
    monkeypatch.setattr(Drawing, "backward", lambda self, v, w: backward(self, 2 * v, w))
    assert gpu.measure_case(8, 32, 16, 1)["colors_apart"] > 0.5


def test_a_gpu_that_fails_gives_no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the CPU's times would stand as the GPU's."""
    use_gsplat_on_cpu(monkeypatch)

    def fails(*_: object) -> None:
        raise RuntimeError("CUDA error")

    monkeypatch.setattr(Drawing, "backward", fails)
    with pytest.raises(SagsError, match="CUDA error"):
        gpu.measure_case(8, 32, 16, 1)


def test_what_cannot_be_measured_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    refused(2, *COMMAND, "--large", said=("--device cuda give --quick",), command=main)
    monkeypatch.setattr(device, "has_gpu", lambda: False)
    device.find_gpu.cache_clear()
    refused(2, *COMMAND, "--quick", said=("no NVIDIA GPU", "nvidia-smi"), command=main)
