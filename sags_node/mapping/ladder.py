"""The rungs of quality on which a frame can be mapped, what each costs, and which one a machine affords.

A rung says how much of everything a frame gets. Gaussians do not depend on the size of the image that they
are drawn in, so a model is kept when the rung changes. Prices are times on one machine; only their ratios
count, since every machine measures how long its own frames take. `benchmarks/ladder.md` has the price and
the quality of each rung.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from sags_node.types import RungState


@dataclass(frozen=True, slots=True)
class Rung:
    """What a frame gets."""

    gaussians: int  # at most
    scale: float = 1.0  # of the working size: at which the model is drawn and refined
    depth_every: int = 1  # frames: how often depth is matched
    redraw: float = 1.0  # share of the image, where it was worst, that is drawn anew after the steps


EVERYTHING = Rung(gaussians=2**31)

RUNGS = (
    Rung(5_000, scale=0.5, depth_every=3, redraw=0.4),
    Rung(8_000, scale=0.5, depth_every=3, redraw=0.4),
    Rung(12_000, scale=0.5, depth_every=3, redraw=0.4),
    Rung(16_000, scale=0.5, depth_every=2, redraw=0.4),
    Rung(16_000, scale=0.75, depth_every=2, redraw=0.4),
    Rung(20_000, scale=0.75, depth_every=2, redraw=0.4),
    Rung(25_000, scale=0.75, depth_every=2, redraw=0.4),
    Rung(30_000, scale=0.75, depth_every=2, redraw=0.4),
    Rung(30_000, depth_every=2, redraw=0.4),
    Rung(36_000, depth_every=2, redraw=0.4),
    Rung(44_000, depth_every=2, redraw=0.4),
    Rung(54_000, depth_every=2, redraw=0.6),
    Rung(70_000),
    Rung(90_000),
    Rung(115_000),
    Rung(150_000),
)


# On a GPU small images save little, and Gaussians are cheap.
GPU_RUNGS = (
    Rung(15_000, scale=0.5, depth_every=3, redraw=0.4),
    Rung(20_000, scale=0.75, depth_every=2, redraw=0.4),
    Rung(30_000, depth_every=2),
    Rung(45_000, depth_every=2),
    Rung(60_000, depth_every=2),
    Rung(80_000, depth_every=2),
    Rung(80_000),
    Rung(110_000),
    Rung(150_000),
    Rung(200_000),
    Rung(300_000),
)


@dataclass(frozen=True, slots=True)
class Prices:
    """What a frame costs on one machine, ms; only ratios count."""

    every_frame: float  # whatever rung and size: the camera's images, watchers, tracks
    depth: float  # one match of depth
    worked: float  # flow and masks of images of `FULL` px
    drawn: float  # drawing an image of `FULL` px
    stepped: float  # a step on an image of `FULL` px
    per_thousand: float  # ms per 1,000 Gaussians


USED = 0.82  # of the Gaussians that a rung allows: what a model has; the rest is room for what appears
# Measured on two cores of one machine, live with a viewer, at three working sizes (`benchmarks/ladder.md`).
ON_CPU = Prices(every_frame=10.0, depth=3.0, worked=2.2, drawn=3.6, stepped=2.4, per_thousand=0.33)
# From five runs on one H200 with 16 cores (`benchmarks/gpu.md`), which took 1.07 to 1.12 times as long. Not
# measured on a GPU since.
ON_GPU = Prices(every_frame=8.5, depth=5.0, worked=0.8, drawn=3.6, stepped=1.2, per_thousand=0.08)
FULL = 640 * 512  # px

AVERAGED = 12  # frames behind the measured speed; the two slowest of them are left out
LATE, LATE_OF = 4, 60  # frames that may take longer than a frame's time, of so many in a row
LATE_HIGHER = 1  # frames of these that may be late on a higher rung, as predicted, for it to be tried
SPARE = 0.2  # of the frame's time, at most, is left free for late frames: five frames then make up for one
# that is late by a whole frame
FIRST_AIM = 0.8  # of the frame's time: what the first rung may take, by a guess before the first frame
AIM = 0.92  # of the frame's time: what a rung may take, since costs vary
CLIMB = 0.9  # of the frame's time: what a higher rung may take, with the late frames, before it is tried
SETTLING = 4  # frames from one change of the rung to the next, at least
PATIENCE = 10  # sum over frames of the higher rungs that fit, before one is tried; doubled if it failed
LONGEST_PATIENCE = 960
FIRST_LOOKS = (4, 8, 16, 30)  # frames after which the rung may jump; later it goes by single steps
FIRST_FRAMES = FIRST_LOOKS[-1]


SCALES = (1.0, 0.75, 0.5, 0.375, 0.25)  # of the working size, that a machine may choose from
SMALLEST = 480 * 360  # px, that it may choose: less saves nothing
ROOMY = 3  # number of the rung that must fit; lower ones are a reserve for other work on the machine
PIXELS_PER_GAUSSIAN = 4  # fewer pixels do not determine its colour, slopes and place
WITH_OTHERS = 1.1  # factor on prices for other work on the machine: a guess until frames are measured


def price(rung: Rung, gaussians: float, pixels: int, prices: Prices = ON_CPU) -> float:
    """Return the time that a frame takes, ms on the machine of the prices.

    Args:
        gaussians: how many the model has.
        pixels: of the working size.
    """
    pictures = pixels / FULL
    drawn = rung.scale**2 * pictures * (prices.drawn * (1 + rung.redraw) + prices.stepped)
    vision = prices.every_frame + prices.depth / rung.depth_every + prices.worked * pictures
    return vision + drawn + prices.per_thousand * 1e-3 * gaussians


def best_scale(rungs: Sequence[Rung], pixels: int, seconds: float, speed: float) -> float:
    """The largest of `SCALES` that leaves room; `benchmarks/ladder.md` has what sizes give and cost.

    Args:
        pixels: of the image at scale 1.
        seconds, speed: see `Ladder`.
    """
    affords = FIRST_AIM * 1e3 * seconds / (WITH_OTHERS * speed)  # ms, in units of the prices
    rung = rungs[min(ROOMY, len(rungs) - 1)]
    scales = [scale for scale in SCALES if scale == 1 or scale**2 * pixels >= SMALLEST]
    costs = (price(rung, USED * rung.gaussians, round(scale**2 * pixels)) for scale in scales)
    return next((scale for scale, ms in zip(scales, costs, strict=True) if ms <= affords), scales[-1])


class Ladder:
    """Finds the rung that fills a frame's time, by what frames take.

    In the first frames it jumps to where the measured speed says; then it goes down by one when frames take
    too long or too many of them are late, and up by one when higher rungs have seemed to fit for a while: the
    more of them, the sooner. A climb that did not hold makes it more patient.

    What makes single frames late (a neighbour, what is done twice a second) does not depend on the rung. So a
    late frame on one rung tells how late it would have been on another.

    Attributes:
        rung: of the next frame.
        speed: the time that the machine takes, in units of the prices' machine.
        reason: why it is that one, for people.
    """

    def __init__(
        self, rungs: Sequence[Rung], pixels: int, seconds: float, speed: float = 1.0,
        prices: Prices = ON_CPU, fixed: int | None = None,
    ) -> None:  # fmt: skip
        """
        Args:
            rungs: from the cheapest to the best.
            pixels: of the working size.
            seconds: that a frame may take.
            speed: the time that the machine takes, in units of the prices' machine.
            prices: what frames cost there.
            fixed: the rung that it stays on.
        """
        self._rungs = rungs
        self._fixed = fixed
        self._prices = prices
        self._pixels = pixels
        self.speed = speed
        self._took: deque[float] = deque(maxlen=AVERAGED)  # frames, in units of their prices
        self._beyond: deque[float] = deque(maxlen=LATE_OF)  # ms by which frames took longer than expected
        self._frames = 0
        self._since = 0  # frames since the rung changed
        self._fitted = 0  # sum over frames in a row of the higher rungs that would have fitted
        self._patience = PATIENCE
        self._climbed = False  # whether the last change was up
        self.seconds = seconds
        self.place, self.reason = self._best(FIRST_AIM), "by the machine's speed"
        if fixed is not None:
            self.place, self.reason = fixed, "by mapping.rung"

    @property
    def rung(self) -> Rung:
        return self._rungs[self.place]

    @property
    def state(self) -> RungState:
        """The rung and why it is that one, for people."""
        rung = self.rung
        return RungState(
            self.place, len(self._rungs), self.reason, rung.gaussians, rung.scale, rung.depth_every
        )

    def learn(self, seconds: float, gaussians: int) -> None:
        """Learn that a frame took `seconds`, without its further steps, with that many Gaussians."""
        usual_ms = price(self.rung, gaussians, self._pixels, self._prices)
        took = 1e3 * seconds / usual_ms
        self._frames += 1
        self._since += 1
        self._took.append(took)
        usual = sorted(self._took)[:-2] or [took]
        self.speed = sum(usual) / len(usual)
        self._beyond.append(1e3 * seconds - self.speed * usual_ms)
        if self._frames <= FIRST_FRAMES:
            if self._frames in FIRST_LOOKS:
                self._go(self._best(AIM), "by the time of the first frames")
            return
        if self._since < SETTLING:
            return
        ms, expected = 1e3 * self.seconds, self._expected(self.place)
        said = f"frames took {expected:.0f} of {ms:.0f} ms"
        too_many = expected > min(ms, self._most(self._tail(LATE, self._since)))
        if too_many and self.place > 0:
            if self._climbed:
                self._patience = min(2 * self._patience, LONGEST_PATIENCE)
            late = f"more than {LATE} of {min(self._since, LATE_OF)} frames took over {ms:.0f} ms"
            self._go(self.place - 1, said if expected > ms else late)
            return
        room = self._best(CLIMB, self._tail(LATE_HIGHER, LATE_OF)) - self.place
        self._fitted = self._fitted + room if room > 0 else 0
        if self._fitted >= self._patience:
            self._go(self.place + 1, said)

    def _expected(self, place: int) -> float:
        """ms that a frame takes on that rung."""
        rung = self._rungs[place]
        return self.speed * price(rung, USED * rung.gaussians, self._pixels, self._prices)

    def _tail(self, late: int, frames: int) -> float:
        """ms above the expected time that all but `late` of the last `frames` frames stayed below."""
        return sorted([0.0] * (late + 1) + list(self._beyond)[-frames:])[-late - 1]

    def _most(self, beyond: float) -> float:
        """The most ms that a frame may be expected to take, if late ones take `beyond` ms more."""
        return 1e3 * self.seconds - min(beyond, SPARE * 1e3 * self.seconds)

    def _best(self, share: float, beyond: float = 0.0) -> int:
        """The highest rung whose expected time is within a share of the time that `beyond` ms leave."""
        most = share * self._most(beyond)
        return max((i for i in range(len(self._rungs)) if self._expected(i) <= most), default=0)

    def _go(self, place: int, reason: str) -> None:
        if place == self.place or self._fixed is not None:
            return
        self._climbed = place > self.place
        self.place, self.reason = place, reason
        self._since = self._fitted = 0
