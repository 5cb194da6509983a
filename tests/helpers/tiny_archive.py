"""Recordings that are played in no time."""

from __future__ import annotations

from pathlib import Path

from sags_node.config import PhantomSource
from sags_node.phantom import write_session

TINY_FRAMES = 6


def write_tiny_session(folder: Path, seed: int) -> None:
    """Six small frames of a phantom, with their truth."""
    write_session(
        PhantomSource(seconds=TINY_FRAMES / 10, width=160, height=128, seed=seed), folder, rate=10.0
    )
