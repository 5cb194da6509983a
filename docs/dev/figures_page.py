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
CROWD_ROW = (
    "{phase} | {rate_hz[p50]:.1f} | {latency_p50_ms:.0f} / {latency_p99_ms:.0f} ms "
    "| {rss_mb[start]:.0f} to {rss_mb[end]:.0f} MB, {rss_mb_per_minute:+.1f} MB a minute"
)
HOST_ROW = (
    "{name} | {share_after_first_second:.1%} | {latency_ms[p50]:.0f}, {latency_ms[p99]:.0f} ms "
    "| {online_at_full_size[psnr]:.1f}, {online_at_full_size[motion][psnr]:.1f} | {gaussians[mean]:,.0f}"
)
INPUT_ROW = "{way} | {node_ms:.1f} | {sender_ms:.1f} | {latency_ms_p50:.1f} / {latency_ms_p99:.1f} ms"
RIGHT = {  # results of the right eye with 24,000 Gaussians
    "D4D, 179 frames": "right_d4d[right]", "... its lift, frames 75 to 105": "right_d4d[right][motion]",
    "Hamlyn heart, 100 frames": "right_hamlyn[right]", "phantom, 120 frames": "right_phantom[right]",
}  # fmt: skip
RIGHT_ROW = "{shown[psnr]:.1f} | {shown[warp_psnr]:.1f} | {shown[model_psnr]:.1f} | {shown[copy_psnr]:.1f}"
STEPS = {  # results frame by frame whose depth says how sure it is
    "phantom, exact depth": "phantom_step", "D4D at 60 to 180 mm, depth of a network": "d4d_step",
}  # fmt: skip
DISTURBED_ROW = (
    "`{name}` | {psnr_before:.1f} / {model_psnr_before:.1f} | {psnr_during:.1f} / {model_psnr_during:.1f} "
    "| {psnr_after:.1f} / {model_psnr_after:.1f} | {model_frames_to_recover} | {confident_depth_p90_mm:.1f} "
    "| {restarts} | {warned_after_s:.1f} / {cleared_after_s:.1f} | {anchors_back:.0%} | {anchors_wrong:.0%}"
)
SURE_ROW = (
    "{depth[coverage]:.0%} | {depth_confidence[sure_share]:.0%} | {depth_confidence[sure_p90_mm]:.2f} mm"
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
    if "overlay" in found:
        found["overlay"]["share"] = found["overlay"]["overlay"] / found["overlay"]["frames"]
    return found


def files(name: str) -> list[str]:
    """The results that a name in a table stands for: one, or the three runs `name_1` to `name_3`."""
    turns = [f"{name}_{turn}" for turn in (1, 2, 3)]
    return turns if (RESULTS / f"{turns[0]}.json").exists() else [name]


class Figure:
    """A part of results, found by what stands in brackets behind them, as `str.format` does.

    Of a list: a place, the row in which one of the values is that word, or `*` for all rows. What is asked of
    all rows is written as the range of its values, what is asked of several runs as one value each, or behind
    `*` as their range. `test` is the half of a clip that no constant was chosen on, and all of a clip that
    has none.
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
            least, most = f"{min(values):{how}}", f"{max(values):{how}}"
            return least if least == most else f"{least} to {most}"
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
        "benchmarks/README.md": (_claims(), _live(), _crowd()),
        "benchmarks/depth.md": (_sure(), _predicted()),
        "benchmarks/disturbances.md": (_disturbed("d4d"), _disturbed("phantom")),
        "benchmarks/ladder.md": (_ladder(), _hosts()),
        "benchmarks/mapping.md": (_right(),),
        "docs/how-it-works.md": (_methods(),),
        "docs/inputs.md": (_inputs(),),
    }
    return {ROOT / page: _replaced((ROOT / page).read_text("utf-8"), *new) for page, new in written.items()}


def _replaced(page: str, *tables: str) -> str:
    before, *rests = page.split(BEGIN)
    after = (END + rest.split(END, 1)[1] for rest in rests)
    return before + "".join(BEGIN + new + rest for new, rest in zip(tables, after, strict=True))


def _plain(name: str) -> str:
    """A table of README.md; its first line has the titles."""
    titles, *rows = lines(name)
    return table(titles, list(map(filled, rows)))


def _claims() -> str:
    rows = [
        f"{filled(line)} | {', '.join(f'`{name}`' for name in claimed(line))}" for line in lines("claims.txt")
    ]
    return f"{table(' | this | compared with | run | `results/`', rows)}\n{_origins()}\n"


def _origins() -> str:
    """Of how many revisions results are, and those that are not of the usual machine by name."""
    origins = {file.stem: result(file.stem)["provenance"] for file in sorted(RESULTS.glob("*.json"))}
    found: dict[str, list[str]] = {}
    for name, origin in origins.items():
        found.setdefault(origin["machine"], []).append(f"`{name}`")
    most, *others = sorted(found, key=lambda machine: -len(found[machine]))
    apart = "".join(f" On `{machine}`: {', '.join(found[machine])}." for machine in others)
    revisions = len({origin["revision"] for origin in origins.values()})
    usual = f"{len(found[most])} of them from `{most}`."
    return f"The {len(origins)} files are of {revisions} revisions, {usual}{apart}"


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


def _crowd() -> str:
    titles = " | updates / s | latency p50 / p99 | memory, start to end"
    return table(titles, [CROWD_ROW.format(**phase) for phase in result("crowd")["phases"]])


def _hosts() -> str:
    titles = " | frames after the first second | latency p50, p99 | dB at full size, all, lift | Gaussians"
    return table(titles, [HOST_ROW.format(**host) for host in result("hosts")["sessions"][0]["hosts"]])


def _disturbed(clip: str) -> str:
    titles = " shown / model, dB | before | during | after | recovers, frames | sure depth, mm | restarts"
    rows = [
        DISTURBED_ROW.format(**{what: Figure([found]) for what, found in row.items()})
        for row in result(f"disturbances_{clip}")["rows"]
    ]
    return table(f"{titles} | warned / cleared, s | anchors back | wrong", rows)


def _inputs() -> str:
    titles = " | node, CPU ms a pair | sender, CPU ms a pair | stamp to mapper, p50 / p99"
    return table(titles, [INPUT_ROW.format(**way) for way in result("inputs")["rows"]])


def _sure() -> str:
    steps = {what: result(file) for what, file in STEPS.items()}
    rows = [f"{what} | {SURE_ROW.format(**found)}" for what, found in steps.items()]
    titles = " one step a frame, 640x512 (`results/*_step.json`) | stated | sure (confidence from 0.5 on)"
    return table(f"{titles} | real error of those, p90", rows)


def _predicted() -> str:
    """For each group of predicted errors, what nine of ten real ones stay below, mm."""
    steps = {what: result(file)["depth_confidence"]["by_predicted_mm"] for what, file in STEPS.items()}
    real = {what: [Figure([group["p90_mm"]]) for group in found.values()] for what, found in steps.items()}
    rows = [" | ".join([what, *(f"{each:.2f}" for each in found)]) for what, found in real.items()]
    return table(" | ".join([" predicted", *next(iter(steps.values()))]), rows)


def _right() -> str:
    rows = [f"{what} | " + filled(RIGHT_ROW.replace("shown", key)) for what, key in RIGHT.items()]
    return table(" dB | shown | the warp | the model alone | the right image before, again", rows)


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
