"""How accurately instruments are placed: in front of the phantom, where their tips are known."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from benchmarks import Advance
from benchmarks.quality.depth import frame_of, rounded, spread
from sags_node.confidence import SURE, error_of
from sags_node.config.schema import LaunchConfig
from sags_node.geometry import project, unproject
from sags_node.mapping.budget import StepBudget
from sags_node.phantom.casting import Bodies
from sags_node.phantom.instruments import NOTHING, OPENING, Instruments, Mesh, joined
from sags_node.phantom.rig import phantom_rig
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.pipeline.warm_up import prepare
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F32, F64, Bool, Camera, FrameResult, InstrumentStates
from sags_node.vision.stereo import StereoDepth

SIZE = (640, 512)
FIRST = 8  # first seed; the seeds before it were used to choose constants
BEFORE, RATE, STEPS = 3, 5.0, 2  # frames without instruments; a second; steps of the mapper, each frame
DISTANCES = (0.005, 0.010, 0.020, 0.040)  # m, along the axis
SIDES = {"one": ("left",), "two": ("left", "right"), "crossing": ("left", "right"), "leaving": ("right",)}
TROCARS = {"left": np.array([-0.105, 0.125, -0.010]), "right": np.array([0.125, 0.105, 0.0])}  # m
WHERE = {  # column of the tip, as a share of the image's width: from, to
    "one": (0.25, 0.70), "two left": (0.20, 0.45), "two right": (0.55, 0.80), "crossing left": (0.55, 0.75),
    "crossing right": (0.25, 0.45), "leaving": (-0.30, -0.05),
}  # fmt: skip
DEPTHS = (0.035, 0.085)  # m, of a tip
NEAR = 0.15  # tolerance, share of the distance
SPREAD = 0.015  # m, of a trocar along each axis
FREE = np.arange(0.0, 0.15, 0.0015)  # m from the tip: no tissue hides the instrument
JAW_END = 0.001  # m: length of the end of a jaw
AROUND = 8  # px around a far end whose median depth it gets
SAID = ("tip_mm", "distance_mm", "clearance_mm", "axis_deg")
BESIDE = ("far_end_on_tissue_mm", "far_end_by_stereo_mm")  # the baselines' tips
KINDS = ("grasper", "open grasper", "hook")


@dataclass(frozen=True, slots=True)
class Tool:
    mesh: Mesh
    kind: str
    tip: F64  # [3] m, world: on the axis, where its metal ends
    ends: F64  # [2, 3] m: of open jaws, else twice the tip; what lies between is the tip, too
    axis: F64  # [3]
    distance: float  # m
    clearance: float  # m


class Scene:
    """A phantom at rest, with instruments in front of it."""

    def __init__(self, seed: int) -> None:
        self.phantom = Phantom(
            PhantomScene(seconds=1.0, width=SIZE[0], height=SIZE[1], seed=seed, still_tissue=True)
        )
        self.camera = Camera(*SIZE, self.phantom.rig.left.P[:, :3].astype(np.float64), np.eye(4))
        self.bare = self.phantom.frame(0, 1, tools=NOTHING)
        self._rng, self._instruments = np.random.default_rng(seed), Instruments()
        self._vertices = self.phantom.tissue.vertices(0.0)
        self._bodies = Bodies(self.phantom.tissue, self._vertices, NOTHING)

    def tool(self, setting: str, side: str, distance: float) -> Tool:
        """Make a tool whose tip is `distance` m from the tissue along its axis; in view unless "leaving"."""
        low, high = WHERE.get(f"{setting} {side}") or WHERE[setting]
        while True:
            pixel = self._rng.uniform([low, 0.25], [high, 0.65]) * SIZE
            depth = np.array(self._rng.uniform(*DEPTHS))
            tip = np.asarray(unproject(self.camera, pixel, depth), np.float64)
            trocar = TROCARS[side] + self._rng.normal(0, SPREAD, 3)
            kind = str(self._rng.choice(KINDS))
            tool = self._made(kind, tip, trocar, (tip - trocar) / np.linalg.norm(tip - trocar))
            near = abs(tool.distance - distance) <= NEAR * distance
            inside = bool(np.all((pixel >= 0) & (pixel < SIZE)))
            if (near or not inside) and self._is_free(tool):
                return tool

    def moving(self, kind: str, trocar: F64, pixel: F64, t: float) -> Tool:
        """Make a tool with its tip at a pixel [2], 8 to 16 mm in front of the tissue there."""
        u, v = np.clip(pixel, 0, np.array(SIZE) - 1).astype(int)
        depth = float(self.bare.depth[v, u]) - 0.012 - 0.004 * np.sin(1.7 * t)
        tip = np.asarray(unproject(self.camera, pixel, np.array(depth)), np.float64)
        return self._made(kind, tip, trocar, (tip - trocar) / np.linalg.norm(tip - trocar))

    def _made(self, kind: str, tip: F64, trocar: F64, axis: F64) -> Tool:
        opening = OPENING if kind == "open grasper" else 0.0
        made = self._instruments
        mesh = made.hook(tip, trocar) if kind == "hook" else made.grasper(tip, trocar, opening)
        tip = tip + axis * float(((mesh.vertices - tip) @ axis).max())
        ray = np.concatenate([tip, axis]).astype(np.float32)[None]
        clearance = np.linalg.norm(self._vertices.reshape(-1, 3) - tip, axis=1).min()
        ends = _jaws(mesh, axis) if opening else np.stack([tip, tip])
        return Tool(mesh, kind, tip, ends, axis, float(self._bodies.cast(ray).distance[0]), float(clearance))

    def _is_free(self, tool: Tool) -> bool:
        pixels, depths = project(self.camera, tool.tip - FREE[:, None] * tool.axis)
        u, v = np.rint(np.nan_to_num(pixels, nan=-1)).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < SIZE[0]) & (v < SIZE[1])
        there = self.bare.depth[np.clip(v, 0, SIZE[1] - 1), np.clip(u, 0, SIZE[0] - 1)]
        return bool(np.all((depths < there) | ~inside | (depths <= 0)))


def _jaws(mesh: Mesh, axis: F64) -> F64:
    """The ends [2, 3] of both jaws."""
    along = mesh.vertices @ axis
    end = mesh.vertices[along > along.max() - JAW_END]
    aside = end - (end @ axis)[:, None] * axis
    apart = (aside - aside.mean(0)) @ np.linalg.svd(aside - aside.mean(0), full_matrices=False)[2][0]
    return np.asarray(end[[apart.argmin(), apart.argmax()]], np.float64)


def off(tool: Tool, place: F64) -> float:
    """Return the distance from a place [3] to the tip, mm."""
    way = tool.ends[1] - tool.ends[0]
    share = np.clip((place - tool.ends[0]) @ way / max(way @ way, 1e-12), 0, 1)
    return 1e3 * float(np.linalg.norm(tool.ends[0] + share * way - place))


TABLES = (
    "tip_mm.median tip_mm.p90 axis_deg.median axis_deg.p90 within_told sure placed",
    "sure_tip_mm.median sure_tip_mm.p90 distance_mm.median distance_mm.p90 clearance_mm.median"
    " far_end_on_tissue_mm.median far_end_by_stereo_mm.median instruments",
)


def measure_instruments(seeds: int, advance: Advance) -> dict[str, Any]:
    """Measure every setting and distance, `seeds` times."""
    config = LaunchConfig(source=PhantomScene(width=SIZE[0], height=SIZE[1]))
    prepare(config)
    rows: list[dict[str, Any]] = []
    receipt = Receipt(phantom_rig(*SIZE), SIZE, None)
    for seed in range(FIRST, FIRST + seeds):
        advance(seed - FIRST, seeds, "phantom")
        scene = Scene(seed)
        pipeline = Pipeline(config, scene.phantom.rig, rate=RATE)
        cases: list[tuple[str, float]] = [("", 0.0)] * BEFORE
        cases += [(setting, distance) for setting in SIDES for distance in DISTANCES]
        for number, (setting, distance) in enumerate(cases):
            tools = [scene.tool(setting, side, distance) for side in SIDES.get(setting, ())]
            seen = scene.phantom.frame(number, len(cases), tools=joined([NOTHING, *(t.mesh for t in tools)]))
            frame = frame_of(number, RATE, seen)
            result = pipeline.process(frame, StepBudget(STEPS), FrameRequest(instruments=True))
            receipt.add(frame, result.observation.tissue)
            shown = ~pipeline.rectifier.mask(~seen.tool)
            rows += [{"seed": seed, "setting": setting, **row} for row in _compared(tools, result, shown)]
    summaries = {setting: _summary([row for row in rows if row["setting"] == setting]) for setting in SIDES}
    apart = [row for row in rows if row["setting"] in ("one", "two")]
    return {
        "settings": summaries,
        "kinds": {kind: _summary([row for row in apart if row["kind"] == kind]) for kind in KINDS},
        "distances_mm": {
            f"{1e3 * near:g} to {1e3 * far:g}": _summary([r for r in apart if near <= r["distance"] < far])
            for near, far in ((0.0, 0.0075), (0.0075, 0.015), (0.015, 0.03), (0.03, 0.05))
        },
        "rows": rows,
        "receipts": {"phantom": receipt.as_json()},
    }


def _compared(tools: list[Tool], result: FrameResult, shown: Bool) -> list[dict[str, Any]]:
    """A row for each instrument: the truth, and the errors of the node and of the mask's far end."""
    states = result.instruments
    assert states is not None  # they are asked for
    known = np.nonzero(np.isfinite(states.tips[:, 0]))[0]
    truth = np.array([project(result.observation.camera, tool.tip)[0] for tool in tools]).reshape(-1, 2)
    apart = np.linalg.norm(truth[:, None] - states.pixels[known][None], axis=2)
    found: dict[int, int] = {}
    for at in np.argsort(apart, axis=None):
        number, told = (int(i) for i in np.unravel_index(at, apart.shape))
        if number not in found and told not in found.values():
            found[number] = told
    ends = _far_ends(shown, result)
    rows = []
    for number, tool in enumerate(tools):
        row: dict[str, Any] = {"kind": tool.kind, "distance": tool.distance, "clearance": tool.clearance}
        if number in found:
            at = known[found[number]]
            said = {"distance": states.distance[at], "clearance": states.clearance[at]}
            row |= {f"{name}_mm": 1e3 * abs(float(value) - row[name]) for name, value in said.items()}
            row |= placed(tool, states, at)
            row["distance_told_mm"] = 1e3 * float(error_of(states.distance_confidence[at]))
        for name, places in ends.items():
            if len(places):
                row[f"{name}_mm"] = min(off(tool, place) for place in places)
        rows.append({k: v for k, v in row.items() if isinstance(v, str | bool) or np.isfinite(v)})
    return rows


