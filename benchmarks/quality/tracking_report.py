"""The tables of `python -m benchmarks tracking`."""

from typing import Any

from rich.table import Table

from benchmarks.quality.tracking import RIGHT, RIGHT_MM
from benchmarks.tables import filled
from sags_lab.protocols.point_tracks import Bin


def tables(measured: dict[str, Any]) -> list[Table]:
    """Make the tables; `measured` as `measure_tracking` returns it."""
    return [_by_frame(measured), _by_method(measured), *reliability_tables(measured)]


def _by_frame(measured: dict[str, Any]) -> Table:
    made = Table(
        "frame", "motion p50, p90, px", "anchors", "off by, px", "Gaussians", "off by, px",
        title=f"{measured['session']}, against the {measured['truth']} truth; Gaussians against direct flow",
    )  # fmt: skip
    for row in measured["frames"]:
        motion, anchors, gaussians = (_two(row[f"{what}_px"]) for what in ("motion", "anchors", "gaussians"))
        filled(made, [row], "{frame}", motion, "{anchors}", anchors, "{gaussians}", gaussians)
    return made


def _by_method(measured: dict[str, Any]) -> Table:
    thresholds = [key for key in measured["methods"]["anchors"]["within"] if key != "average"]
    made = Table(
        "", "off by p50, p90, px", *(f"<= {key.removeprefix('within_')} px" for key in thresholds),
        "sure", "sure and wrong", "average Jaccard", "us a point",
        title=f"{measured['points_beside']} points in {len(measured['frames'])} frames",
    )  # fmt: skip
    cells = [f"{{within[{key}]:.1%}}" for key in thresholds]
    cells += ["{sure:.1%}", "{wrong:.1%}", "{average_jaccard:.3f}", "{us_per_point:.0f}"]
    for name, row in measured["methods"].items():
        filled(made, [row], name.replace("_", " "), _two(row["off_by_px"]), *cells)
    return made


def reliability_tables(measured: dict[str, Any]) -> list[Table]:
    """Make the tables of how often anchors of each confidence are right, as far as `measured` has them."""
    limits = {"reliability_px": f"{RIGHT * 640:g} px of 640", "reliability_mm": f"{RIGHT_MM:g} mm"}
    return [_reliability(measured[key], limit) for key, limit in limits.items() if key in measured]


def _reliability(found: dict[str, Any], limit: str) -> Table:
    made = Table(
        "confidence", "anchors", "said", "right", "in sight", "right", "out of sight", "right",
        title=f"right is within {limit}; confidence is off by {found['error']:.3f} in the mean",
    )  # fmt: skip
    parts = [
        {row["least"]: (str(row["count"]), f"{row['right']:.2f}") for row in found[part]}
        for part in ("in_sight", "out_of_sight")
    ]
    for each in (Bin(**row) for row in found["bins"]):
        split = [cell for part in parts for cell in part.get(each.least, ("0", "-"))]
        said, right = f"{each.said:.2f}", f"{each.right:.2f}"
        made.add_row(f"{each.least:g} to {each.most:g}", str(each.count), said, right, *split)
    return made


def _two(figures: dict[str, float] | None) -> str:
    return "-" if figures is None else f"{figures['p50']:.2f}, {figures['p90']:.2f}"
