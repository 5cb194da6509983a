"""Whether anchors come back after a long time out of sight: on the phantom, whose points are known exactly.

Anchors are pinned, then the tissue is out of sight, then it is back. Meanwhile it breathes and is pulled, and
the scope moves. Its pose is given, as by a robot, unless the node is to estimate it (`vision.pose`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import cv2
import numpy as np

from benchmarks import Advance
from benchmarks.quality.tracking import RELIABILITY, RIGHT, RIGHT_MM, pin, reliability_rows
from sags_lab.protocols.point_tracks import SURE
from sags_node.config.schema import PhantomSource
from sags_node.errors import UsageError
from sags_node.geometry import project
from sags_node.mapping.budget import StepBudget
from sags_node.phantom.scene import Phantom, PhantomFrame
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session
from sags_node.pipeline.warm_up import prepare
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import F64, AnchorStates, Bool, Camera, FrameResult, StereoFrame

Scenario = Literal["covered", "dark", "turned away"]
SCENARIOS: tuple[Scenario, ...] = get_args(Scenario)

RATE = 10.0  # frames per second
BEFORE = 2.5  # s in sight; the anchors are pinned in its first third
AFTER = 2.5  # s in sight again
MOST = 60  # anchors
STEPS = 2  # of the mapper, each frame
BORDER = 30  # px: what is nearer to the image's edge is not pinned
COVERED = (0.25, 0.85)  # of the width: what a cloth hides
CLOTH = (190, 230)  # grey levels
DISPARITY = 0.05  # of the width; the cloth is nearer than the tissue
TURN = 45.0  # degrees, so far that nothing seen before is in the image
TURNING = 1.5  # s, there and back
MOVED = np.array([0.006, -0.004, 0.004])  # m, in the dark
ROLLED = 8.0  # degrees, in the dark
WRONG = 6.0 / 640  # of the width; a sure anchor that is farther off is wrong


@dataclass(frozen=True, slots=True)
class _Moment:
    """The truth of one frame."""

    frame: PhantomFrame
    T_world_cam: F64
    hidden: Bool | None  # [H, W] raw left image, True = cloth


TABLES = ("scenario anchors before.found before.wrong found wrong unmoved", RELIABILITY)


def measure_recall(session: Session, away: float, advance: Advance) -> dict[str, Any]:
    """Play each scenario once, `away` s out of sight, on the phantom of the session's size and seed.

    Returns:
        `rows`, by scenario: anchors, and shares of those whose points are in sight. `found`: sure and right,
        `wrong`: sure and farther off than `WRONG`, 2.4 s after they are back, and `before` they went;
        `unmoved`: right if they had not moved. `reliability_mm`, `reliability_px`: of all anchors in all
        frames that were not held; in px only of those whose points are in the image or hidden there.
    """
    source = session.config.source
    if not isinstance(source, PhantomSource):
        raise UsageError("benchmarks recall needs the phantom, whose points are known: launch/phantom.yaml")
    prepare(session.config)
    counts = [round(seconds * RATE) for seconds in (BEFORE, away, AFTER)]
    phantom = Phantom(source.model_copy(update={"seconds": sum(counts) / RATE}))
    said, film = _Said(), _Film(phantom, sum(counts))
    rows = [_played(session, film, scenario, counts, said, advance) for scenario in SCENARIOS]
    return {"session": session.name, "seed": source.seed, "away_s": away, "rows": rows, **said.reliability()}


@dataclass(frozen=True, slots=True)
class _Said:
    """How sure anchors were in all frames, and whether they were right."""

    confidence: list[F64] = field(default_factory=list)  # [A] of each frame
    near_px: list[Bool] = field(default_factory=list)
    near_mm: list[Bool] = field(default_factory=list)
    in_sight: list[Bool] = field(default_factory=list)
    inside: list[Bool] = field(default_factory=list)  # the point is in the image, seen or hidden

    def add(self, result: FrameResult, pinned: dict[int, int], truth: F64, points: F64) -> None:
        """Add a frame, given `truth` [P, 2] px and `points` [P, 3] m of all the phantom's points. A held
        frame is left out: the positions of its anchors are not known."""
        if result.held:
            return
        anchors, camera = result.anchors, result.pair.camera
        rows = [pinned[int(anchor)] for anchor in anchors.ids]
        pixels = truth[rows]
        self.confidence.append(anchors.confidence.astype(np.float64))
        self.near_px.append(np.linalg.norm(anchors.pixels - pixels, axis=1) < RIGHT * camera.width)
        self.near_mm.append(np.linalg.norm(anchors.points - points[rows], axis=1) < RIGHT_MM * 1e-3)
        self.in_sight.append(anchors.visibility == 1)
        self.inside.append(_inside(pixels, camera))

    def reliability(self) -> dict[str, Any]:
        confidence, in_sight = np.concatenate(self.confidence), np.concatenate(self.in_sight)
        near_px, inside = np.concatenate(self.near_px), np.concatenate(self.inside)
        return {
            "reliability_px": reliability_rows(confidence[inside], near_px[inside], in_sight[inside]),
            "reliability_mm": reliability_rows(confidence, np.concatenate(self.near_mm), in_sight),
        }


def _played(
    session: Session, film: _Film, scenario: Scenario, counts: list[int], said: _Said, advance: Advance
) -> dict[str, Any]:
    before = counts[0]
    pipeline, budget = Pipeline(session.config, film.phantom.rig), StepBudget(STEPS)
    receipt = Receipt(film.phantom.rig, session.working_size, None)
    pinned: dict[int, int] = {}
    width, _ = session.working_size
    for number, moment in enumerate(_moments(film, scenario, counts)):
        frame = _stereo(number, moment)
        result = pipeline.process(frame, budget)
        receipt.add(frame, result.observation.tissue)
        truth, visible = _truth(result, moment)
        if number == before // 3:
            last = result.pair.camera.width - BORDER, result.pair.camera.height - BORDER
            middle = (truth > BORDER).all(1) & (truth < last).all(1)
            pinned = pin(pipeline, result, truth, np.flatnonzero(visible & middle)[:MOST])
        if number == before - 1:
            at_last = _scored(result.anchors, pinned, truth, visible, width)
            standing = result.anchors
        said.add(result, pinned, truth, moment.frame.points)
        advance(number + 1, sum(counts), scenario)
    there = int(visible[list(pinned.values())].sum())
    unmoved = _scored(standing, pinned, truth, visible, width)
    return {
        "scenario": scenario,
        "anchors": there,
        **_scored(result.anchors, pinned, truth, visible, width),
        "before": at_last,
        "unmoved": unmoved["found"],
        "restarts": pipeline.map.restarts,
        "receipt": receipt.as_json(),
    }


def _scored(
    anchors: AnchorStates, pinned: dict[int, int], truth: F64, visible: Bool, width: int
) -> dict[str, float]:
    """Shares of the anchors whose points are in sight: sure and right, and sure and wrong."""
    points = np.array([pinned[int(anchor)] for anchor in anchors.ids])
    there = visible[points]
    errors = np.linalg.norm(anchors.pixels - truth[points], axis=1)[there] / width
    sure = anchors.confidence[there] >= SURE
    return {
        "found": float(np.mean(sure & (errors < RIGHT))),
        "wrong": float(np.mean(sure & ~(errors < WRONG))),
    }


@dataclass(frozen=True, slots=True)
class _Film:
    """The phantom's frames; those with the scope at rest are rendered once for all scenarios."""

    phantom: Phantom
    count: int
    still: dict[int, PhantomFrame] = field(default_factory=dict)

    def frame(self, number: int, T_world_cam: F64) -> PhantomFrame:
        if not np.array_equal(T_world_cam, np.eye(4)):
            return self.phantom.frame(number, self.count, T_world_cam)
        if number not in self.still:
            self.still[number] = self.phantom.frame(number, self.count, T_world_cam)
        return self.still[number]


