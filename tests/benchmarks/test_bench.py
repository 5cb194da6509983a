"""`benchmarks kernels`: what it counts, what it reports, and that its check finds a slower kernel."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any
from unittest.mock import ANY
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner, Result
from engine_scenes import camera, one_gaussian
from places import ROOT

from benchmarks.__main__ import main
from benchmarks.kernels import contention, rasterizing
from benchmarks.kernels import measure as kernels
from benchmarks.kernels.check import SECTIONS, check, compare
from benchmarks.kernels.plot import stacked_bars
from benchmarks.kernels.scenes import SCENES
from benchmarks.kernels.timing import stage_clock
from benchmarks.kernels.work import Work, stage_rows
from sags_node.engine.interface import MIN_ALPHA
from sags_node.engine.rasterizer import compositing
from sags_node.engine.rasterizer.layout import PAIR
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.kernels import peak
from sags_node.kernels.peak import Peak
from sags_node.kernels.threads import thread_count
from sags_node.kernels.vectors import BLOCK_WIDTH

Table = dict[str, Any]
COMMITTED = ROOT / "benchmarks/results/kernels.json"


def sags(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> tuple[Table, Path]:
    """The table of a quick run, and the file it was written to."""
    file = tmp_path_factory.mktemp("bench") / "new" / "kernels.json"
    result = sags("kernels", "--quick", "--json", "--out", file)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout), file


def long_enough(table: Table) -> Table:
    """The same with every stage a thousand times longer: a quick run's are too short to be compared."""
    table = copy.deepcopy(table)
    for section in SECTIONS:
        for row in table[section]:
            for stage in row["stages"]:
                stage["ms"] *= 1000
    return table


@pytest.fixture
def frozen(quick: tuple[Table, Path], monkeypatch: pytest.MonkeyPatch) -> Table:
    """The command measures this table again and again."""
    table = long_enough(quick[0])
    monkeypatch.setattr(kernels, "measure_kernels", lambda settings, advance: table)
    return table


# ---- what is counted -------------------------------------------------------------------------------------


def test_pairs_are_the_rows_of_blended_pairs_times_the_width_of_a_column() -> None:
    pairs = np.zeros(6, PAIR)  # the last is room that is not used
    pairs["begin"] = [[0, 2], [3, 32], [5, 0], [0, 0], [1, 0], [0, 0]]
    pairs["end"] = [[4, 3], [5, 7], [6, 0], [9, 0], [2, 1], [30, 30]]
    # four tiles: two pairs of the first are blended, its third is hidden; the second has none; the third is
    # not drawn, and what its end says means nothing; two pairs of the last
    arguments = {
        "pairs": pairs,
        "tile_starts": np.array([0, 3, 3, 3, 5], np.int32),
        "tile_ends": np.array([2, 3, 0, 5], np.int32),
        "drawn": np.array([0, 1, 3], np.int32),
    }
    assert rasterizing.evaluated_pairs(arguments) == (4 + 1 + 2 + 9 + 1 + 1) * BLOCK_WIDTH


def test_pairs_of_one_gaussian_on_one_tile() -> None:
    view = camera(16, 32, focal=60.0)
    gaussian = one_gaussian(np.array([0.0, 0.0, 0.06]), scale=0.003, opacity=0.9)  # 3 px wide, round
    with stage_clock(rasterizing.STAGES) as clock:
        make_rasterizer("numba", 16, 32).forward(gaussian, view)
    variance = (view.K[1, 1] * 0.003 / 0.06) ** 2 + 0.1
    radius = math.sqrt(2 * variance * math.log(0.9 * (variance - 0.1) / variance / MIN_ALPHA))
    rows = np.abs(np.arange(32) - view.K[1, 2]) <= radius
    assert 10 < rows.sum() < 32
    found = rasterizing.evaluated_pairs(clock.arguments["composite"]) / 16
    assert abs(found - rows.sum()) <= 1  # fx and fy differ: the variances along x and y, too


def test_the_longer_of_arithmetic_and_memory_binds() -> None:
    machine = Peak(threads=1, operations=100e9, bandwidths={2 * 10**6: 50e9, 10**9: 10e9})
    rows = stage_rows(
        {"a": 2.0, "b": 4.0, "c": 1.0},
        {
            "a": Work(bytes=1e6, operations=100e6, pairs=10),
            "b": Work(bytes=20e6, operations=1e6),
            "c": Work(bytes=1e6),  # stays in the cache
        },
        machine,
    )
    assert rows[0]["bound"] == "arithmetic" and rows[0]["share_of_peak"] == pytest.approx(0.5)
    assert rows[1]["bound"] == "memory" and rows[1]["share_of_peak"] == pytest.approx(0.5)
    assert rows[2]["share_of_peak"] == pytest.approx(0.02)
    assert rows[0]["pairs_per_s"] == pytest.approx(10 / 2e-3)
    assert "pairs_per_s" not in rows[1]


