"""`sags fit`: the offline fit of a recording, from its folder to a model, drawn test frames and figures."""

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from sags_node.cli.launching import write_json
from sags_node.config.schema import DeviceName, EndoNerfSource
from sags_node.engine.device import TORCH_WITH_CUDA, choose_device, is_of_warp
from sags_node.errors import SagsError, UsageError, first_line
from sags_node.files import check_results, is_result, writing
from sags_node.kernels.threads import configure_threads
from sags_node.model.ply import write_ply
from sags_node.pipeline.session import Session
from sags_node.terminal import text
from sags_node.terminal.console import stop_signals, tell, time_text
from sags_node.tools.evaluation.lpips import BACKBONE, Lpips
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.provenance import machine_name
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.tools.fitting import checkpoint
from sags_node.tools.fitting.clip import read_clip
from sags_node.tools.fitting.fit import FITTING, Fit
from sags_node.tools.fitting.outlook import Outlook
from sags_node.tools.fitting.score import published, score, score_between, score_depth, score_tracks
from sags_node.tools.fitting.settings import LEAST, FitSettings, Schedule, iterations_for
from sags_node.tools.fitting.start import FOLLOW, LEARN, PATH_STEPS
from sags_node.types import Bool, StereoFrame

log = logging.getLogger(__name__)

CHECKPOINT, FIGURES, MODEL, DRAWN = "checkpoint.npz", "figures.json", "model.ply", "test"
CHECKPOINT_PERIOD = 60.0  # s; it holds hundreds of MB
SHOWN_EVERY = 5  # iterations
# What a training frame of the online pass, a step on the paths and an iteration after them take,
# s of one core (D4D at 640x512, 70,000 Gaussians; the phantom at 320x256, 48,000: 0.08, 0.03, 0.11).
ONLINE_PRICES = {FOLLOW: 0.145, LEARN: 0.036, FITTING: 0.162}

Advance = Callable[..., None]  # done, of, what, seconds left in all: `console.progress`


def check_fit(out: Path) -> None:
    """Check, before any work, that a fit may be written into this folder.

    Raises:
        UsageError: other files of its names are there.
        SagsError: it cannot be written to.
    """
    figures = out / FIGURES
    ours = (out / CHECKPOINT).is_file() or (figures.is_file() and is_result(figures))
    check_results(out, (CHECKPOINT, FIGURES, MODEL, DRAWN), ours)


def device_of(wanted: DeviceName, schedule: Schedule) -> str | None:
    """Return the device that a fit runs on, as `Fit` takes it: "cuda", or None for the CPU.

    Raises:
        UsageError: a GPU is wanted, and none can be used, or not for this schedule.
    """
    if schedule == "online":
        if wanted == "cuda":
            raise UsageError(
                "device: cuda: a fit from an online start runs on the CPU; give --schedule paper, or set "
                "device:=cpu"
            )
        return None
    if choose_device(wanted).kind == "cpu":
        return None
    if torch.cuda.is_available():
        return "cuda"
    lacks = f"torch {torch.__version__} finds no GPU, and a fit needs it"
    fix = f"install one with CUDA: {TORCH_WITH_CUDA}"
    if wanted == "cuda":
        raise UsageError(f"device: cuda: {lacks}; {fix}, or set device:=cpu")
    log.warning("%s: this one runs on the CPU; %s", lacks, fix)
    return None