def _moments(film: _Film, scenario: Scenario, counts: list[int]) -> Iterator[_Moment]:
    before, away, _ = counts
    for number in range(sum(counts)):
        gone = before <= number < before + away
        T_world_cam = _place(scenario, number - before, away)
        dark = gone and scenario == "dark"  # then it does not matter where the scope is
        frame = film.frame(number, np.eye(4) if dark else T_world_cam)
        hidden = None
        if gone and scenario == "covered":
            hidden, width = np.zeros_like(frame.tool), frame.tool.shape[1]
            hidden[:, round(COVERED[0] * width) : round(COVERED[1] * width)] = True
        elif dark:
            frame = _dark(frame, number)
        yield _Moment(frame, T_world_cam, hidden)


def _place(scenario: Scenario, since: int, away: int) -> F64:
    """Pose of the scope `since` frames after the tissue went out of sight."""
    T_world_cam = np.eye(4)
    if scenario == "turned away":
        share = np.clip(min(since, away - since) / (TURNING * RATE), 0, 1)
        T_world_cam[:3, :3] = cv2.Rodrigues(np.radians([0, TURN * share, 0]))[0]
    elif scenario == "dark" and since >= away // 2:
        T_world_cam[:3, :3] = cv2.Rodrigues(np.radians([0, 0, ROLLED]))[0]
        T_world_cam[:3, 3] = MOVED
    return T_world_cam


def _dark(frame: PhantomFrame, seed: int) -> PhantomFrame:
    noise = np.random.default_rng(seed).integers(0, 4, frame.left.shape).astype(np.uint8)
    return replace(frame, left=noise, right=noise, visible=np.zeros_like(frame.visible))


def _stereo(number: int, moment: _Moment) -> StereoFrame:
    frame, hidden = moment.frame, moment.hidden
    left, right, tissue = frame.left, frame.right, ~frame.tool
    if hidden is not None:
        cloth = np.random.default_rng(0).integers(*CLOTH, hidden.shape).astype(np.uint8)[..., None]
        nearer = np.roll(hidden, -round(DISPARITY * hidden.shape[1]), axis=1)
        left, right = np.where(hidden[..., None], cloth, left), np.where(nearer[..., None], cloth, right)
        tissue = tissue & ~hidden
    stamp = round((1 + number / RATE) * 1e9)
    return StereoFrame(number, stamp, stamp, left, right, T_world_cam=moment.T_world_cam, tissue=tissue)


def _truth(result: FrameResult, moment: _Moment) -> tuple[F64, Bool]:
    """Pixels [P, 2] of the phantom's points, and which are in the image and not hidden [P]."""
    camera = replace(result.pair.camera, T_world_cam=moment.T_world_cam)
    pixels: F64 = np.asarray(project(camera, moment.frame.points)[0], np.float64)
    return pixels, moment.frame.visible & _inside(pixels, camera)


def _inside(pixels: F64, camera: Camera) -> Bool:
    inside = (pixels > 0) & (pixels < [camera.width - 1, camera.height - 1])
    return np.asarray(inside.all(1))
