"""Writes the tables of figures in README.md and other pages from benchmarks/results: `make docs`.

A table stands between two comments. `why.txt`, `headline.txt` and `claims.txt` name the figures of theirs.
A result that is not there ends with its name.
"""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

from sags_node.mapping.ladder import FULL, RUNGS, USED, price

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
RESULTS = ROOT / "benchmarks/results"
BEGIN, END = "<!-- Written by `make docs` from benchmarks/results -->\n", "<!-- end -->"
METHODS = {  # results of `python -m benchmarks methods`
    "phantom": "phantom, 90 frames", "d4d": "D4D, the lift, 60 frames", "hamlyn": "Hamlyn heart, 100 frames",
    "pulling": "pulling, 63 frames, left eye",
}  # fmt: skip
LIVE = {
    "D4D, 30 Hz": "d4d_realtime", "phantom, seeds 1 to 3, 30 Hz": "phantom_realtime",
    "Hamlyn heart, 25 Hz": "hamlyn_realtime",
}  # fmt: skip
LIVE_ROW = (
    "{share:.1%} | {latency_ms[p50]:.0f}; {latency_ms[p99]:.0f} | {gaussians[mean]:.0f} "
    "| {shown[test][psnr]:.1f} | {predict[test][copy_psnr]:.1f} | {depth[test][median_mm]:.2f}"
)
LADDER_ROW = (
    "{d4d[frame_ms][p50]:.1f} | {d4d[cpu_ms][p50]:.0f} | {d4d[gaussians][mean]:,.0f} "
    "| {d4d[predict][psnr]:.1f} | {d4d[predict][model_psnr]:.1f} | {d4d[online][psnr]:.1f} "
    "| {d4d[novel][psnr]:.1f} | {d4d[depth][median_mm]:.2f} | {phantom[frame_ms][p50]:.1f} "
    "| {phantom[predict][psnr]:.1f} | {phantom[predict][model_psnr]:.1f} | {phantom[online][psnr]:.1f} "
    "| {phantom[depth][median_mm]:.3f} | {phantom[track][median_mm]:.3f}"
)
METHOD_ROW = (
    "{width}x{height} `{method}` | {live[rate_hz]:.1f} Hz, {live[latency_ms][p50]:.0f} / "
    "{live[latency_ms][p99]:.0f} ms | {live[psnr]:.1f} dB | {step[online]:.1f} dB | {step[predict]:.1f} dB "
    "| {step[heldout]:.1f} dB"
)


@cache
def result(file: str) -> dict[str, Any]:
    """A committed result. FileNotFoundError: there is none of that name."""
    found: dict[str, Any] = json.loads((RESULTS / f"{file}.json").read_text(encoding="utf-8"))
    if "processed" in found:
        found["share"] = found["processed"] / found["frames"]
    return found


def files(name: str) -> list[str]:
    """The results that a name in a table stands for: one, or the three runs `name_1` to `name_3`."""
    turns = [f"{name}_{turn}" for turn in (1, 2, 3)]
    return turns if (RESULTS / f"{turns[0]}.json").exists() else [name]


class Figure:
    """A part of results, found by what stands in brackets behind them, as `str.format` does.

    Of a list: a place, the row in which one of the values is that word, or `*` for all rows. What is asked of
    all rows is written as the range of its values, what is asked of several runs as one value each, or behind
    `*` as their range. `test`
    is the half of a clip that no constant was chosen on, and all of a clip that has none.
    """

    def __init__(self, runs: list[Any], rows: bool = False) -> None:
        self._runs = runs
        self._rows = rows

    def __getitem__(self, key: str | int) -> Figure:
        if key == "*":
            (first, *others) = self._runs
            return Figure(self._runs if others else first, rows=True)
        return Figure([_part(run, key) for run in self._runs], self._rows)

    def __format__(self, how: str) -> str:
        if self._rows:
            values = [value for value in self._runs if value is not None]
            return f"{min(values):{how}} to {max(values):{how}}"
        return ", ".join("-" if value is None else f"{value:{how}}" for value in self._runs)


def _part(found: Any, key: str | int) -> Any:
    if isinstance(found, list) and isinstance(key, str):
        return next(row for row in found if key in (v for v in row.values() if isinstance(v, str)))
    if key == "test" and (found is None or not found.get(key)):
        return found
    return None if found is None else found[key]


def claimed(line: str) -> list[str]:
    """The results that a line takes its figures from."""
    return list(dict.fromkeys(file for name in re.findall(r"\{(\w+)", line) for file in files(name)))


