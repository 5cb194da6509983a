"""Line plots over time as plain SVG text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 720, 190  # px
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 26, 24  # margins


@dataclass(frozen=True, slots=True)
class Series:
    """Points (frame, or what else lies across, and value) in order; NaN breaks the line."""

    label: str
    colour: str
    points: Sequence[tuple[float, float]]
    dots: bool = False  # single points, not joined


def line_plot(title: str, series: Sequence[Series], spans: Mapping[str, tuple[int, int]]) -> str:
    """An SVG of several series over the frame number; `spans` are shaded and named.

    Empty text when there is nothing to draw.
    """
    series = [each for each in series if any(math.isfinite(value) for _, value in each.points)]
    if not series:
        return ""
    values = [value for each in series for _, value in each.points if math.isfinite(value)]
    frames = [frame for each in series for frame, _ in each.points]
    scale = _Scale(min(frames), max(frames), *_widened(min(values), max(values)))
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">',
        f'<text x="{LEFT}" y="15" class="title">{escape(title)}</text>',
    ]
    for name, (first, last) in spans.items():
        parts.append(_span(scale, name, first, last))
    for tick in _ticks(scale.low, scale.high):
        y = scale.y(tick)
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" class="value">{tick:g}</text>')
    for tick in _ticks(scale.first, scale.last):
        parts.append(f'<text x="{scale.x(tick):.1f}" y="{HEIGHT - 6}" class="frame">{tick:g}</text>')
    for place, each in enumerate(series):
        parts.append(_drawn(scale, each))
        if len(series) == 1:
            break
        x = WIDTH - RIGHT - 110 * (len(series) - place)
        parts.append(f'<rect x="{x}" y="7" width="10" height="10" fill="{each.colour}"/>')
        parts.append(f'<text x="{x + 14}" y="16" class="label">{escape(each.label)}</text>')
    return "\n".join([*parts, "</svg>"])


@dataclass(frozen=True, slots=True)
class _Scale:
    """Frames and values to pixels."""

    first: float
    last: float
    low: float
    high: float

    def x(self, frame: float) -> float:
        span = max(self.last - self.first, 1)
        return LEFT + (frame - self.first) / span * (WIDTH - LEFT - RIGHT)

    def y(self, value: float) -> float:
        return HEIGHT - BOTTOM - (value - self.low) / (self.high - self.low) * (HEIGHT - TOP - BOTTOM)


def _widened(low: float, high: float) -> tuple[float, float]:
    margin = 0.05 * (high - low) or max(abs(high) * 0.05, 0.5)
    return (max(0.0, low - margin) if low >= 0 else low - margin), high + margin


def _ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round numbers between `low` and `high`: steps of 1, 2 or 5 times a power of ten."""
    raw = (high - low) / about
    if raw <= 0:
        return [low]
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw)
    return [step * index for index in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _span(scale: _Scale, name: str, first: int, last: int) -> str:
    start, end = max(first, scale.first), min(last, scale.last)
    if start > end:
        return ""
    x = scale.x(start)
    return (
        f'<rect x="{x:.1f}" y="{TOP}" width="{scale.x(end) - x:.1f}" height="{HEIGHT - TOP - BOTTOM}"'
        f' class="span"/><text x="{x + 4:.1f}" y="{TOP + 12}" class="label">{escape(name)}</text>'
    )


def _drawn(scale: _Scale, series: Series) -> str:
    known = [(scale.x(frame), scale.y(value), value) for frame, value in series.points]
    if series.dots:
        return "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="{series.colour}"/>'
            for x, y, value in known
            if math.isfinite(value)
        )
    path, pen_down = [], False
    for x, y, value in known:
        if math.isfinite(value):
            path.append(f"{'L' if pen_down else 'M'}{x:.1f} {y:.1f}")
        pen_down = math.isfinite(value)
    return f'<path d="{" ".join(path)}" fill="none" stroke="{series.colour}" stroke-width="1.5"/>'
