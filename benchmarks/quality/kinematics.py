"""How accurately tips are placed by a robot's kinematics, with and without the image, on the phantom."""

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from benchmarks import Advance
from benchmarks.quality.depth import frame_of, spread
from benchmarks.quality.instruments import FIRST, KINDS, SIZE, STEPS, TROCARS, Scene, Tool, placed, tally
from sags_node.config.schema import LaunchConfig
from sags_node.geometry import rigid
from sags_node.instruments.instruments import Instruments
from sags_node.mapping.budget import StepBudget
from sags_node.phantom.instruments import NOTHING, joined
from sags_node.phantom.scene import PhantomScene
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.types import F64, InstrumentStates, ToolPose
from sags_node.vision.pyramid import pyramids

RATE, SECONDS, LEAVES = 5.0, 8.0, 6.0  # a second; s; s after which the tip leaves the image
SETTLED = 2.0  # s, after which corrected poses are counted apart
SHIFT, TURN = 0.005, np.radians(5.0)  # m; rad about MIDDLE: the error of the kinematics
MIDDLE = np.array([0.0, 0.0, 0.06])  # m, of where instruments work
FIGURES = ("tip_mm", "axis_deg")
ERROR = 0.010  # m, the default in robot.tools
CASES = {  # whether the image is used, and whether the robot's kinematics are: exact, or off
    "picture": (True, None), "exact": (False, "exact"), "off": (False, "off"),
    "exact_corrected": (True, "exact"), "off_corrected": (True, "off"),
}  # fmt: skip


@dataclass
class _Case:
    found: Instruments
    rows: list[dict[str, Any]] = field(default_factory=list)


def measure_kinematics(seeds: int, advance: Advance) -> dict[str, Any]:
    """Measure one moving tool in front of each of `seeds` phantoms."""
    config = LaunchConfig(source=PhantomScene(width=SIZE[0], height=SIZE[1]))
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in CASES}
    for seed in range(FIRST, FIRST + seeds):
        advance(seed - FIRST, seeds, "kinematics")
        scene, rng = Scene(seed), np.random.default_rng(1000 + seed)
        kind, trocar = KINDS[seed % len(KINDS)], TROCARS["left"] + rng.normal(0, 0.015, 3)
        E = _error(rng, MIDDLE - trocar)
        pipeline = Pipeline(config, scene.phantom.rig, rate=RATE)
        cases = {name: _Case(Instruments(pipeline.tissue.usable)) for name in CASES}
        count = round(SECONDS * RATE)
        for number in range(-3, count):
            tool = scene.moving(kind, trocar, _pixel(number / RATE), number / RATE) if number >= 0 else None
            tools = joined([NOTHING] if tool is None else [NOTHING, tool.mesh])
            seen = scene.phantom.frame(number + 3, count + 3, tools=tools)
            frame = frame_of(number + 3, RATE, seen)
            result = pipeline.process(frame, StepBudget(STEPS), FrameRequest(instruments=True))
            right, row_error = pyramids(result.pair)[1], pipeline.depth.stereo.rows.newest
            if tool is None:
                continue
            T = _pose(tool)
            for name, (by_picture, robot) in CASES.items():
                poses = {"exact": T, "off": E @ T}
                told = () if robot is None else (ToolPose("tool", ERROR, poses[robot]),)
                states = cases[name].found.update(
                    pipeline.tissue.instruments if by_picture else None, result.observation.gray,
                    None if right is None else right.full, result.observation.camera, result.pair.baseline,
                    result.views["left"], 0.0 if row_error is None else row_error.median, told,
                )  # fmt: skip
                assert states is not None
                row = {"seed": seed, "kind": kind, "t_s": number / RATE, **_compared(tool, states)}
                row["in_picture"] = number / RATE < LEAVES
                rows[name].append(row)
    return {
        "rows": rows,
        **{
            name: {part: _summary(c) for part, c in _parts(all_rows).items()}
            for name, all_rows in rows.items()
        },
    }


def _pixel(t: float) -> F64:
    """The tip's pixel [2]: it moves about in the image, and leaves it after `LEAVES` s."""
    u, v = 0.45 + 0.18 * np.sin(1.3 * t), 0.45 + 0.15 * np.sin(2.1 * t + 1)
    u -= 0.8 * max(0.0, t - LEAVES) ** 0.5 * (t > LEAVES)
    return np.array([u, v]) * SIZE


def _error(rng: np.random.Generator, tool: F64) -> F64:
    """The error [4, 4] of the kinematics; it turns about an axis across the tool [3], so all of it shows."""
    way, turn = rng.normal(size=(2, 3))
    turn = np.cross(tool, turn)
    way, turn = way / np.linalg.norm(way), turn / np.linalg.norm(turn)
    R = cv2.Rodrigues(TURN * turn)[0]
    return rigid(R, MIDDLE - R @ MIDDLE + SHIFT * way)


def _pose(tool: Tool) -> F64:
    """The pose [4, 4] by exact kinematics: its origin is the tip, and z points out of the tip."""
    x = np.cross(tool.axis, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return rigid(np.stack([x, np.cross(tool.axis, x), tool.axis], -1), tool.tip)


def _compared(tool: Tool, states: InstrumentStates) -> dict[str, Any]:
    """The errors of the reported tip that is nearest to the true one."""
    known = np.nonzero(np.isfinite(states.tips[:, 0]))[0]
    row: dict[str, Any] = {"rows": len(states)}
    if len(known):
        tips = states.tips[known].astype(np.float64)
        at = known[int(np.linalg.norm(tips - tool.tip, axis=1).argmin())]
        row |= placed(tool, states, int(at)) | {"source": int(states.sources[at])}
    return row


def _parts(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    within = [row for row in rows if row["in_picture"]]
    return {
        "first": [row for row in within if row["t_s"] < SETTLED],
        "settled": [row for row in within if row["t_s"] >= SETTLED],
        "outside": [row for row in rows if not row["in_picture"]],
    }


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    there, said = tally("frames", rows)
    for name in FIGURES:
        if values := [row[name] for row in there if name in row]:
            said[name] = spread(values)
    return said
