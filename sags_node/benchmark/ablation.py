"""What does each part of the SAGS model bring? The ablation of the paper, and of what goes beyond it.

Every variant is fitted to the same training frames with the same number of iterations and measured on the
same frames that it never saw: every eighth, and the last ones of the recording, which ask it to look ahead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.table import Table

from sags_node.engine.threads import configure_threads
from sags_node.evaluation.lpips import Lpips
from sags_node.evaluation.machine import machine_name
from sags_node.fitting.clip import Clip, read_clip
from sags_node.fitting.fit import Fit
from sags_node.fitting.score import score, score_depth, score_tracks
from sags_node.fitting.settings import FitSettings
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
    session: Session,
    warm_up: int,
    iterations: int,
    hold_out: int,
    lpips_weights: Path | None,
    advance: Advance,
) -> dict[str, Any]:
    """Fit and measure every variant.

    Args:
        session: a recording of more than `AHEAD` training frames.
        warm_up, iterations: of each fit.
        hold_out: every so manieth frame is for testing only.
        lpips_weights: npz of LPIPS weights; None: no LPIPS.
        advance: called with what is going on.

    Returns:
        The table, keys as benchmarks/README.md lists them.

    Raises:
        SagsError: the recording cannot be read, or no frame has depth enough.
    """
    lpips = None if lpips_weights is None else Lpips(lpips_weights)
    configure_threads(session.config.engine.threads)
    count = session.source.frame_count
    clip = read_clip(
        session, lambda i: i > 0 and (i - 1) % hold_out == 0, lambda done: advance(done, count, "reading")
    )
    first_ahead = sorted(frame.frame_id for frame in (*clip.train, *clip.test))[-AHEAD]
    known = Clip(
        [frame for frame in clip.train if frame.frame_id < first_ahead],
        [frame for frame in clip.test if frame.frame_id < first_ahead],
    )
    everything = sorted((*clip.train, *clip.test), key=lambda frame: frame.frame_id)
    ahead = everything[-AHEAD:]
    variants = {}
    for name, chosen in VARIANTS.items():
        fit = Fit(known, replace(chosen, warm_up=warm_up, iterations=iterations))
        advance(0, None, f"{name}: starting")
        fit.start(lambda what, done, of: advance(done, of, what))
        started = fit.seconds
        while not fit.done:
            fit.iterate()
            advance(fit.iteration, fit.total, f"{name}: fitting")
        variants[name] = {
            "heldout": score(fit, known.test, session.config.segments, lpips),
            "ahead": score(fit, ahead, {}, lpips),
            "depth": score_depth(fit, everything[:-AHEAD], session.config.segments),
            "track": score_tracks(fit, everything[:-AHEAD]),
            "track_with_ahead": score_tracks(fit, [everything[0], *ahead]),
            "gaussians": len(fit.model),
            "ms_per_iteration": round(1e3 * (fit.seconds - started) / fit.total, 1),
            "seconds": round(fit.seconds, 1),
        }
    return {
        "session": session.name,
        "warm_up": warm_up,
        "iterations": iterations,
        "settings": {name: asdict(chosen) for name, chosen in VARIANTS.items()},
        "machine": machine_name(),
        "variants": variants,
    }


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
