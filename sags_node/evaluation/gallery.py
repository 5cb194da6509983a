"""A few frames of a run for a person to look at."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sags_node.types import F32, U8, Bool

EVENLY_SPACED = 3


@dataclass(frozen=True, slots=True)
class Picture:
    """One frame: what the camera saw and what the model showed."""

    frame_id: int
    psnr: float  # dB, tissue
    truth: U8  # [H, W, 3]
    render: U8  # [H, W, 3]
    depth: F32  # [H, W] m, 0 unknown
    tissue: Bool  # [H, W]


class Gallery:
    """Keeps some evenly spaced frames and the worst of all that it is offered."""

    def __init__(self, frames: int) -> None:
        steps = max(1, EVENLY_SPACED - 1)
        self._places = {round((frames - 1) * step / steps) for step in range(EVENLY_SPACED)}
        self._spaced: list[Picture] = []
        self.worst: Picture | None = None

    def offer(self, place: int, picture: Picture) -> None:
        """Look at the frame processed as number `place`; NaN is never the worst."""
        if place in self._places:
            self._spaced.append(picture)
        if not math.isnan(picture.psnr) and (self.worst is None or picture.psnr < self.worst.psnr):
            self.worst = picture

    @property
    def pictures(self) -> list[Picture]:
        """In order of time, each once."""
        unique = {picture.frame_id: picture for picture in (*self._spaced, self.worst) if picture}
        return [unique[frame_id] for frame_id in sorted(unique)]
