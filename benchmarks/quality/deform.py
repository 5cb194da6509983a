"""How well a registered model follows tissue that is pulled: on the phantom, rigid and bent with it.

The motion of the phantom's surface is known exactly. The phantom has nothing below it: there the truth is by
definition an incompressible elastic half space with this surface. Its solution is that of Stokes' equations
below a plane with a given motion, wave by wave: at depth z a wave of k rad/m has faded to (1 + k z) exp(-k z)
upwards, and to less sideways. The overlay does not know this solution: it fades every motion alike.
"""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from benchmarks import Advance
from benchmarks.quality.depth import rounded
from benchmarks.quality.registration import SIZE, part, shown_to_node
from sags_node.clients.overlay.draw import Body
from sags_node.clients.overlay.frame import Anchor, TissueFrame
from sags_node.clients.overlay.held import HeldObject
from sags_node.clients.overlay.mesh import Mesh
from sags_node.clients.overlay.pinner import Pinner
from sags_node.clients.overlay.registering import holding
from sags_node.clients.overlay.scene import ObjectSpec
from sags_node.config.schema import LaunchConfig
from sags_node.mapping.budget import StepBudget
from sags_node.phantom.relief import SPACING
from sags_node.phantom.rig import phantom_rig
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.phantom.tissue import LIFT
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.warm_up import prepare
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F64, I32, FrameResult

RATE, SECONDS, STEPS = 15, 4.0, 2  # Hz; s, one pull; steps of the mapper, each frame
PINNED, LAST = 4, 39  # frames: before the pull, and when it lets go
PULLED, MOVED = 0.010, 0.005  # m: pull of the grip; motion of surface that is counted apart
BELOW = (0.0, 0.005, 0.010, 0.020)  # m
STATED = 0.45  # mm: 90th percentile of the residual that `register` finds on the phantom
CHECKED = "residual_mm", "residual_limit_mm", "unsure"
MODES: dict[str, dict[str, Any]] = {"rigid": {}, "bent": {"deform": True}}


class Own(Pinner):
    """Pins in a pipeline of this process."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline

    def pin(self, requests: Any) -> Future[list[int]]:
        newest, done = self._pipeline.newest, Future[list[int]]()
        assert newest is not None
        frame = newest.observation, newest.snapshot, newest.views["left"]
        points = np.array([[request[axis] for axis in "xyz"] for request in requests])
        done.set_result([self._pipeline.anchors.add_point(point, *frame) for point in points])
        return done


TABLES = (
    "below_mm all_rigid.median_mm all_rigid.p90_mm all_bent.median_mm all_bent.p90_mm moved_rigid.median_mm"
    " moved_rigid.p90_mm moved_bent.median_mm moved_bent.p90_mm worse_mm",
)


def measure_deform(seeds: int, advance: Advance) -> dict[str, Any]:
    """Measure how the model follows, on each seed's phantom."""
    scene = PhantomScene(seconds=SECONDS, width=SIZE[0], height=SIZE[1])
    config = LaunchConfig(source=scene)
    prepare(config)
    receipt = Receipt(phantom_rig(*SIZE), SIZE, None)
    found, checked = [], []
    for seed in range(seeds):
        advance(seed, seeds, "pulling")
        phantom = Phantom(scene.model_copy(update={"seed": seed}))
        frames = list(_pulled(Pipeline(config, phantom.rig, rate=RATE), phantom, seed, receipt))
        found += [each[:2] for each in frames]
        checked.append({"seed": seed, **frames[-1][2]})
    errors, ways = (np.concatenate(each, axis=-1) for each in zip(*found, strict=True))
    said = {"pulled_mm": 1e3 * PULLED, "moved_mm": 1e3 * MOVED, "seeds": seeds, "stated_mm": STATED}
    rows = _rows(errors, ways > MOVED)
    return {**said, "rows": rows, "checked": checked, "receipts": {"phantom": receipt.as_json()}}


