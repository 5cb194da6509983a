"""Pairs the images of both eyes that are of one moment, by their stamps: live and in recordings."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple, Self

import numpy as np

from sags_node.types import I64, U8, Samples, Side, StereoFrame

log = logging.getLogger(__name__)

QUEUE_LENGTH = 4  # images of one eye that wait for their partner
REPORT_EVERY = 100  # unpaired images between two warnings
POLL_S = 0.1  # s between looks while waiting for a pair
NEAR = 0.6  # periods between partners, at most: free-running eyes are up to half a period apart
SETTLING_NS = 300_000_000  # ns: stamps that go back by less are a better clock estimate (`sources.clock`)


class Picture(NamedTuple):
    """The image of one eye."""

    t_ns: int  # wall clock
    image: U8  # [H, W, 3] RGB
    device_ns: int = 0  # stamp on the clock of the device or sender; 0: none
    arrival_ns: int = 0  # wall clock; 0: not known


class Shot(NamedTuple):
    """One image as a device delivers it: of one eye, or of both."""

    t_ns: int  # wall clock
    image: Samples  # [H, W, 3] RGB
    side: Side | None = None  # the eye, if one device delivers single images of both
    device_ns: int | None = None  # stamp on the device's clock, which may begin at 0; None: none
    arrival_ns: int = 0  # wall clock; 0: not known


class LivePairs:
    """A `Source` of live stereo frames: any thread puts images in; pairs come out, until `stop` or `end`.

    Images are paired by their stamps. `frame_id` counts left images, so a left image without a partner
    leaves a gap. `epoch` grows when the clock is set back. If stamps go back by less than `SETTLING_NS`,
    pairs are left out until the stamps have caught up. A pair with the same stamp as the one before was sent
    twice, and is left out, too.

    Args:
        tolerance_ms: largest difference of the stamps of a pair.
        latency_ms: from exposure to stamp; subtracted from the capture times.
    """

    frame_count: int | None = None
    rate: float  # Hz, nominal

    def __init__(self, tolerance_ms: float, latency_ms: float = 0.0) -> None:
        self._tolerance_ns = round(tolerance_ms * 1e6)
        self._latency_ns = round(latency_ms * 1e6)
        # Each image with the number of images of its eye before it.
        self._waiting: dict[Side, deque[tuple[int, Picture]]] = {"left": deque(), "right": deque()}
        self._pairs: deque[tuple[int, Picture, Picture]] = deque()
        self._counts: dict[Side, int] = {"left": 0, "right": 0}
        self._skew_ns = self._unpaired = self._outdated = 0
        self._arrived = threading.Condition()
        self._ended = False
        self.stopped = threading.Event()

    @property
    def dropped(self) -> int:
        """The number of images without a partner, and of pairs that are no newer than the one before."""
        return self._unpaired + self._outdated

    def start(self) -> None:
        """Begin to receive images."""

    def close(self) -> None:
        """Release the devices or sockets."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self.close()

    def add(self, side: Side, picture: Picture) -> None:
        """Put in one eye's image."""
        with self._arrived:
            waiting = self._waiting[side]
            if len(waiting) == QUEUE_LENGTH:
                self._drop(waiting)
            waiting.append((self._counts[side], picture))
            self._counts[side] += 1
            self._arrived.notify_all()

    def add_both(self, left: Picture, right: Picture) -> None:
        """Put in two images that are a pair, whatever their stamps."""
        with self._arrived:
            if len(self._pairs) == QUEUE_LENGTH:
                self._pairs.popleft()
                self._unpaired += 1
            self._pairs.append((self._counts["left"], left, right))
            self._counts = {side: count + 1 for side, count in self._counts.items()}
            self._arrived.notify_all()

    def end(self) -> None:
        """Say that no more images will be put in."""
        with self._arrived:
            self._ended = True
            self._arrived.notify_all()

    def stop(self) -> None:
        """End the iteration; any thread may call this."""
        with self._arrived:
            self.stopped.set()
            self._arrived.notify_all()

    def __iter__(self) -> Iterator[StereoFrame]:
        """Yield pairs as they arrive; wait while no images come."""
        epoch, last_ns = 0, -1
        while True:
            with self._arrived:
                while (pair := self._take()) is None and not (self.stopped.is_set() or self._ended):
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

    def _take(self) -> tuple[int, Picture, Picture] | None:
        """Take the oldest pair: number of left images before it, left, right. None if there is none yet.

        Of two images that are too far apart the older one is dropped; also if its successor is nearer.
        """
        if self._pairs:
            return self._pairs.popleft()
        lefts, rights = self._waiting["left"], self._waiting["right"]
        while lefts and rights:
            (number, left), (_, right) = lefts[0], rights[0]
            self._skew_ns = left.t_ns - right.t_ns
            older, newer = (lefts, right) if self._skew_ns < 0 else (rights, left)
            distance = abs(self._skew_ns)
            nearer_follows = len(older) > 1 and abs(older[1][1].t_ns - newer.t_ns) < distance
            if distance <= self._tolerance_ns and not nearer_follows:
                lefts.popleft()
                rights.popleft()
                return number, left, right
            self._drop(older)
        return None

    def _drop(self, waiting: deque[tuple[int, Picture]]) -> None:
        waiting.popleft()
        self._unpaired += 1
        if self._unpaired % REPORT_EVERY == 0:
            log.warning(
                "%d images without a partner (left %d, right %d so far), last skew %.1f ms; "
                "is one camera away, or source.pair_tolerance_ms too small?",
                *(self._unpaired, *self._counts.values(), self._skew_ns / 1e6),
            )


