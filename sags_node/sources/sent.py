"""Checks images that other programs send, converts their stamps to this machine's clock, and pairs them."""

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

OLDEST_NS = 1_000_000_000  # ns: an older image is of no use, or its clock is another one
AWAY_NS = 1_000_000_000  # ns: a gap of at least this, and of
AWAY_STEPS = 10  # usual steps, means that the sender paused: nothing was lost
ONE_CLOCK_NS = 100_000_000  # ns: if both eyes' clocks differ by less, they are one clock
AHEAD_NS = 100_000_000  # ns ahead: synchronised clocks do not differ by more
LATE_NS = 200_000_000  # ns of transit: a hand that is guided by later images misses
SMOOTHED = 0.1  # weight of the newest image in the mean age
ENOUGH = 0.9  # share of the nominal rate; if less comes, the sender is told
OTHER: Mapping[Side, Side] = {"left": "right", "right": "left"}
WINDOW = 90  # images over which losses are counted: 3 s at 30 Hz


class Arrivals:
    """Counts one eye's images and, by the gaps between stamps, those that were lost in transit.

    Attributes:
        lost: number since the start, up to the last full stretch of `WINDOW` images.
    """

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=WINDOW + 1)  # ns, and the one before
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
        """The share of images lost in the last `WINDOW`; 0 until so many have come."""
        if len(self._stamps) < WINDOW:
            return 0.0
        return self._lost_now() / (self._lost_now() + len(self._stamps))

    @property
    def rate(self) -> float:
        """The rate by the last stamps, Hz; infinite until there are enough."""
        if len(self._stamps) < WINDOW // 3:
            return float("inf")
        return (len(self._stamps) - 1) * 1e9 / (self._stamps[-1] - self._stamps[0])

    def _was_away(self, gap_ns: int) -> bool:
        if gap_ns < AWAY_NS or len(self._stamps) < 2:
            return False
        return gap_ns > AWAY_STEPS * float(np.median(np.diff(np.array(self._stamps))))

    def _lost_now(self) -> float:
        """The number of images missing in the last `WINDOW`, by the median step between stamps."""
        steps = np.diff(np.array(self._stamps))
        return max(0.0, float(steps.sum() / np.median(steps)) - len(steps))


class SentPictures(LivePairs):
    """A `Source` of both eyes' images from another program. One receiving thread puts them in.

    Attributes:
        arrivals: counts of each eye's images.

    Args:
        size: width and height that images must have, px; None: those of the first.
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
        self._age_ns = 0.0  # smoothed age of images on arrival

    @property
    def dropped(self) -> int:
        """The number of missing pairs: lost in transit, or without the other eye's image."""
        return max(super().dropped, *(eye.lost for eye in self.arrivals.values()))

    def slowness(self) -> str | None:
        """Return a warning for the sender if images come too seldom or too late; else None."""
        rate = min(arrivals.rate for arrivals in self.arrivals.values())
        if rate < ENOUGH * self.rate:
            return (
                f"{rate:.1f} of {self.rate:g} images a second come: send faster, or set "
                f"source.rate:={round(rate, 1):g}"
            )
        if not self._own and self._age_ns > LATE_NS:
            return (
                f"images are {self._age_ns * 1e-6:.0f} ms old when they come: send smaller ones, or JPEG; "
                "stamp them when they are taken"
            )
        return None

    def put(self, eye: Side, stamp_ns: int, arrival_ns: int, decode: Callable[[], U8]) -> None:
        """Put in one eye's image.

        Raises:
            SagsError: it is refused; the error says why, and how to fix it.
        """
        t_ns = self._on_wall(eye, stamp_ns, arrival_ns)
        self.arrivals[eye].add(stamp_ns)
        picture = self._checked(decode(), self._one)
        self.add(eye, Picture(t_ns, self._one.eye(picture, eye), stamp_ns, arrival_ns))

    def put_both(self, stamp_ns: int, arrival_ns: int, decode: Callable[[], U8]) -> None:
        """Put in an image of both eyes: side by side, unless the geometry says otherwise; see `put`."""
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
            f"an image's stamp is {abs(age) * 1e-9:.1f} s {way}: stamp it by the wall clock when it is "
            "taken and set both clocks by each other, or set source.stamps:=own"
        )

    def _own_on_wall(self, eye: Side, stamp_ns: int, arrival_ns: int) -> int:
        """Convert a stamp by the eye's own clock: images come in any order, and there may be two clocks."""
        self._clocks[eye].add(stamp_ns, arrival_ns)
        own, other = self._clocks[eye].to_wall(stamp_ns), self._clocks[OTHER[eye]].to_wall(stamp_ns)
        assert own is not None  # it was just added
        return own if other is None or abs(other - own) > ONE_CLOCK_NS else min(own, other)

    def _checked(self, picture: U8, layout: Layout) -> U8:
        """The image, if its eyes have the right size."""
        size = layout.size(picture.shape[1], picture.shape[0], "an image")
        self._size = self._size or size
        if size != self._size:
            raise SagsError(
                f"an eye's image is {size_text(*size)} px, it must be {size_text(*self._size)} as in the "
                "calibration; send that size, or name the right calibration in rig"
            )
        return picture
