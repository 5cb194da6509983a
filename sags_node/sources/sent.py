"""What other programs stamp and send: checked, brought to this machine's clock, paired and counted."""

from collections import deque
from collections.abc import Callable, Mapping

import numpy as np

from sags_node.config.schema import SentSource
from sags_node.errors import SagsError
from sags_node.sources.clock import CaptureClock
from sags_node.sources.layout import Layout
from sags_node.sources.pairing import LivePairs, Picture
from sags_node.sources.pictures import size_text
from sags_node.types import U8, Side

OLDEST_NS = 1_000_000_000  # what is older is of no use, or of another clock
AWAY_NS = 1_000_000_000  # without a picture, and
AWAY_STEPS = 10  # times the usual step: whoever sends was away, and nothing was lost
ONE_CLOCK_NS = 100_000_000  # the eyes' clocks apart: it is one, and the ways differ
AHEAD_NS = 100_000_000  # beyond what clocks that are set by each other differ
LATE_NS = 200_000_000  # on the way: a hand that is shown so late misses
SMOOTHED = 0.1  # share of the newest picture in what is said of the last ones
ENOUGH = 0.9  # of the pictures that should come
OTHER: Mapping[Side, Side] = {"left": "right", "right": "left"}
WINDOW = 90  # stamps that the loss is counted over: three seconds


class Arrivals:
    """What came of one eye's pictures, and what was lost on the way, by the gaps between stamps.

    Attributes:
        lost: since the start, up to the last full stretch of `WINDOW` pictures.
    """

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=WINDOW + 1)  # with the one before
        self._count = 0
        self.lost = 0

    def add(self, stamp_ns: int) -> None:
        if self._stamps and (stamp_ns <= self._stamps[-1] or self._was_away(stamp_ns - self._stamps[-1])):
            self._stamps.clear()
            self._count = 0
        self._stamps.append(stamp_ns)
        self._count += 1
        if self._count % WINDOW == 0:
            self.lost += round(self._lost_now())

    @property
    def share_lost(self) -> float:
        """The share lost of the last seconds' pictures; 0 until there are enough to tell."""
        if len(self._stamps) < WINDOW:
            return 0.0
        return self._lost_now() / (self._lost_now() + len(self._stamps))

    @property
    def rate(self) -> float:
        """Hz, by the stamps of the last seconds; infinite until there are enough to tell."""
        if len(self._stamps) < WINDOW // 3:
            return float("inf")
        return (len(self._stamps) - 1) * 1e9 / (self._stamps[-1] - self._stamps[0])

    def _was_away(self, gap_ns: int) -> bool:
        if gap_ns < AWAY_NS or len(self._stamps) < 2:
            return False
        return gap_ns > AWAY_STEPS * float(np.median(np.diff(np.array(self._stamps))))

    def _lost_now(self) -> float:
        """In the last stretch: pictures that the usual step between two leaves room for, and did not come."""
        steps = np.diff(np.array(self._stamps))
        return max(0.0, float(steps.sum() / np.median(steps)) - len(steps))


class SentPictures(LivePairs):
    """A `Source` of both eyes' pictures from another program. One receiving thread puts them in.

    Attributes:
        arrivals: of each eye.

    Args:
        size: width and height that pictures must have, px; None: those of the first.
    """

    def __init__(self, config: SentSource, size: tuple[int, int] | None) -> None:
        super().__init__(config.pair_tolerance_ms, config.latency_ms)
        self.rate = config.rate
        self.arrivals: dict[Side, Arrivals] = {"left": Arrivals(), "right": Arrivals()}
        self._size = size
        self._one = Layout(config.geometry.model_copy(update={"layout": "separate"}))
        said = config.geometry.layout
        both = "side_by_side" if said == "separate" else said
        self._both = Layout(config.geometry.model_copy(update={"layout": both}))
        self._own = config.stamps == "own"
        self._clocks: Mapping[Side, CaptureClock] = {"left": CaptureClock(), "right": CaptureClock()}
        self._age_ns = 0.0  # of pictures when they come

    @property
    def dropped(self) -> int:
        """Pairs that are missing: lost on the way, or without the other eye's picture."""
        return max(super().dropped, *(eye.lost for eye in self.arrivals.values()))

    def slowness(self) -> str | None:
        """Return what is wrong with how pictures come, for who sends them; None: nothing."""
        rate = min(arrivals.rate for arrivals in self.arrivals.values())
        if rate < ENOUGH * self.rate:
            return (
                f"{rate:.1f} of {self.rate:g} pictures a second come: send faster, or set "
                f"source.rate:={round(rate, 1):g}"
            )
        if not self._own and self._age_ns > LATE_NS:
            return (
                f"pictures are {self._age_ns * 1e-6:.0f} ms old when they come: send smaller ones, or JPEG; "
                "stamp them when they are taken"
            )
        return None

    def put(self, eye: Side, stamp_ns: int, arrival_ns: int, decode: Callable[[], U8]) -> None:
        """Take one eye's picture in.

        Raises:
            SagsError: it is refused; why, and how to fix it.
        """
        t_ns = self._on_wall(eye, stamp_ns, arrival_ns)
        self.arrivals[eye].add(stamp_ns)
        picture = self._checked(decode(), self._one)
        self.add(eye, Picture(t_ns, self._one.eye(picture, eye), stamp_ns, arrival_ns))

    def put_both(self, stamp_ns: int, arrival_ns: int, decode: Callable[[], U8]) -> None:
        """Take one picture of both eyes in, side by side unless the geometry says otherwise; see `put`."""
        t_ns = self._on_wall("left", stamp_ns, arrival_ns)
        for arrivals in self.arrivals.values():
            arrivals.add(stamp_ns)
        eyes = self._both.eyes(self._checked(decode(), self._both))
        left, right = (Picture(t_ns, eye, stamp_ns, arrival_ns) for eye in eyes)
        self.add_both(left, right)

    def _on_wall(self, eye: Side, stamp_ns: int, arrival_ns: int) -> int:
        if self._own:
            return self._own_on_wall(eye, stamp_ns, arrival_ns)
        age = arrival_ns - stamp_ns
        if -AHEAD_NS <= age <= OLDEST_NS:
            self._age_ns += SMOOTHED * (age - self._age_ns)
            return stamp_ns
        way = "old" if age > 0 else "ahead of this machine's clock"
        raise SagsError(
            f"a picture's stamp is {abs(age) * 1e-9:.1f} s {way}: stamp it by the wall clock when it is "
            "taken and set both clocks by each other, or set source.stamps:=own"
        )

    def _own_on_wall(self, eye: Side, stamp_ns: int, arrival_ns: int) -> int:
        """Each eye is followed by itself: their pictures come in any order, and may be of two clocks."""
        self._clocks[eye].add(stamp_ns, arrival_ns)
        own, other = self._clocks[eye].to_wall(stamp_ns), self._clocks[OTHER[eye]].to_wall(stamp_ns)
        assert own is not None  # it was just added
        return own if other is None or abs(other - own) > ONE_CLOCK_NS else min(own, other)

    def _checked(self, picture: U8, layout: Layout) -> U8:
        """A picture whose eyes have the right size."""
        size = layout.size(picture.shape[1], picture.shape[0], "a picture")
        self._size = self._size or size
        if size != self._size:
            raise SagsError(
                f"an eye's picture is {size_text(*size)} px, it must be {size_text(*self._size)} as in the "
                "calibration; send that size, or name the right calibration in rig"
            )
        return picture
