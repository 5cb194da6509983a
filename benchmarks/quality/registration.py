"""How accurately a model is placed on tissue: on the phantom, whose surface is the model, and a real organ.

Each seed is another phantom, another part of its surface, and other errors of the picked points.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np

from benchmarks import Advance
from benchmarks.quality.depth import frame_of, rounded, spread
from benchmarks.quality.depth_ct import CTPair, configured_depth, read_ct_pair
from sags_node.clients.registration.register import Registration, Verdict, register
from sags_node.clients.registration.rigid import kabsch
from sags_node.clients.registration.surfaces import MIRROR, Shape, Surface
from sags_node.config.schema import LaunchConfig
from sags_node.geometry import invert, project, rigid, transform
from sags_node.mapping.budget import StepBudget
from sags_node.phantom.rig import phantom_rig
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.warm_up import prepare
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F32, F64, I32, I64, Camera, StereoFrame

PAIRS, TARGETS = 5, 5
PICKED = 1e-3  # m, standard deviation of a picked point along each axis
BELOW = 0.020  # m under the surface, along the line of sight
FRAMES, RATE, STEPS = 5, 5.0, 2  # a second of the node; steps of the mapper, each frame
SIZE = (640, 512)
PART = (0.35, 0.36)  # half axes of the part that is cut out, of width and height
REACH = 0.010  # m, largest distance of a correspondence in Open3D's ICP
EVEN = 0.03  # m, half a side of the shapes that do not fix a pose
ERRORS = 5  # random errors of the picked points on each of these shapes
RADIUS = 0.05  # m, of the ball


class Case:
    """A model that lies somewhere in its own coordinates, and where it truly is.

    Args:
        rng: for the model's pose and the errors of the picked points.
        vertices: [V, 3] m, world, that the eye at the world's origin sees.
    """

    def __init__(self, rng: np.random.Generator, vertices: F64, triangles: I32) -> None:
        away = rigid(cv2.Rodrigues(rng.normal(size=3))[0], rng.normal(0, 0.1, 3))
        self.truth = invert(away)
        picked = _far_apart(rng, vertices)
        seen = vertices[rng.choice(len(vertices), TARGETS)]
        self.deep = seen * (1 + BELOW / np.linalg.norm(seen, axis=1, keepdims=True))
        self.at, self.targets, lying = (
            np.asarray(transform(away, points), np.float64) for points in (picked, self.deep, vertices)
        )
        self.places = picked + rng.normal(0, PICKED, picked.shape)
        self.model = Shape(lying, triangles)

    def errors(self, T: F64) -> F64:
        """Return the errors (m) of the targets under a pose."""
        return np.asarray(np.linalg.norm(transform(T, self.targets) - self.deep, axis=1), np.float64)


@dataclass(frozen=True, slots=True)
class Placing:
    """The result of one case. Errors are by pose: by_pairs, open3d, and fitted unless it was refused."""

    found: Registration
    errors_mm: dict[str, list[float]]  # of each target
    told_mm: dict[str, list[float]]  # stated errors of each target; Open3D states none

    def as_json(self, seed: int) -> dict[str, Any]:
        """Return what is kept of the result."""
        said = {"seed": seed, "verdict": self.found.verdict, "reason": self.found.reason}
        return {**said, "share": rounded(self.found.share), "fitted_mm": self.errors_mm.get("fitted", [])}


TABLES = (
    "told_mm within_told p90_mm median_mm",
    "what refused of with_its_remedy said",
)


def measure_registration(ct: Path | None, seeds: int, advance: Advance) -> dict[str, Any]:
    """Register on each seed's phantom and, with the folder `ct`, on the CT surface; count the refusals."""
    config = LaunchConfig(source=PhantomScene(width=SIZE[0], height=SIZE[1]))
    prepare(config)
    placings: list[Placing] = []
    refusals: list[tuple[str, Registration, str]] = []
    receipt = Receipt(phantom_rig(*SIZE), SIZE, None)
    for seed in range(seeds):
        advance(seed, seeds, "phantom")
        phantom = Phantom(
            PhantomScene(seconds=1.0, width=SIZE[0], height=SIZE[1], seed=seed, still_tissue=True)
        )
        camera, surface = _node_sees(config, phantom, receipt)
        rng = np.random.default_rng(seed)
        used, triangles = part(rng, phantom, camera)
        case = Case(rng, phantom.tissue.vertices(0.0).reshape(-1, 3)[used].astype(np.float64), triangles)
        placings.append(_registered(case, surface))
        refusals += _spoilt(case, surface)
    refusals += _even(np.random.default_rng(0))
    measured: dict[str, Any] = {
        "picked_mm": 1e3 * PICKED,
        "below_mm": 1e3 * BELOW,
        "phantom": _summary(placings),
        "rows": [each.as_json(seed) for seed, each in enumerate(placings)],
        "refused": _counted(refusals),
        "receipts": {"phantom": receipt.as_json()},
    }
    if ct is not None:
        advance(seeds, seeds, "CT")
        pair = read_ct_pair(ct)
        placings = list(_on_ct(pair, seeds))
        measured["ct"] = _summary(placings)
        measured["ct_rows"] = [each.as_json(seed) for seed, each in enumerate(placings)]
        measured["receipts"]["ct"] = pair.receipt
    return measured


