"""What does each part of the SAGS model bring? The ablation of the paper, and of what goes beyond it.

Every variant is fitted to the same training frames with as many iterations, from several seeds, and
measured on the same frames that it never saw: every eighth, and the last ones of the recording, for which it
must look ahead. Training frames are measured, too: they tell overfitting from what was not learnt. So are
images of half and a quarter of the size, for which the filters are made.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import cv2
import numpy as np

from benchmarks import Advance
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import scale_intrinsics
from sags_node.kernels.threads import configure_threads
from sags_node.pipeline.session import Session
from sags_node.quality import metrics
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.provenance import machine_name
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.tools.fitting.clip import Clip, ClipFrame, read_clip
from sags_node.tools.fitting.fit import Fit
from sags_node.tools.fitting.score import score, score_between, score_depth, score_tracks
from sags_node.tools.fitting.settings import ONLINE, PAPER, FitSettings, with_changes
from sags_node.types import Bool

AHEAD = 3  # last frames, not used for training
SMALLER = {"half": 2, "quarter": 4}  # what an image's sides are divided by

_PAPER = replace(PAPER, max_gaussians=30_000)
_ONLINE = replace(ONLINE, max_gaussians=30_000)
VARIANTS: Mapping[str, FitSettings] = {
    "base": replace(_PAPER, block="mlp", antialias=False),
    "no_alias_free": replace(_PAPER, antialias=False),
    "no_adaptive": replace(_PAPER, block="mlp"),
    "full": _PAPER,
    "no_block": replace(_PAPER, block="none"),
    "nodes": replace(_PAPER, tokens="nodes"),
    "online": _ONLINE,
    "online_no_alias_free": replace(_ONLINE, antialias=False),
    "online_no_adaptive": replace(_ONLINE, block="none"),
    "online_self": replace(_ONLINE, tokens="self"),
}

# What a part brings: variant with it, variant without it, gain in the paper's table (dB, EndoNeRF "pulling").
PARTS: Mapping[str, tuple[str, str, float | None]] = {
    "self-adaptive block, beside an MLP of its size": ("full", "no_adaptive", 0.26),
    "self-adaptive block, beside none": ("full", "no_block", None),
    "both filters, without the block": ("no_adaptive", "base", 0.90),
    "both filters, with the block": ("full", "no_alias_free", None),
    "both filters, after the online start": ("online", "online_no_alias_free", None),
    "self-adaptive block, after the online start": ("online", "online_no_adaptive", None),
}

Row = dict[str, Any]


def measure_ablation(
    session: Session,
    warm_up: int,
    iterations: int,
    advance: Advance,
    seeds: int,
    only: Sequence[str],
    changes: Sequence[str],
) -> dict[str, Any]:
    """Fit and measure every variant; keys as benchmarks/README.md lists them.

    Args:
        warm_up: iterations of each fit without deformation; only of the paper's schedule.
        iterations: of each fit, with deformation.
        seeds: how many fits of each variant.
        only: names of variants; none: all.
        changes: of the settings of every variant, as `with_changes` takes them.
    """
    unknown = [name for name in only if name not in VARIANTS]
    if unknown:
        raise UsageError(f"there is no variant {', '.join(unknown)}; choose of {', '.join(VARIANTS)}")
    configure_threads(session.config.engine.threads)
    count = session.source.frame_count
    receipt = Receipt(session.rig, session.working_size, None)
    holds_out = MeasureOptions().holds_out
    clip = read_clip(session, holds_out, lambda done: advance(done, count, "reading"), receipt.add)
    known, ahead = _split(clip)
    chosen = {
        name: replace(
            with_changes(settings, changes),
            warm_up=warm_up if settings.schedule == "paper" else 0,
            iterations=iterations,
        )
        for name, settings in VARIANTS.items()
        if not only or name in only
    }
    variants: dict[str, list[Row]] = {name: [] for name in chosen}
    for seed in range(seeds):
        for name, settings in chosen.items():
            fit, started = _fitted(known, replace(settings, seed=seed), f"{name}, seed {seed}", advance)
            row = _measured(fit, ahead, session.config.played_segments)
            row["ms_per_iteration"] = round(1e3 * (fit.seconds - started) / fit.total, 1)
            variants[name].append(row)
    return {
        "session": session.name,
        "warm_up": warm_up,
        "iterations": iterations,
        "seeds": seeds,
        "settings": {name: asdict(settings) for name, settings in chosen.items()},
        "machine": machine_name(),
        "receipt": receipt.as_json(),  # of all frames
        "variants": variants,
        "parts": {
            part: {"paper_db": claim, **_gain(variants[whole], variants[without])}
            for part, (whole, without, claim) in PARTS.items()
            if whole in variants and without in variants
        },
    }


def _fitted(clip: Clip, settings: FitSettings, name: str, advance: Advance) -> tuple[Fit, float]:
    """A finished fit, and the seconds that its start took."""
    fit = Fit(clip, settings)
    advance(0, None, f"{name}: starting")
    fit.start(lambda what, done, of: advance(done, of, what))
    started = fit.seconds
    while not fit.done:
        fit.iterate()
        advance(fit.iteration, fit.total, f"{name}: fitting")
    return fit, started


def _measured(fit: Fit, ahead: Sequence[ClipFrame], segments: Mapping[str, tuple[int, int]]) -> Row:
    known, places = _by_time(fit.clip), dict(segments)
    some = fit.clip.train[:: max(1, len(fit.clip.train) // max(1, len(fit.clip.test)))]
    return {
        "heldout": score(fit, fit.clip.test, places),
        "train": score(fit, some, places),
        "between": score_between(fit, fit.clip.test, places),
        "smaller": {name: _smaller(fit, fit.clip.test, factor) for name, factor in SMALLER.items()},
        "ahead": score(fit, ahead, {}),
        "depth": score_depth(fit, known, places),
        "track": score_tracks(fit, known),
        "track_with_ahead": score_tracks(fit, [known[0], *ahead]),
        "gaussians": len(fit.model),
        "seconds": round(fit.seconds, 1),
    }


def _smaller(fit: Fit, frames: Iterable[ClipFrame], factor: int) -> float:
    """Mean PSNR, dB, over tissue of images with sides divided by `factor`. A pixel's truth is the mean of
    the pixels that it stands for."""
    found = []
    for frame in frames:
        height, width = (side // factor for side in frame.tissue.shape)
        rows, across = height * factor, width * factor
        camera = replace(
            frame.camera,
            width=width,
            height=height,
            K=scale_intrinsics(frame.camera.K, (across, rows), (width, height)),
        )
        rasterizer = make_rasterizer("numba", width, height, fit.settings.antialias)
        planes = rasterizer.forward(fit.gaussians(frame), camera)
        shown = colours_of(planes)
        picture = metrics.as_float(frame.image)[:rows, :across]
        truth = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        blocks = frame.tissue[:rows, :across].reshape(height, factor, width, factor)
        tissue: Bool = np.asarray(blocks.all(axis=(1, 3)))
        found.append(metrics.psnr(shown, truth, tissue))
    return round(float(np.nanmean(found)), 4)


TABLES = (
    "heldout.psnr heldout.ssim train.psnr smaller.half smaller.quarter ahead.psnr track.median_mm gaussians"
    " ms_per_iteration",
    "train.mean half.mean quarter.mean heldout.lowest heldout.highest heldout.mean paper_db",
)
FIGURES: Mapping[str, Callable[[Row], float]] = {
    "heldout": lambda row: float(row["heldout"]["psnr"]),
    "train": lambda row: float(row["train"]["psnr"]),
    "half": lambda row: float(row["smaller"]["half"]),
    "quarter": lambda row: float(row["smaller"]["quarter"]),
}


def _gain(whole: Sequence[Row], without: Sequence[Row]) -> dict[str, dict[str, float]]:
    """The gain of the whole over the variant without the part, same seed, dB: mean, lowest and highest."""
    found = {}
    for name, figure in FIGURES.items():
        gains = [figure(a) - figure(b) for a, b in zip(whole, without, strict=True)]
        found[name] = {
            "mean": round(float(np.mean(gains)), 3),
            "lowest": round(min(gains), 3),
            "highest": round(max(gains), 3),
        }
    return found


def _by_time(clip: Clip) -> list[ClipFrame]:
    return sorted((*clip.train, *clip.test), key=lambda frame: frame.frame_id)


def _split(clip: Clip) -> tuple[Clip, list[ClipFrame]]:
    """The clip without its last `AHEAD` frames, and those frames."""
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
            "one: play more (source.frames, source.start)"
        )
    return known, frames[-AHEAD:]
