"""One stereo frame in, one result out: the straight line. No threads, sockets or clock decisions here."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from sags_node.config import LaunchConfig
from sags_node.engine.rasterize import make_rasterizer, to_view
from sags_node.mapping.anchors import Anchors
from sags_node.mapping.budget import Budget, capacity
from sags_node.mapping.mapper import Mapper
from sags_node.types import (
    F32,
    NO_TIME,
    AnchorStates,
    Bool,
    Camera,
    FrameResult,
    RectifiedPair,
    RenderedView,
    Snapshot,
    StereoFrame,
    StereoRig,
)
from sags_node.vision.change import StillScene
from sags_node.vision.observe import observe
from sags_node.vision.rectify import Rectifier
from sags_node.vision.stereo import StereoDepth
from sags_node.vision.tissue import TissueMask

FINE_FLOW_MS = 60.0  # a budget that has room for it
FARTHEST = 10.0  # m: what a session says to be beyond is no depth
DUPLICATE_RMS = 0.6  # grey levels: below a video codec's own noise (PSNR > 52 dB)


class Pipeline:
    """rectify -> tissue mask -> depth -> map -> render."""

    def __init__(self, config: LaunchConfig, rig: StereoRig) -> None:
        vision = config.vision
        width, height = vision.working_size(rig.left.width, rig.left.height)
        self.rectifier = Rectifier(rig, width, height)
        self.tissue = TissueMask(vision.tissue, self.rectifier)
        self.stereo = StereoDepth(vision.stereo, self.rectifier.camera, self.rectifier.baseline)
        self._rasterizer = make_rasterizer(config.engine.backend, width, height)
        self._config = config
        self.mapper = Mapper(
            self._rasterizer,
            capacity(config.mapping, width, height),
            config.mapping.smoothing,
            fine_flow=config.mapping.budget_ms >= FINE_FLOW_MS,
        )
        self.anchors = Anchors()
        self._still = StillScene()
        self._mapped: FrameResult | None = None  # the last frame that was really mapped

    def reset(self) -> None:
        """Forget the model; the next frame makes a new one, in a new epoch."""
        self.mapper.restart()
        self._still.forget()
        self._mapped = None

    @property
    def newest(self) -> FrameResult | None:
        """The frame mapped last; None before the first, and after a reset."""
        return self._mapped

    def reconfigure(self, config: LaunchConfig) -> None:
        """Take changed parameters over; the model stays."""
        self._config = config

    def process(self, frame: StereoFrame, budget: Budget, waited: float = 0.0) -> FrameResult:
        """Everything that happens to one frame, `waited` seconds after it came."""
        budget.start(waited)
        watch = Stopwatch()
        with watch("rectify"):
            pair = self.rectifier(frame)
        if self._mapped is not None and self._config.mapping.skip_duplicates:
            if _rms_difference(pair, self._mapped.pair) < DUPLICATE_RMS:
                anchors = self.anchors.at(pair.t_capture_ns)
                return _repeat(self._mapped, pair, self._epoch(frame), watch.timings_ms, anchors)
        still = self._still(pair) if self._config.mapping.skip_still else 0  # frames
        skipped: dict[str, str] = {}
        with watch("mask"):
            tissue = self.tissue(frame, pair)
        with watch("depth"):
            known = self._mapped.observation if still and self._mapped is not None else None
            if known is not None and known.depth.any():
                depth, confidence = known.depth * tissue, known.depth_confidence * tissue
                skipped = dict.fromkeys(("depth", "motion"), "nothing moves")
            elif self._lacks_time_for_depth(frame, budget):
                depth, confidence = np.zeros((2, *tissue.shape), np.float32)
                skipped["depth"] = NO_TIME
            else:
                depth, confidence = self.depth(frame, pair, tissue)
            observation = observe(pair, tissue, depth, confidence, self._config.mapping.right_eye)
        with watch("map"):
            snapshot = self.mapper.update(observation, budget, still)
        with watch("render"):
            views = self._draw_eyes(snapshot, pair.baseline)
            self.mapper.drawn(observation, views["left"])
        with watch("anchors"):
            self.anchors.update(observation, snapshot, views["left"])
            anchors = self.anchors.at(pair.t_capture_ns)
        if not still:  # which tells nothing of what a moving frame costs
            budget.finish()
        epoch = self._epoch(frame)
        self._mapped = FrameResult(
            pair, observation, snapshot, views, epoch, watch.timings_ms, skipped, anchors
        )
        return self._mapped

    def _lacks_time_for_depth(self, frame: StereoFrame, budget: Budget) -> bool:
        needs_matching = frame.depth is None and self.mapper.model.count > 0  # a first model needs depth
        return needs_matching and self._config.mapping.skip_depth and not budget.affords_depth()

    def depth(self, frame: StereoFrame, pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        """Depth and confidence [H, W]: the session's own depth, fully trusted, or else stereo."""
        if frame.depth is None:
            return self.stereo(pair, tissue)
        given = self.rectifier.depth(frame.depth)
        known = tissue & (given > 0) & (given < FARTHEST)
        return np.where(known, given, np.float32(0)), known.astype(np.float32)

    def _epoch(self, frame: StereoFrame) -> int:
        """Grows with the source's epochs and with every new model: ids then mean other Gaussians."""
        return frame.epoch + self.mapper.restarts

    def _draw_eyes(self, snapshot: Snapshot, baseline: float) -> dict[str, RenderedView]:
        """The left eye is drawn last: the mapper looks at what the rasteriser drew last."""
        stale, before = self.mapper.stale_tiles, self._mapped
        if before is not None and stale is not None and not stale.any():
            return _restamped(before.views, snapshot.frame_id, snapshot.t_capture_ns)
        if not self._config.publish.right:
            return {"left": self._draw(snapshot, snapshot.camera, stale)}
        right = self._draw(snapshot, snapshot.camera.moved_right(baseline))
        return {"left": self._draw(snapshot, snapshot.camera), "right": right}

    def _draw(self, snapshot: Snapshot, camera: Camera, tiles: Bool | None = None) -> RenderedView:
        planes = self._rasterizer.forward(snapshot.gaussians, [camera], tiles)
        return to_view(planes[0], camera, snapshot.frame_id, snapshot.t_capture_ns)


