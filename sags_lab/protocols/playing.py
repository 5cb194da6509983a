"""What all protocols need to play a recording."""

from collections.abc import Callable, Sequence

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LaunchConfig, RecordedSource
from sags_node.errors import UsageError
from sags_node.pipeline.warm_up import prepare

STEP = ("source.loop:=false", "source.pace:=step")  # each frame in its turn
AS_GIVEN = "vision.tissue.dilate:=0"  # masks without the margin that a node puts around instruments

Progress = Callable[[int, str], None]  # frames done, of what


def configured(given: Sequence[str], overrides: Sequence[str]) -> LaunchConfig:
    """Return the configuration that plays what is `given`, each frame in turn, with the user's overrides."""
    config = load_launch(None, [*given, *STEP, *overrides])
    prepare(config)
    return config


def check_default(config: LaunchConfig, *keys: str) -> None:
    """Check that these keys of `source` are not set: the truth is of certain frames of the recording.

    Raises:
        UsageError: one is set, so the truth would be compared with other frames.
    """
    default = type(config.source).model_fields
    for key in keys:
        if getattr(config.source, key) != default[key].default:
            raise UsageError(
                f"source.{key}: points are marked in frames that would not be played; leave it out"
            )


def stride_of(config: LaunchConfig) -> int:
    return config.source.stride if isinstance(config.source, RecordedSource) else 1
