"""`benchmarks endurance` and what `soak --check` finds: orders of frames, slopes, and what gets worse."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from command_line import refused
from places import SESSION

from benchmarks.__main__ import main
from benchmarks.node import endurance
from benchmarks.node.endurance import Window, measure_endurance, slope
from benchmarks.node.soak import worsening
from sags_node.errors import SagsError
from sags_node.pipeline.session import open_session

QUIET = Window(0, 25.0, 30.0, 45.0, 35.0, 30_000, 500, 400.0, 0, 0, 0)


# ---- the order of frames ---------------------------------------------------------------------------------


def visits(count: int, order: Any, length: int, seed: int = 0) -> list[int]:
    return list(itertools.islice(endurance.visits(count, order, seed), length))


@pytest.mark.parametrize(
    ("order", "count", "numbers"),
    [
        ("there-and-back", 4, [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0]),  # none twice in a row, no jump
        ("there-and-back", 2, [0, 1, 0, 1]),
        ("wrap", 3, [0, 1, 2, 0, 1, 2, 0]),
        *((order, 1, [0] * 5) for order in ("there-and-back", "wrap", "walk")),  # a single one is enough
    ],
)
def test_frames_come_in_the_order_that_was_asked_for(order: Any, count: int, numbers: list[int]) -> None:
    assert visits(count, order, len(numbers)) == numbers


def test_a_walk_goes_by_single_frames_to_all_of_them_and_never_the_same_way_again() -> None:
    walk = visits(40, "walk", 4000)
    assert set(np.abs(np.diff(walk))) == {1} and set(walk) == set(range(40))
    assert walk == visits(40, "walk", 4000) != visits(40, "walk", 4000, seed=1)
    stretches = {tuple(walk[i : i + 200]) for i in range(0, 4000, 200)}
    assert len(stretches) == 20


# ---- slopes ----------------------------------------------------------------------------------------------


def windows(rss: list[float]) -> list[Window]:
    return [replace(QUIET, frames=500 * (i + 1), rss_mb=value) for i, value in enumerate(rss)]


def test_a_slope_is_that_of_the_line_and_the_first_window_does_not_count() -> None:
    found = slope(windows([0.0, 400, 401, 402, 403]), "rss_mb")
    assert found["slope"] == pytest.approx(2.0) and found["standard_error"] == pytest.approx(0, abs=1e-9)
    assert slope(windows([0.0, 400, 401]), "rss_mb") is None


def test_the_standard_error_covers_scatter() -> None:
    """Of many series without a trend, the slope is beyond 2 standard errors as seldom as theory says."""
    rng = np.random.default_rng(0)
    beyond = 0
    for _ in range(400):
        found = slope(windows(list(rng.normal(400, 1, 21))), "rss_mb")
        beyond += abs(found["slope"]) > 2 * found["standard_error"]
    assert 8 <= beyond <= 40  # 6 % of 400 for 18 degrees of freedom


# ---- the run ---------------------------------------------------------------------------------------------


def test_ctrl_c_keeps_what_is_known_so_far() -> None:
    def stop(done: int, total: int, what: str) -> None:
        if done == 25:
            raise KeyboardInterrupt

    small = ["source.pace:=step", "mapping.max_gaussians:=2000", "mapping.iterations:=1"]
    found = measure_endurance(open_session(SESSION, small), 1000, 10, "walk", stop)
    assert found["interrupted"] and [window["frames"] for window in found["windows"]] == [10, 20]
    assert found["still"] is None


@pytest.mark.fault("memory: a recording does not fit")
def test_a_recording_that_does_not_fit_into_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endurance, "MOST_BYTES", 2_000_000)
    refused(1, "endurance", SESSION, "--frames", 5, said=("source.frames:=",), command=main)


# ---- when `python -m benchmarks soak --check` fails ----------------------------------------------------


HOURLY = 108.0  # thousands of frames


def soak(figure: str, mean: float, hourly: float, error: float) -> dict[str, Any]:
    trend = {"slope": hourly / HOURLY, "standard_error": error / HOURLY}
    return {"windows": [{figure: mean}] * 5, "per_1000_frames": {figure: trend}}


@pytest.mark.parametrize(
    ("figure", "mean", "hourly", "error", "fails"),
    [
        ("rss_mb", 400.0, 50.0, 10.0, True),
        ("rss_mb", 400.0, 50.0, 20.0, False),  # within its scatter
        ("rss_mb", 400.0, 30.0, 1.0, False),  # less than a tenth
        ("rss_mb", 400.0, -50.0, 1.0, False),
        ("psnr", 32.0, -4.0, 1.0, True),
        ("psnr", 32.0, 4.0, 1.0, False),
        ("descriptors", 40.0, 5.0, 0.0, True),
    ],
)
def test_what_gets_worse_beyond_its_scatter_fails(
    figure: str, mean: float, hourly: float, error: float, fails: bool
) -> None:
    assert worsening(soak(figure, mean, hourly, error)) == ([figure] if fails else [])


def test_too_few_windows_are_no_pass() -> None:
    with pytest.raises(SagsError, match="too few windows"):
        worsening({"windows": [], "per_1000_frames": {"rss_mb": None}})