def test_chains_compute_every_multiply_add() -> None:
    """Nothing was left out by the compiler: y = y / 2 + s, so many times, from the numbers of the chains."""
    before = thread_count()
    chains = np.arange(peak.CHAINS, dtype=np.float64)
    for rounds, left in ((1, 0.5), (8, 0.5**8)):
        expected = [(chains * left + 2 * s * (1 - left)).sum() for s in (0, 1)]
        found = [peak.run_chains(np.float32(s), rounds) for s in (0, 1)]
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    measured = peak.measure_peak(1)
    assert thread_count() == before
    assert 1e8 < measured.operations < 1e13
    assert all(1e8 < rate < 1e14 for rate in measured.bandwidths.values())


def test_the_clock_leaves_the_engine_as_it_was() -> None:
    before = {key: getattr(*key) for key in rasterizing.STAGES}
    with pytest.raises(ZeroDivisionError), stage_clock(rasterizing.STAGES):
        assert compositing.composite is not before[compositing, "composite"]
        _ = 1 / 0
    assert {key: getattr(*key) for key in rasterizing.STAGES} == before


@pytest.mark.parametrize("name", SCENES)
def test_scenes_lie_in_the_picture(name: str) -> None:
    gaussians, view = SCENES[name](1000, 64, 48)
    assert abs(len(gaussians) - 1000) < 40
    seen = gaussians.means @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    pixels = seen @ view.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    reach = 0.25 if name == "corner" else 1.0
    inside = ((pixels > -4) & (pixels < np.array([64, 48]) * reach + 4)).all(1)
    assert inside.mean() > 0.95
    neighbours = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
    assert (np.median(neighbours) > 10) == (name == "shuffled")


def test_the_busy_process_ends_with_the_measurement() -> None:
    with pytest.raises(ZeroDivisionError), contention.burning_core() as process:
        assert process.poll() is None
        _ = 1 / 0
    assert process.poll() is not None


# ---- what is reported ------------------------------------------------------------------------------------


def test_every_row_holds_plausible_values(quick: tuple[Table, Path]) -> None:
    for section in SECTIONS:
        assert quick[0][section], section
        for row in quick[0][section]:
            for key, value in row.items():
                if key == "between_stages_ms":  # a difference of medians, held at 0
                    assert value >= 0, (section, key)
                elif key.endswith("_ms"):
                    assert value > 0, (section, key)
            for each in [row, *row["stages"]]:
                # no upper bound: a neighbour may have had a core while the peak was measured
                assert 0 < each["share_of_peak"] < math.inf, (section, each)


