"""What all mappers share: the result of a frame, and how a frame is judged."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sags_node.engine.losses.pieces import LEVEL
from sags_node.engine.rasterizer.confidence import with_confidence
from sags_node.engine.rasterizer.views import colours_of, to_view
from sags_node.mapping.densify import HOLE_ALPHA
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, Forecast, Observation, RenderedView, Snapshot
from sags_node.vision.watch.picture_fit import MISFIT

MIN_FIRST_DEPTHS = 200  # px with depth that a first model needs
LOST_COVERAGE = 0.3  # of the tissue: a model that covers less is lost
SETTLED = 10  # frames in which nothing moved, after which a model has little more to learn
SETTLED_EVERY = 5  # frames: then it is refined in only one of so many
SOME = slice(None, None, 8)  # rows and columns of an image that are enough to judge by


@dataclass(frozen=True, slots=True)
class Mapped:
    """What the mapper made of one frame."""

    snapshot: Snapshot
    view: RenderedView  # the model drawn for the left eye


def can_start(observation: Observation) -> bool:
    """Tell whether this frame has depth enough for a first model."""
    return bool(np.count_nonzero(observation.depth) >= MIN_FIRST_DEPTHS)


def most_steps(still: int, frames: int) -> float:
    """The most steps that frame number `frames` may have, after `still` frames in which nothing moved."""
    if still <= SETTLED:
        return math.inf
    return 0 if frames % SETTLED_EVERY else 1


def is_lost(planes: F32, observation: Observation) -> bool:
    """Tell whether the model, moved to this frame, hardly covers it: after damage, or where the camera is
    known to be in another place. What the image shows is judged before, see `vision.watch.scene_watch`."""
    tissue = observation.tissue[SOME, SOME]
    covered = tissue & (planes[4, SOME, SOME] > HOLE_ALPHA)
    return bool(np.count_nonzero(covered) < LOST_COVERAGE * np.count_nonzero(tissue))


def is_worse_than_one_colour(planes: F32, observation: Observation) -> bool:
    """Tell whether one colour would show the tissue of this frame better than the model, whose colours are
    wrong on the whole. A model that has just learnt from the frame is then broken: compared with it, every
    later image would seem to show another scene."""
    tissue = observation.tissue[SOME, SOME]
    if not tissue.any():
        return False
    seen = observation.image[SOME, SOME][tissue] * LEVEL
    shown = colours_of(planes[:, SOME, SOME])[tissue]
    return not np.mean((shown - seen) ** 2) <= max(seen.var(axis=0).mean(), MISFIT**2)


def as_view(planes: F32, model: GaussianModel, observation: Observation) -> RenderedView:
    """Make the view to publish of the model's planes [5, h, w], drawn for a frame at any size."""
    view = to_view(planes, observation.camera, observation.frame_id, observation.t_capture_ns)
    return with_confidence(view, model.gaussians(), observation.grid)


def snapshot_of(
    model: GaussianModel, observation: Observation, step: int, loss: float, counts: Mapping[str, int],
    right: bool, forecast: Forecast | None = None,
) -> Snapshot:  # fmt: skip
    """Copy the model as it is at the time of a frame; `right`: also how the right eye's colours differ."""
    return Snapshot(
        frame_id=observation.frame_id,
        t_capture_ns=observation.t_capture_ns,
        step=step,
        gaussians=model.snapshot(),
        velocities=model.velocities.copy(),
        camera=observation.camera,
        loss=loss,
        counts=counts,
        forecast=forecast,
        right_colors=model.right_colors.copy() if right else None,
    )
