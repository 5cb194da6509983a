r"""The running node: four threads and the slots between them. The only file that knows threads.

    capture --frames--> mapping --results--> publishing
                           \--scenes--> drawing --views--/

Slots hold the newest value only (live), or hand every value over (recordings not played in real time).
The sockets live on the publishing thread; what a client asks of the model runs on the mapping thread,
between two frames. Consumers' own views are drawn on a thread that gives way to all others.
"""

from __future__ import annotations

import logging
import os
import threading
import time
import uuid
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from sags_node.config import LaunchConfig, V4l2Source
from sags_node.errors import SagsError
from sags_node.findings import by_code
from sags_node.health import Statistics
from sags_node.kernels.threads import configure_threads
from sags_node.latest import Latest
from sags_node.launch_file import with_parameters
from sags_node.messaging import content
from sags_node.messaging.masks import MaskSubscriber
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.requests import AnchorName, AnchorRequest, ViewName, ViewRequest, parse
from sags_node.model.ply import write_ply
from sags_node.pipeline import Pipeline
from sags_node.recording.child import RecorderProcess
from sags_node.sources.source import Source
from sags_node.types import DrawnView, FrameResult, NodeHealth, RectifiedPair, StereoFrame, StereoRig
from sags_node.views import Views, prepare_thread

log = logging.getLogger(__name__)

