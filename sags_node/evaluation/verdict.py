"""What a run was worth, in a dozen lines: each figure with its unit and what it is compared with."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

AGAINST = {  # `settings.depth_reference`
    "exact": "exact truth",
    "structured_light": "a structured-light scan",
    "ct": "a CT scan",
    "stereo_network": "the depth of a stereo network",
}
BEFORE = "the picture before, shown again: {:.1f} dB"

Flat = Mapping[str, Any]


def flat(figures: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """All numbers and words of nested figures in one row, named by their way: `online.psnr`."""
    row: dict[str, Any] = {}
    for key, value in figures.items():
        if isinstance(value, Mapping):
            row |= flat(value, f"{prefix}{key}.")
        elif not isinstance(value, list):
            row[f"{prefix}{key}"] = value
    return row


def below(figures: Flat, prefix: str) -> dict[str, Any]:
    """The figures below a key, named by the rest of their way: counts by reason, by rung, by warning."""
    return {key[len(prefix) + 1 :]: value for key, value in figures.items() if key.startswith(prefix + ".")}


def verdict(figures: Flat) -> list[tuple[str, str]]:
    """What, and how good: at most eleven lines.

    Args:
        figures: of `summarise`, and of an overlay under `overlay`, made `flat`. What is missing or None is
            left out.
    """
    lines = {
        "speed": _speed(figures),
        "latency": _latency(figures),
        "picture": _picture(figures),
        "unseen": _unseen(figures),
        "depth": _depth(figures),
        "points": _points(figures),
        "overlay": _overlay(figures),
        "quality": _quality(figures),
        "warnings": ", ".join(
            f"{code} ({count} frames)" for code, count in below(figures, "warnings").items()
        ),
        "machine": _machine(figures),
    }
    return [(name, said) for name, said in lines.items() if said]


def _speed(figures: Flat) -> str:
    if figures.get("processed") is None:
        return ""
    asked = figures["frames"] - figures["held_out"]
    shown = f"{figures['processed']} of {asked} frames shown"
    kept = f"; {figures['held_out']} others kept back for testing" if figures["held_out"] else ""
    rate = figures.get("rate_hz")
    if _is_live(figures):
        speed = "" if rate is None else f" at {rate:.1f} frames/s"
        return f"{shown}{speed}, {figures['dropped']} missed{kept}"
    speed = "" if rate is None else f"{rate:.1f} frames/s would be possible; "
    return f"{speed}frame by frame, {shown}{kept}"


def _is_live(figures: Flat) -> bool:
    return figures.get("latency_ms.p50") is not None


def _latency(figures: Flat) -> str:
    if _is_live(figures):
        said = f"{_middle(figures, 'latency_ms')} from the camera's stamp to sending"
        return f"{said}; {figures['first_render_ms']:.0f} ms for the first frame"
    if figures.get("frame_ms.p50") is None:
        return ""
    return f"{_middle(figures, 'frame_ms')} of work on a frame"


def _middle(figures: Flat, key: str) -> str:
    return f"{figures[key + '.p50']:.0f} ms (p50), {figures[key + '.p99']:.0f} ms (p99)"


def _picture(figures: Flat) -> str:
    """What a view shows of the next frame, as the left render of a frame is mostly its own picture; of a live
    run, whose views are not known, that render."""
    copied = figures.get("predict.copy_psnr")
    beside = [] if copied is None else [BEFORE.format(copied)]
    said = figures.get("predict.psnr")
    if said is not None:
        name, model = "of the next frame", figures.get("predict.model_psnr")
        if model is not None and model != said:
            beside.append(f"the model alone: {model:.1f} dB")
    else:
        name, said = "of the frame itself, mostly its own picture", figures.get("shown.psnr")
        if said is None:
            name, said = "by the model", figures.get("online.psnr")
    if said is None:
        return ""
    return f"{said:.1f} dB PSNR {name}" + (f" ({'; '.join(beside)})" if beside else "")


def _unseen(figures: Flat) -> str:
    """Frames that the model never got."""
    if figures.get("heldout.psnr") is None:
        return ""
    copied = figures.get("heldout.copy_psnr")
    said = f"{figures['heldout.psnr']:.1f} dB PSNR on frames kept back"
    return said + ("" if copied is None else f" ({BEFORE.format(copied)})")


def _depth(figures: Flat) -> str:
    if figures.get("depth.median_mm") is None:
        return ""
    reference = AGAINST.get(str(figures.get("settings.depth_reference")), "the recording's")
    covered = figures.get("depth.coverage")
    share = "" if covered is None else f", on {covered:.0%} of the tissue"
    return f"{_off(figures, 'depth')}{share}, against {reference}"


def _points(figures: Flat) -> str:
    if figures.get("track.lost") is None:
        return ""
    if figures.get("track.median_mm") is None:
        return "all lost"
    return f"{_off(figures, 'track')}; {figures['track.lost']:.0%} lost"


def _off(figures: Flat, key: str) -> str:
    nine = figures.get(key + ".p90_mm")
    return f"{figures[key + '.median_mm']:.2f} mm off (median)" + (
        "" if nine is None else f", nine of ten within {nine:.2f} mm"
    )


def _overlay(figures: Flat) -> str:
    if figures.get("overlay.frames") is None:
        return ""
    without = "".join(f"; {count} without: {why}" for why, count in below(figures, "overlay.blanked").items())
    return f"on {figures['overlay.overlay']} of {figures['overlay.frames']} frames{without}"


def _quality(figures: Flat) -> str:
    from sags_node.mapping.ladder import GPU_RUNGS, RUNGS  # only here: all load this file; numpy is slow

    rungs = Counter({int(rung): count for rung, count in below(figures, "rungs").items() if count})
    said = []
    if rungs:
        most = rungs.most_common(1)[0][0]
        highest = len(GPU_RUNGS if figures.get("settings.device") == "cuda" else RUNGS) - 1
        said.append(f"rung {most} of 0 to {highest} for most frames ({min(rungs)} to {max(rungs)})")
    if figures.get("gaussians.mean") is not None:
        said.append(f"{figures['gaussians.mean']:,.0f} Gaussians on average")
    if figures.get("settings.width") is not None:
        said.append(f"{figures['settings.width']}x{figures['settings.height']} px")
    return ", ".join(said)


def _machine(figures: Flat) -> str:
    device = figures.get("settings.device")
    refined = "" if device is None else f"; the model on the {'CPU' if device == 'cpu' else 'GPU'}"
    return f"{figures.get('machine') or ''}{refined}"
