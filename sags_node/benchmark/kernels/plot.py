"""Stacked bars of stage times as an SVG file that stands alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

WIDTH, LEFT, RIGHT = 860, 190, 80  # px
BAR, GAP, HEAD, LEGEND_ROW = 20, 8, 36, 18
PER_LEGEND_ROW = 5
COLOURS = (
    "#2166ac",
    "#67a9cf",
    "#1b7837",
    "#a6dba0",
    "#b2182b",
    "#ef8a62",
    "#7b3294",
    "#c2a5cf",
    "#8c510a",
    "#dfc27d",
)

Bar = tuple[str, Mapping[str, float]]  # label, stage -> ms
Chart = tuple[str, Sequence[Bar]]  # title, bars


def stacked_bars(charts: Sequence[Chart]) -> str:
    """Charts one below the other, on one scale. A bar is divided into its stages and ends with its total."""
    longest = max(sum(times.values()) for _, bars in charts for _, times in bars)
    per_ms = (WIDTH - LEFT - RIGHT) / longest
    parts, y = [], 0
    for title, bars in charts:
        drawn, height = _chart(title, bars, per_ms)
        parts.append(f'<g transform="translate(0 {y})">{drawn}</g>')
        y += height
    style = "text { font: 12px system-ui, sans-serif; fill: #333 } .title { font-weight: 600 }"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y}" role="img">'
    background = f'<style>{style}</style><rect width="{WIDTH}" height="{y}" fill="#fff"/>'
    return "\n".join([head, background, *parts, "</svg>\n"])


def _chart(title: str, bars: Sequence[Bar], per_ms: float) -> tuple[str, int]:
    """What is drawn, and its height."""
    stages = list(dict.fromkeys(stage for _, times in bars for stage in times))
    colours = {stage: COLOURS[place % len(COLOURS)] for place, stage in enumerate(stages)}
    parts = [f'<text x="{GAP}" y="22" class="title">{escape(title)}</text>']
    y = HEAD
    for label, times in bars:
        parts.append(f'<text x="{LEFT - 8}" y="{y + 14}" text-anchor="end">{escape(label)}</text>')
        x = float(LEFT)
        for stage, ms in times.items():
            parts.append(_block(x, y, ms * per_ms, BAR, colours[stage], f"{stage}: {ms:.2f} ms"))
            x += ms * per_ms
        parts.append(f'<text x="{x + 6:.1f}" y="{y + 14}">{sum(times.values()):.1f} ms</text>')
        y += BAR + GAP
    for place, stage in enumerate(stages):
        x = GAP + place % PER_LEGEND_ROW * (WIDTH - GAP) / PER_LEGEND_ROW
        row = y + place // PER_LEGEND_ROW * LEGEND_ROW
        parts.append(_block(x, row, 10, 10, colours[stage], stage))
        parts.append(f'<text x="{x + 14:.1f}" y="{row + 10}">{escape(stage)}</text>')
    legend_rows = -(-len(stages) // PER_LEGEND_ROW)
    return "\n".join(parts), y + legend_rows * LEGEND_ROW + GAP


def _block(x: float, y: float, width: float, height: float, colour: str, title: str) -> str:
    shape = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height}" fill="{colour}"'
    return f"<rect {shape}><title>{escape(title)}</title></rect>"
