"""Two more runs, frame by frame, for what a subscriber does not see or has no ground truth.

These are the right eye and hidden tissue, and how far depth is from the frame's own stereo. Where no true
points are known, some are followed to the last frame that is played, and back to the first one, where the
tissue must be as it was.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from sags_node.config.schema import RecordedSource
from sags_node.geometry import transform, unproject
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session
from sags_node.tools.evaluation.hidden import measure_hidden
from sags_node.tools.evaluation.measure import FrameRow, MeasureOptions, Measurer
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.tools.evaluation.run import MappedFrame, Run
from sags_node.tools.evaluation.steps import again, run_step
from sags_node.tools.evaluation.tracking import REACH, PointTracks, TrackErrors, pooled
from sags_node.types import F64, FrameResult, StereoFrame
from sags_node.vision.rectify import Rectifier

MOST = 150  # frames of the recording that are played: five seconds, so that long ones can be measured too
GROUPS = ("right", "novel", "stereo")  # groups of a frame's figures that come from the first of these runs
STEPS = 16  # places of points along each side of the image


def measure_second(
    session: Session, every: int, hidden: bool, progress: Callable[[str, int, int | None], None]
) -> tuple[dict[int, FrameRow], dict[str, Any]]:
    """Play the first `MOST` frames of a recording again, at the size of the session.

    Args:
        every: the right eye is measured on every so many frames.
        hidden: also hide tissue, in a run of its own.
        progress: called with what is going on, the frames done and those in all.

    Returns:
        Rows by frame number, with figures of `GROUPS` and `hidden`; the summary's `second_run` and, where no
        true points are known, `forth_back` (see `_forth_and_back`).
    """
    played = session.config.source
    assert isinstance(played, RecordedSource)
    most = MOST + played.warm_up
    frames = min(most, session.source.frame_count or most)
    source = played.model_copy(update={"frames": frames})
    publish = session.config.publish.model_copy(update={"right": True})
    alone = session.config.model_copy(update={"source": source})  # nobody looks at the right eye
    config = alone.model_copy(update={"publish": publish})
    session = replace(session, config=config)
    session = replace(session, source=again(session))
    asked = MeasureOptions(0, every, unseen=True)

    def told(what: str, done: int) -> None:
        progress(f"once more, frame by frame: {what}", done, frames)

    with Run() as run:
        pipeline = run_step(session, asked, run, told)
        receipt = Receipt(session.rig, session.working_size, None)
        rectifier = Rectifier(session.rig, *session.working_size, session.published_size)
        plain = config.model_copy(update={"publish": publish.model_copy(update={"detail": False})})
        measurer = Measurer(run, rectifier, plain, asked, receipt)  # it draws the model alone
        with again(session) as recorded:
            measurer.run(recorded, told)
        followed = any(row.track is not None for row in measurer.rows)  # beside true points
        found = None if followed else _forth_and_back(session, pipeline, run, told)
    rows = {
        row.frame_id: replace(row, figures={key: row.figures[key] for key in GROUPS if key in row.figures})
        for row in measurer.rows
    }
    of_hidden = measure_hidden(alone, session.rig, again(session), len(rows), told) if hidden else {}
    for frame_id in of_hidden.keys() & rows.keys():
        rows[frame_id].figures["hidden"] = of_hidden[frame_id]
    return rows, {"second_run": {"frames": len(rows)}, "forth_back": found}


def _forth_and_back(
    session: Session, pipeline: Pipeline, run: Run, told: Callable[[str, int], None]
) -> dict[str, Any] | None:
    """Play the frames of a run backwards to its first one, where the tissue is again as it was.

    Returns:
        How far points are from where they were then, `median_mm`, `p90_mm`, `median_px`; `lost`, the share of
        which no Gaussian is left; and `moved_mm`, how far they were from there at most (median).
    """
    first = run.read(run.frame_ids[0])
    assert isinstance(first, MappedFrame)
    points = _points(first)
    if len(points) == 0 or len(run) == 1:
        return None
    tracks = PointTracks(len(points))
    _errors(tracks, points, first)
    moved = 0.0
    for frame_id in run.frame_ids:
        shown = run.read(frame_id)
        assert isinstance(shown, MappedFrame)
        errors = _errors(tracks, points, shown).errors_mm
        moved = max(moved, float(np.median(errors))) if len(errors) else moved
    with again(session) as recorded:
        for frame in recorded:
            run.keep(frame)
    result, budget = pipeline.newest, pipeline.make_budget()
    last = run.frame(run.frame_ids[-1])
    for done, frame_id in enumerate(reversed(run.frame_ids[:-1]), 1):
        result = pipeline.process(_mirrored(run.frame(frame_id), last), budget)
        told("backwards", done)
    assert result is not None
    end = _errors(tracks, points, result)
    return {**pooled([end]), "lost": end.lost / len(points), "moved_mm": moved}


def _mirrored(frame: StereoFrame, last: StereoFrame) -> StereoFrame:
    """A frame with time and number mirrored: as far after the last frame as it was before it."""
    left = 2 * last.t_capture_ns - frame.t_capture_ns
    right = left + frame.t_capture_right_ns - frame.t_capture_ns
    number = 2 * last.frame_id - frame.frame_id
    return replace(frame, frame_id=number, t_capture_ns=left, t_capture_right_ns=right)


def _points(first: MappedFrame) -> F64:
    """Places [P, 3] m of the tissue in the camera of a frame, where the model has Gaussians: evenly spaced in
    the image."""
    height, width = first.depth.shape
    rows, columns = (np.round((np.arange(STEPS) + 0.5) / STEPS * side - 0.5) for side in (height, width))
    v, u = (each.ravel().astype(int) for each in np.meshgrid(rows, columns, indexing="ij"))
    known = first.tissue[v, u] & (first.depth[v, u] > 0)
    u, v = u[known], v[known]
    camera, means = first.snapshot.camera, first.snapshot.gaussians.means
    pixels = np.stack([u, v], 1).astype(np.float64)
    world = np.asarray(unproject(camera, pixels, first.depth[v, u].astype(np.float64)))
    near = [np.linalg.norm(means - point, axis=1).min() < REACH for point in world]
    return np.asarray(transform(camera.viewmat, world[near]), np.float64)


def _errors(tracks: PointTracks, points: F64, shown: MappedFrame | FrameResult) -> TrackErrors:
    """The errors of points against their places in the first frame, in the camera's coordinates."""
    snapshot = shown.snapshot
    there = np.asarray(transform(snapshot.camera.T_world_cam, points), np.float64)
    return tracks.update(snapshot.gaussians, there, np.ones(len(points), np.bool_), snapshot.camera)