HEALTH_PERIOD = 1.0  # s
STOP_SECONDS = 10.0  # longest wait for each thread to end
REQUEST_WAIT = 0.05  # s: how soon a request is served while no frames come
LIVE_PARAMETERS = (
    "mapping.budget_ms",
    "mapping.skip_duplicates",
    "mapping.skip_depth",
    "mapping.skip_fitted",
    "mapping.skip_still",
)

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
        self._masks: MaskSubscriber | None = None
        if config.vision.tissue.endpoint is not None and config.vision.tissue.method == "topic":
            self._masks = MaskSubscriber(config.vision.tissue.endpoint, config.vision.tissue.ns)
            self._pipeline = Pipeline(config, rig, self._masks.nearest, self._offer_picture)
        else:
            self._pipeline = Pipeline(config, rig)
        self._pictures: Latest[tuple[RectifiedPair, int]] = Latest(on_put=self._wake_publishing)  # and epoch
        self._budget = self._pipeline.make_budget()
        self._live = isinstance(config.source, V4l2Source) or config.source.pace == "realtime"
        self._wake = os.eventfd(0, os.EFD_NONBLOCK)
        self._frames: Latest[tuple[StereoFrame, float]] = Latest()  # and when it came
        self._results: Latest[FrameResult] = Latest(on_put=self._wake_publishing)
        self._scenes: Latest[tuple[FrameResult, bool]] = Latest()  # and whether frames were missed
        # By name, the newest only; None: closed. Single operations on a dict need no lock.
        self._drawn: dict[str, DrawnView | None] = {}
        self._views = Views(config.engine.backend)
        self._watched: frozenset[str] = frozenset()  # views that somebody subscribes to
        self._mapping_requests = _Requests()
        self._view_requests = _Requests()
        self._error: BaseException | None = None
        self._stopping = threading.Event()
        self._paused = threading.Event()
        self._parameters_changed = threading.Event()
        self._state_changed = threading.Event()  # status is due at once
        self._stats = Statistics()
        self._last_sent: FrameResult | None = None
        self._scene: FrameResult | None = None  # drawn last; of the drawing thread
        self._publisher = Publisher(config.publish, config.ns, uuid.uuid4().hex, self._handlers())
        ipc = [endpoint for endpoint in self.endpoints if endpoint.startswith("ipc:")]
        self._recorder = RecorderProcess(config.ns, ipc[0] if ipc else None)
        work = {
            "capture": (self._capture, self._frames.close),
            "mapping": (self._map, self._close_results),
            "drawing": (self._draw_views, lambda: None),
            "publishing": (self._publish, self._close_publisher),
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
        """End capture first, then mapping, drawing and publishing: the last health message gets out."""
        self._stopping.set()
        self._source.stop()
        self._frames.close()
        for thread, ended in zip(self._threads, self._ended.values(), strict=True):
            if thread.ident is not None:  # it was started
                ended.wait(STOP_SECONDS)
        self._recorder.close()
        if self._masks is not None:
            self._masks.close()

    @property
    def endpoints(self) -> list[str]:
        """Where the data socket is bound."""
        return self._publisher.connection.data

    def health(self) -> NodeHealth:
        """What is true now; may be called from any thread."""
        return self._stats.health(
            dropped=self._dropped(),
            stopping=self._stopping.is_set(),
            paused=self._paused.is_set(),
            error=self._error,
            warnings=self._pipeline.warnings,
            connections=self._publisher.connections,
            views=self._views.status,
        )

    def _dropped(self) -> dict[str, int]:
        """Slot -> frames left out since the start."""
        return {
            "source": self._source.dropped,
            "capture": self._frames.dropped,
            "publish": self._results.dropped,
        }

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

    # ---- the four threads ----------------------------------------------------------------------------

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
        dropped = 0
        while not self._frames.closed:
            self._mapping_requests.serve()
            ending = self._stopping.is_set() or self._error is not None
            if self._paused.is_set() and not self._live and not ending:
                self._stopping.wait(REQUEST_WAIT)  # the recording waits; live frames are taken and left out
                continue
            came = self._frames.get(timeout=REQUEST_WAIT)
            if came is not None and not self._paused.is_set():
                frame, at = came
                waited = time.monotonic() - at if self._live else 0.0
                result = self._pipeline.process(frame, self._budget, waited)
                give(result)
                dropped, before = self._frames.dropped, dropped
                if not result.held:
                    self._scenes.put((result, dropped > before))
        self._mapping_requests.serve()

    def _draw_views(self) -> None:
        prepare_thread()
        newest: FrameResult | None = None
        while not self._scenes.closed:
            came = self._scenes.get(timeout=REQUEST_WAIT)
            if came is not None:
                newest, missed = came
                for name, drawn in self._views.draw_due(newest, self._watched, missed):
                    self._hand_over_view(name, drawn)
            self._scene = newest
            self._view_requests.serve()
        self._view_requests.serve()

    def _hand_over_view(self, name: str, drawn: DrawnView | None) -> None:
        self._drawn[name] = drawn
        self._wake_publishing()

    def _offer_picture(self, pair: RectifiedPair, epoch: int) -> None:
        """Out with it now: a mask made of it is in time for the next frame then."""
        self._pictures.put((pair, epoch))

    def _wake_publishing(self) -> None:
        os.eventfd_write(self._wake, 1)

    def _close_results(self) -> None:
        self._scenes.close()
        self._results.close()

    def _close_publisher(self) -> None:
        self._results.close()  # mapping must not wait for a thread that failed
        self._publisher.close()

    def _publish(self) -> None:
        self._parameters_changed.set()
        next_health = time.monotonic()
        warned: tuple[str, ...] = ()
        while not self._results.closed:
            if self._publisher.poll(timeout_ms=100, wake_fd=self._wake):
                os.eventfd_read(self._wake)
            if self._parameters_changed.is_set():
                self._parameters_changed.clear()
                self._publisher.publish_parameters(self.config.model_dump(mode="json"))
            result = self._results.get(timeout=0)
            if result is not None:
                self._send(result)
            picture = self._pictures.get(timeout=0)  # of a later frame
            if picture is not None:
                self._publisher.publish_picture(*picture)
            self._send_views()
            before, warned = warned, tuple(by_code(self._pipeline.warnings))
            if time.monotonic() >= next_health or self._state_changed.is_set() or warned != before:
                self._state_changed.clear()
                next_health = time.monotonic() + HEALTH_PERIOD
                self._publisher.publish_health(self.health())
        self._publisher.publish_health(self.health())

    def _send(self, result: FrameResult) -> None:
        started = time.perf_counter()
        self._publisher.publish_result(result, dropped=self._frames.dropped + self._results.dropped)
        publish_ms = (time.perf_counter() - started) * 1e3
        latency_ms = (time.time_ns() - result.pair.t_capture_ns) * 1e-6
        result = replace(result, timings_ms={**result.timings_ms, "publish": publish_ms})
        self._stats.add(result, latency_ms, self._dropped())
        self._last_sent = result
        if self._on_result is not None:
            self._on_result(result, latency_ms)

    def _send_views(self) -> None:
        while self._drawn:
            name, drawn = self._drawn.popitem()
            if drawn is None:
                self._publisher.forget_view(name)
            else:
                self._publisher.publish_view(name, drawn)
        self._watched = frozenset(name for name in self._views.status if self._publisher.watches_view(name))

    # ---- control -------------------------------------------------------------------------------------

    def _handlers(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        return {
            "get_status": lambda args: content.status(self.health(), self._last_sent),
            "get_parameters": lambda args: self.config.model_dump(mode="json"),
            "set_parameters": lambda args: self._mapping_requests.post(lambda: self._set_parameters(args)),
            "reset_model": lambda args: self._mapping_requests.post(self._reset_model),
            "pause": lambda args: self._mapping_requests.post(self._pause),
            "resume": lambda args: self._mapping_requests.post(self._resume),
            "add_anchor": lambda args: self._mapping_requests.post(lambda: self._add_anchor(args)),
            "remove_anchor": lambda args: self._mapping_requests.post(lambda: self._remove_anchor(args)),
            "open_view": lambda args: self._view_requests.post(lambda: self._open_view(args)),
            "close_view": lambda args: self._view_requests.post(lambda: self._close_view(args)),
            "start_recording": self._start_recording,
            "stop_recording": lambda args: self._recorder.stop(),
            "take_snapshot": lambda args: self._recorder.snapshot(),
            "save_model": lambda args: self._mapping_requests.post(lambda: self._save_model(args)),
        }

    def _set_parameters(self, args: dict[str, Any]) -> dict[str, Any]:
        refused = [key for key in args if key not in LIVE_PARAMETERS]
        if refused:
            raise SagsError(
                f"{', '.join(refused)} cannot be changed while running; "
                f"what can: {', '.join(LIVE_PARAMETERS)}"
            )
        self.config = with_parameters(self.config, args)
        self._pipeline.reconfigure(self.config)
        self._budget = self._pipeline.make_budget(self._budget.speed)
        self._parameters_changed.set()
        return self.config.model_dump(mode="json")

    def _start_recording(self, args: dict[str, Any]) -> Future[Any]:
        return self._recorder.start(args)

    def _reset_model(self) -> dict[str, Any]:
        self._pipeline.reset()
        return {}

    def _pause(self) -> dict[str, Any]:
        self._paused.set()
        self._state_changed.set()
        return {"paused": True}

    def _resume(self) -> dict[str, Any]:
        if self._paused.is_set():
            self._stats.forget_rate()
            self._paused.clear()
            self._state_changed.set()
        return {"paused": False}

    def _add_anchor(self, args: dict[str, Any]) -> dict[str, Any]:
        request = parse(AnchorRequest, args)
        newest = self._pipeline.newest
        if newest is None:
            raise SagsError("there is no model yet; wait for the first frame")
        frame = newest.observation, newest.snapshot, newest.views["left"]
        if request.u is not None and request.v is not None:
            anchor = self._pipeline.anchors.add_pixel(request.u, request.v, *frame)
        else:
            point = np.array([request.x, request.y, request.z], np.float64)
            anchor = self._pipeline.anchors.add_point(point, *frame)
        sure = self._pipeline.anchors.depth_confidence(anchor)
        return {"id": anchor, "frame_id": newest.pair.frame_id, "depth_confidence": round(sure, 3)}

    def _remove_anchor(self, args: dict[str, Any]) -> dict[str, Any]:
        self._pipeline.anchors.remove(parse(AnchorName, args).id)
        return {}

    def _open_view(self, args: dict[str, Any]) -> dict[str, Any]:
        request = parse(ViewRequest, args)
        drawn = self._views.open(request, self._scene)
        if drawn is not None:
            self._hand_over_view(request.name, drawn)
        status = self._views.status[request.name]
        return {"topics": content.view_topics(request.name, request.stereo, request.depth), **asdict(status)}

    def _close_view(self, args: dict[str, Any]) -> dict[str, Any]:
        name = parse(ViewName, args).name
        self._views.close(name)
        self._hand_over_view(name, None)
        return {}

    def _save_model(self, args: dict[str, Any]) -> dict[str, Any]:
        path = args.get("path")
        if not isinstance(path, str) or not path.endswith(".ply"):
            raise SagsError("save_model needs a path that ends in .ply")
        if "\0" in path:
            raise SagsError("a path cannot hold a zero character")
        gaussians = self._pipeline.mapper.model.frozen()
        if len(gaussians) == 0:
            raise SagsError("there is no model yet; wait for the first frame")
        file = Path(path).absolute()
        write_ply(file, gaussians)
        return {"path": str(file), "gaussians": len(gaussians)}


class _Requests:
    """Work that other threads leave for one thread to do."""

    def __init__(self) -> None:
        self._waiting: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()

    def post(self, work: Callable[[], Any]) -> Future[Any]:
        future: Future[Any] = Future()
        self._waiting.put((work, future))
        return future

    def serve(self) -> None:
        """Do all that waits; its failure is the answer, and does not end the thread."""
        while True:
            try:
                work, future = self._waiting.get_nowait()
            except Empty:
                return
            try:
                future.set_result(work())
            except Exception as error:  # a client's request must not end the node; it is the answer
                future.set_exception(error)
