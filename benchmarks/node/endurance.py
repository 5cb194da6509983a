"""Does the node last? Thousands of frames in a row: time, quality, sizes and memory, window by window.

The frames of a recording are kept in memory and played there and back, so that nothing ever jumps, in a loop,
or in an order that never repeats. At the end one frame is shown again and again: what stillness costs.
"""

import itertools
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from benchmarks import Advance
from sags_node.errors import SagsError
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.budget import Budget
from sags_node.mapping.mapped import SETTLED
from sags_node.messaging import published
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.pipeline.session import Session
from sags_node.processes import resident_mb
from sags_node.quality.metrics import as_float, psnr
from sags_node.tools.evaluation.provenance import machine_name
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import U8, StereoFrame

Order = Literal["there-and-back", "wrap", "walk"]

MOST_BYTES = 4_000_000_000  # of images kept in memory
TURN = 0.05  # chance per frame that a walk goes the other way
WATCHED = FrameRequest(left=True, right=True)  # somebody looks at both eyes
STILL_FRAMES = 100
CAMERA_NOISE = 2.0  # grey levels, standard deviation
FIGURES = ("ms_p50", "ms_p99", "psnr", "model_psnr", "gaussians", "nodes", "rss_mb")


@dataclass(frozen=True, slots=True)
class _Taken:
    """What one frame cost, and how it looked."""

    ms: float
    cpu_ms: float
    psnr: float  # dB over tissue of what is published, mostly the frame's own image, against the frame
    model_psnr: float  # dB, the same of the model alone
    still: bool
    hurried: bool  # depth was left out for lack of time


@dataclass(frozen=True, slots=True)
class Window:
    """Some hundred frames in a row."""

    frames: int  # played up to its end
    ms_p50: float
    ms_p99: float
    psnr: float  # dB, median
    model_psnr: float  # dB, median
    gaussians: int  # at its end
    nodes: int  # that Gaussians follow, likewise
    rss_mb: float  # likewise
    still: int  # frames in which nothing moved
    hurried: int  # frames without time for depth
    restarts: int  # of the model, since the first frame


class _Run:
    """A pipeline in step mode; frame numbers and stamps go on when the recording repeats."""

    def __init__(self, session: Session) -> None:
        configure_threads(session.config.engine.threads)
        self.pipeline = Pipeline(session.config, session.rig)
        self._budget: Budget = self.pipeline.make_budget()
        self._rate = session.source.rate
        self._number = 0
        self.receipt = Receipt(session.rig, session.working_size, None)

    def take(self, frame: StereoFrame) -> _Taken:
        stamp = round(self._number * 1e9 / self._rate)
        frame = replace(frame, frame_id=self._number, t_capture_ns=stamp, t_capture_right_ns=stamp, epoch=0)
        self._number += 1
        began, cpu_began = time.perf_counter(), time.process_time()
        result = self.pipeline.process(frame, self._budget, WATCHED)
        ms, cpu_ms = (time.perf_counter() - began) * 1e3, (time.process_time() - cpu_began) * 1e3
        pair, view, tissue = result.pair, result.views["left"], result.observation.tissue
        size, where = published.size_of(pair), published.nearest(pair, tissue)
        true = as_float(published.picture(pair, "left"))
        shown, model = (
            psnr(as_float(each), true, where)
            for each in (published.colours(view, size), view.colours.at(*size))
        )
        self.receipt.add(frame, tissue)
        still = "motion" in result.skipped
        return _Taken(ms, cpu_ms, shown, model, still, not still and "depth" in result.skipped)

    def window(self, taken: Sequence[_Taken]) -> Window:
        model = self.pipeline.map.model
        p50, p99 = np.percentile([each.ms for each in taken], [50, 99])
        return Window(
            frames=self._number,
            ms_p50=float(p50),
            ms_p99=float(p99),
            psnr=float(np.nanmedian([each.psnr for each in taken])),
            model_psnr=float(np.nanmedian([each.model_psnr for each in taken])),
            gaussians=model.count,
            nodes=int(model.node_index.max(initial=-1)) + 1,
            rss_mb=resident_mb(),
            still=sum(each.still for each in taken),
            hurried=sum(each.hurried for each in taken),
            restarts=self.pipeline.map.restarts,
        )


TABLES = (
    "frames ms_p50 ms_p99 psnr model_psnr gaussians nodes rss_mb still hurried restarts",
    "slope standard_error",
    "still: recognised settled cpu_ms moving_cpu_ms cpu_ratio model_psnr",
)


