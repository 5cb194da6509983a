"""`sags bag record --session`: a recording goes through a node into a bag, and nothing is left out."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import pure_json, refused, sags

from sags_node.config.schema import PhantomSource
from sags_node.phantom import write_session
from sags_node.pipeline.session import open_session

pytestmark = pytest.mark.live
FRAMES = 6
WARM_UP = 2  # more, before them


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("session") / "played"
    write_session(
        PhantomSource(seconds=(WARM_UP + FRAMES) / 10, width=160, height=128, seed=3), folder, rate=10.0
    )
    return folder


def test_every_frame_after_the_warm_up_is_recorded_and_plays_again(session: Path, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    asked = (f"source.warm_up:={WARM_UP}", "--json")
    said = pure_json(sags("bag", "record", "-o", bag, "--session", session, *asked).stdout)
    assert (said["frames"], said["lost"], said["dropped"]) == (FRAMES, 0, 0)
    for topic in ("left/image_rect_color", "left/render/depth", "right/render/image", "splats"):
        assert said["topics"][f"sags/{topic}"]["messages"] == FRAMES
    with open_session(bag, ["source.pace:=step"]).source as source:
        assert len([frame for frame in source if frame.right is not None]) == FRAMES


def test_what_does_not_go_together_is_refused(session: Path, tmp_path: Path) -> None:
    record = ("bag", "record", "-o", tmp_path)
    refused(2, *record, "mapping.rung:=1", said=("mapping.rung:=1", "--session"))
    refused(2, *record, "--session", session, "--seconds", "2", said=("no --snapshot-mode",))
    refused(2, *record, "--session", session, said=("exists already",))
    refused(2, *record, "--session", "source.kind:=v4l2", said=("leave out --session",))
