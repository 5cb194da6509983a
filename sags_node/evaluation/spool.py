"""What a run showed, kept on disk while it runs, so that measuring it later cannot slow it down.

One file per frame: a line of JSON, then arrays in `.npy` form. Nothing but the frame numbers stays in memory.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from sags_node.errors import SagsError
from sags_node.findings import NOTHING, Findings, by_code
from sags_node.messaging import published
from sags_node.processes import resident_mb
from sags_node.types import (
    F32,
    I32,
    U8,
    Bool,
    Camera,
    Forecast,
    FrameResult,
    Gaussians,
    MotionState,
    Snapshot,
)

_ARRAYS = 20  # in a frame's file
_NO_FORECAST = (np.empty(0, np.float32),) * 4
_SHOWN = 5 + len(_NO_FORECAST)  # of them the last: velocities, what was shown, and the forecast


@dataclass(frozen=True, slots=True)
class RunFacts:
    """What the run itself says of one processed frame."""

    t_shown_ns: int  # when its result was done or published; monotonic clock
    frame_ms: float | None  # wall time of all stages; None: the node alone knows
    latency_ms: float | None  # capture stamp to publish; None when nothing was published
    rss_mb: float
    timings_ms: dict[str, float]  # stage -> ms
    skipped: dict[str, str]
    gaussians: int
    counts: dict[str, int]  # inserted, removed, iterations, ...
    rung: int | None = None  # of the ladder of quality; None: fixed steps
    warnings: dict[str, str] = field(default_factory=dict)  # code -> what is wrong and how to fix it
    cpu_ms: float | None = None  # processor time of all threads for the frame; None: not measured


@dataclass(frozen=True, slots=True)
class SpooledFrame:
    """One processed frame as it was shown."""

    facts: RunFacts
    snapshot: Snapshot  # stamped on the clock of the run
    baseline: float  # m
    rgb: U8  # [H, W, 3] the model drawn for the left eye after this frame's update
    depth: F32  # [H, W] m, the same, 0 where the model says nothing
    tissue: Bool  # [H, W]
    measured_depth: F32  # [H, W] m, the stereo stage's own, 0 unknown
    confidence: F32  # [H, W] 0..1, of `depth`; NaN: unknown
    right_rgb: U8 | None  # [H, W, 3] the right view; None: the run showed none


class Spool:
    """A temporary folder of frames; gone when the `with` block ends, for whatever reason."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="sags-eval-")
        self.folder = Path(self._folder.name)
        self.frame_ids: list[int] = []

    def __enter__(self) -> Spool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._folder.cleanup()

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __iter__(self) -> Iterator[SpooledFrame]:
        return (self.read(place) for place in range(len(self)))

    def add(
        self,
        result: FrameResult,
        frame_ms: float,
        t_shown_ns: int,
        latency_ms: float | None = None,
        warnings: Findings = NOTHING,
        cpu_ms: float | None = None,
    ) -> None:
        """Keep one frame: about 6 MB and 2 to 3 ms at 640x512 with 30,000 Gaussians.

        Raises:
            SagsError: the disk is full.
        """
        snapshot, seen, view = result.snapshot, result.observation, result.views["left"]
        gaussians, forecast = snapshot.gaussians, snapshot.forecast
        facts = RunFacts(
            t_shown_ns,
            frame_ms,
            latency_ms,
            resident_mb(),
            dict(result.timings_ms),
            dict(result.skipped),
            len(gaussians),
            dict(snapshot.counts),
            None if result.rung is None else result.rung.number,
            by_code(warnings),
            cpu_ms,
        )
        header = {
            "facts": asdict(facts),
            "frame_id": snapshot.frame_id,
            "t_capture_ns": snapshot.t_capture_ns,
            "step": snapshot.step,
            "loss": float(snapshot.loss),
            "baseline": result.pair.baseline,
            "forecast": None if forecast is None else [forecast.frame_s, *asdict(forecast.state).values()],
        }
        arrays = (
            snapshot.camera.K,
            snapshot.camera.T_world_cam,
            np.packbits(seen.tissue),
            seen.depth,
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            gaussians.colors,
            gaussians.ids,
            np.zeros_like(gaussians.means) if gaussians.slopes is None else gaussians.slopes,
            snapshot.velocities,
            view.rgb,
            view.depth,
            np.full_like(view.depth, np.nan) if view.confidence is None else view.confidence,
            published.colours(result.pair, result.views["right"])
            if "right" in result.views
            else np.empty(0, np.uint8),
            *(_NO_FORECAST if forecast is None else _forecast_arrays(forecast)),
        )
        try:
            with self._file(len(self)).open("wb") as file:
                file.write(json.dumps(header).encode() + b"\n")
                for array in arrays:
                    np.save(file, array, allow_pickle=False)
        except OSError as error:
            raise SagsError(
                f"cannot keep frame {snapshot.frame_id} in {self.folder}: {error.strerror}; "
                "set TMPDIR to a folder with room (about 6 MB per frame) or play fewer frames"
            ) from None
        self.frame_ids.append(snapshot.frame_id)

    def read(self, place: int) -> SpooledFrame:
        """The frame that was added as number `place`."""
        with self._file(place).open("rb") as file:
            header: dict[str, Any] = json.loads(file.readline())
            arrays = [np.load(file, allow_pickle=False) for _ in range(_ARRAYS)]
        forecast = None
        if header["forecast"] is not None:
            frame_s, *state = header["forecast"]
            forecast = Forecast(MotionState(*state), frame_s, *arrays[-len(_NO_FORECAST) :])
        (
            K,
            T_world_cam,
            tissue,
            measured_depth,
            *splats,
            slopes,
            velocities,
            rgb,
            depth,
            confidence,
            right_rgb,
        ) = arrays[: -len(_NO_FORECAST)]
        facts = RunFacts(**header["facts"])
        height, width = measured_depth.shape
        snapshot = Snapshot(
            frame_id=header["frame_id"],
            t_capture_ns=header["t_capture_ns"],
            step=header["step"],
            gaussians=replace(Gaussians(*splats), slopes=slopes),
            velocities=velocities,
            camera=Camera(width, height, K, T_world_cam),
            loss=header["loss"],
            counts=facts.counts,
            forecast=forecast,
        )
        return SpooledFrame(
            facts=facts,
            snapshot=snapshot,
            baseline=header["baseline"],
            rgb=rgb,
            depth=depth,
            tissue=np.unpackbits(tissue, count=width * height).reshape(height, width).view(bool),
            measured_depth=measured_depth,
            confidence=confidence,
            right_rgb=right_rgb if right_rgb.size else None,
        )

    def _file(self, place: int) -> Path:
        return self.folder / f"{place:06d}.frame"


def _forecast_arrays(forecast: Forecast) -> tuple[F32, F32, I32, F32]:
    return forecast.nodes, forecast.moves, forecast.node_index, forecast.node_weight
