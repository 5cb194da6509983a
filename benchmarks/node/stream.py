"""Does the model last over a stream that never ends? Memory, and quality where the window of time moves on.

A session is played in a loop for several times the window, frame by frame, and three models learn from it:
the product's, one that forgets what leaves its window, and one whose window covers the whole stream, which
nothing leaves. Each picture is compared with the frame itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.table import Table

from sags_node.engine.rasterizer.views import colours_of
from sags_node.evaluation.metrics import as_float, psnr
from sags_node.evaluation.provenance import machine_name
from sags_node.evaluation.receipt import Receipt
from sags_node.fitting.clip import ClipFrame, play
from sags_node.fitting.stream import StreamFit, StreamSettings
from sags_node.kernels.threads import configure_threads
from sags_node.pipeline.session import Session
from sags_node.processes import resident_mb
from sags_node.types import F32

AGES = (0.25, 0.5, 0.75, 1.0)  # of the window: what is still remembered of then
NEAR = 0.15  # s from such an age to the nearest frame that is kept
SETTLED = 1.0  # s from the start that do not count

Advance = Callable[[int, int, str], None]  # done, total, what comes next


@dataclass(frozen=True, slots=True)
class _Arrival:
    """What was measured of one frame, PSNR in dB over tissue."""

    seconds: float  # since the first frame
    predicted: float  # drawn before the frame was learnt from
    learnt: float  # and after
    retired: int  # slots that left the window
    jump: float  # 0..1: largest change of a drawn colour as they did, at times that stay within the window
    ms: float


def measure_stream(session: Session, settings: StreamSettings, advance: Advance) -> dict[str, Any]:
    """Play the session once for each model.

    Args:
        session: a finite recording or one that loops with a number of frames.
        settings: of the product's model.
        advance: called with what is going on.

    Returns:
        The table, keys as benchmarks/README.md lists them.

    Raises:
        SagsError: the recording cannot be read, or no frame has depth enough.
    """
    configure_threads(session.config.engine.threads)
    count = session.source.frame_count or 0
    seconds = count / session.source.rate
    variants = {
        "window": settings,
        "no_folding": replace(settings, folds=False),
        "window_covers_all": replace(settings, window=seconds),
    }
    found: dict[str, Any] = {
        "machine": machine_name(),
        "frames": count,
        "seconds": seconds,
        "window_s": settings.window,
        "slot_s": settings.slot,
        "steps_per_frame": settings.newest_steps + settings.replay_steps,
        "tokens": settings.tokens,
    }
    for turn, (name, chosen) in enumerate(variants.items()):

        def progress(done: int, turn: int = turn, name: str = name) -> None:
            advance(turn * count + done, len(variants) * count, name.replace("_", " "))

        found[name] = _play(session, chosen, settings.window, progress)
    return found


def _play(
    session: Session, settings: StreamSettings, remembered: float, progress: Callable[[int], None]
) -> dict[str, Any]:
    """One model through the whole stream. `remembered` s back it is asked for what it still knows."""
    fit: StreamFit | None = None
    receipt = Receipt(session.rig, session.working_size, None)
    arrivals: list[_Arrival] = []
    by_second: list[dict[str, Any]] = []
    first_ns, per_second = 0, max(1, round(session.source.rate))
    for done, frame in enumerate(play(session, references=False, on_frame=receipt.add)):
        if fit is None:
            height, width = frame.tissue.shape
            fit, first_ns = StreamFit(width, height, settings), frame.t_capture_ns
        arrivals.append(_take(fit, frame, first_ns))
        if (done + 1) % per_second == 0:
            state = _state(fit, frame, remembered)
            by_second.append(_summary(arrivals[-per_second:], len(by_second) + 1) | state)
        progress(done + 1)
    settled = [each for each in arrivals if each.seconds >= SETTLED]
    moved = [each for each in settled if each.retired]
    still = [each for each in settled if not each.retired]
    return {
        "psnr_predicted": _mean(each.predicted for each in settled),
        "psnr_learnt": _mean(each.learnt for each in settled),
        "ms_per_frame": _mean(each.ms for each in settled),
        "retired_slots": sum(each.retired for each in arrivals),
        "largest_jump": max((each.jump for each in arrivals), default=0.0),
        "psnr_predicted_at_retirement": _mean(each.predicted for each in moved),
        "psnr_predicted_elsewhere": _mean(each.predicted for each in still),
        "by_second": by_second,
        "receipt": receipt.as_json(),
    }


def _take(fit: StreamFit, frame: ClipFrame, first_ns: int) -> _Arrival:
    """Let the model learn from a frame, and look before, in between and after."""
    looked = [fit.kept[len(fit.kept) // 2], fit.kept[-1]] if fit.kept else []
    before = [_picture(fit, each) for each in looked]
    began = time.perf_counter()
    retired = fit.arrive(frame)
    arrived = time.perf_counter()
    after = [_picture(fit, each) for each in looked]
    jumps = [
        float(np.abs(a - b)[each.tissue].max()) for a, b, each in zip(before, after, looked, strict=True)
    ]
    predicted = _psnr(fit, frame)
    resumed = time.perf_counter()
    fit.learn()
    spent = time.perf_counter() - resumed + arrived - began
    seconds = (frame.t_capture_ns - first_ns) * 1e-9
    return _Arrival(seconds, predicted, _psnr(fit, frame), retired, max(jumps, default=0.0), spent * 1e3)


def _state(fit: StreamFit, frame: ClipFrame, remembered: float) -> dict[str, Any]:
    """What the model remembers of the last `remembered` seconds, and its size."""
    ages: dict[str, float | None] = {}
    for age in AGES:
        wanted = frame.t_capture_ns - age * remembered * 1e9
        nearest = min(fit.kept, key=lambda each: abs(each.t_capture_ns - wanted))
        there = abs(nearest.t_capture_ns - wanted) <= NEAR * 1e9  # not yet at the start
        ages[f"{age * remembered:g} s ago"] = _psnr(fit, nearest) if there else None
    kept = sum(each.image.nbytes + each.tissue.nbytes + each.depth.nbytes for each in fit.kept)
    return {
        "psnr_remembered": ages,
        "gaussians": len(fit.model),
        "model_mb": fit.model.nbytes / 1e6,
        "frames_kept": len(fit.kept),
        "frames_mb": kept / 1e6,
        "rss_mb": resident_mb(),
    }


def _summary(arrivals: list[_Arrival], second: int) -> dict[str, Any]:
    """Means over the frames of one second."""
    return {
        "second": second,
        "psnr_predicted": _mean(each.predicted for each in arrivals),
        "psnr_learnt": _mean(each.learnt for each in arrivals),
        "retired_slots": sum(each.retired for each in arrivals),
        "largest_jump": max(each.jump for each in arrivals),
        "ms_per_frame": _mean(each.ms for each in arrivals),
    }


def _picture(fit: StreamFit, frame: ClipFrame) -> F32:
    """[H, W, 3] the model at the time of a frame."""
    planes = fit.draw(frame.t_capture_ns, frame.camera)
    return colours_of(planes)


def _psnr(fit: StreamFit, frame: ClipFrame) -> float:
    return psnr(_picture(fit, frame), as_float(frame.image), frame.tissue)


def _mean(values: Iterable[float]) -> float | None:
    listed = list(values)
    return float(np.mean(listed)) if listed else None


def tables(measured: Mapping[str, Any]) -> list[Table]:
    """For people; `measured` as `measure_stream` returns it."""
    made = []
    for name in ("window", "no_folding", "window_covers_all"):
        part = measured[name]
        ages = list(part["by_second"][0]["psnr_remembered"]) if part["by_second"] else []
        table = Table(
            "second", "predicted, dB", "learnt, dB", *ages, "slots retired", "largest jump", "Gaussians",
            "model, MB", "frames, MB", "process, MB", "ms per frame",
            title=name.replace("_", " "),
        )  # fmt: skip
        for row in part["by_second"]:
            table.add_row(
                str(row["second"]),
                f"{row['psnr_predicted']:.2f}",
                f"{row['psnr_learnt']:.2f}",
                *("–" if value is None else f"{value:.2f}" for value in row["psnr_remembered"].values()),
                str(row["retired_slots"]),
                f"{row['largest_jump']:.1e}",
                str(row["gaussians"]),
                f"{row['model_mb']:.1f}",
                f"{row['frames_mb']:.0f}",
                f"{row['rss_mb']:.0f}",
                f"{row['ms_per_frame']:.0f}",
            )
        made.append(table)
    return made
