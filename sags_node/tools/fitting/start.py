"""How a fit begins: canonical Gaussians, and what the field knows of the motion already.

`paper`: points of all training frames pooled at random (EndoGaussian, SAGS); the field knows nothing.
`online`: the online mapper plays the clip once. It follows every Gaussian through the frames; the field
learns these paths by regression, which needs no drawing and so is fast. What it leaves becomes residuals.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sags_node.engine.rasterizer.rasterize import Rasterizer
from sags_node.errors import SagsError
from sags_node.field.deformation import Field
from sags_node.field.drawing import deactivate
from sags_node.geometry import unproject
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.mapper import Mapper
from sags_node.mapping.motion import Drawn, SurfaceTracker
from sags_node.mapping.refiner import CpuRefiner
from sags_node.mapping.tissue_map import TissueMap
from sags_node.model import columns
from sags_node.model.exposure import Exposure
from sags_node.tools.fitting.clip import Clip, ClipFrame, is_cut
from sags_node.tools.fitting.residuals import Residuals, check_size
from sags_node.tools.fitting.settings import FitSettings, path_frames
from sags_node.types import F32, I64, Bool, Gaussians

POOLED_SHARE = 0.01  # of a frame's pixels
ONLINE_STEPS = 2  # of the mapper per frame
PATH_POINTS = 8192  # Gaussians per step of the regression
PATH_STEPS = 1500
CARRIERS = 8  # nearest Gaussians whose mean motion tells where a new one was in the first frame
NEIGHBOURS_AT_A_TIME = 2048  # points whose distances to all others fit on a GPU
HIDDEN = -5.0  # added to an opacity logit

FOLLOW, LEARN = "following the tissue", "learning the paths"  # stages of an online start

Progress = Callable[[str, int, int], None]  # stage, done, of


@dataclass(frozen=True, slots=True)
class Paths:
    """The state of each Gaussian in the online mapper at some times."""

    times_ns: I64  # [K]
    states: F32  # [K, N, 14], see `columns`
    known: Bool  # [K, N]


def pooled_rows(
    clip: Clip, exposure: Exposure, settings: FitSettings, device: torch.device | None = None
) -> F32:
    """The canonical rows [N, 14], without exposure, from random pixels of all training frames. `device`:
    where torch finds their neighbours; None: Open3D does.

    Raises:
        SagsError: no frame has a depth.
    """
    rng = np.random.default_rng(settings.seed)
    pools = [_random_points(frame, exposure, rng) for frame in clip.train]
    means, colors = (np.concatenate(parts) for parts in zip(*pools, strict=True))
    if len(means) == 0:
        raise SagsError("no training frame has a depth on tissue; check vision.stereo and the masks")
    most = settings.max_gaussians
    count = min(settings.growth.first or most, most, len(means))
    picked = rng.choice(len(means), count, replace=False)
    means, colors = means[picked], colors[picked]
    gaussians = Gaussians(
        means,
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.repeat(np.float32(settings.growth.scale) * _neighbour_distance(means, device)[:, None], 3, axis=1),
        np.full(count, settings.growth.opacity, np.float32),
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


def _neighbour_distance(points: F32, device: torch.device | None) -> F32:
    """Root mean square distance [N] m to the three nearest others."""
    if device is None:
        _, squared = _nearest(points, points, 4)  # the nearest is the point itself
    else:
        exact, there = "donot_use_mm_for_euclid_dist", torch.from_numpy(points).to(device)
        parts = torch.split(there, NEIGHBOURS_AT_A_TIME)
        near = [torch.cdist(part, there, compute_mode=exact).topk(4, largest=False)[0] for part in parts]
        squared = torch.cat(near).square().cpu().numpy()
    distances: F32 = np.sqrt(np.maximum(squared[:, 1:].mean(1), 1e-10))
    return distances


def _nearest(points: F32, queries: F32, count: int) -> tuple[I64, F32]:
    """The points nearest to each query, at most `count`: indices and squared distances, [M, count]."""
    import open3d as o3d  # takes seconds to import

    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
    search.knn_index()
    found, squared = search.knn_search(
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(queries)), min(count, len(points))
    )
    return found.numpy(), squared.numpy()


def follow_online(
    clip: Clip, rasterizer: Rasterizer, exposure: Exposure, settings: FitSettings, progress: Progress
) -> tuple[F32, F32, Paths]:
    """Play the training frames through the online mapper.

    Returns:
        Canonical rows [N, 14], placed as the tissue lay in the first frame, slopes [N, 3], and the paths, all
        without exposure.

    Raises:
        SagsError: no frame had depth enough to start a model, or the clip is too long for its memory.
    """
    slots = path_frames(len(clip.train))
    check_size(len(slots), settings.max_gaussians)
    refiner = CpuRefiner(lambda width, height: rasterizer)  # all frames have its size
    mapper, budget = Mapper(refiner, TissueMap(settings.max_gaussians)), StepBudget(ONLINE_STEPS)
    surface, last = SurfaceTracker(), None
    seen: list[tuple[I64, F32, F32]] = []
    first = _Places()
    for done, frame in enumerate(clip.train):
        observation = frame.observation()
        if done and is_cut(clip.train[done - 1], frame):
            mapper.map.restart()
            last = None
        budget.start()
        tracks = None if last is None else surface.track(mapper.model.means, last, observation)
        last = Drawn(observation, mapper.update(observation, tracks, budget).view)
        gaussians = mapper.model.gaussians()  # before the 3D filter: the fit applies its own
        first.add(gaussians.ids, gaussians.means)
        if done in slots:
            rows = deactivate(gaussians)
            gain = exposure.at(frame.t_capture_ns)
            rows[:, columns.COLOR] /= gain
            slopes = mapper.model.slopes / gain.mean()
            seen.append((gaussians.ids.copy(), rows, slopes))  # the mapper goes on writing into its own
        progress(FOLLOW, done + 1, len(clip.train))
    ids, lives = np.unique(np.concatenate([ids for ids, *_ in seen]), return_counts=True)
    if len(ids) > settings.max_gaussians:  # after a cut in the recording
        ids = np.sort(ids[np.argsort(-lives, kind="stable")[: settings.max_gaussians]])
    if len(ids) == 0:
        raise SagsError("no training frame had depth enough to start a model; check vision.stereo")
    states, slopes = (
        np.zeros((len(seen), len(ids), columns.COUNT), np.float32),
        np.zeros((len(ids), 3), np.float32),
    )
    known = np.zeros(states.shape[:2], np.bool_)
    for slot, (those, rows, there) in enumerate(seen):
        kept = np.isin(those, ids)
        at = np.searchsorted(ids, those[kept])
        states[slot, at], known[slot, at] = rows[kept], True
        slopes[at] += there[kept]
    slopes /= known.sum(0)[:, None]
    rows = (states * (known[..., None] / known.sum(0)[None, :, None]).astype(np.float32)).sum(0)
    rows[:, columns.MEAN] = first.of(ids)
    times_ns = np.array([clip.train[slot].t_capture_ns for slot in slots])
    return rows, slopes, Paths(times_ns, states, known)


class _Places:
    """Where each Gaussian lay in the first frame. One that appears later is carried back there by the
    displacement of those around it."""

    def __init__(self) -> None:
        self._places = np.zeros((0, 3), np.float32)  # by id
        self._known = np.zeros(0, np.bool_)

    def add(self, ids: I64, means: F32) -> None:
        """Take in the next frame's Gaussians, ids [N] and means [N, 3] m, and place the new ones."""
        more = max(int(ids.max(initial=-1)) + 1 - len(self._known), 0)
        self._places = np.pad(self._places, ((0, more), (0, 0)))
        self._known = np.pad(self._known, (0, more))
        known = self._known[ids]
        new = means[~known].copy()
        if known.any() and len(new):
            displacement = means[known] - self._places[ids[known]]
            carriers, _ = _nearest(means[known], new, CARRIERS)
            new -= displacement[carriers].mean(axis=1)
        self._places[ids[~known]], self._known[ids[~known]] = new, True

    def of(self, ids: I64) -> F32:
        """The places [N, 3] m in the first frame of Gaussians that were added."""
        return self._places[ids]


