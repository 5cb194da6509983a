"""The running node: three threads and two slots. The only file that knows threads.

    capture --frames--> mapping --results--> publishing

Slots hold the newest value only (live), or hand every value over (recordings not played in real time).
The sockets live on the publishing thread; what a client asks of the model runs on the mapping thread,
between two frames.
"""

from __future__ import annotations

import logging
import os
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from sags_node.config import LaunchConfig, V4l2Source, with_parameters
from sags_node.engine.threads import configure_threads
from sags_node.errors import SagsError
from sags_node.latest import Latest
from sags_node.mapping.budget import make_budget
from sags_node.messaging import content
from sags_node.messaging.publisher import Publisher
from sags_node.model.ply import write_ply
from sags_node.pipeline import Pipeline
from sags_node.recording.child import RecorderProcess
from sags_node.sources.source import Source
from sags_node.types import FrameResult, NodeHealth, StereoFrame, StereoRig

log = logging.getLogger(__name__)

HEALTH_PERIOD = 1.0  # s
WAITING_AFTER = 1.0  # s without a frame
STOP_SECONDS = 10.0  # longest wait for each thread to end
WINDOW = 150  # frames behind the published rates and latencies
LIVE_PARAMETERS = ("mapping.budget_ms", "mapping.skip_duplicates", "mapping.skip_still")

OnResult = Callable[[FrameResult, float], None]  # a published result and its latency, ms


