"""`benchmarks kernels`: what it counts, what it reports, and that its check finds a slower kernel."""

import copy
import json
import math
from typing import Any

import numpy as np
import pytest
from engine_scenes import camera, one_gaussian
from places import ROOT

from benchmarks.kernels import rasterizing
from benchmarks.kernels.check import SECTIONS, compare
from benchmarks.kernels.scenes import SCENES
from benchmarks.kernels.timing import Work, stage_clock, stage_rows
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


# ---- what is reported ------------------------------------------------------------------------------------


def test_nothing_in_the_committed_table_beats_the_peak() -> None:
    table = json.loads(COMMITTED.read_text())
    for section in SECTIONS:
        for row in table[section]:
            for each in [row, *row["stages"]]:
                assert 0 < each["share_of_peak"] < 1, (section, each)
    drawn = {(row["n"] // 1000, row["width"]) for row in table["rasterize"]}
    assert {(9, 640), (30, 640), (99, 640), (9, 320)} <= drawn
    assert all(each.ratio == pytest.approx(1) for each in compare(table, table))


# ---- the check -------------------------------------------------------------------------------------------
@pytest.fixture
def kept() -> Table:
    """A table of one machine."""
    table: Table = json.loads(COMMITTED.read_text())
    return table


def with_times(table: Table, factor: float, of: str = "") -> Table:
    """The same with stages so many times as long: of this name, or all."""
    table = copy.deepcopy(table)
    for stage in (stage for section in SECTIONS for row in table[section] for stage in row["stages"]):
        stage["ms"] *= factor if of in stage["stage"] else 1
    return table


def test_a_kernel_twice_as_slow_is_named(kept: Table) -> None:
    found = {each.kernel: each.ratio for each in compare(with_times(kept, 2, "composite backward"), kept)}
    slow = {name for name, ratio in found.items() if ratio == pytest.approx(2)}
    assert slow and all("rasterize composite backward" in name for name in slow)
    assert all(ratio == pytest.approx(1) for name, ratio in found.items() if name not in slow)
