"""Does the image stay right at another size, or from another distance, than it was trained at?

That is what both filters of Mip-Splatting (Yu et al., CVPR 2024) are for; at the trained size they bring
nothing. Four models of one instant of the phantom are trained by the mapper, each with its own choice of
filters, and drawn where nothing was trained, against the ray-cast truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from benchmarks import Advance
from benchmarks.quality.alias_truth import AliasTruth, Shot
from sags_node.config.schema import PhantomSource
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.mapper import Mapper
from sags_node.mapping.motion import Drawn, SurfaceTracker
from sags_node.mapping.refiner import CpuRefiner
from sags_node.mapping.tissue_map import TissueMap
from sags_node.model.alias_free import smoothing_variances
from sags_node.quality.metrics import psnr
from sags_node.tools.evaluation.provenance import machine_name
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F32, U8, Camera, Gaussians, Observation, StereoFrame

CROPS = {0.25: (0.45, 0.45, 0.4), 4.0: (0.62, 0.6, 0.1)}  # size -> left, top, side: shares of the image
PANEL = (400, 320)  # px

SIZES = (0.25, 0.5, 1.0, 2.0, 4.0)
DISTANCES = (0.5, 1.0, 2.0, 4.0)
DRIFT_SIZE, DRIFT_STEP = 0.25, 0.1  # of the trained size; px per frame
STEPS_PER_ROUND = 50  # between two looks for holes


@dataclass(frozen=True, slots=True)
class Settings:
    """What is measured."""

    width: int = 640  # px, size of the training image
    height: int = 512
    max_gaussians: int = 30_000
    rounds: int = 6  # of STEPS_PER_ROUND
    frames: int = 24  # of the slow motion


QUICK = Settings(width=160, height=128, max_gaussians=3000, rounds=1, frames=4)


@dataclass(frozen=True, slots=True)
class Filters:
    """Which of the two filters are on."""

    screen: bool  # 2D; off: the fixed dilation of 3D Gaussian Splatting
    world: bool  # 3D


VARIANTS: Mapping[str, Filters] = {
    "both": Filters(screen=True, world=True),
    "only_2d": Filters(screen=True, world=False),
    "only_3d": Filters(screen=False, world=True),
    "none": Filters(screen=False, world=False),
}


@dataclass(frozen=True, slots=True)
class Trained:
    """A model and how it must be drawn."""

    gaussians: Gaussians
    antialias: bool

    def draw(self, camera: Camera) -> F32:
        """Draw the image [H, W, 3]."""
        rasterizer = make_rasterizer("numba", camera.width, camera.height, self.antialias)
        return colours_of(rasterizer.forward(self.gaussians, camera))


def train(observation: Observation, filters: Filters, settings: Settings) -> Trained:
    """Train a model on one still image with the node's own mapper."""
    refiner = CpuRefiner(partial(make_rasterizer, "numba", antialias=filters.screen))
    mapper = Mapper(refiner, TissueMap(settings.max_gaussians), filters.world, focus=1.0)
    mapped = mapper.update(observation, None, StepBudget(STEPS_PER_ROUND))  # places the Gaussians
    for _ in range(settings.rounds):
        last = Drawn(observation, mapped.view)
        tracks = SurfaceTracker().track(mapper.model.means, last, observation)
        mapped = mapper.update(observation, tracks, StepBudget(STEPS_PER_ROUND))
    return Trained(mapped.snapshot.gaussians, filters.screen)  # the mapper's own has new, untrained splits


@dataclass(frozen=True, slots=True)
class Measured:
    """The table, keys as benchmarks/README.md lists them, and what it was measured with."""

    table: dict[str, Any]
    truth: AliasTruth
    models: Mapping[str, Trained]


TABLES = (
    "gain_db_quarter gain_db_size_4 gain_db_distance_4 gain_db_distance_half",
    f"{' '.join(VARIANTS)} factor",
    " ".join(f"{name}.{part}" for name in VARIANTS for part in ("picture", "error")) + " px_per_frame",
    "view no yes",
)


def measure_alias(settings: Settings, advance: Advance) -> Measured:
    """Train all variants, draw them and compare them with the truth."""
    total = len(VARIANTS) + 2
    advance(0, total, "the truth")
    truth = AliasTruth(PhantomSource(width=settings.width, height=settings.height))
    still = truth.observation()
    receipt = Receipt(truth.rig, (settings.width, settings.height), None)
    receipt.add(StereoFrame(0, 0, 0, still.image, None), still.tissue)
    models = {}
    for done, (name, filters) in enumerate(VARIANTS.items(), 1):
        advance(done, total, f"training: {name.replace('_', ' ')}")
        models[name] = train(still, filters, settings)
    advance(total - 1, total, "other sizes and distances, slow motion")
    size = [{"factor": k, **_psnrs(models, truth.at_size(k))} for k in SIZES]
    distance = [{"factor": k, **_psnrs(models, truth.at_distance(k))} for k in DISTANCES]
    table = {
        "machine": machine_name(),
        "width": settings.width,
        "height": settings.height,
        "steps": settings.rounds * STEPS_PER_ROUND,
        "gaussians": {name: len(model.gaussians) for name, model in models.items()},
        "gain_db_quarter": _gain(size, 0.25),
        "gain_db_size_4": _gain(size, 4.0),
        "gain_db_distance_4": _gain(distance, 4.0),
        "gain_db_distance_half": _gain(distance, 0.5),
        "psnr_at_size": size,
        "psnr_at_distance": distance,
        "thin_vessel_brightness_change": [
            {"factor": k, **_brightness_changes(models, truth, k)} for k in SIZES
        ],
        "flicker": _flicker(models, truth, settings.frames),
        "requested_view_in_filter": _requested_view(models["both"], truth),
        "receipt": receipt.as_json(),  # of what trains
    }
    return Measured(table, truth, models)