def placed(tool: Tool, states: InstrumentStates, at: int) -> dict[str, Any]:
    """Return a tip's error and its stated error (mm), whether it is sure, and its axis' error."""
    row = {
        "tip_mm": off(tool, states.tips[at].astype(np.float64)),
        "told_mm": 1e3 * float(error_of(states.confidence[at])),
        "sure": bool(states.confidence[at] >= SURE),
    }
    if np.isfinite(states.axes[at, 0]):
        row["axis_deg"] = float(np.degrees(np.arccos(np.clip(states.axes[at] @ tool.axis, -1, 1))))
    return row


def _far_ends(shown: Bool, result: FrameResult) -> dict[str, F64]:
    """The far end [K, 3] (m) of each region of the mask, once at the tissue's depth there and once at the
    depth that the node's stereo finds on the instruments."""
    pair, view = result.pair, result.views["left"]
    camera = result.observation.camera
    matched, _ = StereoDepth(LaunchConfig().vision.stereo, camera, pair.baseline)(pair, np.ones_like(shown))
    edge = np.ones_like(shown)
    edge[1:-1, 1:-1] = False
    count, labels = cv2.connectedComponents(shown.view(np.uint8))
    found: dict[str, list[F64]] = {"far_end_on_tissue": [], "far_end_by_stereo": []}
    for label in range(1, count):
        rows, columns = np.nonzero(labels == label)
        entry = np.argwhere((labels == label) & edge)
        if len(entry) == 0:
            continue
        middle = entry.mean(0)
        far = int(np.hypot(rows - middle[0], columns - middle[1]).argmax())
        pixel = np.array([columns[far], rows[far]], np.float64)
        for name, depth in (("far_end_on_tissue", view.depth), ("far_end_by_stereo", matched)):
            z = _around(np.where(shown, depth, 0) if depth is matched else depth, pixel)
            if z > 0:
                found[name].append(np.asarray(unproject(camera, pixel, np.array(z)), np.float64))
    return {name: np.array(places).reshape(-1, 3) for name, places in found.items()}


