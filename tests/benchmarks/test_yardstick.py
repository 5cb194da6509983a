"""`benchmarks kernels --yardstick`: both draw the same, and what is missing is said."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from unittest.mock import ANY

import numpy as np
import pytest
from click.testing import CliRunner, Result
from engine_scenes import EXPONENTIAL
from places import ROOT
from rounding import after

from benchmarks.__main__ import main
from benchmarks.kernels import yardstick
from benchmarks.kernels.rasterizing import Drawing, RasterCase
from sags_node.engine.interface import MIN_ALPHA
from sags_node.engine.rasterizer import cpu

PROGRAM = ROOT.parent / "shared/experiments/raster/splat.cpp"
needs_program = pytest.mark.skipif(not PROGRAM.exists(), reason="the program is not part of the project")
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")


def bench(file: Path, *options: object) -> Result:
    arguments = ["kernels", "--yardstick", file, *options]
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def said(result: Result) -> str:
    return " ".join(result.stderr.split())


@needs_compiler
@needs_program
def test_one_row_per_case(tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    result = bench(PROGRAM, "--quick", "--json", "--out", file)
    assert result.exit_code == 0, result.output
    table = json.loads(result.stdout)
    assert json.loads(file.read_text()) == {"provenance": ANY} | table
    (row,) = table["yardstick"]
    for name in ("forward", "forward_backward"):
        assert row[f"{name}_ratio"] == row[f"{name}_ms"] / row[f"yardstick_{name}_ms"]


@needs_compiler
@needs_program
def test_both_draw_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """With its screen filter in the place of ours."""
    monkeypatch.setattr(cpu, "MIP_VARIANCE", 0.3)
    case = RasterCase(500, 64, 64, 1)
    ours = Drawing(case).forward()[:3]
    with yardstick.compiled(PROGRAM, 1) as library:
        program = yardstick.Program(library, case)
        program.forward_backward()
    # 2^x of both is off by 2.6e-6, and colours are below 1; a splat cut at 1/255 may show in a few pixels
    apart = np.abs(program.picture - ours)
    assert np.percentile(apart, 99) < 2 * EXPONENTIAL + after(60)
    assert apart.max() < 2 * MIN_ALPHA


@needs_compiler
@pytest.mark.parametrize(
    ("code", "message"),
    [("int tile_w(", "does not compile"), ('extern "C" int tile_w() { return 16; }', "depth_sort")],
)
def test_a_file_that_is_no_yardstick(tmp_path: Path, code: str, message: str) -> None:
    file = tmp_path / "program.cpp"
    file.write_text(code)
    result = bench(file, "--quick")
    assert result.exit_code == 1 and message in said(result)


@needs_compiler
def test_too_many_pairs_for_the_program(tmp_path: Path) -> None:
    bodies = [
        f"long {name}(...) {{ return {-(10**6) if name == 'bin' else 16}; }}" for name in yardstick.FUNCTIONS
    ]
    file = tmp_path / "program.cpp"
    file.write_text('extern "C" {\n' + "\n".join(bodies) + "\n}")
    result = bench(file, "--quick")
    assert result.exit_code == 1 and "room for 1000000 pairs" in said(result)


def test_without_a_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    file = tmp_path / "program.cpp"
    file.touch()
    result = bench(file)
    assert result.exit_code == 1 and "g++" in said(result)


def test_usage(tmp_path: Path) -> None:
    file = tmp_path / "program.cpp"
    missing = bench(file)
    assert missing.exit_code == 2 and file.name in said(missing)
    file.touch()
    assert bench(file, "--large").exit_code == 2
