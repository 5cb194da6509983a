"""How well a registered model follows tissue that is pulled: on the phantom, rigid and bent with it.

Where the phantom's surface goes is known exactly. It has nothing below: there the truth is that of an
incompressible elastic half space with this surface, by definition. Its solution is that of Stokes' equations
below a plane whose motion is given, wave by wave: a wave of k rad/m has faded to (1 + k z) exp(-k z) in depth
z, upwards, and sooner sideways. Nothing of it is in the overlay, which fades every motion alike.
"""

from __future__ import annotations

from concurrent.futures import Executor, Future
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.quality.depth import Advance, rounded
from benchmarks.quality.registration import SIZE, part
from sags_node.config.schema import LaunchConfig
from sags_node.evaluation.receipt import Receipt
from sags_node.geometry import transform
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.budget import StepBudget
from sags_node.overlay.draw import Body, Placed
from sags_node.overlay.frame import Anchor, TissueFrame
from sags_node.overlay.held import HeldObject
from sags_node.overlay.mesh import Mesh
from sags_node.overlay.pinner import Pinner
from sags_node.overlay.registering import holding
from sags_node.overlay.residual import look
from sags_node.overlay.scene import ObjectSpec
from sags_node.phantom.relief import SPACING
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.phantom.tissue import LIFT
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.warm_up import warm_up
from sags_node.types import F32, F64, Bool, FrameResult, StereoFrame

SEEDS = 5
RATE, SECONDS, STEPS = 15, 4.0, 2  # Hz; s, one pull; steps of the mapper, each frame
PINNED, SETTLED, LAST = 4, 8, 38  # frames: before the pull, before it too, and when it lets go
MODES = ("rigid", "bent")
PULLED = 0.010  # m, of the grip
MOVED = 0.005  # m, of the surface: what lies under it is counted apart
BELOW = (0.0, 0.005, 0.010, 0.020)  # m
DEPTHS_MM = (15.0, 30.0)  # `deform_depth_mm`


class AtOnce(Executor):
    """Does what it is given before it goes on, so that runs repeat."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class Own(Pinner):
    """Pins in a pipeline of this process."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline

    def pin(self, requests: Any) -> Future[list[int]]:
        newest = self._pipeline.newest
        assert newest is not None
        frame = newest.observation, newest.snapshot, newest.views["left"]
        points = [np.array([request[axis] for axis in "xyz"]) for request in requests]
        return AtOnce().submit(lambda: [self._pipeline.anchors.add_point(each, *frame) for each in points])


def measure_deform(seeds: int, advance: Advance) -> dict[str, Any]:
    """All of it, of each seed's phantom."""
    config = LaunchConfig(source=PhantomScene(width=SIZE[0], height=SIZE[1]))
    warm_up(config)
    configure_threads(config.engine.threads)
    receipt: Receipt | None = None
    rows, held = [], []
    for depth_mm in DEPTHS_MM:
        pulls = []
        for seed in range(seeds):
            advance(len(held), seeds * len(DEPTHS_MM), "pulling")
            phantom = Phantom(PhantomScene(seconds=SECONDS, width=SIZE[0], height=SIZE[1], seed=seed))
            receipt = receipt or Receipt(phantom.rig, SIZE, None)
            pulls.append(_Pull(config, phantom, depth_mm, np.random.default_rng(seed), receipt))
            held.append({"deform_depth_mm": depth_mm, "seed": seed, **pulls[-1].held()})
        rows += _rows(depth_mm, pulls)
    assert receipt is not None
    said = {"pulled_mm": 1e3 * PULLED, "moved_mm": 1e3 * MOVED, "seeds": seeds, "rows": rows, "held": held}
    return {**said, "receipts": {"phantom": receipt.as_json()}}


