"""What the phantom is written from in the layouts of public data sets."""

import pytest
from places import SESSION

from sags_node.config.launch_file import load_launch
from sags_node.rig import load_rig
from sags_node.sources.source import open_source
from sags_node.types import StereoFrame, StereoRig


@pytest.fixture(scope="session")
def rig() -> StereoRig:
    return load_rig(SESSION / "calib")


@pytest.fixture(scope="session")
def played() -> list[StereoFrame]:
    """Its first thirteen frames, with their truth."""
    with open_source(load_launch(SESSION, ["source.pace:=step", "source.frames:=13"]).source) as frames:
        return list(frames)
