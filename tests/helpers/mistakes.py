"""Recordings that cannot be played: what is said when they are opened, or on the way."""

from collections.abc import Callable

import pytest

from sags_node.config import schema as cfg
from sags_node.errors import SagsError
from sags_node.sources.source import open_source
from sags_node.types import StereoFrame


def refused_at_opening(config: Callable[[], cfg.Source], message: str) -> SagsError:
    """The error, of one line that `message` matches."""
    with pytest.raises(SagsError, match=message) as caught:
        open_source(config())
    assert "\n" not in str(caught.value)
    return caught.value


def frames_until_error(config: cfg.Source) -> tuple[list[StereoFrame], str]:
    frames = []
    with open_source(config) as source, pytest.raises(SagsError) as caught:
        for frame in source:
            frames.append(frame)
    return frames, str(caught.value)
