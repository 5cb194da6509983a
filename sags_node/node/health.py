"""The health of the node: rates, latencies and costs of its last frames, and warnings from them."""

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import chain
from math import inf
from statistics import median

import numpy as np

from sags_node.config.schema import MappingConfig, PushSource, RecordedSource, Ros2Source, Source
from sags_node.findings import Findings, by_code, by_stage
from sags_node.processes import resident_mb
from sags_node.types import ClockStatus, Finding, FrameResult, MotionState, NodeHealth, RungState, ViewStatus

WAITING_AFTER = 1.0  # s without a frame until the state is `waiting`, without one taken in until it is `held`
WINDOW = 150  # frames from which the published rates and latencies are computed
MOST_LEFT_OUT = 0.1  # share of frames; with more left out, readers refuse the rest (`messaging.freshness`)
BACK_AT = 0.8  # share of `MOST_LEFT_OUT` at which a warning ends
DRAWN = 0.05  # share of the tissue; with less drawn, nothing is shown
EVERY = 8  # px between the pixels that `_lacks` looks at
WHY_NONE = {"calibration_changed", "sent_refused"}  # warnings that say themselves why no frame comes
LONGER = 1.05  # times the period of frames: a budget that was only rounded up is not too long


LOWER = ", or lower mapping.max_gaussians or vision.scale"  # on the lowest rung nothing is left to lower
TOO_SLOW = "this machine is too slow for them"


def why_missed(mapping: MappingConfig, rate: float | None) -> str:
    """Why frames are left out, if they are, and the remedy.

    Args:
        rate: frames that come per second; None: they come when they are taken.
    """
    if mapping.iterations is not None:
        return "mapping.iterations fixes the work on each: lower it, or leave it out"
    if rate is not None and mapping.frame_ms(rate) > LONGER * 1e3 / rate:
        of = f"of {mapping.budget_ms:g} is longer than the {1e3 / rate:.1f} ms from frame to frame"
        return f"mapping.budget_ms {of}: leave it out"
    if mapping.rung is not None:
        return "mapping.rung fixes the quality: lower it, or leave it out"
    return TOO_SLOW


class Statistics:
    """Rate, latency and cost of the last frames.

    Args:
        source: where they come from.
    """

    def __init__(self, source: Source | None = None) -> None:
        self._nothing_comes, self._too_few_come = _remedies(source)
        self._lock = threading.Lock()
        self._published: deque[float] = deque(maxlen=WINDOW)
        self._taken_in = -inf  # when a frame that was taken in was last published
        self._resumed = -inf
        self._drawn = inf  # when one that shows the model was; inf: none is expected yet
        self._lacks = ""  # why the last frame that was taken in does not show the model
        self._latency: deque[float] = deque(maxlen=WINDOW)
        self._stamped_now = not (isinstance(source, RecordedSource) and source.pace == "step")
        self._worked: deque[float] = deque(maxlen=WINDOW)  # ms on each
        self._stages: dict[str, deque[float]] = {}
        self._skipped: dict[str, int] = {}
        self._gaussians = 0
        self._rung: RungState | None = None
        self._motion: MotionState | None = None
        self._started = False
        self._left_out: deque[Mapping[str, int]] = deque(maxlen=WINDOW)  # slot -> frames, since the start
        self._too_many: set[str] = set()  # slots that leave out too many frames
        # Median time from capture to published; 0 before the first frame. Read without the lock, which others
        # may hold for long.
        self.latency_s = 0.0

    def add(self, result: FrameResult, latency_ms: float, dropped: Mapping[str, int]) -> bool:
        """Add a published frame; `dropped`: how many frames each slot has left out until now.

        Returns:
            Whether it is the first after a time without frames: the node was waiting or starting.
        """
        with self._lock:
            waited = self._is_waiting(time.monotonic())
            self._left_out.append(dropped)
            self._started = True
            self._published.append(time.monotonic())
            if not result.held:
                self._taken_in = self._published[-1]
                self._lacks = _lacks(result)
            if result.held or not self._lacks or waited:
                self._drawn = self._published[-1]
            if self._stamped_now:  # else stamps are not wall-clock times of now
                self._latency.append(latency_ms)
                self.latency_s = 1e-3 * median(self._latency)
            self._worked.append(sum(result.timings_ms.values()))
            for stage, ms in result.timings_ms.items():
                self._stages.setdefault(stage, deque(maxlen=WINDOW)).append(ms)
            for what in result.skipped:
                self._skipped[what] = self._skipped.get(what, 0) + 1
            self._gaussians = len(result.snapshot.gaussians)
            self._rung = result.rung
            forecast = result.snapshot.forecast
            self._motion = None if forecast is None else forecast.state
        return waited

    def _is_waiting(self, now: float) -> bool:
        last = self._published[-1] if self._published else self._resumed
        return now - last > WAITING_AFTER

    @property
    def flowing(self) -> bool:
        """Tell whether frames come; those before the last pause do not count."""
        with self._lock:
            return bool(self._published) and not self._is_waiting(time.monotonic())

    def resume(self) -> None:
        """Start anew after a pause: the time without frames during it does not count."""
        with self._lock:
            self._published.clear()
            self._resumed = self._taken_in = time.monotonic()
            self._drawn = max(self._drawn, self._resumed)

    def health(
        self,
        dropped: dict[str, int],
        stopping: bool,
        paused: bool,
        error: BaseException | None,
        warnings: Findings,
        connections: dict[str, dict[str, int]],
        views: Mapping[str, ViewStatus],
        clock: ClockStatus | None = None,
        missed: str = TOO_SLOW,
        working: float = 0.0,
        recording: Mapping[str, object] | None = None,
    ) -> NodeHealth:
        """Return the health of the node now.

        Args:
            missed: why frames are left out, if they are, and the remedy.
            working: s for which the newest frame has been worked on; 0: none is.
        """
        consumers = connections.get("data", {}).get("open", 0)
        with self._lock:
            now = time.monotonic()
            waiting = self._is_waiting(now)
            span = self._published[-1] - self._published[0] if len(self._published) > 1 else 0.0
            if stopping:
                state = "stopping"
            elif error is not None:
                state = "degraded"
            elif paused:
                state = "paused"
            elif waiting:
                state = "waiting" if self._started else "starting"
            elif now - self._taken_in > WAITING_AFTER:
                state = "held"
            else:
                state = "running"
            return NodeHealth(
                state=state,
                rate_hz=(len(self._published) - 1) / span if span > 0 and not (waiting or paused) else 0.0,
                latency_ms=_percentiles(self._latency),
                frame_ms=_percentiles(self._worked),
                stage_ms={stage: float(np.median(ms)) for stage, ms in self._stages.items()},
                dropped=dropped,
                gaussians=self._gaussians,
                rss_mb=resident_mb(),
                skipped=dict(self._skipped),
                last_error=str(error) if error else None,
                warnings=by_stage(
                    [
                        *chain(*warnings.values()),
                        *self._findings(state, now, missed, working, consumers, warnings),
                    ]
                ),
                connections=connections,
                views=views,
                rung=self._rung,
                motion=self._motion,
                clock=clock,
                recording=recording,
            )

    def _findings(
        self, state: str, now: float, missed: str, working: float, consumers: int, known: Findings
    ) -> list[Finding]:
        """Return the warnings about the flow of frames; to be called with the lock held."""
        found = []
        if state == "waiting" and working > WAITING_AFTER:
            said = f"one frame has been worked on for {working:.0f} s, as {missed}"
            found.append(Finding("mapping_hangs", f"{said}; if it stays, restart the node"))
        elif state == "waiting" and not WHY_NONE & by_code(known).keys():
            said = f"no frame for {now - self._published[-1]:.0f} s" if self._published else "no frame comes"
            found.append(Finding("no_frames", f"{said}: {self._nothing_comes}"))
        if state == "running" and now - self._drawn > WAITING_AFTER:
            found.append(Finding("no_model", f"nothing is shown: {self._lacks}"))
        if self._leaves_out_too_many("source"):
            said = "the source leaves out over a tenth of its frames"
            helps = self._too_few_come or f"{_relief(consumers)}, or is the disk slow?"
            found.append(Finding("source_drops", f"{said}: {helps}"))
        if self._leaves_out_too_many("capture"):
            if missed == TOO_SLOW:
                lower = "" if self._rung is not None and self._rung.number == 0 else LOWER
                missed = f"{missed}: {_relief(consumers)}{lower}"
            found.append(Finding("frames_missed", f"over a tenth of the frames is left out, as {missed}"))
        return found

    def _leaves_out_too_many(self, slot: str) -> bool:
        if len(self._left_out) == WINDOW:
            count = self._left_out[-1].get(slot, 0) - self._left_out[0].get(slot, 0)
            limit = MOST_LEFT_OUT * (BACK_AT if slot in self._too_many else 1.0)
            (self._too_many.add if count > limit * (count + WINDOW - 1) else self._too_many.discard)(slot)
        return slot in self._too_many


