"""Depth from stereo against a known truth: the node's stage at every scale, and SGBM."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import Advance
from benchmarks.quality.sgbm import JudgedSGBM, PlainSGBM
from sags_node.config.schema import OnnxConfig, StereoConfig, VisionConfig
from sags_node.errors import SagsError
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.budget import StepBudget
from sags_node.phantom.scene import Phantom, PhantomFrame, PhantomScene
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session
from sags_node.quality import metrics
from sags_node.sources.source import open_source
from sags_node.tools.evaluation.provenance import machine_name
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F32, F64, Bool, Camera, RectifiedPair, StereoFrame
from sags_node.vision.onnx_depth import NetworkDepth
from sags_node.vision.rectify import Rectifier
from sags_node.vision.stereo import StereoDepth

STEP = 2.0  # px of disparity over `AROUND`: an edge of the depth, or a slope that is hard to match
AROUND = 21  # px, a window's side
BESIDE = 30 / 640  # share of the width: distance from instruments and all else that is no tissue

SCALES = (1, 2, 4)
PLAIN_SCALES = (1, 2)
MODEL = "the model, drawn"
CONFIDENCES = (0.0, 0.25, 0.5, 0.75, 1.0)  # edges of the table's groups
EVERY = 10  # frames of a recording
WHITE = 230  # of 255, in every channel: a highlight
FAULTS: dict[str, tuple[float, ...]] = {  # name in `PhantomScene` -> levels
    "noise": (0.0, 0.01, 0.03, 0.06),
    "blur": (0.0, 1.0, 2.0, 4.0),
    "smoke": (0.0, 0.3, 0.6, 0.9),
    "gloss": (0.0, 1.0, 8.0, 64.0),
}

Matcher = Callable[[RectifiedPair, Bool], tuple[F32, F32]]  # depth (m, 0 unknown) and confidence, [H, W]


def _network_matcher(file: Path, config: StereoConfig, camera: Camera, baseline: float) -> Matcher:
    """Return the stage with a network, as `vision.onnx` sets it up, without its fallback.

    Raises:
        UsageError: the file is no depth network.
    """
    stereo = StereoDepth(config, camera, baseline)
    onnx = OnnxConfig(path=file, fallback=False)
    network = NetworkDepth(VisionConfig(stereo=config, onnx=onnx), stereo, camera, baseline)

    def match(pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        found = network(pair, tissue, lambda: stereo(pair, tissue)[0])
        assert found is not None  # without a fallback it raises
        return found

    return match


def make_matchers(
    config: StereoConfig, camera: Camera, baseline: float, network: Path | None = None
) -> dict[str, Matcher]:
    """Return the matchers by name. The first, to which the others are compared, is as `config` says.

    Args:
        network: an ONNX file to compare as well.

    Raises:
        UsageError: the images are too small to match at `SCALES`, or the file is no depth network.
    """
    matchers: dict[str, Matcher] = {"as configured": StereoDepth(config, camera, baseline)}
    for scale in SCALES:
        setting = config.model_copy(update={"scale": scale})
        matchers[f"inverse search, scale {scale}"] = StereoDepth(setting, camera, baseline)
    for scale in SCALES:
        matchers[f"SGBM, judged, scale {scale}"] = JudgedSGBM(config, camera, baseline, scale)
    for scale in PLAIN_SCALES:
        matchers[f"plain SGBM, scale {scale}"] = PlainSGBM(config, camera, baseline, scale)
    if network is not None:
        matchers[f"network {network.name}"] = _network_matcher(network, config, camera, baseline)
    return matchers


@dataclass
class Tally:
    """The results of one matcher over all frames so far."""

    errors_mm: list[F64] = field(default_factory=list)  # measured minus true
    confidences: list[F32] = field(default_factory=list)
    shared: list[Bool] = field(default_factory=list)  # also known to the stage as configured
    times_ms: list[float] = field(default_factory=list)
    wanted: int = 0  # px that have a true depth

    def add(self, depth: F32, confidence: F32, truth: F32, mask: Bool, shared: Bool) -> None:
        """Add a frame: images [H, W]; `mask`: pixels that count; `shared`: the first matcher has depth."""
        comparable = mask & (truth > 0)
        given = comparable & (depth > 0)
        self.wanted += int(comparable.sum())
        self.errors_mm.append((depth[given].astype(np.float64) - truth[given]) * 1e3)
        self.confidences.append(confidence[given])
        self.shared.append(shared[given])

    def errors(self) -> dict[str, Any]:
        errors, shared = np.concatenate(self.errors_mm), np.concatenate(self.shared)
        return {
            **error_figures(errors),
            "coverage": rounded(len(errors) / self.wanted) if self.wanted else None,
            "where_configured_knows": error_figures(errors[shared]),
        }

    def figures(self) -> dict[str, Any]:
        return self.errors() | {"ms": rounded(statistics.median(self.times_ms)) if self.times_ms else None}

    def by_confidence(self) -> list[dict[str, Any]]:
        return by_confidence(np.concatenate(self.errors_mm), np.concatenate(self.confidences))


def by_confidence(errors_mm: F64, confidences: F32) -> list[dict[str, Any]]:
    """Show whether confidence orders the errors: return one row for each group of confidence."""
    rows = []
    for low, high in pairwise(CONFIDENCES):
        group = (confidences > low) & (confidences <= high)
        share = rounded(group.mean()) if len(group) else None
        rows.append({"above": low, "up_to": high, "share": share, **error_figures(errors_mm[group])})
    return rows


def error_figures(errors_mm: F64) -> dict[str, float | None]:
    """Return figures of signed errors; None if there are none. A negative bias means too near."""
    if len(errors_mm) == 0:
        return dict.fromkeys(("median_mm", "p90_mm", "bias_mm"))
    size = np.abs(errors_mm)
    figures = np.median(size), np.percentile(size, 90), np.median(errors_mm)
    return dict(zip(("median_mm", "p90_mm", "bias_mm"), map(rounded, figures), strict=True))


def rounded(value: float | np.floating[Any]) -> float:
    return round(float(value), 4)


def spread(values: Sequence[float] | NDArray[np.floating[Any]]) -> dict[str, float]:
    """Return the median and the 90th percentile of values."""
    return {"median": rounded(np.median(values)), "p90": rounded(np.quantile(values, 0.9))}


class Comparison:
    """Matchers on the same frames."""

    def __init__(self, matchers: Mapping[str, Matcher]) -> None:
        self._matchers = matchers
        self.tallies = {name: Tally() for name in matchers}
        self._warm = False

    def add(self, pair: RectifiedPair, tissue: Bool, truth: F32, extra: Mapping[str, F32]) -> F32:
        """Match one pair with each matcher and compare with `truth` [H, W] (m) on tissue.

        Args:
            extra: depths that need no matching, by name.

        Returns:
            The first matcher's depth, [H, W] m.
        """
        configured: F32 | None = None
        for name, matcher in self._matchers.items():
            if not self._warm:
                matcher(pair, tissue)  # buffers are made and code is loaded in the first call
            started = time.perf_counter()
            depth, confidence = matcher(pair, tissue)
            self.tallies[name].times_ms.append((time.perf_counter() - started) * 1e3)
            if configured is None:
                configured = depth
            self.tallies[name].add(depth, confidence, truth, tissue, configured > 0)
        self._warm = True
        assert configured is not None  # there is always a matcher
        for name, depth in extra.items():
            known = (depth > 0).astype(np.float32)
            self.tallies.setdefault(name, Tally()).add(depth, known, truth, tissue, configured > 0)
        return configured

    def rows(self) -> list[dict[str, Any]]:
        return [{"name": name, **tally.figures()} for name, tally in self.tallies.items()]


TABLES = (
    "fault level white name median_mm p90_mm bias_mm coverage nearest_median_mm nearest_p90_mm"
    " where_configured_knows.median_mm where_configured_knows.p90_mm ms",
    "share median_mm p90_mm bias_mm above up_to",
    "region stage.median_mm stage.p90_mm stage.coverage drawn.median_mm drawn.p90_mm drawn.coverage"
    " drawn.where_configured_knows.bias_mm",
)


def measure_recording(session: Session, advance: Advance, network: Path | None = None) -> dict[str, Any]:
    """Compare depth on tissue with a recording's reference depth, in at most one of `EVERY` frames.

    The whole recording is played with one step of the mapper a frame, so that the depth of the drawn model is
    measured, too.

    Raises:
        SagsError: no frame has a reference depth, or the recording cannot be used.
        UsageError: as `make_matchers`.
    """
    config = session.config
    configure_threads(config.engine.threads)
    pipeline, budget = Pipeline(config, session.rig), StepBudget(1)
    camera, size = pipeline.rectifier.camera, session.working_size
    matchers = make_matchers(config.vision.stereo, camera, pipeline.rectifier.baseline, network)
    comparison, regions = Comparison(matchers), dict[str, dict[str, Tally]]()
    receipt = Receipt(session.rig, size, None)
    measured, kind, next_number = 0, "", 0
    focal_baseline = float(camera.K[0, 0]) * pipeline.rectifier.baseline
    with open_source(config.source) as frames:
        for number, frame in enumerate(frames):
            result = pipeline.process(frame, budget)
            advance(number + 1, None, "playing")
            reference = frame.reference
            if number < next_number or reference is None or reference.depth is None:
                continue
            next_number = number + EVERY
            truth, kind = metrics.resample_nearest(reference.depth, *size), reference.depth_kind
            drawn, tissue = result.views["left"].depth, result.observation.tissue
            stage = comparison.add(result.pair, tissue, truth, {MODEL: drawn})
            for name, mask in regions_of(truth, tissue, focal_baseline).items():
                tallies = regions.setdefault(name, {"stage": Tally(), "drawn": Tally()})
                for tally, depth in zip(tallies.values(), (stage, drawn), strict=True):
                    tally.add(depth, np.ones_like(depth), truth, mask, stage > 0)
            receipt.add(frame, tissue)
            measured += 1
    if measured == 0:
        raise SagsError(f"{session.name} has no reference depth to compare with; set source.reference.depth")
    return {
        "truth": kind,
        "session": session.name,
        "size": size,
        "frames": measured,
        "machine": machine_name(),
        "settings": comparison.rows(),
        "confidence": comparison.tallies["as configured"].by_confidence(),
        "regions": [
            {"region": name, **{which: tally.errors() for which, tally in tallies.items()}}
            for name, tallies in regions.items()
        ],
        "receipt": receipt.as_json(),
    }


def measure_faults(
    advance: Advance,
    network: Path | None = None,
    size: tuple[int, int] = (640, 512),
    frames: int = 4,
    faults: Mapping[str, Sequence[float]] = FAULTS,
) -> dict[str, Any]:
    """Measure the phantom, whose depth is known exactly, with one fault of its images rising at a time.

    Args:
        network: an ONNX file to compare as well.
        size: width and height of the images, px.
        frames: of each level, evenly over the whole motion.
        faults: levels by the name of the fault in `PhantomScene`.
    """
    levels = [(fault, level) for fault, values in faults.items() for level in values]
    rows = []
    for done, (fault, level) in enumerate(levels):
        advance(done, len(levels), f"{fault} {level:g}")
        phantom = Phantom(PhantomScene.model_validate({"width": size[0], "height": size[1], fault: level}))
        rectifier = Rectifier(phantom.rig, *size)
        matchers = make_matchers(StereoConfig(), rectifier.camera, rectifier.baseline, network)
        comparison = Comparison(matchers)
        receipt, white = Receipt(phantom.rig, size, None), []
        for index in range(frames):
            truth = phantom.frame(index, frames)
            frame = StereoFrame(index, 0, 0, truth.left, truth.right)
            pair, tissue = rectifier(frame), rectifier.mask(~truth.tool)
            comparison.add(pair, tissue, truth.depth, {})
            receipt.add(frame, tissue)
            white.append(float((pair.left.min(-1) >= WHITE)[tissue].mean()))
        rows.append(
            {
                "fault": fault,
                "level": level,
                "white": rounded(statistics.mean(white)),
                "settings": comparison.rows(),
                "confidence": comparison.tallies["as configured"].by_confidence(),
                "receipt": receipt.as_json(),
            }
        )
    return {
        "truth": "exact",
        "session": "phantom",
        "size": size,
        "frames": frames,
        "machine": machine_name(),
        "faults": rows,
    }


def frame_of(number: int, rate: float, truth: PhantomFrame) -> StereoFrame:
    """Return a phantom's frame as a camera of `rate` frames per second gives it, with its true mask."""
    stamp = round((1 + number / rate) * 1e9)
    return StereoFrame(number, stamp, stamp, truth.left, truth.right, tissue=~truth.tool)


