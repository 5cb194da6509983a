r"""The running node: five threads and the slots between them.

    capture --frames--> mapping --results--> publishing --whole--> thinning
                           \--scenes--> drawing --views--/ \--------thin----/

Slots hold the newest value only (live), or hand every value over (recordings not played in real time).
The sockets live on the publishing thread; clients' requests about the model run on the mapping thread,
between two frames. Consumers' own views are drawn, and thin images made, on threads of their own, which
take no more of a core than `allowance` says.
"""

import logging
import os
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

from sags_node.config.schema import LaunchConfig, LiveSource
from sags_node.detail.seen import SeenFrame
from sags_node.errors import SagsError
from sags_node.findings import by_code, by_stage
from sags_node.kernels.threads import configure_threads, leave_a_core
from sags_node.mapping.devices import backend_of
from sags_node.messaging import content
from sags_node.messaging.cdr import Content
from sags_node.messaging.masks import MaskSubscriber
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.requests import without_args
from sags_node.messaging.thin import thin_pictures
from sags_node.messaging.topics import ThinPicture
from sags_node.node.allowance import Allowance, Pace
from sags_node.node.health import Statistics, in_a_line, why_missed
from sags_node.node.latest import Latest
from sags_node.node.operations import NodeState, Operations
from sags_node.node.recorder import RecorderProcess
from sags_node.node.service_manager import ServiceManager
from sags_node.node.views import Views
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.sources.clock import CaptureClock, FrameRate
from sags_node.sources.source import Source, findings_of
from sags_node.types import (
    DrawnView,
    FrameResult,
    NodeHealth,
    RectifiedPair,
    RectifiedPictures,
    StereoFrame,
    StereoRig,
)

log = logging.getLogger(__name__)

HEALTH_PERIOD = 1.0  # s between two health messages
STOP_SECONDS = 10.0  # longest wait for all threads to end
LAST_WORDS = 1.0  # s to wait for the last health message, where another thread hangs
REQUEST_WAIT = 0.05  # s between looks for requests while no frames come
LOOKS_AGAIN = 5.0  # s: who asks for single images comes again in this time, and finds the next one ready

OnResult = Callable[[FrameResult, float], None]  # a published result and its latency, ms


