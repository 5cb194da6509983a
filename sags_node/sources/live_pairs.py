"""Live pictures of both eyes, put in by any threads, as frames for one that takes them."""

from __future__ import annotations

import threading
from collections.abc import Iterator

from sags_node.sources.device import Picture
from sags_node.sources.pairing import Pairing
from sags_node.types import Side, StereoFrame

POLL_S = 0.1  # how soon a waiting taker notices `stop`, if nobody tells it
SETTLING_NS = 300_000_000  # stamps that go back by less: their clock is better known now (`sources.clock`)


class LivePairs:
    """Pictures in, frames out, until `stop`, or until all are out after `end`.

    `frame_id` counts the left eye's pictures, so a left picture that found no partner leaves a gap. `epoch`
    grows when the clock is set back. Where stamps go back by less than `SETTLING_NS`, pairs are left out
    until they have caught up; so is a pair with the stamp of the one before, which was sent twice.

    Args:
        tolerance_ms: how far the stamps of a pair may lie apart.
        latency_ms: from the exposure to the stamp; taken off the capture times.
    """

    def __init__(self, tolerance_ms: float, latency_ms: float) -> None:
        self._pairing = Pairing(round(tolerance_ms * 1e6))
        self._latency_ns = round(latency_ms * 1e6)
        self._arrived = threading.Condition()
        self._ended = False
        self._outdated = 0
        self.stopped = threading.Event()

    @property
    def unpaired(self) -> int:
        """Pictures of either eye that found no partner, and pairs no newer than the one before."""
        return self._pairing.unpaired + self._outdated

    def put(self, eye: Side, picture: Picture) -> None:
        with self._arrived:
            (self._pairing.add_left if eye == "left" else self._pairing.add_right)(picture)
            self._arrived.notify_all()

    def put_both(self, left: Picture, right: Picture) -> None:
        """Two that belong together, whatever their stamps."""
        with self._arrived:
            self._pairing.add_pair(left, right)
            self._arrived.notify_all()

    def end(self) -> None:
        """No more pictures will be put in."""
        with self._arrived:
            self._ended = True
            self._arrived.notify_all()

    def stop(self) -> None:
        """End the iteration; any thread may call this."""
        with self._arrived:
            self.stopped.set()
            self._arrived.notify_all()

    def __iter__(self) -> Iterator[StereoFrame]:
        """Pairs as they arrive, until `stop`; silent while no pictures come."""
        epoch, last_ns = 0, -1
        while True:
            with self._arrived:
                while (pair := self._pairing.take()) is None and not (self.stopped.is_set() or self._ended):
                    self._arrived.wait(POLL_S)
            if pair is None or self.stopped.is_set():
                return
            frame_id, left, right = pair
            if last_ns - SETTLING_NS < left.t_ns <= last_ns:
                self._outdated += 1
                continue
            epoch += left.t_ns < last_ns
            last_ns = left.t_ns
            yield StereoFrame(
                frame_id,
                t_capture_ns=left.t_ns - self._latency_ns,
                t_capture_right_ns=right.t_ns - self._latency_ns,
                left=left.image,
                right=right.image,
                epoch=epoch,
                t_device_ns=left.device_ns,
                t_arrival_ns=left.arrival_ns,
            )