def regions_of(truth: F32, tissue: Bool, focal_baseline: float) -> dict[str, Bool]:
    """Return masks [H, W] of pixels that are tissue and have a true depth, by the name of the region.

    "near" and "far" are the thirds of them with the least and the greatest depth. The next three may overlap;
    "elsewhere" is what is in none of these three.

    Args:
        truth: [H, W] m, 0 unknown.
        focal_baseline: px m, of this image.
    """
    comparable = tissue & (truth > 0)
    if not comparable.any():
        return {}
    disparity = np.divide(focal_baseline, truth, out=np.zeros_like(truth), where=truth > 0)
    nearest, farthest = np.percentile(truth[comparable], [100 / 3, 200 / 3])
    window = np.ones((AROUND, AROUND), np.uint8)
    lowest = cv2.erode(np.where(truth > 0, disparity, np.inf).astype(np.float32), window)
    edges = cv2.dilate(disparity, window) - lowest > STEP
    side = 2 * round(BESIDE * truth.shape[1]) + 1
    beside = cv2.erode(tissue.view(np.uint8), np.ones((side, side), np.uint8)) == 0
    unseen = np.arange(truth.shape[1]) < disparity
    masks = {
        "near": truth <= nearest,
        "far": truth > farthest,
        "at edges": edges,
        "beside instruments": beside,
        "not seen by the right eye": unseen,
        "elsewhere": ~(edges | beside | unseen),
    }
    return {name: np.asarray(comparable & mask, np.bool_) for name, mask in masks.items()}
