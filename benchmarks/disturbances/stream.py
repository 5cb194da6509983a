"""A stream of frames of which a stretch is disturbed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from benchmarks.disturbances.catalogue import Disturbance
from benchmarks.disturbances.moment import Moment
from benchmarks.disturbances.scene import Scene
from benchmarks.disturbances.signal import LATE
from sags_node.types import StereoFrame


class Taken(NamedTuple):
    """One frame of a disturbed stream."""

    clean: StereoFrame  # as it was taken: the true picture of that time
    given: StereoFrame | None  # as it comes; None: it is lost


def disturbed(
    disturbance: Disturbance, frames: Iterable[StereoFrame], during: range, rate: float, scene: Scene
) -> Iterator[Taken]:
    """The frames with one disturbance. Numbers, stamps, poses, and what is true of them stay as they are.

    Args:
        frames: of a source, both eyes.
        during: numbers (`frame_id`) of the frames that it changes.
        rate: frames per second.
        scene: where the tissue is.
    """
    history: list[StereoFrame] = []
    for frame in frames:
        history.append(frame)
        if frame.frame_id not in during:
            del history[:-LATE]
            yield Taken(frame, frame)
            continue
        moment = Moment(frame.frame_id - during.start, len(during), rate, tuple(history), scene)
        yield Taken(frame, disturbance.change(moment))