def _around(depth: F32, pixel: F64) -> float:
    x, y = pixel.astype(int)
    near = depth[max(0, y - AROUND) : y + AROUND + 1, max(0, x - AROUND) : x + AROUND + 1]
    return float(np.median(near[near > 0])) if (near > 0).any() else 0.0


def tally(what: str, rows: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the rows with a placed tip, and counts: all rows (`what`), placed, sure, within stated error."""
    there = [row for row in rows if "tip_mm" in row]
    said: dict[str, Any] = {what: len(rows), "placed": len(there), "sure": sum(row["sure"] for row in there)}
    if there:
        said["within_told"] = rounded(np.mean([row["tip_mm"] <= row["told_mm"] for row in there]))
    return there, said


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts, and the median and 90th percentile of each figure that is there."""
    there, said = tally("instruments", rows)
    met = [row for row in there if "distance_mm" in row]
    if met:
        within = [row["distance_mm"] <= row["distance_told_mm"] for row in met]
        said["distance_within_told"] = rounded(np.mean(within))
    parts = [("", (*SAID, *BESIDE), rows), ("sure_", SAID, [row for row in there if row["sure"]])]
    for prefix, columns, among in parts:
        for name in columns:
            values = [row[name] for row in among if name in row]
            if values:
                said[f"{prefix}{name}"] = {"count": len(values), **spread(values)}
    return said
