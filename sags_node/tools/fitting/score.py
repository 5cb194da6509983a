"""How good a fit is on frames it never saw: PSNR as papers count it, and figures over tissue alone."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sags_node.detail.motion import SmallDrawings
from sags_node.detail.seen import SeenFrame
from sags_node.engine.rasterizer.views import colours_of, to_view
from sags_node.files import whole
from sags_node.quality import metrics
from sags_node.tools.evaluation.lpips import Lpips
from sags_node.tools.evaluation.moments import carried
from sags_node.tools.evaluation.tracking import PointTracks, TrackErrors, pooled
from sags_node.tools.fitting.clip import ClipFrame
from sags_node.tools.fitting.fit import Fit
from sags_node.types import F32

Segments = dict[str, tuple[int, int]]  # first and last frame

# EndoNeRF's two public clips: how many frames they have, and what was published for the held-out ones.
# Images of 640x512 are multiplied by the tissue mask, which has no margin, and averaged over all pixels
# (`paper_psnr`, dB); every eighth is held out.
CLIPS: dict[str, tuple[int, dict[str, float]]] = {
    "pulling": (63, {"SAGS": 38.3, "EndoGaussian": 37.2}),
    "cutting": (156, {"SAGS": 39.5, "EndoGaussian": 38.4}),
}
PUBLISHED_WAY = 8, (640, 512)  # hold-out, size


def published(folder: Path | None, frames: int, hold_out: int, size: tuple[int, int]) -> dict[str, float]:
    """The PSNR published for a clip, dB by method; empty for another clip or way of measuring.

    Args:
        folder: of the recording in EndoNeRF's layout; None: it has another one.
        frames: how many were read of it.
        hold_out: every how many frames one is held out.
        size: width and height of the images that are compared, px.
    """
    if folder is None or (hold_out, size) != PUBLISHED_WAY:
        return {}
    for clip, (count, figures) in CLIPS.items():
        if clip in folder.resolve().name.lower() and frames == count:
            return figures
    return {}


def score(
    fit: Fit,
    frames: Sequence[ClipFrame],
    segments: Segments,
    lpips: Lpips | None = None,
    pictures: Path | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> dict[str, Any]:
    """Draw the model at each frame's time and compare.

    Args:
        fit: started.
        frames: what to measure on.
        segments: named stretches, whose means are given too.
        lpips: measures LPIPS; None: it is left out.
        pictures: an existing folder that takes the drawn frames, PNG.
        progress: called with the frames done.

    Returns:
        Means over frames: `psnr` over tissue and `paper_psnr` with the masks as they were given, without
        our margin, dB; `ssim` and `lpips`; the same for each segment below its name; and `frames`, their
        number.

    Raises:
        SagsError: an image cannot be written.
    """
    rows = []
    for done, frame in enumerate(frames):
        picture = colours_of(fit.rasterizer.forward(fit.gaussians(frame), frame.camera))
        rows.append(_figures(picture, frame, lpips))
        if pictures is not None:
            _write(pictures / f"{frame.frame_id:06d}.png", picture)
        progress(done + 1)
    return _summary(rows, segments)


def score_between(
    fit: Fit, frames: Iterable[ClipFrame], segments: Segments, lpips: Lpips | None = None
) -> dict[str, Any] | None:
    """Compare frames with what the two training images around each of them predict.

    Args:
        fit: started.
        frames: those between two training frames count.
        segments: named stretches, whose means are given too.
        lpips: measures LPIPS; None: it is left out.

    Returns:
        `carried`: both images carried along the model's motion, and their mean; `mean`: the mean of both as
        they are, the baseline of everything that is shown between two frames. Each as `score` has it. None:
        no frame lies between two.
    """
    rows: dict[str, list[dict[str, float]]] = {"carried": [], "mean": []}
    drawings = SmallDrawings()
    for frame in frames:
        around = fit.clip.around(frame.t_capture_ns)
        if around is None:
            continue
        begin, end = (near.t_capture_ns for near in around)
        share = (frame.t_capture_ns - begin) / (end - begin)
        weights, middle = (1 - share, share), fit.gaussians(frame)
        lent = [(_seen(fit, near), weight) for near, weight in zip(around, weights, strict=True)]
        planes = fit.rasterizer.forward(middle, frame.camera)
        shown = carried(planes, middle, frame.camera, lent, drawings)
        mean = sum(np.float32(weight) * metrics.as_float(seen.picture()) for seen, weight in lent)
        rows["carried"].append(_figures(shown, frame, lpips))
        rows["mean"].append(_figures(np.asarray(mean), frame, lpips))
    if not rows["mean"]:
        return None
    return {name: _summary(each, segments) for name, each in rows.items()}


def _seen(fit: Fit, frame: ClipFrame) -> SeenFrame:
    """A frame, with its image and the model at its time."""
    gaussians, camera = fit.gaussians(frame), frame.camera
    depth = to_view(fit.rasterizer.forward(gaussians, camera), camera, 0, 0).depth
    return SeenFrame(frame.t_capture_ns, camera, gaussians, lambda: frame.image, frame.tissue, depth)


def score_depth(fit: Fit, frames: Iterable[ClipFrame], segments: Segments) -> dict[str, Any] | None:
    """Compare the model's depth with the session's reference: means of `metrics.DepthErrors` over the frames
    that have one, their number `frames`, and the same for each segment. None without a reference."""
    rows = []
    for frame in frames:
        if frame.reference is None or frame.reference.depth is None:
            continue
        depth = _seen(fit, frame).depth
        reference = metrics.resample_nearest(frame.reference.depth, *depth.shape[::-1])
        errors = asdict(metrics.depth_errors(depth, reference, frame.tissue))
        rows.append({"frame_id": frame.frame_id, **errors})
    return _summary(rows, segments) if rows else None


def score_tracks(fit: Fit, frames: Iterable[ClipFrame]) -> dict[str, Any] | None:
    """Measure how well the model's Gaussians stay on true surface points, over points and frames.

    Args:
        fit: started.
        frames: in the order of time.

    Returns:
        `median_mm`, `p90_mm`, `median_px` and `lost`, points without a Gaussian to follow, summed over
        frames; None if no such point could be followed.
    """
    tracks: PointTracks | None = None
    found: list[TrackErrors] = []
    for frame in frames:
        reference = frame.reference
        if reference is None or reference.points is None or reference.points_visible is None:
            continue
        if tracks is None:
            tracks = PointTracks(len(reference.points))
        found.append(
            tracks.update(fit.gaussians(frame), reference.points, reference.points_visible, frame.camera)
        )
    figures = {name: round(value, 4) for name, value in pooled(found).items() if value is not None}
    return {**figures, "lost": sum(errors.lost for errors in found)} if figures else None


def _figures(shown: F32, frame: ClipFrame, lpips: Lpips | None) -> dict[str, float]:
    truth = metrics.as_float(frame.image)
    figures: dict[str, float] = {
        "frame_id": frame.frame_id,
        "psnr": metrics.psnr(shown, truth, frame.tissue),
        "paper_psnr": metrics.paper_psnr(shown, truth, frame.bare),
        "ssim": metrics.ssim(shown, truth, frame.tissue),
    }
    if lpips is not None:
        figures["lpips"] = lpips(shown, truth, frame.tissue)
    return figures


def _summary(rows: list[dict[str, float]], segments: Segments) -> dict[str, Any]:
    found: dict[str, Any] = _means(rows)
    for name, (first, last) in segments.items():
        inside = [row for row in rows if first <= row["frame_id"] <= last]
        if inside:
            found[name] = _means(inside)
    return found


def _means(rows: list[dict[str, float]]) -> dict[str, Any]:
    keys = {key: None for row in rows for key in row if key != "frame_id"}
    values = {key: [row[key] for row in rows if key in row and np.isfinite(row[key])] for key in keys}
    means = {key: round(float(np.mean(found)), 4) if found else None for key, found in values.items()}
    return {"frames": len(rows), **means}


def _write(path: Path, rgb: np.ndarray) -> None:
    picture = np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    with whole(path) as partial:
        partial.write_bytes(cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