class Stopwatch:
    """Wall time of named stages, ms."""

    def __init__(self) -> None:
        self.timings_ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.timings_ms[stage] = (time.perf_counter() - started) * 1e3


def _rms_difference(a: RectifiedPair, b: RectifiedPair) -> float:
    """Grey levels, over every eighth pixel of both eyes: enough to tell a repeated frame from a moved one."""
    squares = [
        np.mean(np.square(x[::8, ::8].astype(np.float32) - y[::8, ::8]))
        for x, y in ((a.left, b.left), (a.right, b.right))
        if x is not None and y is not None
    ]
    return float(np.sqrt(max(squares)))


def _restamped(views: Mapping[str, RenderedView], frame_id: int, stamp: int) -> dict[str, RenderedView]:
    """Pictures of what has not changed since."""
    return {eye: replace(view, frame_id=frame_id, t_capture_ns=stamp) for eye, view in views.items()}


def _repeat(
    mapped: FrameResult, pair: RectifiedPair, epoch: int, timings: dict[str, float], anchors: AnchorStates
) -> FrameResult:
    """The last mapped result under the ids of a frame that equals it."""
    frame_id, stamp = pair.frame_id, pair.t_capture_ns
    still = np.zeros_like(mapped.snapshot.velocities)
    return replace(
        mapped,
        pair=pair,
        observation=replace(mapped.observation, frame_id=frame_id, t_capture_ns=stamp),
        snapshot=replace(
            mapped.snapshot,
            frame_id=frame_id,
            t_capture_ns=stamp,
            velocities=still,
            counts={"iterations": 0},
        ),
        views=_restamped(mapped.views, frame_id, stamp),
        epoch=epoch,
        timings_ms=timings,
        skipped={**mapped.skipped, "frame": "equals its predecessor"},
        anchors=anchors,
    )
