"""Picture quality over run time as a PNG: a panel for each recording."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from sags_node.types import U8

WIDTH, HEIGHT = 1100, 520  # px of a panel
LEFT, RIGHT, TOP, BOTTOM = 80, 130, 60, 60  # margins; labels stand right of their points
FONT, SMALL, LARGE = cv2.FONT_HERSHEY_SIMPLEX, 0.42, 0.55
BLACK, GREY, PALE, WHITE = (30, 30, 30), (130, 130, 130), (225, 225, 225), (255, 255, 255)
COLOURS = {  # RGB
    "default": BLACK,
    "budgets": (33, 102, 172),
    "resolutions": (178, 24, 43),
    "gaussians": (27, 120, 55),
    "rungs": (153, 79, 161),
    "hosts": (230, 97, 1),
}
TICKS_MS = (5, 10, 15, 20, 25, 30, 40, 50, 75, 100, 150, 200, 300, 500, 1000)

Row = Mapping[str, Any]
Pixel = tuple[int, int]
Box = tuple[int, int, int, int]  # left, top, right, bottom


def picture(measured: Row) -> bytes:
    """PNG of `measured` as `measure_pareto` returns it."""
    panels = np.vstack([_panel(session) for session in measured["sessions"]])
    return cv2.imencode(".png", panels[..., ::-1])[1].tobytes()


class _Axes:
    """Milliseconds (logarithmic) and decibels to pixels."""

    def __init__(self, times: Sequence[float], decibels: Sequence[float]) -> None:
        self.times = 0.9 * min(times), 1.1 * max(times)
        margin = max(0.25, 0.08 * (max(decibels) - min(decibels)))
        self.decibels = min(decibels) - margin, max(decibels) + margin

    def __call__(self, ms: float, psnr: float) -> Pixel:
        x = math.log(ms / self.times[0]) / math.log(self.times[1] / self.times[0])
        y = (psnr - self.decibels[0]) / (self.decibels[1] - self.decibels[0])
        return round(LEFT + x * (WIDTH - LEFT - RIGHT)), round(HEIGHT - BOTTOM - y * (HEIGHT - TOP - BOTTOM))


def _panel(session: Row) -> U8:
    live = [row | {"online_at_full_size": row["online"], "non_dominated": False} for row in session["hosts"]]
    rows = [*session["settings"], *live]
    points = [(row["frame_ms"]["p50"], row["online_at_full_size"]["psnr"]) for row in rows]
    period_ms = 1e3 / session["rate_hz"]
    axes = _Axes([*(ms for ms, _ in points), period_ms], [psnr for _, psnr in points])
    panel = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    _frame(panel, axes, session, period_ms)
    places = [axes(*point) for point in points]
    front = sorted(place for place, row in zip(places, rows, strict=True) if row["non_dominated"])
    cv2.polylines(panel, [np.array(front, np.int32)], False, GREY, 1, cv2.LINE_AA)
    taken: list[Box] = [(x - 8, y - 8, x + 8, y + 8) for x, y in places]
    for place, row in zip(places, rows, strict=True):
        colour = COLOURS[row["part"]]
        cv2.circle(panel, place, 6, colour if row["non_dominated"] else WHITE, cv2.FILLED, cv2.LINE_AA)
        cv2.circle(panel, place, 6, colour, 2, cv2.LINE_AA)
        if row["part"] == "default":
            cv2.circle(panel, place, 11, BLACK, 2, cv2.LINE_AA)
        _label(panel, place, _difference(row["name"], rows[0]["name"]), colour, taken)
    return panel


def _frame(panel: U8, axes: _Axes, session: Row, period_ms: float) -> None:
    low, high = axes.decibels
    for ms in TICKS_MS:
        if axes.times[0] <= ms <= axes.times[1]:
            x = axes(ms, low)[0]
            cv2.line(panel, (x, TOP), (x, HEIGHT - BOTTOM), PALE, 1)
            _text(panel, str(ms), (x - 8, HEIGHT - BOTTOM + 18), GREY)
    step = next(step for step in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20) if (high - low) / step <= 8)
    for index in range(math.ceil(low / step), math.floor(high / step) + 1):
        y = axes(axes.times[0], index * step)[1]
        cv2.line(panel, (LEFT, y), (WIDTH - RIGHT, y), PALE, 1)
        _text(panel, f"{index * step:.4g}", (LEFT - 42, y + 4), GREY)
    x = axes(period_ms, low)[0]
    cv2.line(panel, (x, TOP), (x, HEIGHT - BOTTOM), GREY, 1)
    _text(panel, f"camera: {session['rate_hz']:g} Hz", (x + 4, HEIGHT - BOTTOM - 6), GREY)
    title = f"{session['session']}, {session['frames']} frames: online PSNR* (dB) over ms per frame (median)"
    _text(panel, title, (LEFT, 24), BLACK, LARGE)
    x = LEFT
    for part in dict.fromkeys(row["part"] for row in [*session["settings"], *session["hosts"]]):
        cv2.circle(panel, (x + 6, 42), 5, COLOURS[part], cv2.FILLED, cv2.LINE_AA)
        _text(panel, part, (x + 16, 46), COLOURS[part])
        x += 110
    _text(panel, "filled: no other setting is better in both", (x, 46), GREY)


def _difference(name: str, default: str) -> str:
    """Of a name "budget, size, N": what is not as in the default's."""
    usual = default.split(", ")
    return ", ".join(said for said in name.split(", ") if said not in usual) or name


def _label(panel: U8, place: Pixel, text: str, colour: tuple[int, int, int], taken: list[Box]) -> None:
    """Beside its point where there is room, else above or below its neighbours' labels."""
    (width, height), _ = cv2.getTextSize(text, FONT, SMALL, 1)
    x, y = place
    boxes = [
        (left, y + down - height, left + width, y + down)
        for down in (4, -8, 16, -20, 28, -32, 40, -44, 52)
        for left in (x + 18, x - 18 - width)
        if LEFT <= left and left + width <= WIDTH
    ]
    free = [box for box in boxes if not any(_overlap(box, other) for other in taken)]
    box = (free or boxes)[0]
    taken.append(box)
    _text(panel, text, (box[0], box[3]), colour)


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _text(panel: U8, text: str, place: Pixel, colour: tuple[int, int, int], size: float = SMALL) -> None:
    cv2.putText(panel, text, place, FONT, size, colour, 1, cv2.LINE_AA)
