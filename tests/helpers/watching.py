"""Watchers, asked about a frame as the pipeline asks them."""

from sags_node.types import RectifiedPair, StereoFrame
from sags_node.vision.watch.judgement import Evidence, Judgement, Watcher


def judged(watcher: Watcher, frame: StereoFrame, pair: RectifiedPair | None = None) -> Judgement:
    """Of one that needs no `pair` where there is none."""
    return watcher.judge(Evidence(frame, pair, None), Judgement())  # type: ignore[arg-type]