def measure_endurance(
    session: Session, frames: int, per_window: int, order: Order, advance: Advance, seed: int = 0
) -> dict[str, Any]:
    """Play a recording's frames over and over; keys as benchmarks/README.md lists them. Ctrl-C ends it with
    what is known by then.

    Args:
        session: a finite recording that fits into memory.
        order: there and back; from the start again after the last frame, which is a cut where the recording
            does not end as it began; or a random walk through time.
        seed: of the walk, and of the camera's noise over what stands still.
    """
    kept = _kept(session)
    run = _Run(session)
    windows: list[Window] = []
    moving: list[_Taken] = []  # of the newest window
    still: list[_Taken] = []
    interrupted = False
    try:
        for done, index in enumerate(itertools.islice(visits(len(kept), order, seed), frames)):
            if len(moving) == per_window:
                moving.clear()
            moving.append(run.take(kept[index]))
            if len(moving) == per_window:
                windows.append(run.window(moving))
            advance(done + 1, frames + STILL_FRAMES, "playing")
        for done, frame in enumerate(_photographed(kept[index], STILL_FRAMES, seed)):
            still.append(run.take(frame))
            advance(frames + done + 1, frames + STILL_FRAMES, "standing still")
    except KeyboardInterrupt:
        interrupted = True
    return {
        "machine": machine_name(),
        "session": session.name,
        "order": order,
        "recorded_frames": len(kept),
        "per_window": per_window,
        "budget_ms": session.config.mapping.frame_ms(),
        "interrupted": interrupted,
        "windows": [asdict(window) for window in windows],
        "per_1000_frames": {figure: slope(windows, figure) for figure in FIGURES},
        "still": _stillness(moving, still),
        "receipt": run.receipt.as_json(),
    }


def slope(windows: Sequence[Any], figure: str) -> dict[str, float] | None:
    """Return how a figure changes in 1000 frames, with its standard error: least squares over all windows but
    the first, in which the model is still made. None of fewer than three: two always lie on a line."""
    counted = [window for window in windows[1:] if math.isfinite(getattr(window, figure))]
    if len(counted) < 3:
        return None
    x = np.array([window.frames for window in counted]) / 1000
    y = np.array([getattr(window, figure) for window in counted], np.float64)
    x -= x.mean()
    y -= y.mean()  # what never changes has a slope of zero, not of the last bit
    spread = float(np.sum(x * x))
    per_1000 = float(np.sum(x * y)) / spread
    residuals = y - per_1000 * x
    error = math.sqrt(float(np.sum(residuals * residuals)) / (len(y) - 2) / spread)
    return {"slope": per_1000, "standard_error": error}


def _kept(session: Session) -> list[StereoFrame]:
    """All frames of the session."""
    kept: list[StereoFrame] = []
    held = 0
    with session.source as source:
        for frame in source:
            arrays = (frame.left, frame.right, frame.tissue, frame.depth)
            held += sum(array.nbytes for array in arrays if array is not None)
            if held > MOST_BYTES:
                raise SagsError(
                    f"more than {len(kept)} frames do not fit into {MOST_BYTES / 1e9:.0f} GB; play fewer, "
                    f"e.g. source.frames:={len(kept)}"
                )
            kept.append(frame)
    if not kept:
        raise SagsError("the recording has no frames; check source.start and source.frames")
    return kept


def visits(count: int, order: Order, seed: int) -> Iterator[int]:
    """Yield the index of the next frame, without end."""
    if order == "wrap":
        yield from itertools.cycle(range(count))
    elif order == "there-and-back":
        yield from itertools.cycle([*range(count), *range(count - 2, 0, -1)])
    else:
        yield from _walk(count, np.random.default_rng(seed))


def _walk(count: int, rng: np.random.Generator) -> Iterator[int]:
    """A walk to the next or the previous frame. It turns round at the ends, and now and then between them."""
    at, step = 0, 1
    while True:
        yield at
        if rng.random() < TURN:
            step = -step
        if not 0 <= at + step < count:
            step = -step
        at = min(max(at + step, 0), count - 1)


def _photographed(frame: StereoFrame, times: int, seed: int) -> Iterator[StereoFrame]:
    """The same scene again and again, each time with the camera's noise."""
    rng = np.random.default_rng(seed)

    def noisy(picture: U8) -> U8:
        noise = np.float32(CAMERA_NOISE) * rng.standard_normal(picture.shape, np.float32)
        return np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)

    for _ in range(times):
        right = None if frame.right is None else noisy(frame.right)
        yield replace(frame, left=noisy(frame.left), right=right)


def _stillness(moving: Iterable[_Taken], still: Sequence[_Taken]) -> dict[str, Any] | None:
    """What frames cost in which nothing moves, once the model has settled, against moving ones before."""
    settled = [each for each in still[SETTLED + 1 :] if each.still]
    before = [each for each in moving if not each.still]
    if not settled or not before:
        return None
    cpu_ms = float(np.mean([each.cpu_ms for each in settled]))
    moving_cpu_ms = float(np.mean([each.cpu_ms for each in before]))
    return {
        "frames": len(still),
        "recognised": sum(each.still for each in still),
        "settled": len(settled),
        "cpu_ms": cpu_ms,
        "moving_cpu_ms": moving_cpu_ms,
        "cpu_ratio": cpu_ms / moving_cpu_ms,
        "ms_p50": float(np.median([each.ms for each in settled])),
        "psnr": float(np.median([each.psnr for each in settled])),
        "model_psnr": float(np.median([each.model_psnr for each in settled])),
    }
