"""What all protocols play with."""

from __future__ import annotations

from collections.abc import Callable

STEP = ("source.loop:=false", "source.pace:=step")  # each frame in its turn
AS_GIVEN = "vision.tissue.dilate:=0"  # masks without the margin that a node puts around instruments

Progress = Callable[[int, str], None]  # frames done, of what
