"""Writes the tables of figures that stand in README.md and other pages from benchmarks/results: `make docs`.

A table stands between two comments. What is asked of a file that is not there ends with its name.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from claims_page import result, table

from sags_node.mapping.ladder import FULL, RUNGS, USED, price

ROOT = Path(__file__).parents[2]
BEGIN, END = "<!-- Written by `make docs` from benchmarks/results -->\n", "<!-- end -->"
TURNS = (1, 2, 3)  # runs of each clip, in turns with the others
METHODS = {  # results of `python -m benchmarks methods`
    "phantom": "phantom, 90 frames", "d4d": "D4D, the lift, 60 frames", "hamlyn": "Hamlyn heart, 100 frames",
    "pulling": "pulling, 63 frames, left eye",
}  # fmt: skip
CLIPS = {"d4d": "D4D, 30 Hz", "phantom": "phantom, seeds 1 to 3, 30 Hz", "hamlyn": "Hamlyn heart, 25 Hz"}


def replaced(page: str, *tables: str) -> str:
    """A page with its tables written anew."""
    before, *rests = page.split(BEGIN)
    after = (END + rest.split(END, 1)[1] for rest in rests)
    return before + "".join(BEGIN + table + rest for table, rest in zip(tables, after, strict=True))


def pages() -> dict[Path, str]:
    """What each page should be."""
    tables = {
        "README.md": (_headline(),),
        "benchmarks/README.md": (table(), _live()),
        "benchmarks/ladder.md": (_ladder(),),
        "docs/how-it-works.md": (_methods(),),
    }
    return {
        ROOT / page: replaced((ROOT / page).read_text(encoding="utf-8"), *written)
        for page, written in tables.items()
    }


def _each(clip: str, value: Callable[[dict[str, Any]], float | None], digits: int = 1) -> str:
    """A value of each of the three runs."""
    values = [value(result(f"{clip}_realtime_{turn}")) for turn in TURNS]
    return ", ".join("-" if each is None else f"{each:.{digits}f}" for each in values)


def _shown(run: dict[str, Any]) -> float:
    return 100 * float(run["processed"]) / float(run["frames"])


def _test_part(group: dict[str, Any]) -> dict[str, Any]:
    """Of a clip that constants were chosen on, the half that they were not; else all of it."""
    found: dict[str, Any] = group.get("test") or group
    return found


def _live() -> str:
    rows = [
        "| three runs each | frames shown, % | latency p50; p99, ms | Gaussians, thousands | dB "
        "| the picture before, dB | depth, median, mm |\n|---|---|---|---|---|---|---|\n"
    ]
    for clip, name in CLIPS.items():
        cells = (
            name,
            _each(clip, _shown),
            f"{_each(clip, lambda run: run['latency_ms']['p50'], 0)}; "
            f"{_each(clip, lambda run: run['latency_ms']['p99'], 0)}",
            _each(clip, lambda run: run["gaussians"]["mean"] / 1e3),
            _each(clip, lambda run: _test_part(run["online"])["psnr"]),
            _each(clip, lambda run: _test_part(run["predict"])["copy_psnr"]),
            _each(clip, lambda run: _test_part(run["depth"])["median_mm"] if run["depth"] else None, 2),
        )
        rows.append(f"| {' | '.join(cells)} |\n")
    return "".join(rows)


def _ladder() -> str:
    """Every rung on D4D and on the phantom, whose depth and points are known exactly."""
    d4d, phantom = result("ladder")["sessions"]
    runs = [
        {row["name"]: row for row in session["settings"] if row["part"] == "rungs"}
        for session in (d4d, phantom)
    ]
    rows = [
        "| rung | Gaussians | size | depth every | redrawn | price, ms | frame, ms | CPU, ms "
        "| Gaussians there were | online, dB | predict | right eye | depth, mm "
        "| phantom: frame, ms | online, dB | depth, mm | points, mm |\n" + "|---" * 17 + "|\n"
    ]
    for place, rung in enumerate(RUNGS):
        real, exact = (run[f"rung {place}"] for run in runs)
        cells = (
            f"{place}",
            f"{rung.gaussians:,}",
            *(f"{value:g}" for value in (rung.scale, rung.depth_every, rung.redraw)),
            f"{price(rung, USED * rung.gaussians, FULL):.1f}",
            f"{real['frame_ms']['p50']:.1f}",
            f"{real['cpu_ms']['p50']:.0f}",
            f"{real['gaussians']['mean']:,.0f}",
            *(f"{real[group]['psnr']:.1f}" for group in ("online", "predict", "novel")),
            f"{real['depth']['median_mm']:.2f}",
            f"{exact['frame_ms']['p50']:.1f}",
            f"{exact['online']['psnr']:.1f}",
            *(f"{exact[group]['median_mm']:.3f}" for group in ("depth", "track")),
        )
        rows.append(f"| {' | '.join(cells)} |\n")
    return "".join(rows)


def _methods() -> str:
    """Control nodes and the paper's field, side by side."""
    rows = [
        "| | live rate, p50 / p99 | live | newest | next frame | held out | depth | points | `window` |\n"
        + "|---" * 9
        + "|\n"
    ]
    for clip, name in METHODS.items():
        rows.append(f"| {name}: | | | | | | | | |\n")
        for row in result(f"methods_{clip}")["rows"]:
            live, step = row["live"], row["step"]
            late = live["latency_ms"]
            cells = (
                f"{row['width']}x{row['height']} `{row['method']}`",
                f"{live['rate_hz']:.1f} Hz, {late['p50']:.0f} / {late['p99']:.0f} ms",
                f"{live['psnr']:.1f} dB",
                *(f"{step[key]:.1f} dB" for key in ("online", "predict", "heldout")),
                f"{step['depth']:.2f} mm" if "depth" in step else "",
                f"{step['track']:.2f} px" if "track" in step else "",
                f"{step['window']:.1f} dB",
            )
            rows.append(f"| {' | '.join(cells)} |\n")
    return "".join(rows)