def _relief(consumers: int) -> str:
    """Return advice that leaves the node more of its machine's time."""
    if consumers == 0:
        return "end other programs"
    what = "1 consumer takes" if consumers == 1 else f"{consumers} consumers take"
    return f"{what} messages: end some, or let them subscribe to thin/ topics; end other programs"


def _lacks(result: FrameResult) -> str:
    """Why hardly anything of the model is drawn in a frame; empty: enough is."""
    tissue = result.observation.tissue[::EVERY, ::EVERY]
    if not tissue.any():
        return "no tissue is seen; is the scope where it should be, and does the mask fit (vision.tissue)?"
    drawn = result.views["left"].alpha[::EVERY, ::EVERY][tissue] > 0.5
    if np.mean(drawn) >= DRAWN:
        return ""
    return result.skipped.get("depth") or "no depth is known"


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    """The percentiles and the maximum; 0 if there are no values."""
    p50, p90, p99, most = np.percentile(values or [0.0], [50, 90, 99, 100]).tolist()
    return {"p50": p50, "p90": p90, "p99": p99, "max": most}


def _remedies(source: Source | None) -> tuple[str, str]:
    """Return the remedies for when no frame comes, and for when over a tenth is left out."""
    match source:
        case PushSource():
            what = f"start the sender at {source.endpoint}"
        case Ros2Source():
            what = f"start what publishes {source.left} and {source.right}"
        case RecordedSource():
            return "is the disk slow?", ""  # see `_relief`
        case _:
            what = "check the camera, its cable and the capture card"
            return what, "is one camera away, or source.pair_tolerance_ms too small?"
    return (
        what,
        "do the images of both eyes come, with stamps no further apart than source.pair_tolerance_ms?",
    )


def in_a_line(health: NodeHealth) -> str:
    """State, rate and latency, then the codes of all warnings."""
    latency = health.latency_ms["p50"]
    words = f"{health.state}, {health.rate_hz:.1f} Hz, latency {latency:.0f} ms, {health.gaussians} Gaussians"
    codes = ", ".join(by_code(health.warnings))
    return f"{words}; warnings: {codes}" if codes else words