class Node:
    """Runs a source through the pipeline and publishes the results, until the source ends or `stop`."""

    def __init__(
        self, config: LaunchConfig, rig: StereoRig, source: Source, on_result: OnResult | None = None
    ) -> None:
        """Bind the sockets and prepare the pipeline; nothing runs yet.

        Args:
            on_result: called on the publishing thread after each result has been sent.

        Raises:
            SagsError: an endpoint cannot be bound, or the configuration does not fit the rig.
        """
        self.config = config
        self._rig = rig
        self._source = source
        self._on_result = on_result
        self._pipeline = Pipeline(config, rig)
        self._budget = make_budget(config.mapping)
        self._live = isinstance(config.source, V4l2Source) or config.source.pace == "realtime"
        self._wake = os.eventfd(0, os.EFD_NONBLOCK)
        self._frames: Latest[tuple[StereoFrame, float]] = Latest()  # and when it came
        self._results: Latest[FrameResult] = Latest(on_put=lambda: os.eventfd_write(self._wake, 1))
        self._requests: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()
        self._error: BaseException | None = None
        self._stopping = threading.Event()
        self._parameters_changed = threading.Event()
        self._stats = _Statistics()
        self._last_sent: FrameResult | None = None
        self._publisher = Publisher(config.publish, config.ns, uuid.uuid4().hex, self._handlers())
        ipc = [endpoint for endpoint in self.endpoints if endpoint.startswith("ipc:")]
        self._recorder = RecorderProcess(config.ns, ipc[0] if ipc else None)
        work = {
            "capture": (self._capture, self._frames.close),
            "mapping": (self._map, self._results.close),
            "publishing": (self._publish, self._publisher.close),
        }
        # Events, not joins: in Python 3.11 a Ctrl-C during a join marks a living thread as ended.
        self._ended = {name: threading.Event() for name in work}
        self._threads = [
            threading.Thread(target=self._guard, args=(name, *parts), name=name, daemon=True)
            for name, parts in work.items()
        ]

    # ---- life ----------------------------------------------------------------------------------------

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the end of the source; True when the node has ended.

        Raises:
            the error that ended the node, if one did.
        """
        deadline = time.monotonic() + (threading.TIMEOUT_MAX if timeout is None else timeout)
        for ended in self._ended.values():
            if not ended.wait(max(0.0, deadline - time.monotonic())):
                return False
        if self._error is not None:
            raise self._error
        return True

    def stop(self) -> None:
        """End capture first, then mapping, then publishing, so that the last health message gets out."""
        self._stopping.set()
        self._source.stop()
        self._frames.close()
        for thread, ended in zip(self._threads, self._ended.values(), strict=True):
            if thread.ident is not None:  # it was started
                ended.wait(STOP_SECONDS)
        self._recorder.close()

    @property
    def endpoints(self) -> list[str]:
        """Where the data socket is bound."""
        return self._publisher.connection.data

    def health(self) -> NodeHealth:
        """What is true now; may be called from any thread."""
        return self._stats.health(
            dropped={
                "source": self._source.dropped,
                "capture": self._frames.dropped,
                "publish": self._results.dropped,
            },
            stopping=self._stopping.is_set(),
            error=self._error,
            connections=self._publisher.connections,
        )

    def _guard(self, name: str, work: Callable[[], None], after: Callable[[], None]) -> None:
        """Run one thread's work; its failure ends the node in order, and is raised by `wait`."""
        try:
            work()
        except BaseException as error:  # everything ends the node, nothing is lost silently
            if self._error is None:
                self._error = error
            if not isinstance(error, SagsError):
                log.exception("the %s thread failed", name)
            self._source.stop()
            self._frames.close()
        finally:
            try:
                after()
            finally:
                self._ended[name].set()

    # ---- the three threads ---------------------------------------------------------------------------

    def _capture(self) -> None:
        give = self._frames.put if self._live else self._frames.hand_over
        with self._source:
            for frame in self._source:
                if self._stopping.is_set():
                    return
                give((frame, time.monotonic()))

    def _map(self) -> None:
        configure_threads(self.config.engine.threads)
        give = self._results.put if self._live else self._results.hand_over
        while not self._frames.closed:
            came = self._frames.get(timeout=0.05)
            self._serve_requests()
            if came is not None:
                frame, at = came
                waited = time.monotonic() - at if self._live else 0.0
                give(self._pipeline.process(frame, self._budget, waited))
        self._serve_requests()

    def _publish(self) -> None:
        self._parameters_changed.set()
        next_health = time.monotonic()
        while not self._results.closed:
            if self._publisher.poll(timeout_ms=100, wake_fd=self._wake):
                os.eventfd_read(self._wake)
            if self._parameters_changed.is_set():
                self._parameters_changed.clear()
                self._publisher.publish_parameters(self.config.model_dump(mode="json"))
            result = self._results.get(timeout=0)
            if result is not None:
                self._send(result)
            if time.monotonic() >= next_health:
                next_health = time.monotonic() + HEALTH_PERIOD
                self._publisher.publish_health(self.health())
        self._publisher.publish_health(self.health())

    def _send(self, result: FrameResult) -> None:
        started = time.perf_counter()
        self._publisher.publish_result(result, dropped=self._frames.dropped + self._results.dropped)
        publish_ms = (time.perf_counter() - started) * 1e3
        latency_ms = (time.time_ns() - result.pair.t_capture_ns) * 1e-6
        result = replace(result, timings_ms={**result.timings_ms, "publish": publish_ms})
        self._stats.add(result, latency_ms)
        self._last_sent = result
        if self._on_result is not None:
            self._on_result(result, latency_ms)

    # ---- control -------------------------------------------------------------------------------------

    def _handlers(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        return {
            "get_status": lambda args: content.status(self.health(), self._last_sent),
            "get_parameters": lambda args: self.config.model_dump(mode="json"),
            "set_parameters": lambda args: self._on_mapping_thread(lambda: self._set_parameters(args)),
            "reset_model": lambda args: self._on_mapping_thread(self._reset_model),
            "start_recording": self._start_recording,
            "stop_recording": lambda args: self._recorder.stop(),
            "take_snapshot": lambda args: self._recorder.snapshot(),
            "save_model": lambda args: self._on_mapping_thread(lambda: self._save_model(args)),
        }

    def _on_mapping_thread(self, work: Callable[[], Any]) -> Future[Any]:
        future: Future[Any] = Future()
        self._requests.put((work, future))
        return future

    def _serve_requests(self) -> None:
        while True:
            try:
                work, future = self._requests.get_nowait()
            except Empty:
                return
            try:
                future.set_result(work())
            except Exception as error:  # a client's request must not end the node; it is the answer
                future.set_exception(error)

    def _set_parameters(self, args: dict[str, Any]) -> dict[str, Any]:
        refused = [key for key in args if key not in LIVE_PARAMETERS]
        if refused:
            raise SagsError(
                f"{', '.join(refused)} cannot be changed while running; "
                f"what can: {', '.join(LIVE_PARAMETERS)}"
            )
        self.config = with_parameters(self.config, args)
        self._pipeline.reconfigure(self.config)
        self._budget = make_budget(self.config.mapping)
        self._parameters_changed.set()
        return self.config.model_dump(mode="json")

    def _start_recording(self, args: dict[str, Any]) -> Future[Any]:
        return self._recorder.start(args)

    def _reset_model(self) -> dict[str, Any]:
        self._pipeline.reset()
        return {}

    def _save_model(self, args: dict[str, Any]) -> dict[str, Any]:
        path = args.get("path")
        if not isinstance(path, str) or not path.endswith(".ply"):
            raise SagsError("save_model needs a path that ends in .ply")
        gaussians = self._pipeline.mapper.model.frozen()
        if len(gaussians) == 0:
            raise SagsError("there is no model yet; wait for the first frame")
        file = Path(path).absolute()
        write_ply(file, gaussians)
        return {"path": str(file), "gaussians": len(gaussians)}


class _Statistics:
    """What the last frames tell of rate, latency and cost."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._published: deque[float] = deque(maxlen=WINDOW)
        self._latency: deque[float] = deque(maxlen=WINDOW)
        self._stages: dict[str, deque[float]] = {}
        self._skipped: dict[str, int] = {}
        self._gaussians = 0
        self._started = False

    def add(self, result: FrameResult, latency_ms: float) -> None:
        with self._lock:
            self._started = True
            self._published.append(time.monotonic())
            self._latency.append(latency_ms)
            for stage, ms in result.timings_ms.items():
                self._stages.setdefault(stage, deque(maxlen=WINDOW)).append(ms)
            for what in result.skipped:
                self._skipped[what] = self._skipped.get(what, 0) + 1
            self._gaussians = len(result.snapshot.gaussians)

    def health(
        self,
        dropped: dict[str, int],
        stopping: bool,
        error: BaseException | None,
        connections: dict[str, dict[str, int]],
    ) -> NodeHealth:
        with self._lock:
            now = time.monotonic()
            waiting = not self._published or now - self._published[-1] > WAITING_AFTER
            span = self._published[-1] - self._published[0] if len(self._published) > 1 else 0.0
            if stopping:
                state = "stopping"
            elif error is not None:
                state = "degraded"
            elif waiting:
                state = "waiting" if self._started else "starting"
            else:
                state = "running"
            latency = np.array(self._latency) if self._latency else np.zeros(1)
            return NodeHealth(
                state=state,
                rate_hz=(len(self._published) - 1) / span if span > 0 and not waiting else 0.0,
                latency_ms={
                    "p50": float(np.percentile(latency, 50)),
                    "p90": float(np.percentile(latency, 90)),
                    "p99": float(np.percentile(latency, 99)),
                    "max": float(latency.max()),
                },
                stage_ms={stage: float(np.median(ms)) for stage, ms in self._stages.items()},
                dropped=dropped,
                gaussians=self._gaussians,
                rss_mb=resident_mb(),
                skipped=dict(self._skipped),
                last_error=str(error) if error else None,
                connections=connections,
            )


def resident_mb() -> float:
    """Resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