def shown_to_node(phantom: Phantom, number: int, count: int, rate: float) -> StereoFrame:
    """Return frame `number` of `count`, with its true masks and pose."""
    truth = phantom.frame(number, count)
    return replace(frame_of(number, rate, truth), T_world_cam=truth.T_world_cam)


def _node_sees(config: LaunchConfig, phantom: Phantom, receipt: Receipt) -> tuple[Camera, Surface]:
    """The camera and the surface that `sags register` gets from a second of the node."""
    pipeline, parts = Pipeline(config, phantom.rig, rate=RATE), []
    for number in range(FRAMES):
        frame = shown_to_node(phantom, number, FRAMES, RATE)
        result = pipeline.process(frame, StepBudget(STEPS))
        view, tissue = result.views["left"], result.observation.tissue
        receipt.add(frame, tissue)
        assert view.confidence is not None  # the pipeline states it
        parts.append(Surface.of_depth(view.depth, view.confidence, tissue, view.camera))
    return view.camera, Surface.joined(parts)


def part(rng: np.random.Generator, phantom: Phantom, camera: Camera, phase: float = 0.0) -> tuple[I64, I32]:
    """Return the tissue's vertices (indices) within an ellipse of the image, and triangles of these."""
    vertices = phantom.tissue.vertices(phase).reshape(-1, 3).astype(np.float64)
    triangles = phantom.tissue.faces.astype(np.int32)
    size = np.array([camera.width, camera.height])
    middle = size * rng.uniform(0.4, 0.6, 2)
    pixels, _ = project(camera, vertices[triangles].mean(1))
    kept = triangles[np.linalg.norm((pixels - middle) / (PART * size), axis=1) < 1]
    used, numbers = np.unique(kept, return_inverse=True)
    return used.astype(np.int64), numbers.reshape(-1, 3).astype(np.int32)


def _far_apart(rng: np.random.Generator, vertices: F64) -> F64:
    """Landmarks as people pick them: each time, of 12 random vertices, the farthest from those before."""
    chosen = [vertices[rng.integers(len(vertices))]]
    while len(chosen) < PAIRS:
        at_hand = vertices[rng.choice(len(vertices), 12)]
        away = np.linalg.norm(at_hand[:, None] - np.array(chosen), axis=2).min(1)
        chosen.append(at_hand[away.argmax()])
    return np.array(chosen)


def _registered(case: Case, surface: Surface) -> Placing:
    found = register(case.model, case.at, case.places, surface, case.targets)
    start = kabsch(case.at, case.places, np.full(PAIRS, 1 / PAIRS))
    errors = {"by_pairs": start, "open3d": _open3d(case.model, surface, start)}
    told: dict[str, list[float]] = {}
    if found.T_world_model is not None and found.expected_by_pairs is not None and found.expected is not None:
        errors["fitted"] = found.T_world_model
        told = {"by_pairs": _mm(found.expected_by_pairs), "fitted": _mm(found.expected)}
    errors_mm = {name: _mm(case.errors(T)) for name, T in errors.items()}
    return Placing(found, errors_mm, told)


def _open3d(model: Shape, surface: Surface, T: F64) -> F64:
    """The pose [4, 4] by Open3D's point-to-plane ICP with default settings."""
    import open3d as o3d

    measured, corners = (
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (surface.points, model.vertices)
    )
    measured.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(0.005, 30))
    way = o3d.pipelines.registration.TransformationEstimationPointToPlane()
    found = o3d.pipelines.registration.registration_icp(corners, measured, REACH, T, way)
    return np.asarray(found.transformation)


def _spoilt(case: Case, surface: Surface) -> Iterable[tuple[str, Registration, str]]:
    """Registrations that must be refused: name, result, and words that the remedy must contain."""
    model, at, places, targets = case.model, case.at, case.places, case.targets
    for name, factor, word in (
        ("mm read as m", 1000.0, "divide --scale by 1000"),
        ("m read as mm", 0.001, "multiply --scale by 1000"),
        ("cm read as mm", 0.1, "multiply --scale by 10"),
    ):
        other = Shape(factor * model.vertices, model.triangles)
        yield name, register(other, factor * at, places, surface, factor * targets), word
    yield "mirrored", register(model.mirrored(), at * MIRROR, places, surface, targets * MIRROR), "handedness"
    yield "two pairs", register(model, at[:2], places[:2], surface, targets), "give 3 to 20"
    line = np.linspace(0, 1, PAIRS)[:, None]
    at, places = (ends[0] + line * (ends[1] - ends[0]) for ends in (at, places))
    yield "on a line", register(model, at, places, surface, targets), "add one aside"