def _headline() -> str:
    """Of README.md: live as it came, then frame by frame, which repeats."""
    step, seen = result("d4d_step"), _test_part(result("d4d_realtime_1")["predict"])
    groups = (_test_part(step[key]) for key in ("online", "heldout", "predict", "depth", "measured_depth"))
    online, kept, before, depth, stereo = groups
    lift = {key: step[key]["motion"] for key in ("online", "heldout", "predict")}
    views = {
        key: ", ".join(
            f"{result(f'detail_{clip}_rung0')['predict'][key]:.1f}" for clip in ("d4d", "phantom", "heart")
        )
        for key in ("psnr", "copy_psnr", "model_psnr")
    }
    rows = (
        (
            "three live runs: frames shown; latency p50; p99",
            f"{_each('d4d', _shown)} %; {_each('d4d', lambda run: run['latency_ms']['p50'], 0)}; "
            f"{_each('d4d', lambda run: run['latency_ms']['p99'], 0)} ms",
            "the camera's 30 Hz; 33 ms a frame",
        ),
        (
            "the next frame, as views show it, lowest rung: D4D to the lift, phantom, heart",
            f"{views['psnr']} dB",
            f"the picture before: {views['copy_psnr']}; the model alone: {views['model_psnr']} dB",
        ),
        (
            f"model alone, {_each('d4d', lambda run: run['gaussians']['mean'] / 1e3, 0)} thousand Gaussians",
            f"{_each('d4d', lambda run: _test_part(run['online'])['psnr'])} dB",
            f"the picture before, shown again: {seen['copy_psnr']:.1f} dB",
        ),
        (
            f"frame by frame, {step['gaussians']['mean'] / 1e3:.0f} thousand: model alone; the whole lift",
            f"{online['psnr']:.1f}; {lift['online']['psnr']:.1f} dB",
            f"the picture before: {before['copy_psnr']:.1f}; {lift['predict']['copy_psnr']:.1f} dB",
        ),
        (
            "frames kept back; the whole lift",
            f"{kept['psnr']:.1f}; {lift['heldout']['psnr']:.1f} dB",
            f"the picture before: {kept['copy_psnr']:.1f}; {lift['heldout']['copy_psnr']:.1f} dB",
        ),
        (
            "depth, median and nine of ten",
            f"{depth['median_mm']:.2f}, {depth['p90_mm']:.2f} mm, on {100 * depth['coverage']:.0f} % "
            "of the tissue",
            f"stereo alone: {stereo['median_mm']:.2f}, {stereo['p90_mm']:.2f} mm, on "
            f"{100 * stereo['coverage']:.0f} %; both against a stereo network",
        ),
        (
            "phantom, three seeds, live: depth, median",
            f"{_each('phantom', lambda run: run['depth']['median_mm'], 2)} mm",
            "exact truth",
        ),
    )
    body = "".join(f"| {' | '.join(row)} |\n" for row in rows)
    return f"| D4D, second half | model | compared with |\n|---|---|---|\n{body}"


def main() -> None:
    for page, text in pages().items():
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