def test_nothing_in_the_committed_table_beats_the_peak() -> None:
    table = json.loads(COMMITTED.read_text())
    for section in SECTIONS:
        for row in table[section]:
            for each in [row, *row["stages"]]:
                assert 0 < each["share_of_peak"] < 1, (section, each)
    drawn = {(row["n"] // 1000, row["width"]) for row in table["rasterize"]}
    assert {(9, 640), (30, 640), (99, 640), (9, 320)} <= drawn
    assert all(each.ratio == pytest.approx(1) for each in compare(table, table))


def test_the_rasteriser_is_measured_in_every_situation(quick: tuple[Table, Path]) -> None:
    rows = quick[0]["rasterize"]
    promised = {"n", "width", "height", "forward_ms", "forward_backward_ms", "share_of_peak"}
    assert all(promised <= row.keys() for row in rows)
    assert {row["scene"] for row in rows} == {"surface", "corner", "shuffled"}
    assert {row["active_tiles"] for row in rows} == {1.0, 0.5, 0.25, 0.1, 0.05}
    assert {row["sh_degree"] for row in rows} == {0, 3}
    assert (
        rows[0]["speedup_over_twin"] == rows[0]["twin_forward_backward_ms"] / rows[0]["forward_backward_ms"]
    )
    for row in rows:
        stages = {stage["stage"] for stage in row["stages"]}
        assert {"project", "sort", "bin", "composite", "composite backward", "project backward"} <= stages
        assert ("color" in stages) == (row["sh_degree"] > 0)


def test_fewer_tiles_are_fewer_pairs(quick: tuple[Table, Path]) -> None:
    pairs = {row["active_tiles"]: row["pixel_pairs"] for row in quick[0]["rasterize"]}
    assert 0.3 * pairs[1.0] < pairs[0.5] < 0.7 * pairs[1.0]
    assert pairs[0.25] < pairs[0.5]


def test_out_writes_the_table_and_a_plot(quick: tuple[Table, Path]) -> None:
    table, file = quick
    assert json.loads(file.read_text()) == {"provenance": ANY} | table
    assert ElementTree.parse(file.with_suffix(".svg")).getroot().tag.endswith("svg")


def test_bars_are_as_long_as_their_times() -> None:
    root = ElementTree.fromstring(
        stacked_bars([("one", [("x", {"a": 3.0, "b": 1.0})]), ("two", [("y", {"a": 2.0})])])
    )
    svg = "{http://www.w3.org/2000/svg}"
    bars = [path.attrib["d"] for path in root.iter(f"{svg}path") if "clip-path" in path.attrib]
    widths = []
    for bar in bars:
        across = np.array(bar.translate(str.maketrans("MLz", "   ")).split(), float)[::2]
        widths.append(across.max() - across.min())
    assert widths == pytest.approx([3 * widths[1], widths[1], 2 * widths[1]], rel=0.01)
    assert {"4.0 ms", "2.0 ms"} <= {text.text for text in root.iter(f"{svg}text")}


def test_tables_for_people(frozen: Table) -> None:
    result = sags("kernels")
    assert result.exit_code == 0, result.output
    for row in frozen["rasterize"][0]["stages"]:
        assert f"{row['stage']}  " in result.stdout and f"{row['ms']:.3f}" in result.stdout
    assert f"{frozen['rasterize'][0]['speedup_over_twin']:.0f}x" in result.stdout


# ---- the check -------------------------------------------------------------------------------------------


def test_a_kernel_twice_as_slow_is_named(quick: tuple[Table, Path]) -> None:
    now = long_enough(quick[0])
    kept = copy.deepcopy(now)
    stage = next(stage for stage in kept["rasterize"][0]["stages"] if stage["stage"] == "composite backward")
    stage["ms"] /= 2
    first, second, *_ = compare(now, kept)
    assert first.ratio == pytest.approx(2) and second.ratio == pytest.approx(1)
    assert "rasterize composite backward" in first.kernel and "width 64" in first.kernel


def test_a_slower_machine_is_no_slower_kernel(quick: tuple[Table, Path]) -> None:
    kept = long_enough(quick[0])
    now = copy.deepcopy(kept)
    for row in now["peaks"]:
        row["operations_per_s"] /= 3
        row["bytes_per_s_over"] = {size: rate / 3 for size, rate in row["bytes_per_s_over"].items()}
    for row in now["rasterize"]:
        for stage in row["stages"]:
            stage["ms"] *= 3
    assert all(each.ratio < 1.01 for each in compare(now, kept))


def test_check_on_the_command_line(frozen: Table, tmp_path: Path) -> None:
    kept = tmp_path / "kept.json"
    kept.write_text(json.dumps(frozen))
    passed = sags("kernels", "--check", kept)
    assert passed.exit_code == 0, passed.output

    doctored = copy.deepcopy(frozen)
    doctored["rasterize"][0]["stages"][0]["ms"] /= 2
    kept.write_text(json.dumps(doctored))
    failed = sags("kernels", "--check", kept)
    assert failed.exit_code == 1
    name = frozen["rasterize"][0]["stages"][0]["stage"]
    assert f"rasterize {name}" in " ".join(failed.stderr.split())
    assert sags("kernels", "--check", kept, "--tolerance", 2.1).exit_code == 0
    assert sags("kernels", "--check", kept, "--out", tmp_path / "new.json").exit_code == 2


def test_a_disturbed_kernel_gets_another_try(quick: tuple[Table, Path]) -> None:
    calm = long_enough(quick[0])
    disturbed = copy.deepcopy(calm)
    disturbed["rasterize"][0]["stages"][0]["ms"] *= 3
    runs = iter([disturbed, calm])
    assert max(each.ratio for each in check(lambda: next(runs), calm, 1.3)) == pytest.approx(1)
    slow = [copy.deepcopy(disturbed) for _ in range(3)]
    assert check(slow.pop, calm, 1.3)[0].ratio == pytest.approx(3)
    assert not slow


@pytest.mark.parametrize("content", [None, "no json", "[]", "{}", '{"peaks": []}'])
def test_a_table_that_is_none_is_said(frozen: Table, tmp_path: Path, content: str | None) -> None:
    file = tmp_path / "kept.json"
    if content is not None:
        file.write_text(content)
    result = sags("kernels", "--check", file)
    assert result.exit_code == 2, result.output
    assert str(file.name) in result.stderr.replace("\n", "") or "in common" in result.stderr
