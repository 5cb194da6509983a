"""Which pictures of both eyes are of one moment: live, as they come, and in recordings, by their stamps."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple, Self

import numpy as np

from sags_node.types import I64, U8, Samples, Side, StereoFrame

log = logging.getLogger(__name__)

QUEUE_LENGTH = 4  # pictures of one eye that wait for their partner
REPORT_EVERY = 100  # unpaired pictures between two warnings
POLL_S = 0.1  # how soon a waiting taker notices `stop`, if nobody tells it
NEAR = 0.6  # of a period, from a picture to its partner: free-running eyes are up to half of one apart
SETTLING_NS = 300_000_000  # stamps that go back by less: their clock is better known now (`sources.clock`)


class Picture(NamedTuple):
    """The picture of one eye."""

    t_ns: int  # wall clock
    image: U8  # [H, W, 3] RGB
    device_ns: int = 0  # by the clock of what took or sent it; 0: it gave none
    arrival_ns: int = 0  # wall clock; 0: not known


class Shot(NamedTuple):
    """What a device delivers."""

    t_ns: int  # wall clock
    image: Samples  # [H, W, 3] RGB
    side: Side | None = None  # whose it is, where one device delivers either eye's
    device_ns: int | None = None  # by the clock of the device, which may begin at 0; None: it gave none
    arrival_ns: int = 0  # wall clock; 0: not known


class LivePairs:
    """A `Source` of live stereo frames: pictures in, from any threads; pairs out, until `stop` or `end`.

    Pictures are paired by their stamps. `frame_id` counts the left eye's, so a left picture that found no
    partner leaves a gap. `epoch` grows when the clock is set back. Where stamps go back by less than
    `SETTLING_NS`, pairs are left out until they have caught up; so is a pair with the stamp of the one
    before, which was sent twice.

    Args:
        tolerance_ms: how far the stamps of a pair may lie apart.
        latency_ms: from the exposure to the stamp; taken off the capture times.
    """

    frame_count: int | None = None
    rate: float  # frames per second, nominal

    def __init__(self, tolerance_ms: float, latency_ms: float = 0.0) -> None:
        self._tolerance_ns = round(tolerance_ms * 1e6)
        self._latency_ns = round(latency_ms * 1e6)
        # With each picture the count of those of its eye before it.
        self._waiting: dict[Side, deque[tuple[int, Picture]]] = {"left": deque(), "right": deque()}
        self._pairs: deque[tuple[int, Picture, Picture]] = deque()
        self._counts: dict[Side, int] = {"left": 0, "right": 0}
        self._skew_ns = self._unpaired = self._outdated = 0
        self._arrived = threading.Condition()
        self._ended = False
        self.stopped = threading.Event()

    @property
    def dropped(self) -> int:
        """Pictures of either eye that found no partner, and pairs no newer than the one before."""
        return self._unpaired + self._outdated

    def start(self) -> None:
        """Begin to receive pictures."""

    def close(self) -> None:
        """Release what delivers them."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self.close()

    def add(self, side: Side, picture: Picture) -> None:
        """Take one eye's picture in."""
        with self._arrived:
            waiting = self._waiting[side]
            if len(waiting) == QUEUE_LENGTH:
                self._drop(waiting)
            waiting.append((self._counts[side], picture))
            self._counts[side] += 1
            self._arrived.notify_all()

    def add_both(self, left: Picture, right: Picture) -> None:
        """Take two in that belong together, whatever their stamps."""
        with self._arrived:
            if len(self._pairs) == QUEUE_LENGTH:
                self._pairs.popleft()
                self._unpaired += 1
            self._pairs.append((self._counts["left"], left, right))
            self._counts = {side: count + 1 for side, count in self._counts.items()}
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
        """Pairs as they arrive; silent while no pictures come."""
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
        """The oldest pair: count of left pictures before it, left, right. None until there is one.

        The older of two pictures is dropped when they are too far apart, or when its successor is nearer.
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
                "%d pictures without a partner (left %d, right %d so far), last skew %.1f ms; "
                "is one camera away, or source.pair_tolerance_ms too small?",
                *(self._unpaired, *self._counts.values(), self._skew_ns / 1e6),
            )


class Alternation:
    """Joins the pictures of one camera that shows the eyes in turn. Not safe for threads by itself.

    How much time has passed since the picture before tells which eye one shows, so a picture that is lost
    does not exchange the eyes. It passes on the device's clock, or else on one that nobody sets.

    Args:
        period_ns: from picture to picture.
        clock_ns: that nobody sets.
    """

    def __init__(self, period_ns: float, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock_ns = clock_ns
        self._period_ns = period_ns
        self._before: Shot | None = None
        self._arrived_ns = 0  # when that came
        self._turn = -1  # of the picture before; even: the first eye's
        self.alone = 0

    def add(self, picture: Shot) -> tuple[Shot, Shot] | None:
        """The first and the second eye's pictures when this one completes a pair."""
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
    """Rows (index of the left, index of the right picture) [N, 2] of stamps that are each other's nearest.

    Args:
        left, right: capture stamps [L], [R], ns, in any order.
        tolerance: s.
    """
    to_right, to_left = nearest(left, right), nearest(right, left)
    mutual = to_left[to_right] == np.arange(len(left))
    close = np.abs(left - right[to_right]) <= tolerance * 1e9
    chosen = np.flatnonzero(mutual & close)
    chosen = chosen[np.argsort(left[chosen], kind="stable")]
    return np.stack([chosen, to_right[chosen]], axis=1)


def nearest(stamps: I64, others: I64) -> I64:
    """Find for each of `stamps` [N] the index of the nearest of `others` [M], M > 0."""
    order = np.argsort(others, kind="stable")
    ordered = others[order]
    after = np.searchsorted(ordered, stamps).clip(0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(ordered[before] - stamps) <= np.abs(ordered[after] - stamps)
    found: I64 = order[np.where(closer, before, after)]
    return found
