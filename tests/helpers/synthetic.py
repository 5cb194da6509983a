"""A frame whose every number is known: a tilted, coloured plane seen by a moved camera."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import repeating

from sags_node.config.schema import PublishConfig
from sags_node.geometry import quat_to_matrix, unproject
from sags_node.messaging.control import Handler
from sags_node.messaging.publisher import Publisher
from sags_node.types import (
    F32,
    Camera,
    Colours,
    FrameResult,
    Gaussians,
    InstrumentStates,
    NodeHealth,
    Observation,
    RectifiedPair,
    RenderedView,
    Snapshot,
)

WIDTH, HEIGHT, BASELINE = 96, 64, 0.0042
NORMAL, DISTANCE = np.array([-0.2, 0.1, 1.0]), 0.06  # the plane: NORMAL . p = DISTANCE, camera coordinates, m


def plane_instruments() -> InstrumentStates:
    """One whose tip is known, and one whose tip is beyond the image."""

    def column(*first: float) -> F32:
        return np.array([first, np.full(len(first), np.nan)], np.float32)

    def sure(first: float) -> F32:
        return np.array([first, 0], np.float32)

    return InstrumentStates(
        np.array([2, 5]), column(0.01, -0.02, 0.06), column(0, 0.6, 0.8), column(30, 20), sure(0.7),
        column(0.012)[:, 0], sure(0.5), column(0.009)[:, 0], sure(0.6), column(0.01, -0.02, 0.069),
        np.array([3, 1]),
    )  # fmt: skip


def plane_camera() -> Camera:
    K = np.array([[90.0, 0.0, 46.3], [0.0, 91.0, 30.8], [0.0, 0.0, 1.0]])
    T = np.eye(4)
    T[:3, :3] = quat_to_matrix(np.array([0.9, 0.1, -0.2, 0.3]))
    T[:3, 3] = [0.01, -0.02, 0.03]
    return Camera(WIDTH, HEIGHT, K, T)


def plane_depth(camera: Camera) -> np.ndarray:
    """Depth [H, W] (m) of the plane, exact."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.K).T
    return (DISTANCE / (rays @ NORMAL)).astype(np.float32)


def plane_result(
    frame_id: int = 5, stamp_ns: int | None = None, step: int = 70, epoch: int = 2
) -> FrameResult:
    """The plane with one Gaussian per fourth pixel, an instrument in columns 60..69 and no depth in row 0."""
    stamp = time.time_ns() if stamp_ns is None else stamp_ns
    camera = plane_camera()
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    picture = np.stack([2 * u, 3 * v, u + v], -1).astype(np.uint8)
    shown = Colours(picture)
    colors = picture.astype(np.float32) / 255
    depth = plane_depth(camera)
    known = depth.copy()
    known[0] = 0
    tissue = np.ones((HEIGHT, WIDTH), bool)
    tissue[:, 60:70] = False
    pixels = np.stack([u[2::4, 2::4], v[2::4, 2::4]], -1).reshape(-1, 2).astype(np.float64)
    rows, columns = pixels[:, 1].astype(int), pixels[:, 0].astype(int)
    count = len(pixels)
    gaussians = Gaussians(
        means=unproject(camera, pixels, depth[rows, columns].astype(np.float64)).astype(np.float32),
        quats=np.tile(np.array([0.5, -0.5, 0.5, 1.5], np.float32), (count, 1)),
        scales=np.tile(np.array([1e-3, 2e-3, 5e-4], np.float32), (count, 1)),
        opacities=np.linspace(0.2, 0.99, count, dtype=np.float32),
        colors=colors[rows, columns],
        ids=np.arange(count, dtype=np.int64) * 7 + 1000,
        depth_errors=np.linspace(0.0005, 0.009, count, dtype=np.float32),
    )
    alpha = np.full((HEIGHT, WIDTH), 0.75, np.float32)
    sure = np.where(known > 0, np.float32(0.8), np.float32(0))
    return FrameResult(
        pair=RectifiedPair(frame_id, stamp, camera, BASELINE, picture, picture[:, ::-1].copy()),
        observation=Observation(
            frame_id, stamp, camera, picture, picture[..., 1].copy(), tissue, known, np.ones_like(known)
        ),
        snapshot=Snapshot(
            frame_id, stamp, step, gaussians, np.zeros_like(gaussians.means), camera, 0.01, {"inserted": 3}
        ),
        views={
            "left": RenderedView(frame_id, stamp, camera, shown, known, alpha, sure),
            "right": RenderedView(frame_id, stamp, camera.moved_right(BASELINE), shown, known, alpha, sure),
        },
        epoch=epoch,
        timings_ms={"map": 12.0},
        skipped={"keyframe": "budget spent"},
        instruments=plane_instruments(),
    )


def at_frame(result: FrameResult, frame_id: int, stamp_ns: int, epoch: int | None = None) -> FrameResult:
    """The same content as another frame."""
    ids: dict[str, Any] = {"frame_id": frame_id, "t_capture_ns": stamp_ns}
    return replace(
        result,
        pair=replace(result.pair, **ids),
        observation=replace(result.observation, **ids),
        snapshot=replace(result.snapshot, **ids),
        epoch=result.epoch if epoch is None else epoch,
    )


def health(state: str = "running") -> NodeHealth:
    return NodeHealth(
        state=state,
        rate_hz=30.0,
        latency_ms={"p50": 40.0, "max": float("nan")},
        frame_ms={"p50": 20.0},
        stage_ms={"rectify": 2.0, "map": 20.0},
        dropped={"capture": 3},
        gaussians=384,
        rss_mb=900.0,
        skipped={"duplicate": 2},
    )


@contextmanager
def losing_nothing() -> Iterator[None]:
    """By contract a reader that is two frames behind loses messages. Publishers begun within keep all,
    however busy the machine is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sags_node.messaging.publisher.SEND_HIGH_WATER", 0)
        yield


@contextmanager
def publisher(
    run_dir: Path, handlers: Mapping[str, Handler] | None = None, thins: bool = False, **config: Any
) -> Iterator[Publisher]:
    """A publisher named `sags` on free loopback ports."""
    settings = {"data": ("tcp://127.0.0.1:*",), "control": "tcp://127.0.0.1:*", "run_dir": run_dir, **config}
    with Publisher(PublishConfig(**settings), "sags", "session-1", handlers, thins=thins) as running:
        yield running


def stream(
    running: Publisher,
    frame: Callable[[int], FrameResult] | None = None,
    rate: float = 30.0,
    said: Callable[[], NodeHealth] = health,
) -> AbstractContextManager[None]:
    """Publish `frame(i)` (default: the plane, now) and every third time health, from one thread."""
    plane = plane_result()
    make = frame or (lambda i: at_frame(plane, i, time.time_ns()))

    def publish(i: int) -> None:
        running.publish_result(make(i), dropped=i // 2)
        if i % 3 == 0:
            running.publish_health(said())
        running.poll(int(1000 / rate))

    return repeating(publish)