def _psnrs(models: Mapping[str, Trained], shot: Shot) -> dict[str, float]:
    return {name: psnr(model.draw(shot.camera), shot.image, shot.counted) for name, model in models.items()}


def _gain(rows: list[dict[str, float]], factor: float) -> float:
    """The gain of both filters over none, dB."""
    (row,) = (row for row in rows if row["factor"] == factor)
    return row["both"] - row["none"]


def _brightness_changes(models: Mapping[str, Trained], truth: AliasTruth, factor: float) -> dict[str, float]:
    """The change of the thin vessels' mean brightness, as a share of the truth's."""
    shot, vessel = truth.at_size(factor), truth.thin_vessels(factor)
    true = _brightness(shot.image, vessel)
    return {name: _brightness(model.draw(shot.camera), vessel) / true - 1 for name, model in models.items()}


def _brightness(image: F32, weight: F32) -> float:
    return float(np.average(image.mean(-1, dtype=np.float64), weights=weight))


def _flicker(models: Mapping[str, Trained], truth: AliasTruth, frames: int) -> dict[str, Any]:
    """Energy of the pixels' second differences in time over a slow motion, as multiples of the truth's. Of
    the image 1 is right, less is blurred and more flickers; of its error 0 is right."""
    shots = list(truth.drift(DRIFT_SIZE, DRIFT_STEP, frames))
    counted = np.logical_and.reduce([shot.counted for shot in shots])
    true = np.stack([shot.image[counted] for shot in shots])
    found: dict[str, Any] = {"size": DRIFT_SIZE, "px_per_frame": DRIFT_STEP, "frames": frames}
    for name, model in models.items():
        drawn = np.stack([model.draw(shot.camera)[counted] for shot in shots])
        found[name] = {
            "picture": _restlessness(drawn) / _restlessness(true),
            "error": _restlessness(drawn - true) / _restlessness(true),
        }
    return found


def _restlessness(pixels: F32) -> float:
    """Mean square of the second differences along the first axis, time."""
    return float(np.mean(np.diff(pixels, 2, axis=0) ** 2))


def _requested_view(model: Trained, truth: AliasTruth) -> list[dict[str, Any]]:
    """PSNR from nearer by, with and without the camera that only looks at the result in the 3D filter's
    sampling rate."""
    rows = []
    for view, shot in (("size 4", truth.at_size(4.0)), ("distance 0.5", truth.at_distance(0.5))):
        variances = smoothing_variances(model.gaussians.means, [truth.camera, shot.camera])
        joined = replace(model, gaussians=replace(model.gaussians, smoothing=variances))
        yes, no = (psnr(each.draw(shot.camera), shot.image, shot.counted) for each in (joined, model))
        rows.append({"view": view, "yes": yes, "no": no})
    return rows


def picture(truth: AliasTruth, models: Mapping[str, Trained]) -> bytes:
    """Draw pieces of tissue at 1/4 and 4 times the trained size, as a PNG: truth, both filters, none."""
    rows = []
    for factor, crop in CROPS.items():
        shot = truth.at_size(factor)
        drawn = {"both filters": models["both"], "no filter": models["none"]}
        images = {"truth": shot.image} | {name: model.draw(shot.camera) for name, model in drawn.items()}
        rows.append(
            np.hstack([_panel(image, crop, f"{name}, x {factor:g}") for name, image in images.items()])
        )
    return cv2.imencode(".png", np.vstack(rows)[..., ::-1])[1].tobytes()


def _panel(image: F32, crop: tuple[float, float, float], title: str) -> U8:
    """A titled piece of an image; `crop`: left, top and side as shares of the image."""
    height, width = image.shape[:2]
    left, top = round(crop[0] * width), round(crop[1] * height)
    piece = image[top : top + round(crop[2] * height), left : left + round(crop[2] * width)]
    levels = np.asarray(np.clip(piece * 255 + 0.5, 0, 255), np.uint8)
    panel = cv2.resize(levels, PANEL, interpolation=cv2.INTER_NEAREST)
    framed = cv2.copyMakeBorder(panel, 28, 4, 4, 4, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    cv2.putText(framed, title, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    return np.asarray(framed, np.uint8)