def fit_session(
    session: Session,
    settings: FitSettings,
    options: MeasureOptions,
    out: Path,
    resume: bool,
    advance: Advance,
    device: str | None = None,
    by_length: bool = False,
) -> dict[str, Any]:
    """Fit a recording and leave `checkpoint.npz`, `model.ply`, `test/` and `figures.json` in `out`.

    Args:
        session: a recording.
        settings: of the fit.
        options: hold-out and LPIPS weights.
        out: an existing folder. An earlier result there is removed as soon as this one has started.
        resume: go on from its checkpoint.
        advance: called with what is going on.
        device: as `device_of` returns it.
        by_length: whether the iterations are those of `iterations_for`.

    Returns:
        The figures.

    Raises:
        UsageError: nothing to resume, or made with other settings or frames.
        SagsError: the recording cannot be used, a file cannot be written, or the GPU failed.
    """
    stored = out / CHECKPOINT
    if resume and not stored.is_file():
        raise UsageError(f"there is no {stored} to resume from; start without --resume")
    lpips = None if options.lpips_weights is None else Lpips(options.lpips_weights)
    torch.set_num_threads(configure_threads(session.config.engine.threads))
    count = session.source.frame_count
    receipt = Receipt(session.rig, session.working_size, options.lpips_weights)

    def noted(frame: StereoFrame, tissue: Bool) -> None:
        if options.holds_out(frame.frame_id):
            receipt.add(frame, tissue)

    clip = read_clip(
        session, options.holds_out, lambda done: advance(done, count, "reading"), noted, settings.midway
    )
    if by_length:
        settings = replace(settings, iterations=iterations_for(len(clip.train)))
    try:
        fit = Fit(clip, settings, device)
        online = {FOLLOW: len(clip.train), LEARN: PATH_STEPS} if settings.schedule == "online" else {}
        outlook, told = Outlook(online | fit.stages, ONLINE_PRICES), False

        def show(stage: str, done: int, of: int, more: str = "") -> None:
            nonlocal told
            if (left := outlook.left(stage, done)) is not None and not told:
                tell(f"this fit takes about {time_text(left)} from now on")
                told = True
            advance(done, of, stage + more, left)

        if (most := fit.settings.max_gaussians) < min(settings.max_gaussians, LEAST):
            tell(
                f"a clip as long as this has room for {most:,} Gaussians only; set source.frames or "
                "source.stride for a shorter one, or give --schedule paper"
            )
        if resume:
            advance(0, None, "reading the checkpoint")
            checkpoint.load(fit, stored)
        else:
            advance(0, None, "starting; the first time, kernels are compiled for a minute")
            fit.start(show)
        if not (resume and fit.done):  # results there are of another fit, or of other frames
            _clear(out, FIGURES, MODEL)
            outlook.expect(fit.prices())
            _iterate(fit, stored, show)
    except Exception as error:
        if device is None or not is_of_warp(error):
            raise
        go_on = "to go on from the checkpoint add --resume and" if stored.is_file() else "start again and"
        raise SagsError(f"the GPU failed: {first_line(error)}; {go_on} set device:=cpu") from error

    drawn = out / DRAWN
    drawn.mkdir(exist_ok=True)
    _clear(out)
    advance(0, len(clip.test), "measuring")
    segments = session.config.played_segments
    everything = sorted((*clip.train, *clip.test), key=lambda frame: frame.frame_id)
    found = {
        "session": session.name,
        "settings": asdict(fit.settings),
        "machine": machine_name(),
        "device": "cpu" if device is None else choose_device("auto").name,
        "seconds": round(fit.seconds, 1),
        "gaussians": len(fit.model),
        "cap": fit.settings.max_gaussians,
        "pruned": fit.pruned,
        "split": fit.split,
        "heldout": score(
            fit, clip.test, segments, lpips, drawn,
            lambda done: advance(done, len(clip.test), "measuring"),
        ),
        "between": score_between(fit, clip.test, segments, lpips),
        "depth": score_depth(fit, everything, segments),
        "track": score_tracks(fit, everything),
        "train": score(fit, clip.train[:: max(1, options.hold_out)], segments),
        "receipt": receipt.as_json(),  # of the frames held out
        "margin_px": session.config.vision.tissue.dilate,
        "psnr_convention": "tissue",
        "lpips_backbone": BACKBONE if lpips is not None else None,
        "published": published(
            session.config.source.folder if isinstance(session.config.source, EndoNerfSource) else None,
            len(everything),
            options.hold_out,
            session.working_size,
        ),
    }  # fmt: skip
    last = fit.gaussians(clip.train[-1])
    write_ply(out / MODEL, last, force=True)
    write_json(out / FIGURES, found)
    return found


def _clear(out: Path, *names: str) -> None:
    """Remove the drawn test frames of an earlier fit, and files of these names."""
    drawn = [file for file in (out / DRAWN).glob("*.png") if file.stem.isdecimal()]
    with writing(out):
        for file in (*drawn, *(out / name for name in names)):
            file.unlink(missing_ok=True)


