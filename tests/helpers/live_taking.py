"""Taking frames of a live source in a thread, as a node does."""

import threading
from typing import Self

from stereo_sender import read_number

from sags_node.sources.source import Source
from sags_node.types import StereoFrame


class Taker:
    """Of each frame: number painted into the left and the right image."""

    def __init__(self, source: Source) -> None:
        self.numbers: list[tuple[int, int]] = []
        self.newest: StereoFrame | None = None
        self._source = source
        self._thread = threading.Thread(target=self._take)

    def _take(self) -> None:
        with self._source:
            for frame in self._source:
                assert frame.right is not None
                self.numbers.append((read_number(frame.left), read_number(frame.right)))
                self.newest = frame

    @property
    def mismatched(self) -> int:
        return sum(left != right for left, right in self.numbers)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._source.stop()
        self._thread.join(60)
        assert not self._thread.is_alive()