def _even(rng: np.random.Generator) -> Iterable[tuple[str, Registration, str]]:
    """A plane and a part of a sphere, with errors like those of depth; both go on beyond the model."""
    K = np.array([[576.0, 0, 319.5], [0, 576.0, 255.5], [0, 0, 1]])
    camera = Camera(*SIZE, K, np.eye(4))
    x, y = np.meshgrid(np.linspace(-EVEN, EVEN, 61), np.linspace(-EVEN, EVEN, 61))
    corner = (np.arange(60)[:, None] * 61 + np.arange(60)).ravel()
    triangles = np.concatenate(
        [np.stack([corner, corner + 1, corner + 61], 1), np.stack([corner + 62, corner + 61, corner + 1], 1)]
    )
    for name, z in (("plane", 0.08 + 0.2 * x), ("ball", 0.08 + RADIUS - np.sqrt(RADIUS**2 - x**2 - y**2))):
        vertices = np.stack([x, y, z], -1).reshape(-1, 3)
        noisy = vertices * (1 + rng.normal(0, 3e-4, len(vertices)) / vertices[:, 2])[:, None]
        surface = Surface(noisy, np.full(len(noisy), 4e-4), camera.T_world_cam[:3, 3])
        inner = triangles[(np.abs(vertices[triangles, :2].mean(1)) < 0.02).all(1)].astype(np.int32)
        used, numbers = np.unique(inner, return_inverse=True)
        for _ in range(ERRORS):
            case = Case(rng, vertices[used], numbers.reshape(-1, 3).astype(np.int32))
            yield name, register(case.model, case.at, case.places, surface, case.targets), "with an edge"


def _on_ct(pair: CTPair, seeds: int) -> Iterable[Placing]:
    """Registrations on the CT surface, each with other picked points; truth is the set's own alignment."""
    depth, confidence = configured_depth(pair)
    surface = Surface.of_depth(depth, confidence, pair.evaluated, pair.pair.camera)
    triangles = _joined_in_picture(pair.pixels.astype(np.float32), pair.points)
    for seed in range(seeds):
        case = Case(np.random.default_rng(seed), pair.points, triangles)
        yield _registered(case, surface)


def _joined_in_picture(pixels: F32, points: F64) -> I32:
    """Triangles [T, 3] of neighbours in the image (Delaunay) that are neighbours on the surface, too."""
    width, height = np.ceil(pixels.max(0)).astype(int) + 2
    mesh = cv2.Subdiv2D((0, 0, int(width), int(height)))
    numbers = {tuple(np.round(pixel, 3)): number for number, pixel in enumerate(pixels)}
    mesh.insert([tuple(map(float, pixel)) for pixel in pixels])
    corners = np.round(np.asarray(mesh.getTriangleList(), np.float32).reshape(-1, 3, 2), 3)
    found = [[numbers.get(tuple(corner), -1) for corner in triangle] for triangle in corners]
    triangles = np.array([triangle for triangle in found if min(triangle) >= 0], np.int32)
    sides = points[triangles] - points[np.roll(triangles, 1, axis=1)]
    lengths = np.linalg.norm(sides, axis=2).max(1)
    near: I32 = triangles[lengths < 4 * np.median(lengths)]
    return near


def _mm(lengths: F64) -> list[float]:
    return [rounded(1e3 * each) for each in lengths]


def _summary(placings: list[Placing]) -> dict[str, Any]:
    """Figures of all targets of all seeds."""
    said: dict[str, Any] = {"seeds": len(placings)}
    verdicts = [each.found.verdict for each in placings]
    said["verdicts"] = {verdict: verdicts.count(verdict) for verdict in get_args(Verdict)}
    for name in ("by_pairs", "fitted", "open3d"):
        errors = np.array([error for each in placings for error in each.errors_mm.get(name, ())])
        said[name] = {f"{which}_mm": length for which, length in spread(errors).items()}
    for name in ("by_pairs", "fitted"):
        pairs = [
            pair
            for each in placings
            if name in each.told_mm
            for pair in zip(each.errors_mm[name], each.told_mm[name], strict=True)
        ]
        said[name]["told_mm"] = rounded(np.median([told for _, told in pairs]))
        said[name]["within_told"] = rounded(np.mean([error <= told for error, told in pairs]))
    return said


def _counted(refusals: list[tuple[str, Registration, str]]) -> list[dict[str, Any]]:
    counted: dict[str, dict[str, Any]] = {}
    for name, found, word in refusals:
        row = counted.setdefault(name, {"what": name, "of": 0, "refused": 0, "with_its_remedy": 0})
        row["of"] += 1
        row["refused"] += found.verdict == "refused"
        row["with_its_remedy"] += found.verdict == "refused" and word in found.reason
        row["said"] = found.reason
    return list(counted.values())