def learn_paths(field: Field, rows: F32, paths: Paths, settings: FitSettings, progress: Progress) -> None:
    """Train the field on the paths: minimise mean absolute errors of positions, at random times."""
    rng = np.random.default_rng(settings.seed)
    field.follow(rows[:, columns.MEAN])
    for step in range(PATH_STEPS if len(paths.times_ns) > 1 else 0):  # one image shows no motion
        slot = int(rng.integers(len(paths.times_ns)))
        known = np.flatnonzero(paths.known[slot])
        picked = rng.choice(known, min(PATH_POINTS, len(known)), replace=False)
        canonical, which = torch.from_numpy(rows[picked]), torch.from_numpy(picked)
        deformed = field.deform(canonical, int(paths.times_ns[slot]), which)
        wanted = torch.from_numpy(paths.states[slot, picked])
        off: Tensor = (deformed - wanted)[:, columns.MEAN].abs().sum() / len(picked)
        off.backward()  # type: ignore[no-untyped-call]
        field.deltas.step(settings.field_rates.scaled(settings.decay ** (step / PATH_STEPS)))
        progress(LEARN, step + 1, PATH_STEPS)


def remainder(field: Field, rows: F32, paths: Paths) -> Residuals:
    """Return what the field leaves of the paths. Where the mapper did not know a Gaussian, its residual is
    that of the nearest time at which it did, with an opacity that hides it."""
    residuals = Residuals(paths.times_ns, len(rows))
    for slot, t_ns in enumerate(paths.times_ns.tolist()):
        with torch.no_grad():
            deformed = field.deform(torch.from_numpy(rows), t_ns).numpy()
        residuals.values[slot] = paths.states[slot] - deformed
    slots = np.arange(len(paths.times_ns))
    for slot in range(len(slots)):
        lost = np.flatnonzero(~paths.known[slot])
        distance = np.where(paths.known[:, lost], np.abs(slots - slot)[:, None], len(slots))
        residuals.values[slot, lost] = residuals.values[distance.argmin(axis=0), lost]
        residuals.values[slot, lost, columns.LOGIT] += HIDDEN
    return residuals