def _iterate(fit: Fit, stored: Path, show: Callable[[str, int, int, str], None]) -> None:
    """Run all iterations that are left. Ctrl-C leaves a checkpoint, too."""
    show(*fit.stage, "")
    saved = time.monotonic()
    with stop_signals() as stop:  # Ctrl-C waits: no fit can go on from half an iteration
        try:
            while not (fit.done or stop.is_set()):
                fit.iterate()
                if fit.iteration % SHOWN_EVERY == 0 or fit.done:
                    how = f", colours differ by {fit.residual:.4f}, {len(fit.model)} Gaussians"
                    show(*fit.stage, how)
                if time.monotonic() - saved > CHECKPOINT_PERIOD:
                    checkpoint.save(fit, stored)
                    saved = time.monotonic()
        finally:
            checkpoint.save(fit, stored)
            fit.tick()
    if stop.is_set():
        raise KeyboardInterrupt


def fit_verdict(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what a fit was worth, a line each; beside it what was published for the same clip."""
    tested, learnt, depth, track = found["heldout"], found["train"], found["depth"], found["track"]
    mean = (found["between"] or {}).get("mean")
    lines = {}
    if tested["frames"]:  # else none was held out
        lines["image"] = f"{_number(tested['psnr'], 'dB')} PSNR on {tested['frames']} frames kept back" + (
            "" if mean is None else f" (the mean of the images around: {_number(mean['psnr'], 'dB')})"
        )
        if found["published"]:
            others = ", ".join(f"{name} {psnr:.1f} dB" for name, psnr in found["published"].items())
            own = _number(tested.get("paper_psnr"), "dB")
            margin = f"; learnt, unlike theirs, with a margin of {found['margin_px']} px around instruments"
            margin = f"{margin} (without: vision.tissue.dilate:=0)" if found["margin_px"] else ""
            lines["published"] = f"{others}; here, counted as they do: {own}{margin}"
    lines["learnt"] = f"{_number(learnt['psnr'], 'dB')} PSNR on frames that it was fitted to"
    if depth is not None:
        lines["depth"] = f"{_number(depth['median_mm'], 'mm')} off (median), on {depth['frames']} frames"
    if track is not None:
        lines["points"] = f"{track['median_mm']:.2f} mm off (median); {track['lost']:,} times given up"
    size = f"{found['gaussians']:,} Gaussians (at most {found['cap']:,})"
    where = "" if found["device"] == "cpu" else f" on {found['device']}"
    lines["model"] = f"{size}, fitted in {found['seconds']:.0f} s{where}"
    lines["machine"] = found["machine"]
    return list(lines.items())


def figures_table(found: dict[str, Any]) -> Table:
    """Return a table of all figures of the images, and of those published for the same clip."""
    table = text.table("", "frames", "PSNR over tissue", "PSNR, masked pixels equal", "SSIM", "LPIPS")
    between = found["between"] or {}
    rows = {
        "heldout": found["heldout"],
        "  images around, carried": between.get("carried"),
        "  their mean as they are": between.get("mean"),
        "train": found["train"],
    }
    for name, row in rows.items():
        if not row or not row["frames"]:
            continue
        table.add_row(
            name,
            str(row["frames"]),
            _number(row.get("psnr"), "dB"),
            _number(row.get("paper_psnr"), "dB"),
            _number(row.get("ssim")),
            _number(row.get("lpips")),
        )
    for name, psnr in found["published"].items():
        table.add_row(f"{name}, published", "–", "–", _number(psnr, "dB"), "–", "–")
    depth = found["depth"]
    table.caption = f"{found['gaussians']} Gaussians (at most {found['cap']}), {found['seconds']:.0f} s"
    if depth:
        off = _number(depth["median_mm"], "mm")
        table.caption += f", depth {off} off (median, {depth['frames']} frames)"
    return table


def _number(value: float | None, unit: str = "") -> str:
    return "–" if value is None else f"{value:.3f} {unit}".strip() if not unit else f"{value:.2f} {unit}"