class Node:
    """Runs a source through the pipeline and publishes the results, until the source ends or `stop`."""

    def __init__(
        self,
        config: LaunchConfig,
        rig: StereoRig,
        source: Source,
        on_result: OnResult | None = None,
        manager: ServiceManager | None = None,
    ) -> None:
        """Bind the sockets and prepare the pipeline; nothing runs yet.

        Args:
            on_result: called on the publishing thread after each result has been sent.
            manager: is notified of the state of the node.

        Raises:
            SagsError: an endpoint cannot be bound, or the configuration does not fit the rig.
        """
        self._source = source
        self._on_result = on_result
        self._masks: MaskSubscriber | None = None
        self._live = config.in_real_time
        rate = source.rate if self._live else None
        self._rate = FrameRate(source.rate) if isinstance(config.source, LiveSource) else None
        if config.vision.tissue.endpoint is not None and config.vision.tissue.method == "topic":
            self._masks = MaskSubscriber(config.vision.tissue.endpoint, config.vision.tissue.ns)
            pipeline = Pipeline(config, rig, self._masks.nearest, self._offer_picture, rate=rate)
        else:
            pipeline = Pipeline(config, rig, rate=rate)
        statistics = Statistics(config.source)
        self._allowance = Allowance()
        backend = backend_of(config)
        views = Views(
            self._allowance,
            latency=lambda: statistics.latency_s,
            backend=backend,
            detail=config.publish.detail,
        )
        session = uuid.uuid4().hex
        self._state = NodeState(
            config, pipeline, pipeline.make_budget(), views, session, statistics=statistics
        )
        self._operations = Operations(self._state, self._hand_over_view)
        self._pictures: Latest[tuple[RectifiedPair, int]] = Latest(on_put=self._wake_publishing)  # and epoch
        self._clock = CaptureClock()  # of live images
        self._manager = manager or ServiceManager({})
        self._wake = os.eventfd(0, os.EFD_NONBLOCK)
        self._frames: Latest[tuple[StereoFrame, float, RectifiedPictures]] = Latest()  # and when it came
        self._results: Latest[FrameResult] = Latest(on_put=self._wake_publishing)
        self._scenes: Latest[tuple[FrameResult, tuple[SeenFrame, ...]]] = Latest()
        self._whole: Latest[tuple[FrameResult, Mapping[str, ThinPicture]]] = Latest()  # and what is asked for
        self._thin: Latest[tuple[FrameResult, dict[str, Content]]] = Latest(on_put=self._wake_publishing)
        # By name, the newest only; None: closed. Single operations on a dict need no lock.
        self._drawn: dict[str, DrawnView | None] = {}
        self._watched: frozenset[str] = frozenset()  # views that somebody subscribes to
        self._left_is_watched = True  # somebody looks at the left view, or did lately; will at the start
        self._left_looked_at = time.monotonic()  # when somebody did (s)
        self._right_is_watched = False  # somebody looks at the right eye
        self._instruments_asked = False
        self._error: BaseException | None = None
        self._stopping = threading.Event()
        self._last_sent: FrameResult | None = None
        self._sent = 0
        self._working_since: float | None = None  # since when (s, monotonic) the newest frame is worked on
        self._publisher = Publisher(
            config.publish, config.ns, session, self._handlers(), thins=True, metric=rig.metric
        )
        ipc = [endpoint for endpoint in self.endpoints if endpoint.startswith("ipc:")]
        self._recorder = RecorderProcess(config.ns, ipc[0] if ipc else None)
        work = {
            "capture": (self._capture, self._frames.close),
            "mapping": (self._map, self._close_results),
            "drawing": (self._draw_views, lambda: None),
            "thinning": (self._make_thin, lambda: None),
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
        self._manager.ready()

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
        self._manager.stopping()
        self._stopping.set()
        self._source.stop()
        self._frames.close()
        until = time.monotonic() + STOP_SECONDS
        for thread, (name, ended) in zip(self._threads, self._ended.items(), strict=True):
            was_started = thread.ident is not None
            if was_started and not ended.wait(max(0.0, until - time.monotonic())):
                log.warning("the %s thread does not end in %g s; it is left behind", name, STOP_SECONDS)
                self._close_results()  # publishing ends, and nobody finds this node any more
                self._ended["publishing"].wait(LAST_WORDS)
                break
        self._operations.finish(STOP_SECONDS)
        self._recorder.close()
        if self._masks is not None:
            self._masks.close()

    @property
    def config(self) -> LaunchConfig:
        """The configuration now: some parameters change while the node runs."""
        return self._state.config

    @property
    def endpoints(self) -> list[str]:
        """The endpoints to which the data socket is bound."""
        return self._publisher.connection.data

    def health(self) -> NodeHealth:
        """Return the health of the node now; may be called from any thread."""
        return self._state.statistics.health(
            dropped=self.dropped,
            stopping=self._stopping.is_set(),
            paused=self._state.paused.is_set(),
            error=self._error,
            warnings={
                **self._state.pipeline.warnings,
                **by_stage([*findings_of(self._source), *self._recorder.findings()]),
            },
            working=time.monotonic() - began if (began := self._working_since) is not None else 0.0,
            recording=self._recorder.status(),
            missed=why_missed(self._state.config.mapping, self._state.pipeline.rate),
            connections=self._publisher.connections,
            views=self._state.views.status,
            clock=self._clock.status(),
        )

    @property
    def failed(self) -> bool:
        """Tell whether an error has ended the node; `wait` raises that error."""
        return self._error is not None

    @property
    def sent(self) -> int:
        """Frames published since the start."""
        return self._sent

    @property
    def dropped(self) -> dict[str, int]:
        """Slot -> frames left out since the start."""
        return {
            "source": self._source.dropped,
            "capture": self._frames.dropped,
            "publish": self._results.dropped,
        }

    def _guard(self, name: str, work: Callable[[], None], after: Callable[[], None]) -> None:
        """Run one thread's work. If it fails, the node ends in order, and `wait` raises the error."""
        try:
            work()
        except BaseException as error:  # any error ends the node
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

    # ---- the five threads ----------------------------------------------------------------------------

    def _capture(self) -> None:
        configure_threads(1)
        give = self._frames.put if self._live else self._frames.hand_over
        rectifier = self._state.pipeline.rectifier
        with self._source:
            for frame in self._source:
                if self._stopping.is_set():
                    return
                if frame.t_device_ns and frame.t_arrival_ns:
                    self._clock.add(frame.t_device_ns, frame.t_arrival_ns)
                at = time.monotonic()
                give((frame, at, rectifier.pictures(frame)))  # here: mapping has more to do

    def _map(self) -> None:
        leave_a_core(self._state.config.engine.threads)
        give = self._results.put if self._live else self._results.hand_over
        dropped = 0
        while not self._frames.closed:
            self._manager.turned("mapping")
            self._operations.for_mapping.serve()
            ending = self._stopping.is_set() or self._error is not None
            if self._state.paused.is_set() and not self._live and not ending:
                self._stopping.wait(REQUEST_WAIT)  # the recording waits; live frames are taken and left out
                continue
            came = self._frames.get(timeout=REQUEST_WAIT)
            if came is not None and not self._state.paused.is_set():
                frame, at, pictures = came
                if self._rate is not None and self._rate.add(frame):
                    self._state.pipeline.rate = self._rate.hz
                    self._operations.reconfigure()
                waited = time.monotonic() - at if self._live else 0.0
                latency = self._state.statistics.latency_s
                request = FrameRequest(
                    waited, self._left_is_watched, self._right_is_watched, latency, self._instruments_asked
                )
                self._working_since = time.monotonic()
                result = self._state.pipeline.process(frame, self._state.budget, request, pictures)
                self._working_since = None
                if frame.warm_up:
                    continue
                give(result)
                dropped, before = self._frames.dropped, dropped
                self._allowance.frame(waited, missed=dropped > before)
                if not result.held:
                    self._scenes.put((result, self._state.pipeline.seen))
        self._operations.for_mapping.serve()

    def _draw_views(self) -> None:
        configure_threads(1)
        while not self._scenes.closed:
            came = self._scenes.get(timeout=REQUEST_WAIT)
            if came is not None:
                scene, seen = came
                for name, drawn in self._state.views.draw_due(scene, self._watched, seen):
                    self._hand_over_view(name, drawn)
            self._operations.for_drawing.serve()
        self._operations.for_drawing.serve()

    def _make_thin(self) -> None:
        configure_threads(1)
        pace = Pace(self._allowance)
        logged: set[str] = set()
        while not self._whole.closed:
            came = self._whole.get(timeout=REQUEST_WAIT)
            if came is None or not pace.is_due(time.monotonic()):
                continue
            result, asked = came
            started = time.thread_time()
            self._thin.put((result, thin_pictures(result, asked, logged)))
            pace.worked(time.monotonic(), time.thread_time() - started)

    def _hand_over_view(self, name: str, drawn: DrawnView | None) -> None:
        self._drawn[name] = drawn
        self._wake_publishing()

    def _offer_picture(self, pair: RectifiedPair, epoch: int) -> None:
        """Publish the image at once, so that a mask made of it is in time for the next frame."""
        self._pictures.put((pair, epoch))

    def _wake_publishing(self) -> None:
        os.eventfd_write(self._wake, 1)

    def _close_results(self) -> None:
        self._scenes.close()
        self._whole.close()
        self._results.close()

    def _close_publisher(self) -> None:
        self._results.close()  # mapping must not wait for a thread that failed
        self._publisher.close()

    def _publish(self) -> None:
        self._state.parameters_changed.set()
        next_health = time.monotonic()
        warned: tuple[str, ...] = ()
        while not self._results.closed:
            self._manager.turned("publishing")
            if self._publisher.poll(timeout_ms=100, wake_fd=self._wake):
                os.eventfd_read(self._wake)
            self._note_who_looks()
            if self._state.parameters_changed.is_set():
                self._state.parameters_changed.clear()
                self._publisher.publish_parameters(self._state.config.model_dump(mode="json"))
            result = self._results.get(timeout=0)
            if result is not None:
                self._send(result)
            picture = self._pictures.get(timeout=0)  # of a later frame
            if picture is not None:
                self._publisher.publish_picture(*picture)
            self._send_views()
            made = self._thin.get(timeout=0)
            if made is not None:
                self._publisher.publish_thin(*made)
            before, warned = warned, tuple(by_code(self._state.pipeline.warnings))
            if time.monotonic() >= next_health or self._state.status_due.is_set() or warned != before:
                self._state.status_due.clear()
                next_health = time.monotonic() + HEALTH_PERIOD
                health = self.health()
                self._publisher.publish_health(health)
                self._manager.status(in_a_line(health))
        self._publisher.publish_health(self.health())

    def _send(self, result: FrameResult) -> None:
        started = time.perf_counter()
        self._publisher.publish_result(result, dropped=self._frames.dropped + self._results.dropped)
        publish_ms = (time.perf_counter() - started) * 1e3
        latency_ms = (time.time_ns() - result.pair.t_capture_ns) * 1e-6
        result = replace(result, timings_ms={**result.timings_ms, "publish": publish_ms})
        if self._publisher.thin:
            self._whole.put((result, self._publisher.thin))
        if self._state.statistics.add(result, latency_ms, self.dropped):
            self._state.status_due.set()  # until they get the new state, consumers refuse the content
        self._last_sent, self._sent = result, self._sent + 1
        if self._on_result is not None:
            self._on_result(result, latency_ms)

    def _send_views(self) -> None:
        while self._drawn:
            name, drawn = self._drawn.popitem()
            if drawn is None:
                self._publisher.forget_view(name)
            else:
                self._publisher.publish_view(name, drawn)

    def _note_who_looks(self) -> None:
        views = self._state.views
        self._watched = frozenset(name for name in views.status if self._publisher.watches_view(name))
        now = time.monotonic()
        if self._publisher.looked_at("left/render/image"):
            self._left_looked_at = now
        self._left_is_watched = now < self._left_looked_at + LOOKS_AGAIN
        self._instruments_asked = self._publisher.wanted("instruments")
        if self._state.config.publish.right == "auto":
            pictures = ["right/render/image", *(f"view/{name}/right/image" for name in views.pairs)]
            self._right_is_watched = any(map(self._publisher.looked_at, pictures))

    # ---- control -------------------------------------------------------------------------------------

    def _handlers(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        return self._operations.handlers() | {
            "get_status": without_args(lambda: content.status(self.health(), self._last_sent)),
            "get_health": without_args(lambda: content.health_answer(self.health())),
            "start_recording": self._start_recording,
            # The recorder needs the publisher, which gets these, and is made after it.
            "stop_recording": without_args(lambda: self._recorder.stop()),  # noqa: PLW0108
            "take_snapshot": without_args(lambda: self._recorder.snapshot()),  # noqa: PLW0108
        }

    def _start_recording(self, args: dict[str, Any]) -> Future[Any]:
        return self._recorder.start(args)
