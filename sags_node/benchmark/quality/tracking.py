"""How well anchors and Gaussians stay on the tissue of a real recording, against direct optical flow."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from rich.table import Table

from sags_node.errors import SagsError
from sags_node.evaluation.metrics import percentiles
from sags_node.geometry import project
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.motion import BEHIND_TOLERANCE
from sags_node.pipeline import Pipeline
from sags_node.session import Session
from sags_node.types import F32, F64, Bool, FrameResult
from sags_node.warm_up import warm_up

SPACING = 34  # px between anchors
BORDER = 60  # px: what is nearer to the picture's edge soon leaves it
CONSISTENT = 1.0  # px between a point and where the flow there and back takes it

AT_ONCE = 1 << 14  # places: OpenCV takes no picture of more than 32,766 rows

Advance = Callable[[int, int | None, str], None]  # frames done, of, what


def measure_tracking(session: Session, frames: Sequence[int], advance: Advance) -> dict[str, Any]:
    """Pin anchors in the first frame and follow them, one step of the mapper a frame.

    The truth of a point in a later frame is where the flow from the first frame to it (Kroeger et al., ECCV
    2016) takes the point, if the flow back returns within `CONSISTENT` and ends on tissue. It knows nothing
    of the frames between. Points that an instrument hides have no truth.

    Args:
        session: a recording.
        frames: after how many to measure.

    Raises:
        SagsError: the recording is too short, or nothing can be pinned.
    """
    warm_up(session.config)
    configure_threads(session.config.engine.threads)
    pipeline, budget, last = Pipeline(session.config, session.rig), StepBudget(1), max(frames)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    first: FrameResult | None = None
    rows = []
    with session.source as source:
        for number, frame in enumerate(source):
            result = pipeline.process(frame, budget)
            if first is None:
                first, places = result, _pin_everywhere(pipeline, result)
            elif number in frames:
                there = flow.calc(first.observation.gray, result.observation.gray, None)
                back = flow.calc(result.observation.gray, first.observation.gray, None)
                rows.append(_measured(number, first, places, result, there, back))
            advance(number + 1, last + 1, "following")
            if number == last:
                break
    if len(rows) < len(set(frames)):
        raise SagsError(f"the recording ends before frame {last}; choose earlier --frames")
    return {"session": session.name, "anchors": len(places), "frames": rows}


def _pin_everywhere(pipeline: Pipeline, result: FrameResult) -> F64:
    """Anchors on a grid; returns their pixels [A, 2]."""
    height, width = result.observation.tissue.shape
    pinned = []
    for v in range(BORDER, height - BORDER, SPACING):
        for u in range(BORDER, width - BORDER, SPACING):
            try:
                pipeline.anchors.add_pixel(u, v, result.observation, result.snapshot, result.views["left"])
            except SagsError:
                continue  # an instrument, or no depth there
            pinned.append((u, v))
    if not pinned:
        raise SagsError("no tissue with depth was found in the first frame; set source.start to a better one")
    return np.array(pinned, np.float64)


def _measured(
    number: int, first: FrameResult, places: F64, result: FrameResult, there: F32, back: F32
) -> dict[str, Any]:
    truth, known = _follow(places, there, back, result.observation.tissue)
    pixels = result.anchors.pixels
    known &= np.isfinite(pixels).all(1)
    started, ended = _common_gaussians(first, result)
    wanted, sure = _follow(started, there, back, result.observation.tissue)
    return {
        "frame": number,
        "motion_px": percentiles(np.linalg.norm(truth - places, axis=1)[known]),
        "anchors": int(known.sum()),
        "anchors_px": percentiles(np.linalg.norm(truth - pixels, axis=1)[known]),
        "gaussians": int(sure.sum()),
        "gaussians_px": percentiles(np.linalg.norm(wanted - ended, axis=1)[sure]),
    }


def _follow(places: F64, there: F32, back: F32, tissue: Bool) -> tuple[F64, Bool]:
    """Where the flow takes places [M, 2] px, and whether to believe it [M]."""
    ends = places + sample(there, places)
    error = np.linalg.norm(ends + sample(back, ends) - places, axis=1)
    height, width = tissue.shape
    x, y = np.rint(ends).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    on_tissue = inside & tissue[y.clip(0, height - 1), x.clip(0, width - 1)]
    return ends, on_tissue & (error < CONSISTENT)


def sample(flow: F32, places: F64) -> F64:
    taken = [
        cv2.remap(flow, some[:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        for some in np.array_split(places.astype(np.float32), len(places) // AT_ONCE + 1)
    ]
    return np.concatenate(taken).astype(np.float64)


def _common_gaussians(first: FrameResult, result: FrameResult) -> tuple[F64, F64]:
    """Pixels [M, 2] of the Gaussians that lie on the surface seen in the first frame and still live, in both
    frames."""
    before, after = first.snapshot.gaussians, result.snapshot.gaussians
    _, i, j = np.intersect1d(before.ids, after.ids, return_indices=True)
    started, z = project(first.snapshot.camera, before.means[i])
    ended, _ = project(result.snapshot.camera, after.means[j])
    view = first.views["left"]
    height, width = view.depth.shape
    x, y = np.rint(np.nan_to_num(started, nan=-1)).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    drawn = view.depth[y.clip(0, height - 1), x.clip(0, width - 1)]
    seen = inside & (drawn > 0) & (np.abs(z - drawn) < BEHIND_TOLERANCE * drawn)
    return started[seen], ended[seen]


def table(measured: dict[str, Any]) -> Table:
    """For people; `measured` as `measure_tracking` returns it."""
    made = Table(
        "frame", "motion p50, p90, px", "anchors", "off by, px", "Gaussians", "off by, px",
        title=f"{measured['session']}, against direct optical flow",
    )  # fmt: skip
    rows: Iterable[dict[str, Any]] = measured["frames"]
    for row in rows:
        made.add_row(
            str(row["frame"]),
            _two(row["motion_px"]),
            str(row["anchors"]),
            _two(row["anchors_px"]),
            str(row["gaussians"]),
            _two(row["gaussians_px"]),
        )
    return made


def _two(figures: dict[str, float] | None) -> str:
    return "-" if figures is None else f"{figures['p50']:.2f}, {figures['p90']:.2f}"