class _Pull:
    """One phantom, and a part of its surface as a model, with the same 5, 10 and 20 mm deeper.

    Attributes:
        errors: of the rigid and of the bent model in each frame in which the grip is pulled: [layers, N] m.
        moved: [N] of each, which places of the surface have gone far.
    """

    def __init__(
        self,
        config: LaunchConfig,
        phantom: Phantom,
        depth_mm: float,
        rng: np.random.Generator,
        receipt: Receipt,
    ) -> None:
        self.errors: dict[str, list[F64]] = {name: [] for name in MODES}
        self.moved: list[Bool] = []
        self._off_mm: dict[str, list[dict[str, float]]] = {"rest": [], "pulled": []}
        self._pipeline, count = Pipeline(config, phantom.rig, rate=RATE), round(SECONDS * RATE)
        for number in range(LAST):
            phase, stamp = number / count, round((1 + number / RATE) * 1e9)
            true = phantom.frame(number, count)
            given = StereoFrame(
                number, stamp, stamp, true.left, true.right, tissue=~true.tool, T_world_cam=true.T_world_cam
            )
            result = self._pipeline.process(given, StepBudget(STEPS))
            receipt.add(given, result.observation.tissue)
            frame = _frame(result)
            if number == PINNED:
                self._begin(phantom, phase, frame, depth_mm, rng)
            lift = phantom.tissue.lift(phase) * float(np.linalg.norm(LIFT))
            placed = (
                {name: each.placed(frame) for name, each in self._objects.items()} if number >= PINNED else {}
            )
            if number > SETTLED and (lift == 0 or lift >= PULLED):
                self._measure(phantom.tissue.vertices(phase), placed, frame, "pulled" if lift else "rest")

    def _begin(
        self, phantom: Phantom, phase: float, frame: TissueFrame, depth_mm: float, rng: np.random.Generator
    ) -> None:
        self._start = phantom.tissue.vertices(phase).astype(np.float64)
        self._used, triangles = part(rng, phantom, frame.camera, phase)
        surface = self._start.reshape(-1, 3)[self._used]
        self._layers = np.concatenate([surface + (0, 0, below) for below in BELOW])
        faces = np.concatenate([triangles + i * len(surface) for i in range(len(BELOW))]).astype(np.int32)
        colors = np.zeros((len(faces), 3), np.float32)
        body = Body(Mesh(self._layers.astype(np.float32), faces, colors), 1.0, None)
        self.stated_mm = _off_mm(Placed(body, np.eye(4)), frame)
        spec = {
            "file": "organ.ply",
            "anchors": [{"place": place, "at": place} for place in holding(surface).tolist()],
            "registration": {"residual_p90_mm": self.stated_mm},
        }
        bent = spec | {"deform": True, "deform_depth_mm": depth_mm}
        self._objects = {
            name: HeldObject(
                ObjectSpec.model_validate(each), "pin", Own(self._pipeline), False, 0.0, body, AtOnce()
            )
            for name, each in zip(MODES, (spec, bent), strict=True)
        }

    def _measure(self, now: F32, placed: dict[str, Placed | None], frame: TissueFrame, when: str) -> None:
        ways = _half_space(now - self._start)[:, self._used]
        off = {}
        for name, put in placed.items():
            assert put is not None
            off[name] = _off_mm(put, frame)
            vertices = put.body.vertices if put.vertices is None else put.vertices
            error = (
                transform(put.T_world_body, vertices).reshape(ways.shape)
                - self._layers.reshape(ways.shape)
                - ways
            )
            if when == "pulled":
                self.errors[name].append(np.linalg.norm(error, axis=2))
        self._off_mm[when].append(off)
        if when == "pulled":
            self.moved.append(np.linalg.norm(ways[0], axis=1) > MOVED)

    def held(self) -> dict[str, Any]:
        """What the check says: of the surface to the model, nine of ten (mm), the largest of all frames."""
        said: dict[str, Any] = {"stated_mm": self.stated_mm}
        for when, found in self._off_mm.items():
            said[when] = {name: max(off[name] for off in found) for name in MODES}
        return {**said, "unsure": {name: each.unsure for name, each in self._objects.items()}}


def _rows(depth_mm: float, pulls: list[_Pull]) -> list[dict[str, Any]]:
    """Of each layer, all vertices and those under what has moved far."""
    moved = np.concatenate([each for pull in pulls for each in pull.moved])
    errors = {
        name: np.concatenate([each for pull in pulls for each in pull.errors[name]], axis=1) for name in MODES
    }
    rows = []
    for layer, below in enumerate(BELOW):
        row: dict[str, Any] = {"deform_depth_mm": depth_mm, "below_mm": 1e3 * below}
        for which, kept in (("all", np.ones_like(moved)), ("moved", moved)):
            row[which] = {
                name: {
                    "median_mm": rounded(1e3 * np.median(each[layer, kept])),
                    "p90_mm": rounded(1e3 * np.quantile(each[layer, kept], 0.9)),
                }
                for name, each in errors.items()
            }
        row["worse_mm"] = rounded(1e3 * np.max(errors["bent"][layer] - errors["rigid"][layer]))
        rows.append(row)
    return rows


def _off_mm(placed: Placed, frame: TissueFrame) -> float:
    found = look(placed, frame)
    assert found is not None  # the model fills half of the picture
    return rounded(1e3 * found.off)


def _frame(result: FrameResult) -> TissueFrame:
    view, states = result.views["left"], result.anchors
    columns = (
        states.points.astype(np.float64),
        states.visibility,
        states.confidence,
        states.depth_confidence,
    )
    anchors = {
        int(number): Anchor(place, *map(float, rest))
        for number, place, *rest in zip(states.ids, *columns, strict=True)
    }
    pair = result.pair
    return TissueFrame(
        pair.frame_id, pair.t_capture_ns, "", result.epoch, view.camera, None, view.depth,
        result.observation.tissue, anchors, view.confidence,
    )  # fmt: skip


def _half_space(ways: F64) -> F64:
    """How far [layers, N, 3] all goes at each depth below a surface that goes [rows, cols, 3] (m)."""
    rows, cols = ways.shape[:2]
    padded = np.pad(ways, ((0, rows), (0, cols), (0, 0)), mode="symmetric")  # what wraps round is even
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


def tables(measured: dict[str, Any]) -> list[Table]:
    """For people."""
    errors = Table(
        "bent to, mm", "below, mm", "of", *MODES, "worse by at most", title="median, nine of ten, mm"
    )
    for row in measured["rows"]:
        for which in ("all", "moved"):
            said = [f"{row[which][name]['median_mm']}, {row[which][name]['p90_mm']}" for name in MODES]
            errors.add_row(
                str(row["deform_depth_mm"]), str(row["below_mm"]), which, *said, str(row["worse_mm"])
            )
    return [errors]
