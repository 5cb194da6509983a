"""What does each part of the SAGS model bring? The ablation of the paper, and of what goes beyond it.

Every variant is fitted to the same training frames with the same number of iterations and measured on the
same frames that it never saw: every eighth, and the last ones of the recording, which ask it to look ahead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any

from rich.table import Table

from sags_node.errors import SagsError
from sags_node.evaluation.lpips import Lpips
from sags_node.evaluation.machine import machine_name
from sags_node.evaluation.measure import Options
from sags_node.fitting.clip import Clip, ClipFrame, read_clip
from sags_node.fitting.fit import Fit
from sags_node.fitting.score import score, score_depth, score_tracks
from sags_node.fitting.settings import FitSettings
from sags_node.kernels.threads import configure_threads
from sags_node.session import Session

AHEAD = 3  # last frames that nothing is learnt from

PAPER = FitSettings(schedule="paper", tokens="self", slots=60, max_gaussians=30_000)
ONLINE = FitSettings(max_gaussians=30_000)
VARIANTS: Mapping[str, FitSettings] = {
    "base": replace(PAPER, adaptive=False, antialias=False),
    "no_alias_free": replace(PAPER, antialias=False),
    "no_adaptive": replace(PAPER, adaptive=False),
    "full": PAPER,
    "planes": replace(PAPER, tokens="planes"),
    "nodes": replace(PAPER, tokens="nodes"),
    "online": ONLINE,
    "online_no_alias_free": replace(ONLINE, antialias=False),
    "online_no_adaptive": replace(ONLINE, adaptive=False),
    "online_self": replace(ONLINE, tokens="self"),
}

Advance = Callable[[int, int | None, str], None]  # done, of, what


def measure_ablation(
    session: Session, warm_up: int, iterations: int, options: Options, advance: Advance
) -> dict[str, Any]:
    """Fit and measure every variant.

    Args:
        session: a recording.
        warm_up: iterations of each fit without deformation; only of the paper's schedule.
        iterations: of each fit, with deformation.
        options: hold-out and LPIPS weights.
        advance: called with what is going on.

    Returns:
        The table, keys as benchmarks/README.md lists them.

    Raises:
        SagsError: the recording cannot be read or is too short, or no frame has depth enough.
    """
    lpips = None if options.lpips_weights is None else Lpips(options.lpips_weights)
    configure_threads(session.config.engine.threads)
    count = session.source.frame_count
    clip = read_clip(session, options.holds_out, lambda done: advance(done, count, "reading"))
    known, ahead = _split(clip)
    known_frames = _by_time(known)
    chosen = {
        name: replace(settings, warm_up=warm_up if settings.schedule == "paper" else 0, iterations=iterations)
        for name, settings in VARIANTS.items()
    }
    variants = {}
    for name, settings in chosen.items():
        fit = Fit(known, settings)
        advance(0, None, f"{name}: starting")
        fit.start(lambda what, done, of: advance(done, of, what))
        started = fit.seconds
        while not fit.done:
            fit.iterate()
            advance(fit.iteration, fit.total, f"{name}: fitting")
        variants[name] = {
            "heldout": score(fit, known.test, session.config.segments, lpips),
            "ahead": score(fit, ahead, {}, lpips),
            "depth": score_depth(fit, known_frames, session.config.segments),
            "track": score_tracks(fit, known_frames),
            "track_with_ahead": score_tracks(fit, [known_frames[0], *ahead]),
            "gaussians": len(fit.model),
            "ms_per_iteration": round(1e3 * (fit.seconds - started) / fit.total, 1),
            "seconds": round(fit.seconds, 1),
        }
    return {
        "session": session.name,
        "warm_up": warm_up,
        "iterations": iterations,
        "settings": {name: asdict(settings) for name, settings in chosen.items()},
        "machine": machine_name(),
        "variants": variants,
    }


def _by_time(clip: Clip) -> list[ClipFrame]:
    return sorted((*clip.train, *clip.test), key=lambda frame: frame.frame_id)


def _split(clip: Clip) -> tuple[Clip, list[ClipFrame]]:
    """The clip without its last frames, and those."""
    frames = _by_time(clip)
    ahead = {frame.frame_id for frame in frames[-AHEAD:]}
    known = Clip(
        [frame for frame in clip.train if frame.frame_id not in ahead],
        [frame for frame in clip.test if frame.frame_id not in ahead],
    )
    if not known.train or not known.test:
        raise SagsError(
            f"there are {len(frames)} frames; without the last {AHEAD}, which are for looking ahead, "
            f"{len(known.train)} are left to learn from and {len(known.test)} to test on, and each needs "
            "one: play more (source.frames, source.start) or change --hold-out"
        )
    return known, frames[-AHEAD:]


def table(measured: dict[str, Any]) -> Table:
    """A row for each variant."""
    headings = ("", "PSNR* held-out", "SSIM", "LPIPS", "depth mm", "ahead", "track mm", "N", "ms/it")
    made = Table(*headings, box=None, padding=(0, 3, 0, 0), pad_edge=False)
    for name, row in measured["variants"].items():
        heldout, depth, track = row["heldout"], row["depth"] or {}, row["track"] or {}
        figures = (
            heldout["psnr"], heldout["ssim"], heldout.get("lpips"), depth.get("median_mm"),
            row["ahead"]["psnr"], track.get("median_mm"), row["gaussians"], row["ms_per_iteration"],
        )  # fmt: skip
        made.add_row(name, *("–" if value is None else f"{value:.4g}" for value in figures))
    return made
