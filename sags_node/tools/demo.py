"""`sags demo`: a session played live beside an overlay subscriber, and the report of both."""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sags_node.clients.overlay.draw import over
from sags_node.clients.overlay.save import Layer, read_layers
from sags_node.config.schema import LaunchConfig
from sags_node.errors import SagsError
from sags_node.files import whole
from sags_node.media.video_file import VideoFile
from sags_node.messaging.rundir import connection_path, default_run_dir
from sags_node.node.node import Node
from sags_node.pipeline.session import Session
from sags_node.processes import end
from sags_node.terminal.console import stop_signals
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.report import write_report
from sags_node.tools.evaluation.run import Run
from sags_node.tools.evaluation.session import completed, measure
from sags_node.types import U8, FrameResult

VIDEO, LAYERS = "overlay.mp4", "overlay.layers"
OVERLAY_START = 60.0  # s for the overlay to load its shapes and listen
OVERLAY_LAST = 0.5  # s for the overlay of the last frames
OVERLAY_GRACE = 15.0  # s for the overlay to end after that
OVERLAY_STOP = 2.0  # s for it when the demo is interrupted
_OPTIONS = MeasureOptions(hold_out=0, second=True)


@dataclass(frozen=True, slots=True)
class Demo:
    """What a demo leaves behind."""

    summary: dict[str, Any]  # as `sags eval --out`, and what the overlay subscriber counted under "overlay"
    report: Path


def run_demo(session: Session, out: Path, progress: Callable[[int, int | None, str], None]) -> Demo:
    """Play a recorded session once through the node, sockets included, and measure what it showed.

    Args:
        session: a recording in real time, of a known length.
        out: folder for `report.html`, `sheet.png` and `overlay.mp4`.
        progress: called with (frames done, frames in all, what is going on).

    Raises:
        SagsError: the node or the overlay failed.
    """
    out.mkdir(parents=True, exist_ok=True)
    frames = session.source.frame_count
    with Run() as run:

        def keep(result: FrameResult, latency_ms: float) -> None:
            frame_ms, warnings = sum(result.timings_ms.values()), node.health().warnings
            run.add(result, frame_ms, time.monotonic_ns(), latency_ms, warnings)

        with stop_signals() as stop:
            node = Node(session.config, session.rig, session.source, on_result=keep)
            overlay = _start_overlay(session.config, run.folder / LAYERS)
            try:
                _await_overlay(session.config, overlay, stop)
                node.start()
                while not (stop.is_set() or node.wait(0.25)):
                    progress(len(run), frames, "playing")
                if stop.is_set():
                    raise KeyboardInterrupt
            except BaseException:
                end(overlay, grace=OVERLAY_STOP)  # time to close its files, and no more
                raise
            finally:
                node.stop()
        consumed = _finish_overlay(overlay)
        with whole(out / VIDEO) as partial:
            video = VideoFile(partial, session.source.rate, session.published_size)
            shown = Shown(video, read_layers(run.folder / LAYERS))
            outcome = measure(
                session, run, _OPTIONS, (), lambda what, done: progress(done, frames, what), shown.add
            )
            video.finish()
    outcome = completed(outcome, session, _OPTIONS, lambda what, done, count: progress(done, count, what))
    outcome.summary.update(overlay=consumed | {"saved": str(out / VIDEO)}, receipt=outcome.receipt)
    page = write_report(out, outcome.summary, outcome.rows, outcome.pictures, VIDEO)
    return Demo(outcome.summary, page)


class Shown:
    """What a display showed: the camera's image, and what the overlay drew over it. For a missed
    frame, what was there before."""

    def __init__(self, file: VideoFile, layers: Mapping[int, Layer]) -> None:
        self._file = file
        self._layers = layers
        self._shown: U8 | None = None

    def add(self, frame_id: int, left: U8) -> None:
        layer = self._layers.get(frame_id)
        if layer is not None:
            self._shown = left.copy()
            bottom, right = layer.top + layer.rgba.shape[0], layer.left + layer.rgba.shape[1]
            part = self._shown[layer.top : bottom, layer.left : right]
            part[:] = over(part, layer.rgba)
        self._file.add(left if self._shown is None else self._shown)


def _start_overlay(config: LaunchConfig, layers: Path) -> subprocess.Popen[str]:
    """Start the consumer in a process of its own, as in an operating theatre; it waits for the node."""
    command = [sys.executable, "-m", "sags_node", "overlay", "--ns", config.ns, "--repin"]
    command += ["--run-dir", str(config.publish.run_dir or default_run_dir())]
    command += ["--layers", str(layers), "--json"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _await_overlay(config: LaunchConfig, overlay: subprocess.Popen[str], stop: threading.Event) -> None:
    """Wait until the overlay listens: a short demo would be over before.

    Raises:
        SagsError: it does not come up in time.
    """
    ready = connection_path(config.publish.run_dir or default_run_dir(), "overlay")
    deadline = time.monotonic() + OVERLAY_START
    while not ready.exists() and overlay.poll() is None:
        if stop.wait(0.02):
            return
        if time.monotonic() > deadline:
            raise SagsError(
                f"the overlay subscriber did not come up in {OVERLAY_START:.0f} s: the machine is too busy"
            )


def _finish_overlay(overlay: subprocess.Popen[str]) -> dict[str, Any]:
    time.sleep(OVERLAY_LAST)
    overlay.terminate()
    try:
        stdout, stderr = overlay.communicate(timeout=OVERLAY_GRACE)
    except subprocess.TimeoutExpired:
        end(overlay, grace=0.0)
        raise SagsError("the overlay subscriber did not end; see `sags overlay --help`") from None
    if overlay.returncode != 0:
        raise SagsError(f"the overlay subscriber failed: {stderr.strip()}")
    counted: dict[str, Any] = json.loads(stdout)
    return counted
