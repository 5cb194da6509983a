"""The spool, the measuring of a run with known answers, golden comparison and the report."""

import json
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from sags_node.engine.rasterize import rasterize
from sags_node.errors import SagsError, UsageError
from sags_node.evaluation.golden import Golden, Tolerance, compare, read_golden, write_golden
from sags_node.evaluation.measure import Measurer, Options
from sags_node.evaluation.plots import Series, line_plot
from sags_node.evaluation.report import write_report
from sags_node.evaluation.session import evaluate
from sags_node.evaluation.spool import Spool
from sags_node.evaluation.summary import STAGES, summarise
from sags_node.types import (
    Camera,
    Eye,
    FrameResult,
    Gaussians,
    Observation,
    RectifiedPair,
    Reference,
    RenderedView,
    Snapshot,
    StereoFrame,
    StereoRig,
)
from sags_node.vision.rectify import Rectifier

WIDTH, HEIGHT, FOCAL, BASELINE, DEPTH = 160, 128, 250.0, 0.004, 0.1  # disparity 10 px
K = np.array([[FOCAL, 0, 79.5], [0, FOCAL, 63.5], [0, 0, 1]])
CAMERA = Camera(WIDTH, HEIGHT, K, np.eye(4))
PERIOD_NS = 33_333_333
SPEED = np.array([0.015, 0.006, 0.0], np.float32)  # m/s: 1.25 and 0.5 px a frame
FRAMES = 20


def rig() -> StereoRig:
    P = np.column_stack([K, np.zeros(3)])
    P_right = P.copy()
    P_right[0, 3] = -FOCAL * BASELINE
    eyes = [Eye(WIDTH, HEIGHT, K, np.zeros(5), np.eye(3), each) for each in (P, P_right)]
    return StereoRig("synthetic", *eyes)


def tissue_at(seconds: float) -> Gaussians:
    """A textured sheet, larger than the view, that slides with SPEED."""
    spacing = 1.5 * DEPTH / FOCAL
    x, y = np.meshgrid(np.arange(-80, 80), np.arange(-65, 65))
    count = x.size
    means = np.stack([x.ravel() * spacing, y.ravel() * spacing, np.full(count, DEPTH)], 1).astype(np.float32)
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.random((130, 160, 3), np.float32), (0, 0), 1.5).reshape(-1, 3)
    return Gaussians(
        means=means + SPEED * np.float32(seconds),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), 0.6 * spacing, np.float32),
        opacities=np.full(count, 0.9, np.float32),
        colors=np.clip((texture - 0.5) * 4 + 0.5, 0, 1),
        ids=np.arange(count),
    )


def as_uint8(rgb: np.ndarray) -> np.ndarray:
    return np.round(np.clip(rgb, 0, 1) * 255).astype(np.uint8)


def stereo_frame(frame_id: int) -> StereoFrame:
    """What two cameras with different exposures see, with an instrument on the left and exact truth."""
    stamp = frame_id * PERIOD_NS
    tissue = np.ones((HEIGHT, WIDTH), bool)
    tissue[40:60, 100:] = False
    left = as_uint8(rasterize(tissue_at(stamp * 1e-9), CAMERA).rgb)
    left[~tissue] = (200, 255, 200)
    right = rasterize(tissue_at(stamp * 1e-9), CAMERA.moved_right(BASELINE)).rgb
    right = as_uint8(0.8 * right + 0.05)
    right[40:60, 88:] = (200, 255, 200)
    points = tissue_at(0).means[10_000:10_050].astype(np.float64) + SPEED * stamp * 1e-9
    reference = Reference(
        depth=np.full((HEIGHT, WIDTH), DEPTH, np.float32),
        points=points,
        points_visible=np.ones(50, bool),
    )
    return StereoFrame(
        frame_id, stamp, stamp, left, right, tissue=tissue, reference=reference
    )


def frame_result(frame: StereoFrame, velocity: np.ndarray, late: float = 0.0) -> FrameResult:
    """What a mapper says that knows the truth, or knows it `late` seconds late."""
    gaussians = tissue_at(frame.t_capture_ns * 1e-9 - late)
    velocities = np.tile(velocity.astype(np.float32), (len(gaussians), 1))
    ids = frame.frame_id, frame.t_capture_ns
    assert frame.tissue is not None
    image = frame.left.astype(np.float32) / 255
    measured = np.where(frame.tissue, np.float32(DEPTH + 0.002), np.float32(0))
    view = rasterize(gaussians, CAMERA)
    return FrameResult(
        pair=RectifiedPair(*ids, CAMERA, BASELINE, frame.left, frame.right),
        observation=Observation(
            *ids, CAMERA, image, frame.left[..., 0], frame.tissue, measured, np.ones_like(measured)
        ),
        snapshot=Snapshot(*ids, 3 * frame.frame_id, gaussians, velocities, CAMERA, 0.01, {"iterations": 2}),
        views={"left": RenderedView(*ids, CAMERA, view.rgb, view.depth, view.alpha)},
        epoch=0,
        timings_ms={"rectify": 1.0, "map": 20.0},
        skipped={"frame": "equals its predecessor"} if frame.frame_id == 3 else {},
    )


def spooled_run(
    spool: Spool, velocity: np.ndarray, options: Options, late: float = 0.0, leave_out: int = -1
) -> Iterator[StereoFrame]:
    """Fill the spool as a run would; the frames to measure it with."""
    frames = [stereo_frame(frame_id) for frame_id in range(FRAMES)]
    for frame in frames:
        if not options.holds_out(frame.frame_id) and frame.frame_id != leave_out:
            spool.add(frame_result(frame, velocity, late), 21.0, frame.t_capture_ns)
    return iter(frames)


def measured(velocity: np.ndarray, options: Options = Options(), late: float = 0.0, leave_out: int = -1):  # type: ignore[no-untyped-def]  # noqa: B008  # frozen
    rectifier = Rectifier(rig(), WIDTH, HEIGHT)
    with Spool() as spool:
        frames = spooled_run(spool, velocity, options, late, leave_out)
        measurer = Measurer(spool, rectifier, lambda frame, pair: frame.tissue, options)
        measurer.run(frames, lambda what, done: None)
    return measurer
