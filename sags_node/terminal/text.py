"""The results of `sags topic` and `sags overlay` as text. Programs get the same records as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.table import Table

if TYPE_CHECKING:
    from sags_node.types import RungState

Record = Mapping[str, Any]


def table(*headings: str) -> Table:
    """An empty table without lines, flush with the left margin."""
    made = Table(box=None, padding=(0, 3, 0, 0), pad_edge=False, show_header=bool(headings))
    for heading in headings:
        made.add_column(heading)
    return made


def rows_table(rows: Sequence[Record]) -> Table:
    """The table of records that share their keys, which become the headings."""
    made = table(*(rows[0] if rows else ()))
    for row in rows:
        made.add_row(*(str(value) for value in row.values()))
    return made


def findings_table(rows: Sequence[Record]) -> Table:
    """The table of the results of checks, without the keys that are for programs."""
    return rows_table([{k: row[k] for k in row if k not in ("figures", "launch")} for row in rows])


def topics_table(rows: Sequence[Record]) -> Table:
    """The table of `topic_list`; a dash where nothing was heard, or too little to tell a rate."""
    made = table("topic", "type")
    made.add_column("rate", justify="right")
    made.add_column("message", justify="right")
    for row in rows:
        rate = "–" if row["rate_hz"] is None else f"{row['rate_hz']:.1f} Hz"
        message = byte_text(row["mean_bytes"]) if row["messages"] else "–"
        made.add_row(row["topic"], row["type"], rate, message)
    return made


def hz_text(figures: Record) -> str:
    frozen = f"freezes: {figures['freezes']}, {figures['frozen_s']:.2f} s in all"
    frozen += f", still: {figures['silent']}" if "silent" in figures else ""
    return f"average rate: {figures['average_rate']:.3f} Hz\n  {_spread(figures)}\n  {frozen}"


def delay_text(figures: Record) -> str:
    lines = [f"average delay: {_ms(figures['average_delay_s'])}", f"  {_spread(figures)}"]
    if figures["clock_offset_s"] is not None:
        ahead, bound = _ms(figures["clock_offset_s"]), _ms(figures["clock_bound_s"])
        lines.append(f"  the node's clock is {ahead} ahead, to within {bound}")
    return "\n".join(lines)


def bw_text(figures: Record) -> str:
    mean, smallest, largest = (byte_text(figures[f"{which}_bytes"]) for which in ("mean", "min", "max"))
    return (
        f"{byte_text(figures['bytes_per_s'])}/s from {figures['window']} messages\n"
        f"  message size mean: {mean}  min: {smallest}  max: {largest}"
    )


def yaml_text(value: Any, short_lines: bool = True) -> str:
    """A value as YAML, without the end marker `...`."""
    import yaml  # only here: all commands load this file

    flow = False if short_lines else None  # None: lists and mappings without nested parts stand in one line
    said: str = yaml.safe_dump(value, sort_keys=False, default_flow_style=flow, width=100)
    return said.removesuffix("...\n").rstrip()


def echo_text(record: Any) -> str:
    """One message, or a part of one, as YAML, ended by a line of dashes."""
    return f"{yaml_text(_short(record), short_lines=False)}\n---"


def overlay_table(summary: Record) -> Table:
    made = table()
    made.add_row("frames", f"{summary['frames']}, {summary['overlay']} with the overlay")
    for reason, count in summary["blanked"].items():
        made.add_row("", f"{count} without: {reason}")
    for key, name in (("latency_ms", "latency"), ("draw_ms", "drawing")):
        figures = [f"{which} {value:.0f} ms" for which, value in summary[key].items() if value is not None]
        made.add_row(name, "  ".join(figures) or "–")
    for thing in summary["objects"]:
        anchors = ", ".join(str(anchor["id"]) for anchor in thing["anchors"])
        held = f"held by anchor {anchors}" if anchors else "not held"
        anew = f", {thing['pinned'] - 1} times anew" if thing["pinned"] > 1 else ""
        why = thing["reason"] or (f"unsure: {thing['unsure']}" if thing["unsure"] else "")
        made.add_row(thing["name"], held + anew + (f"; {why}" if why else ""))
    made.add_row("lost", f"{summary['lost']} messages")
    if summary["saved"] is not None:
        made.add_row("saved", summary["saved"])
    return made


def rung_text(rung: RungState) -> str:
    """The ladder's rung in one line."""
    depth = "every frame" if rung.depth_every == 1 else f"one frame in {rung.depth_every}"
    return (
        f"rung {rung.number} of 0 to {rung.of - 1}: up to {rung.gaussians:,} Gaussians, "
        f"drawn at {rung.scale:g} of the size, depth in {depth} ({rung.reason})"
    )


def byte_text(count: float) -> str:
    """Bytes in decimal units, three digits: 328 kB."""
    for unit in ("B", "kB", "MB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"


def _spread(figures: Record) -> str:
    smallest, largest, deviation = (_ms(figures[f"{which}_s"]) for which in ("min", "max", "std_dev"))
    return f"min: {smallest}  max: {largest}  std dev: {deviation}  window: {figures['window']} messages"


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.1f} ms"


def _short(value: Any) -> Any:
    """The value with its numbers rounded to six significant digits."""
    if isinstance(value, Mapping):
        return {key: _short(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_short(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
