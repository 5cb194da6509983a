"""What all protocols play with."""

from collections.abc import Callable, Sequence

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LaunchConfig, RecordedSource
from sags_node.errors import UsageError
from sags_node.pipeline.warm_up import prepare

STEP = ("source.loop:=false", "source.pace:=step")  # each frame in its turn
AS_GIVEN = "vision.tissue.dilate:=0"  # masks without the margin that a node puts around instruments

Progress = Callable[[int, str], None]  # frames done, of what


def configured(given: Sequence[str], overrides: Sequence[str]) -> LaunchConfig:
    """The launch that plays what is `given`, each frame in its turn, and what the user changes of it."""
    config = load_launch(None, [*given, *STEP, *overrides])
    prepare(config)
    return config


def check_default(config: LaunchConfig, *keys: str) -> None:
    """To be asked where the truth is that of a recording's first frame, last frame, or each.

    Raises:
        UsageError: one of these keys of `source` is set, so another frame would be compared with it.
    """
    default = type(config.source).model_fields
    for key in keys:
        if getattr(config.source, key) != default[key].default:
            raise UsageError(
                f"source.{key}: points are marked in frames that would not be played; leave it out"
            )


def stride_of(config: LaunchConfig) -> int:
    return config.source.stride if isinstance(config.source, RecordedSource) else 1
