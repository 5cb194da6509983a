"""How a fit begins: canonical Gaussians, and what the field knows of the motion already.

`paper`: points of all training frames pooled at random (EndoGaussian, SAGS); the field knows nothing.
`online`: the online mapper plays the clip once. It follows every Gaussian through the frames; the field
learns these paths by regression, which needs no drawing and so is fast, before it is refined on the pictures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sags_node.engine.rasterize import Rasterizer, to_view
from sags_node.errors import SagsError
from sags_node.fitting.clip import Clip, ClipFrame
from sags_node.fitting.settings import FitSettings
from sags_node.geometry import unproject
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.mapper import Mapper
from sags_node.model import columns
from sags_node.model.activation import deactivate
from sags_node.model.exposure import Exposure
from sags_node.model.field import Field
from sags_node.types import F32, I64, Bool, Gaussians

POOLED_SHARE = 0.01  # of a frame's pixels
FIRST_OPACITY = 0.1
ONLINE_STEPS = 1  # of the mapper per frame
PATH_POINTS = 8192  # Gaussians per step of the regression
PATH_STEPS = 2000
POSITION_TOLERANCE = 1e-4  # m: an error of a path that counts as much as one of `COLOR_TOLERANCE`
COLOR_TOLERANCE = 0.02

Progress = Callable[[str, int, int], None]  # what, done, of


@dataclass(frozen=True, slots=True)
class Paths:
    """Where the online mapper saw each Gaussian, and how coloured."""

    times_ns: I64  # [T]
    means: F32  # [T, N, 3] m
    colors: F32  # [T, N, 3]
    known: Bool  # [T, N]


def pooled_rows(clip: Clip, exposure: Exposure, settings: FitSettings) -> F32:
    """Canonical rows [N, 14], without exposure, from random pixels of all training frames.

    Raises:
        SagsError: no frame has a depth.
    """
    rng = np.random.default_rng(settings.seed)
    pools = [_random_points(frame, exposure, rng) for frame in clip.train]
    means, colors = (np.concatenate(parts) for parts in zip(*pools, strict=True))
    if len(means) == 0:
        raise SagsError("no training frame has a depth on tissue; check vision.stereo and the masks")
    picked = rng.choice(len(means), min(settings.max_gaussians, len(means)), replace=False)
    means, colors = means[picked], colors[picked]
    count = len(means)
    gaussians = Gaussians(
        means,
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.repeat(_neighbour_distance(means)[:, None], 3, axis=1),
        np.full(count, FIRST_OPACITY, np.float32),
        colors,
        np.arange(count),
    )
    return deactivate(gaussians)


def _random_points(frame: ClipFrame, exposure: Exposure, rng: np.random.Generator) -> tuple[F32, F32]:
    y, x = np.nonzero(frame.tissue & (frame.depth > 0))
    picked = rng.random(len(x)) < POOLED_SHARE
    y, x = y[picked], x[picked]
    pixels = np.stack([x, y], 1).astype(np.float32)
    points = unproject(frame.camera, pixels, frame.depth[y, x]).astype(np.float32)
    return points, frame.image[y, x] / (np.float32(255) * exposure.at(frame.t_capture_ns))


def _neighbour_distance(points: F32) -> F32:
    """Root mean square distance [N] m to the three nearest others."""
    import open3d as o3d  # takes seconds to import

    places = o3d.core.Tensor.from_numpy(points)
    index = o3d.core.nns.NearestNeighborSearch(places)
    index.knn_index()
    _, squared = index.knn_search(places, min(4, len(points)))
    distances: F32 = np.sqrt(np.maximum(squared.numpy()[:, 1:].mean(1), 1e-10))
    return distances


def follow_online(
    clip: Clip, rasterizer: Rasterizer, exposure: Exposure, settings: FitSettings, progress: Progress
) -> tuple[F32, Paths]:
    """Play the training frames through the online mapper.

    Returns:
        Canonical rows [N, 14], at the mean of each Gaussian's path, and the paths, without exposure.

    Raises:
        SagsError: no frame had depth enough to start a model.
    """
    mapper, budget = Mapper(rasterizer, settings.max_gaussians), StepBudget(ONLINE_STEPS)
    seen: list[tuple[I64, F32, F32]] = []
    for done, frame in enumerate(clip.train):
        observation = frame.observation()
        budget.start()
        snapshot = mapper.update(observation, budget)
        planes = rasterizer.forward(snapshot.gaussians, [frame.camera])[0]
        mapper.drawn(observation, to_view(planes, frame.camera, frame.frame_id, frame.t_capture_ns))
        gaussians = snapshot.gaussians
        colors = gaussians.colors / exposure.at(frame.t_capture_ns)
        seen.append((gaussians.ids, gaussians.means, colors))
        progress("following the tissue", done + 1, len(clip.train))
    final = mapper.model.gaussians()  # before the 3D filter: the fit applies its own
    if len(final) == 0:
        raise SagsError("no training frame had depth enough to start a model; check vision.stereo")
    shape = (len(seen), len(final), 3)
    means, colors = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    known = np.zeros(shape[:2], np.bool_)
    row_of = np.full(max(int(ids.max(initial=0)) for ids, _, _ in seen) + 1, -1)
    row_of[final.ids] = np.arange(len(final))
    for t, (ids, at, colored) in enumerate(seen):
        rows = row_of[ids]
        kept = rows >= 0
        means[t, rows[kept]], colors[t, rows[kept]] = at[kept], colored[kept]
        known[t, rows[kept]] = True
    rows = deactivate(final)
    weight = known[..., None] / known.sum(0)[None, :, None]
    rows[:, columns.MEAN] = (means * weight).sum(0)
    rows[:, columns.COLOR] = (colors * weight).sum(0)
    times = np.array([frame.t_capture_ns for frame in clip.train])
    return rows, Paths(times, means, colors, known)


def learn_paths(field: Field, rows: F32, paths: Paths, settings: FitSettings, progress: Progress) -> None:
    """Let the field learn the paths: mean absolute errors of positions and colours, at random times."""
    rng = np.random.default_rng(settings.seed)
    for step in range(PATH_STEPS):
        t = int(rng.integers(len(paths.times_ns)))
        known = np.flatnonzero(paths.known[t])
        picked = rng.choice(known, min(PATH_POINTS, len(known)), replace=False)
        canonical = rows[picked]
        field.follow(canonical[:, columns.MEAN])
        deformed = field.deform(canonical, int(paths.times_ns[t]))
        v_deformed = np.zeros_like(deformed)
        means, colors = paths.means[t, picked], paths.colors[t, picked]
        v_deformed[:, columns.MEAN] = np.sign(deformed[:, columns.MEAN] - means) / POSITION_TOLERANCE
        v_deformed[:, columns.COLOR] = np.sign(deformed[:, columns.COLOR] - colors) / COLOR_TOLERANCE
        field.backward(v_deformed / np.float32(len(picked)))
        field.step(settings.field_rates.scaled(settings.decay ** (step / PATH_STEPS)))
        progress("learning the paths", step + 1, PATH_STEPS)
    field.follow(rows[:, columns.MEAN])
