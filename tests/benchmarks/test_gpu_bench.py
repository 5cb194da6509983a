"""`make gpu-check` on Warp's CPU device: everything but the speed."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import warp as wp
from command_line import ran
from warp_on_cpu import use_warp_on_cpu

from benchmarks.__main__ import main
from benchmarks.gpu import check
from benchmarks.gpu.check import Part, gpu_check, in_a_process, measure_case, parts, table
from sags_node.cli import fit_folder
from sags_node.engine.gpu.rasterizer import DeviceRasterizer
from sags_node.errors import SagsError


def test_a_wrong_drawing_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    use_warp_on_cpu(monkeypatch)
    backward = DeviceRasterizer.backward
    monkeypatch.setattr(
        DeviceRasterizer, "backward", lambda self, v, w: backward(self, wp.array(2 * v.numpy()), w)
    )
    assert measure_case(8, 32, 16, 1)["colors_apart"] > 0.5


def test_a_gpu_that_fails_gives_no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the CPU's times would stand as the GPU's."""
    use_warp_on_cpu(monkeypatch)

    def fails(*_: object) -> None:
        raise RuntimeError("CUDA error")

    monkeypatch.setattr(DeviceRasterizer, "backward", fails)
    with pytest.raises(SagsError, match="CUDA error"):
        measure_case(8, 32, 16, 1)


def test_every_part_of_the_check_gives_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """The live runs differ in what they play, which small ones do not: one of them is enough."""
    use_warp_on_cpu(monkeypatch)
    monkeypatch.setattr(fit_folder, "device_of", lambda wanted, schedule: "cpu")
    chosen = parts(small=True, schedule="paper")
    tried = [name for name in chosen if not name.startswith("live")] + ["live D4D, 60 Hz"]
    figures = {name: chosen[name].run() for name in tried}
    shown = table(figures, chosen)
    assert {*shown.columns[0].cells} == {*tried} - {"environment"}
    lines = [*zip(*(column.cells for column in shown.columns), strict=True)]
    assert {line[1:2] + line[4:] for line in lines if line[0] == "parity 200"} == {
        ("pixels_apart", "yes"), ("gradients_apart", "yes"), ("repeats", "yes")
    }  # fmt: skip
    assert {"seconds", "rate_hz", "online.psnr", "gpu_frame_ms"} <= {line[1] for line in lines}


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import os; os.abort()", "exit code -6"),
        ("import subprocess, time; subprocess.Popen(['sleep', '600']); time.sleep(600)", "within 2 s"),
        ("import sys; sys.exit('CUDA error')", "exit code 1: CUDA error"),
    ],
)
def test_a_part_that_fails_crashes_or_hangs_spoils_only_itself(code: str, said: str) -> None:
    assert said in in_a_process([sys.executable, "-c", code], 2.0)["error"]
    assert in_a_process([sys.executable, "-c", "print('noise'); print('{\"ms\": 1}')"], 60.0) == {"ms": 1}


def test_what_is_measured_is_kept_after_each_part_and_no_part_begins_late() -> None:
    kept: list[dict[str, Any]] = []
    chosen = {"first": Part(dict), "second": Part(dict)}
    figures = gpu_check(["--device", "cpu"], chosen, lambda found: kept.append(dict(found)), -1.0)
    assert [[*found] for found in kept] == [["first"], ["first", "second"]] and kept[-1] == figures
    assert "the time is up" in figures["first"]["error"]
    assert [*table(figures, chosen).columns[4].cells] == ["no", "no"]


def test_a_failed_part_ends_the_command_with_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check, "parts", lambda *_: {"first": Part(dict), "second": Part(dict)})
    found = iter([{"error": "exit code 1: CUDA error"}, {"ms": 1.0}])
    monkeypatch.setattr(check, "in_a_process", lambda *_: next(found))
    code, shown, said = ran("gpu", "--out", tmp_path / "gpu.json", command=main)
    assert code == 1 and "CUDA error" in shown and "failed: first" in said
    written = json.loads((tmp_path / "gpu.json").read_text())
    assert "CUDA error" in written["first"]["error"] and written["second"] == {"ms": 1.0}
