"""When `python -m benchmarks soak --check` fails."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.node.soak import worsening
from sags_node.errors import SagsError

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