def _pulled(
    pipeline: Pipeline, phantom: Phantom, seed: int, receipt: Receipt
) -> Iterator[tuple[F64, F64, dict[str, Any]]]:
    """For each frame in which the grip is pulled by `PULLED` or more: errors [modes, layers, N] (m) of the
    vertices, how far those of the surface have moved [N] (m), and the results of the last check."""
    count = round(SECONDS * RATE)
    with ThreadPoolExecutor(1) as worker:
        for number in range(LAST):
            given = shown_to_node(phantom, number, count, RATE)
            result = pipeline.process(given, StepBudget(STEPS))
            receipt.add(given, result.observation.tissue)
            frame, now = seen(result), phantom.tissue.vertices(number / count).astype(np.float64)
            if number < PINNED:
                continue
            if number == PINNED:
                start, rng = now, np.random.default_rng(seed)
                used, triangles = part(rng, phantom, frame.camera, number / count)
                layers = start.reshape(-1, 3)[used] + np.array([[[0, 0, below]] for below in BELOW])
                objects = _objects(layers, triangles, Own(pipeline), worker)
            placed = [each.placed(frame) for each in objects]
            worker.submit(int).result()  # wait for all work, so that runs are repeatable
            if phantom.tissue.lift(number / count) * float(np.linalg.norm(LIFT)) >= PULLED:
                gone = _half_space(now - start)[:, used]
                worlds = [put.shape(put.T_world_body) for put in placed if put is not None]
                off = np.stack([world.reshape(gone.shape) - layers - gone for world in worlds])
                said = dict(zip(MODES, (each.status() for each in objects), strict=True))
                said = {name: {key: each[key] for key in CHECKED} for name, each in said.items()}
                yield np.linalg.norm(off, axis=-1), np.linalg.norm(gone[0], axis=-1), said


def _objects(layers: F64, triangles: I32, pinner: Pinner, worker: ThreadPoolExecutor) -> list[HeldObject]:
    """The model [layers, N, 3] (m), rigid and bent, in the coordinates of the world."""
    faces = np.concatenate([triangles + np.int32(i * layers.shape[1]) for i in range(len(layers))])
    mesh = Mesh(layers.reshape(-1, 3).astype(np.float32), faces, np.zeros((len(faces), 3), np.float32))
    anchors = [{"place": place, "at": place} for place in holding(layers[0]).tolist()]
    spec = {"file": "organ.ply", "anchors": anchors, "registration": {"residual_p90_mm": STATED}}
    specs = [ObjectSpec.model_validate(spec | more) for more in MODES.values()]
    return [HeldObject(each, "pin", pinner, False, 0.0, Body(mesh, 1.0, None), worker) for each in specs]


def _rows(errors: F64, moved: Any) -> list[dict[str, Any]]:
    """A row for each layer: all vertices, and those under surface that has moved by more than `MOVED`."""
    rows = []
    for layer, below in enumerate(BELOW):
        row: dict[str, Any] = {"below_mm": 1e3 * below}
        for which, kept in (("all", np.ones_like(moved)), ("moved", moved)):
            for name, each in zip(MODES, errors[:, layer][:, kept], strict=True):
                median, most = 1e3 * np.quantile(each, (0.5, 0.9))
                row[f"{which}_{name}"] = {"median_mm": rounded(median), "p90_mm": rounded(most)}
        row["worse_mm"] = rounded(1e3 * (errors[1, layer] - errors[0, layer]).max())
        rows.append(row)
    return rows


def seen(result: FrameResult) -> TissueFrame:
    """Return what the overlay would receive of a frame."""
    view, states, pair = result.views["left"], result.anchors, result.pair
    rows = zip(
        states.ids, states.points, states.visibility, states.confidence, states.depth_confidence, strict=True
    )
    anchors = {int(n): Anchor(place.astype(np.float64), *map(float, rest)) for n, place, *rest in rows}
    shown = view.camera, None, view.depth, result.observation.tissue
    return TissueFrame(pair.frame_id, pair.t_capture_ns, "", result.epoch, *shown, anchors, view.confidence)


def _half_space(ways: F64) -> F64:
    """The motion [layers, N, 3] (m) at the depths `BELOW`, given that of the surface [rows, cols, 3] (m)."""
    rows, cols = ways.shape[:2]
    padded = np.pad(ways, ((0, rows), (0, cols), (0, 0)), mode="symmetric")  # no jump where it wraps
    waves = np.fft.fft2(padded, axes=(0, 1))
    ky, kx = np.meshgrid(*(2 * np.pi * np.fft.fftfreq(2 * n, SPACING) for n in (rows, cols)), indexing="ij")
    k = np.hypot(kx, ky)
    along = k * waves[..., 2] - 1j * (kx * waves[..., 0] + ky * waves[..., 1])
    unit = np.stack([-1j * kx / np.where(k > 0, k, 1), -1j * ky / np.where(k > 0, k, 1), np.ones_like(k)], -1)
    found = [
        np.fft.ifft2(np.exp(-k * z)[..., None] * (waves + z * along[..., None] * unit), axes=(0, 1)).real
        for z in BELOW
    ]
    return np.stack(found)[:, :rows, :cols].reshape(len(BELOW), -1, 3)
