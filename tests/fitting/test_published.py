"""Published figures stand beside the clip that they belong to, and beside no other."""

from pathlib import Path

from sags_node.fitting.score import published


def test_only_the_clip_itself_has_published_figures() -> None:
    assert published(Path("pulling_soft_tissues"), 63)["SAGS"] == 38.3
    assert published(Path("cutting_tissues_twice"), 156)["SAGS"] == 39.5
    assert published(Path("pulling_soft_tissues"), 40) == {}  # a part of it
    assert published(Path("my_pulling"), 100) == {}
    assert published(Path("other"), 63) == published(None, 63) == {}
