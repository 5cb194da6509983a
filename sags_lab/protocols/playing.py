"""What all protocols play with."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LaunchConfig, RecordedSource
from sags_node.pipeline.warm_up import prepare

STEP = ("source.loop:=false", "source.pace:=step")  # each frame in its turn
AS_GIVEN = "vision.tissue.dilate:=0"  # masks without the margin that a node puts around instruments

Progress = Callable[[int, str], None]  # frames done, of what


def configured(given: Sequence[str], overrides: Sequence[str]) -> LaunchConfig:
    """The launch that plays what is `given`, each frame in its turn, and what the user changes of it."""
    config = load_launch(None, [*given, *STEP, *overrides])
    prepare(config)
    return config


def stride_of(config: LaunchConfig) -> int:
    return config.source.stride if isinstance(config.source, RecordedSource) else 1