def lines(name: str) -> list[str]:
    """Of one of the `.txt`, without comments."""
    text = (HERE / name).read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def filled(line: str) -> str:
    names = set(re.findall(r"\{(\w+)", line))
    return line.format(**{name: Figure(list(map(result, files(name)))) for name in names})


def table(titles: str, rows: list[str]) -> str:
    """A table in Markdown; a title or a row: its cells, with `|` between."""
    rule = "|---" * (titles.count("|") + 1)
    return f"|{titles} |\n{rule}|\n" + "".join(f"| {row} |\n" for row in rows)


def pages() -> dict[Path, str]:
    """What each page should be."""
    written = {
        "README.md": (_plain("why.txt"), _plain("headline.txt")),
        "benchmarks/README.md": (_claims(), _live()),
        "benchmarks/ladder.md": (_ladder(),),
        "docs/how-it-works.md": (_methods(),),
    }
    return {ROOT / page: _replaced((ROOT / page).read_text("utf-8"), *new) for page, new in written.items()}


def _replaced(page: str, *tables: str) -> str:
    before, *rests = page.split(BEGIN)
    after = (END + rest.split(END, 1)[1] for rest in rests)
    return before + "".join(BEGIN + new + rest for new, rest in zip(tables, after, strict=True))


def _plain(name: str) -> str:
    """A table of README.md."""
    return table(" | the model | compared with", list(map(filled, lines(name))))


def _claims() -> str:
    rows = [
        f"{filled(line)} | {', '.join(f'`{name}`' for name in claimed(line))}" for line in lines("claims.txt")
    ]
    origins = f"{_origin('revision')} {_origin('machine')}"
    return f"{table(' | this | compared with | run | `results/`', rows)}\n{origins}\n"


def _origin(key: str) -> str:
    """What most results are of by this key of their provenance, and those of another one by name."""
    found: dict[str, list[str]] = {}
    for file in sorted(RESULTS.glob("*.json")):
        found.setdefault(result(file.stem)["provenance"][key], []).append(f"`{file.stem}`")
    most, *others = sorted(found, key=lambda value: -len(found[value]))
    apart = "".join(f" Of `{value}`: {', '.join(found[value])}." for value in others)
    return f"{len(found[most])} of {sum(map(len, found.values()))} files are of {key} `{most}`.{apart}"


def _live() -> str:
    rows = [
        f"{clip} | " + filled(re.sub(r"\{(\w+)", rf"{{{name}[\1]", LIVE_ROW)) for clip, name in LIVE.items()
    ]
    titles = " three runs each | frames shown | latency p50; p99, ms | Gaussians | the frame as shown, dB"
    return table(f"{titles} | the image before, dB | depth, median, mm", rows)


def _ladder() -> str:
    """Every rung on D4D and on the phantom, whose depth and points are known exactly."""
    d4d, phantom = (Figure([session["settings"]]) for session in result("ladder")["sessions"])
    rows = [
        f"{place} | {rung.gaussians:,} | {rung.scale:g} | {rung.depth_every:g} | {rung.redraw:g} "
        f"| {price(rung, USED * rung.gaussians, FULL):.1f} | "
        + LADDER_ROW.format(d4d=d4d[f"rung {place}"], phantom=phantom[f"rung {place}"])
        for place, rung in enumerate(RUNGS)
    ]
    titles = (
        " rung | Gaussians | size | depth every | redrawn | price, ms | frame, ms | CPU, ms "
        "| Gaussians there were | next frame as shown, dB | by the model | the frame by the model "
        "| right eye by the model | depth, mm | phantom: frame, ms | next frame as shown, dB | by the model "
        "| the frame by the model | depth, mm | points, mm"
    )
    return table(titles, rows)


def _methods() -> str:
    """Control nodes and the paper's field, side by side."""
    rows = []
    for clip, name in METHODS.items():
        rows.append(f"{name}:" + " |" * 8)
        for row in result(f"methods_{clip}")["rows"]:
            known = (
                f"{row['step'][key]:.2f} {unit}" if key in row["step"] else ""
                for key, unit in (("depth", "mm"), ("track", "px"))
            )
            rows.append(f"{METHOD_ROW.format(**row)} | {' | '.join(known)} | {row['step']['window']:.1f} dB")
    return table(
        " | live rate, p50 / p99 | live | newest | next frame | held out | depth | points | `window`", rows
    )


if __name__ == "__main__":
    for page, text in pages().items():
        page.write_text(text, encoding="utf-8")