class Alternation:
    """Joins the images of one camera that shows the eyes in turn. Not thread-safe.

    The time since the image before tells which eye an image shows, so that a lost image does not swap
    the eyes. It is measured on the device's clock, or else on a monotonic one.

    Args:
        period_ns: from image to image.
        clock_ns: monotonic.
    """

    def __init__(self, period_ns: float, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock_ns = clock_ns
        self._period_ns = period_ns
        self._before: Shot | None = None
        self._arrived_ns = 0  # arrival of the image before
        self._turn = -1  # number of the image before, lost ones counted; even: the first eye
        self.alone = 0

    def add(self, picture: Shot) -> tuple[Shot, Shot] | None:
        """Take an image in; return the images of the first and the second eye if it completes a pair."""
        before, turn = self._before, self._turn
        self._turn, self._before = turn + self._steps(before, picture), picture
        is_second = self._turn % 2 == 1
        if is_second and before is not None and self._turn == turn + 1:
            return before, picture
        self.alone += is_second + (before is not None and turn % 2 == 0)
        return None

    def _steps(self, before: Shot | None, picture: Shot) -> int:
        last_ns, self._arrived_ns = self._arrived_ns, self._clock_ns()
        if before is None:
            return 1
        passed_ns = self._arrived_ns - last_ns
        if picture.device_ns is not None and before.device_ns is not None:
            passed_ns = picture.device_ns - before.device_ns
        return max(1, round(passed_ns / self._period_ns))


def pair(left: I64, right: I64, tolerance: float) -> I64:
    """Pair stamps that are each other's nearest: rows [N, 2] of left index, right index, by left stamp.

    Args:
        left, right: capture stamps [L], [R], ns, in any order.
        tolerance: largest difference, s.
    """
    to_right, to_left = nearest(left, right), nearest(right, left)
    mutual = to_left[to_right] == np.arange(len(left))
    close = np.abs(left - right[to_right]) <= tolerance * 1e9
    chosen = np.flatnonzero(mutual & close)
    chosen = chosen[np.argsort(left[chosen], kind="stable")]
    return np.stack([chosen, to_right[chosen]], axis=1)


def nearest(stamps: I64, others: I64) -> I64:
    """Return for each of `stamps` [N] the index of the nearest of `others` [M], M > 0."""
    order = np.argsort(others, kind="stable")
    ordered = others[order]
    after = np.searchsorted(ordered, stamps).clip(0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(ordered[before] - stamps) <= np.abs(ordered[after] - stamps)
    found: I64 = order[np.where(closer, before, after)]
    return found
