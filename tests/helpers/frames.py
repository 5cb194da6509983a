"""Stereo frames as a source gives them, and a robot's poses."""

from collections.abc import Iterator
from typing import Self

from sags_node.config.schema import Source as SourceConfig
from sags_node.messaging import cdr
from sags_node.sources.pose_track import PoseTrack
from sags_node.sources.source import open_source
from sags_node.types import F64, U8, Bool, StereoFrame


def make_frame(left: U8, right: U8, tissue: Bool | None = None) -> StereoFrame:
    return StereoFrame(7, 1_000, 2_000, left, right, tissue=tissue)


class Frames:
    """A source of given frames."""

    rate, frame_count, dropped = 10.0, None, 0

    def __init__(self, *frames: StereoFrame) -> None:
        self._frames = frames

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...
    def stop(self) -> None: ...
    def __iter__(self) -> Iterator[StereoFrame]:
        return iter(self._frames)


def played(config: SourceConfig) -> list[StereoFrame]:
    with open_source(config) as source:
        return list(source)


def told(track: PoseTrack, T: F64, t_ns: int) -> None:
    track.add(bytes(cdr.pose(T, t_ns).parts[0]), cdr.POSE)
