"""The operations that clients may ask of a running node, by name, and the threads that carry them out."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from sags_node.config.launch_file import with_parameters
from sags_node.config.schema import LIVE_PARAMETERS, LaunchConfig
from sags_node.errors import SagsError
from sags_node.files import check_name
from sags_node.mapping.budget import Budget
from sags_node.messaging import content, published
from sags_node.messaging.measure import measured
from sags_node.messaging.requests import (
    AnchorName,
    AnchorRequest,
    MeasureRequest,
    SaveRequest,
    ViewName,
    ViewRequest,
    parse,
    without_args,
)
from sags_node.model.ply import write_ply
from sags_node.node.health import Statistics
from sags_node.node.views import Views
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.results import unsure
from sags_node.types import DrawnView, FrameResult


@dataclass
class NodeState:
    """What the threads of a node and its operations share."""

    config: LaunchConfig
    pipeline: Pipeline  # of the mapping thread
    budget: Budget  # of the mapping thread
    views: Views  # of the drawing thread
    session: str  # id of this start of the node
    statistics: Statistics = field(default_factory=Statistics)
    paused: threading.Event = field(default_factory=threading.Event)
    parameters_changed: threading.Event = field(default_factory=threading.Event)
    status_due: threading.Event = field(default_factory=threading.Event)  # publish the status at once


class Operations:
    """Answers requests of clients. Those that touch the model wait for the mapping thread, those that touch
    views for the drawing thread. A disk may hang: each file is written by a thread of its own.

    Args:
        show_view: called with a view's name and its drawing to publish; None: the view was closed.
    """

    def __init__(self, state: NodeState, show_view: Callable[[str, DrawnView | None], None]) -> None:
        self._state = state
        self._show_view = show_view
        self.for_mapping = Requests()
        self.for_drawing = Requests()
        self._saving: list[Future[Any]] = []  # models that are being written

    def handlers(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """The handlers by operation name; one returns a `Future` where another thread does the work."""
        return {
            "get_parameters": without_args(lambda: self._state.config.model_dump(mode="json")),
            "set_parameters": lambda args: self.for_mapping.post(lambda: self._set_parameters(args)),
            "reset_model": without_args(lambda: self.for_mapping.post(self._reset_model)),
            "pause": without_args(lambda: self.for_mapping.post(self._pause)),
            "resume": without_args(lambda: self.for_mapping.post(self._resume)),
            "add_anchor": lambda args: self.for_mapping.post(lambda: self._add_anchor(args)),
            "remove_anchor": lambda args: self.for_mapping.post(lambda: self._remove_anchor(args)),
            "measure": lambda args: self.for_mapping.post(lambda: self._measure(args)),
            "start_strain": without_args(lambda: self.for_mapping.post(self._start_strain)),
            "stop_strain": without_args(lambda: self.for_mapping.post(self._state.pipeline.stop_strain)),
            "open_view": lambda args: self.for_drawing.post(lambda: self._open_view(args)),
            "close_view": lambda args: self.for_drawing.post(lambda: self._close_view(args)),
            "save_model": self._save_model,
        }

    def _set_parameters(self, args: dict[str, Any]) -> dict[str, Any]:
        refused = [key for key in args if key not in LIVE_PARAMETERS]
        if refused:
            raise SagsError(
                f"{', '.join(refused)} cannot be changed while running; "
                f"what can: {', '.join(LIVE_PARAMETERS)}"
            )
        self._state.config = with_parameters(self._state.config, args)
        self.reconfigure()
        self._state.parameters_changed.set()
        return self._state.config.model_dump(mode="json")

    def reconfigure(self) -> None:
        """Apply the present configuration and rate to the next frames; to be called on the mapping thread."""
        self._state.pipeline.reconfigure(self._state.config)
        self._state.budget = self._state.pipeline.make_budget(self._state.budget.speed)

    def _reset_model(self) -> dict[str, Any]:
        self._state.pipeline.reset()
        return {}

    def _pause(self) -> dict[str, Any]:
        self._state.paused.set()
        self._state.status_due.set()
        return {"paused": True}

    def _resume(self) -> dict[str, Any]:
        if self._state.paused.is_set():
            self._state.statistics.resume()
            self._state.paused.clear()
            self._state.status_due.set()
        return {"paused": False}

    def _add_anchor(self, args: dict[str, Any]) -> dict[str, Any]:
        request = parse(AnchorRequest, args)
        newest = self._state.pipeline.newest
        if newest is None:
            raise SagsError("there is no model yet; wait for the first frame")
        frame = newest.observation, newest.snapshot, newest.views["left"]
        if request.u is not None and request.v is not None:
            if held := self._state.pipeline.held:  # the consumer clicked on a newer image
                raise SagsError(f"frames are held: {held}; pin when they are taken in again")
            size = published.size_of(newest.pair)
            anchor = self._state.pipeline.anchors.add_pixel(request.u, request.v, *frame, size)
        else:
            point = np.array([request.x, request.y, request.z], np.float64)
            anchor = self._state.pipeline.anchors.add_point(point, *frame)
        if request.ahead_ms:
            seconds = None if request.ahead_ms == "auto" else request.ahead_ms * 1e-3
            self._state.pipeline.anchors.look_ahead(anchor, seconds)
            self._state.pipeline.predict_motion()
        sure = self._state.pipeline.anchor_confidence(anchor)
        said = {"id": anchor, "session": self._state.session, "frame_id": newest.pair.frame_id}
        return {**said, "depth_confidence": round(sure, 3)}

    def _remove_anchor(self, args: dict[str, Any]) -> dict[str, Any]:
        request = parse(AnchorName, args)
        if request.session not in (None, self._state.session):
            raise SagsError(f"anchor {request.id} was of the node's start before, and is gone with it")
        self._state.pipeline.anchors.remove(request.id)
        return {}

    def _measure(self, args: dict[str, Any]) -> dict[str, Any]:
        request, newest = parse(MeasureRequest, args), self._scene()
        if newest is None:
            raise SagsError("the tissue of now is not known; measure when frames are taken in")
        camera = replace(published.camera_of(newest.pair), T_world_cam=newest.snapshot.camera.T_world_cam)
        states, metric = newest.anchors, self._state.pipeline.metric
        return {
            **asdict(measured(states, camera, request.anchors, request.area, metric)),
            "stamp_ns": newest.pair.t_capture_ns,
        }

    def _start_strain(self) -> dict[str, Any]:
        if self._scene() is None:
            raise SagsError("the tissue of now is not known; begin when frames are taken in")
        return {"stamp_ns": self._state.pipeline.start_strain()}

    def _open_view(self, args: dict[str, Any]) -> dict[str, Any]:
        request = parse(ViewRequest, args)
        if request.ahead_ms:
            self._state.pipeline.predict_motion()
        drawn = self._state.views.open(request, self._scene(), self._state.pipeline.seen)
        status = self._state.views.status[request.name]
        if drawn is not None or status.draw_ms == 0:  # None: forget kept images of the old viewpoint
            self._show_view(request.name, drawn)
        return {"topics": content.view_topics(request.name, request.stereo, request.depth), **asdict(status)}

    def _scene(self) -> FrameResult | None:
        """Return the result that shows the tissue now; None: the next frame that is taken in will."""
        state, newest = self._state, self._state.pipeline.newest
        if newest is None or state.pipeline.held or state.paused.is_set() or not state.statistics.flowing:
            return None
        return newest if state.pipeline.may_be_sure else unsure(newest)

    def _close_view(self, args: dict[str, Any]) -> dict[str, Any]:
        name = parse(ViewName, args).name
        self._state.views.close(name)
        self._show_view(name, None)
        return {}

    def _save_model(self, args: dict[str, Any]) -> Future[Any]:
        path = parse(SaveRequest, args).path
        if not path.endswith(".ply"):
            raise SagsError("save_model needs a path that ends in .ply")
        if "\0" in path:
            raise SagsError("a path cannot hold a zero character")
        check_name(file := Path(path).absolute())
        newest = self._state.pipeline.newest
        if newest is None or len(newest.snapshot.gaussians) == 0:
            raise SagsError("there is no model yet; wait for the first frame")
        metric = self._state.pipeline.metric
        newest = newest if self._state.pipeline.may_be_sure else unsure(newest)
        gaussians = newest.snapshot.gaussians  # never changed any more

        def write() -> dict[str, Any]:
            write_ply(file, gaussians, metric=metric)
            return {"path": str(file), "gaussians": len(gaussians)}

        saved: Future[Any] = Future()
        self._saving = [one for one in self._saving if not one.done()] + [saved]
        threading.Thread(target=_answer, args=(saved, write), name="save-model", daemon=True).start()
        return saved

    def finish(self, seconds: float) -> None:
        """Wait at most `seconds` for models that are being written."""
        wait(self._saving, seconds)


class Requests:
    """Work that other threads leave for one thread to do."""

    def __init__(self) -> None:
        self._waiting: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()

    def post(self, work: Callable[[], Any]) -> Future[Any]:
        future: Future[Any] = Future()
        self._waiting.put((work, future))
        return future

    def serve(self) -> None:
        """Do all the work that waits."""
        while True:
            try:
                work, future = self._waiting.get_nowait()
            except Empty:
                return
            _answer(future, work)


def _answer(future: Future[Any], work: Callable[[], Any]) -> None:
    """Do the work unless it was cancelled. A failure becomes the answer, and does not end the thread."""
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(work())
    except Exception as error:
        future.set_exception(error)
