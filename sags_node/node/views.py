"""Viewpoints that consumers asked for, drawn from the newest snapshot beside the mapping.

Mapping goes first. All views together get a share of one core, see `allowance`; it is split so that each
gets the same fraction of the rate it asked for. A view that nobody subscribes to is not drawn. Used from one
thread; only `status` and `pairs` may be read by others.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sags_node.detail.seen import SeenFrame
from sags_node.engine.rasterizer.confidence import with_confidence
from sags_node.engine.rasterizer.rasterize import Drawer, to_view
from sags_node.errors import SagsError
from sags_node.geometry import scale_intrinsics
from sags_node.messaging import published
from sags_node.messaging.requests import ViewRequest
from sags_node.model.forecast import gaussians_ahead, reached
from sags_node.model.gaussians import for_right_eye
from sags_node.model.strain import painted
from sags_node.node.allowance import SHARE, Allowance
from sags_node.node.teacher import Teacher, is_of
from sags_node.types import F32, Camera, DrawnView, FrameResult, Gaussians, RenderedView, ViewStatus

MAX_VIEWS = 8
HELD_OVER = 5.0  # s over which the rate kept is counted
EARLY = 0.25  # share of a period by which a view may be drawn early, rather than at the next frame
LEARNING = 0.2  # share of a new measurement in a running mean of costs

log = logging.getLogger(__name__)

Clock = Callable[[], float]


@dataclass(slots=True)
class _View:
    request: ViewRequest
    due: float  # when it is to be drawn next
    cost: float = 0.0  # s of processor time for one drawing; 0: never drawn
    drawn_at: deque[float] = field(default_factory=deque)
    failure: str = ""  # of the last drawing; empty: none
    logged: str = ""  # the last failure that was logged

    @property
    def finished(self) -> bool:
        return self.request.static and self.cost > 0


class Views:
    """The open views.

    Attributes:
        status: how each view is served; replaced as a whole whenever it changes.
        pairs: names of the stereo views that are drawn repeatedly; replaced as `status` is.
    """

    def __init__(
        self,
        allowance: Allowance,
        clock: Clock = time.monotonic,
        processor_clock: Clock = time.thread_time,
        latency: Clock = lambda: 0.0,
        backend: str = "numba",
        detail: bool = False,
    ) -> None:
        """
        Args:
            allowance: what drawing may take of one core.
            latency: returns the recent time from capture to publication, s.
            backend: as for `make_rasterizer`.
            detail: whether views get the detail of images.
        """
        self.status: Mapping[str, ViewStatus] = {}
        self.pairs: Collection[str] = ()
        self._allowance = allowance
        self._clock = clock
        self._processor_clock = processor_clock
        self._latency = latency
        self._backend = backend
        self._views: dict[str, _View] = {}
        self._drawers: dict[tuple[int, int], Drawer] = {}
        self._watched: Collection[str] = ()
        self._teacher = Teacher() if detail else None

    def open(
        self, request: ViewRequest, scene: FrameResult | None, seen: Sequence[SeenFrame] = ()
    ) -> DrawnView | None:
        """Open a view, or change the one of that name. Returns its first image if there is a scene;
        otherwise it is drawn with the next scene.

        Raises:
            SagsError: there are too many views.
            Exception: it cannot be drawn; it is closed then.
        """
        known = self._views.get(request.name)
        if known is None and len(self._views) >= MAX_VIEWS:
            names = ", ".join(sorted(self._views))
            raise SagsError(f"{MAX_VIEWS} views are open, the most there can be ({names}); close one first")
        view = _View(request, self._clock()) if known is None else known
        if request.static or view.request.static:
            view.cost = 0.0  # not yet drawn as it is requested now
        view.request = request
        self._views[request.name] = view
        self._forget_sizes()
        self._watched = {*self._watched, request.name}  # assumed until `draw_due` says who subscribes
        drawn = None
        if scene is not None and view.cost == 0:
            try:
                drawn = self._draw(view, scene, seen)
            except Exception:
                self.close(request.name)
                raise
        self._note()
        return drawn

    def close(self, name: str) -> None:
        """Close a view; raises `SagsError` where none of that name is open."""
        if self._views.pop(name, None) is None:
            raise SagsError(f"no view '{name}' is open; open are: {', '.join(sorted(self._views)) or 'none'}")
        self._forget_sizes()
        self._note()

    def _forget_sizes(self) -> None:
        """Free the drawers of sizes that no view has any more: tens of MB each."""
        sizes = {(view.request.width, view.request.height) for view in self._views.values()}
        self._drawers = {size: kept for size, kept in self._drawers.items() if size in sizes}

    def draw_due(
        self, scene: FrameResult, watched: Collection[str], seen: Sequence[SeenFrame] = ()
    ) -> Iterator[tuple[str, DrawnView]]:
        """Draw the views due of a new scene, longest overdue first. A failure affects only its own view.

        Args:
            watched: views that somebody subscribes to.
            seen: frames that lend their images: that of the scene, and older ones (`Pipeline.seen`).
        """
        self._watched = watched
        if self._teacher is not None and seen:
            self._teacher.take(scene, seen[0])
        for name, view in sorted(self._views.items(), key=lambda item: item[1].due):
            if view.finished or (view.cost > 0 and name not in watched):
                continue
            now = self._clock()
            period = 1 / self._granted(view)
            if now < view.due - EARLY * period:
                continue
            view.due = max(view.due + period, now)
            try:
                drawn = self._draw(view, scene, seen)
            except Exception as error:
                view.failure = f"it cannot be drawn: {str(error) or type(error).__name__}"
                if view.failure != view.logged:
                    view.logged = view.failure
                    unforeseen = not isinstance(error, SagsError)
                    log.warning("view '%s': %s", name, view.failure, exc_info=unforeseen)
            else:
                yield name, drawn
        self._note()

    def _draw(self, view: _View, scene: FrameResult, seen: Sequence[SeenFrame]) -> DrawnView:
        request = view.request
        started = self._processor_clock()
        snapshot = scene.snapshot
        left = replace(published.camera_of(scene.pair), T_world_cam=snapshot.camera.T_world_cam)
        camera = view_camera(request, left)
        eyes = {"": camera}
        if request.stereo:
            eyes = {"left": camera, "right": camera.moved_right(scene.pair.baseline)}
        wanted = self._latency() + view.cost if request.ahead_ms == "auto" else 1e-3 * request.ahead_ms
        ahead = reached(snapshot, wanted)
        gaussians = gaussians_ahead(snapshot, ahead) if ahead > 0 else snapshot.gaussians
        strained = request.show == "strain"
        if strained:
            if scene.strain is None:
                raise SagsError("nothing says since when tissue is stretched: send start_strain first")
            gaussians = painted(gaussians, scene.strain)
        pictures = {}
        for eye, camera in eyes.items():
            shown = _published(scene, camera) if eye == "right" and ahead == 0 and not strained else None
            if shown is None:
                drawn = for_right_eye(gaussians, snapshot) if eye == "right" and not strained else gaussians
                planes = self._planes(drawn, camera)
                shown = to_view(planes, camera, snapshot.frame_id, snapshot.t_capture_ns)
                if self._teacher is not None and is_of(seen, snapshot) and not strained:
                    added = self._teacher.detail(scene, seen, gaussians, shown, ahead, eye == "right")
                    shown = replace(shown, shown=added)
            pictures[eye] = with_confidence(shown, gaussians)
        spent = self._processor_clock() - started
        view.cost = spent if view.cost == 0 else view.cost + LEARNING * (spent - view.cost)
        view.failure = ""
        view.drawn_at.append(self._clock())
        return DrawnView(pictures, scene.pair.baseline, request.depth, request.static, scene.epoch, ahead)

    def _planes(self, gaussians: Gaussians, camera: Camera) -> F32:
        size = camera.width, camera.height
        if size not in self._drawers:
            self._drawers[size] = Drawer(self._backend, *size)
        return self._drawers[size].forward(gaussians, camera)

    # ---- rates -----------------------------------------------------------------------------------------

    def _granted(self, view: _View) -> float:
        """The granted rate, Hz: the fraction of the rate asked for that all views can keep."""
        served = {id(view): view, **{id(v): v for n, v in self._views.items() if n in self._watched}}
        demand = sum(one.cost * one.request.rate_hz for one in served.values() if not one.request.static)
        return view.request.rate_hz * min(1.0, self._allowance.share / max(demand, 1e-9))

    def _note(self) -> None:
        self.status = {name: self._status(name, view) for name, view in self._views.items()}
        self.pairs = [n for n, view in self._views.items() if view.request.stereo and not view.finished]

    def _status(self, name: str, view: _View) -> ViewStatus:
        now = self._clock()
        while view.drawn_at and view.drawn_at[0] < now - HELD_OVER:
            view.drawn_at.popleft()
        span = now - view.drawn_at[0] if view.drawn_at else 0.0
        held = (len(view.drawn_at) - 1) / span if span > 0 else 0.0
        asked = 0.0 if view.request.static else view.request.rate_hz
        granted = 0.0 if view.request.static else self._granted(view)
        return ViewStatus(asked, granted, held, view.cost * 1e3, self._limit(name, view, granted))

    def _limit(self, name: str, view: _View, granted: float) -> str:
        live = not view.request.static
        short = live and granted < 0.95 * view.request.rate_hz
        reasons = (
            (bool(view.failure), view.failure),
            (view.cost == 0, "it waits for a frame that is taken in"),
            (live and name not in self._watched, "nobody subscribes"),
            (short and self._allowance.is_behind, "the mapping is late and goes first"),
            (short, f"all views together get {SHARE:g} of a core"),
        )
        return next((why for applies, why in reasons if applies), "")


def _published(scene: FrameResult, camera: Camera) -> RenderedView | None:
    """The node's own view of the right eye, if `camera` is that eye; its depth may be written."""
    shown = scene.views.get("right")
    if shown is None or published.size_of(scene.pair) != (camera.width, camera.height):
        return None
    if not (
        np.array_equal(published.camera_of(scene.pair).K, camera.K)
        and np.array_equal(shown.camera.T_world_cam, camera.T_world_cam)
    ):
        return None
    return published.view(scene.pair, shown)


def view_camera(request: ViewRequest, left: Camera) -> Camera:
    """The camera of a view when the left camera is `left`."""
    size = request.width, request.height
    K = request.intrinsics()
    if K is None:
        K = scale_intrinsics(left.K, (left.width, left.height), size)
    pose = request.pose()
    return Camera(*size, K, pose if request.T_world_cam is not None else left.T_world_cam @ pose)
