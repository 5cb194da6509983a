"""Objects held by anchors: pinned once, then placed in every frame by where the node says its anchors are."""

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import Any

import numpy as np

from sags_node.clients.overlay.deform import Deformation
from sags_node.clients.overlay.draw import Body, Placed
from sags_node.clients.overlay.frame import Anchor, TissueFrame
from sags_node.clients.overlay.pinner import Pinner, Request
from sags_node.clients.overlay.pose import on_surface, surface_normal
from sags_node.clients.overlay.residual import Residual
from sags_node.clients.overlay.scene import ObjectSpec
from sags_node.clients.registration.register import misread
from sags_node.clients.registration.rigid import on_a_line, rigid_fit
from sags_node.clients.registration.surfaces import Shape
from sags_node.confidence import LEAST
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import invert, scale_pixels, transform
from sags_node.types import F64

LEAST_ANCHORS = 3  # for a rigid fit
FAR = 0.01  # m; an object that is farther than this and its own size from all anchors is misplaced
MISFIT = 0.003  # m from an anchor to its place on the rigid object; nine of ten are within half of it
NORMAL_MEMORY = 0.8  # weight of the last normal, as the depth of one frame is noisy
ELSEWHERE = (
    "it was registered in another session or epoch of the node, whose world may be another: register it again"
)
AGAIN = "it comes back once recognised; else pin it again, by four anchors or more"
UNRECOGNISED = "its anchors were not recognised lately"
NO_UNIT = "nobody has calibrated the eyes: its size beside the tissue is a guess"
GONE = f"the tissue at its anchors left the model; {AGAIN}"

log = logging.getLogger(__name__)


class HeldObject:
    """One object of a scene.

    Attributes:
        reason: why it has no place in the newest frame; None: it has.
        unsure: why its place is not sure; None: it is, or it has none.
        error: how badly its anchors fit its rigid shape (m, RMS); 0 with one anchor.

    Args:
        repin: after the model or the node was started anew, pin it once more at the same pixels and places.
        ahead: how far ahead of its frames it is placed, ms or `auto`, see `add_anchor`.
        body: what is placed.
        worker: for what takes longer than a frame.
    """

    def __init__(
        self,
        spec: ObjectSpec,
        where: str,
        pinner: Pinner,
        repin: bool,
        ahead: float | str,
        body: Body,
        worker: Executor,
    ) -> None:
        self.spec = spec
        self.reason: str | None = None
        self.unsure: str | None = None
        self.error = 0.0
        self.times_pinned = 0
        self._where = where  # what its anchors are called in messages
        self._pinner = pinner
        self._repin = repin
        self._asked = {} if ahead == 0 else {"ahead_ms": ahead}
        self._pinning: Future[list[int]] | None = None
        self._ids: list[int] = []
        self._session = ""  # of the node in which it was pinned
        self._states: list[Anchor] = []
        self._model: F64 | None = None  # [k, 3] m, points of the object that lie at the anchors
        self._right = np.zeros(3)  # where the image's x axis pointed when it was pinned
        self._normal: F64 | None = None
        self._lost: str | None = None
        self._body = body
        self._worker = worker
        self._off: dict[int, float] = {}  # m, of each anchor from where the unbent shape has it
        self._bend: Deformation | None = None
        self._residual: Residual | None = None
        self._follow()
        self._refused: str | None = None  # for good
        self._misread = self._misreadings()
        self._doubt: str | None = None  # about its `at`, once their unit is known, or about its places
        self._size: tuple[int, int] | None = None  # of the image that its pixels are meant in: the first
        self._begun_s: float | None = None  # place in the recording at which it was pinned first, s
        self._held_s: float | None = None  # of the newest frame in which its anchors were known
        self._began_anew = False  # the recording did, since it was lost

    def _follow(self) -> None:
        """Prepare to bend and to check it, again after it was lost."""
        stated = self.spec.registration
        if self.spec.deform:
            depth = 1e-3 * self.spec.deform_depth_mm
            self._bend = Deformation(self._body.vertices, depth, self._pinner, self._worker, self._asked)
        if stated is not None and stated.residual_p90_mm is not None:
            self._residual = Residual(1e-3 * stated.residual_p90_mm, stated.share, self._worker)

    def placed(self, frame: TissueFrame) -> Placed | None:
        """Return it as it is to be drawn: placed, bent and checked as its scene file says; see `place`."""
        T = self.place(frame)
        if T is None:
            return None
        put, doubts = Placed(self._body, T), [None if frame.metric else NO_UNIT, self.unsure]
        if self._bend is not None:
            put = replace(put, vertices=self._bend.move(frame, T))
            doubts.append(self._bend.doubt and f"it is drawn rigid: {self._bend.doubt}")
        if self._residual is not None:
            # The surface is known for now only, not for the time for which it is placed ahead.
            doubts.append(self._residual.look(frame, put, again=self.ahead_s == 0))
        self.unsure = next(filter(None, doubts), None)
        known = [state.depth_confidence for state in self._states]
        return replace(put, is_sure=self.is_sure, depth_confidence=float(np.median(known)))

    def place(self, frame: TissueFrame) -> F64 | None:
        """The pose [4, 4] of the object in the world, or None and a `reason`. Pins it when it is not yet.

        Raises:
            UsageError: a pixel to pin it to lies outside the image.
        """
        T, self.reason, self.unsure = None, self._unready(frame), None
        if self.reason is None:
            T, self.reason = self._held(frame, [frame.anchors.get(anchor) for anchor in self._ids])
        return T

    @property
    def is_sure(self) -> bool:
        """Tell whether it has a place, enough of its anchors are sure and fit its shape, and nothing else
        speaks against it."""
        return self.times_pinned > 0 and self.reason is None and self.unsure is None

    def _unready(self, frame: TissueFrame) -> str | None:  # noqa: PLR0911, one return per reason
        """Why its anchors do not hold it, or not yet."""
        if self._refused is not None:
            return self._refused
        if self._ids and frame.session != self._session:
            self._begun_s = None  # it may play another recording, whose pixels show other tissue
            return self._lose("the node was started anew", self._pinner.forget)
        may_pin = self._lost is None or self._may_pin_again(frame)
        if not self._ids:
            return self._pin(frame) if may_pin else str(self._lost)
        states = [frame.anchors.get(anchor) for anchor in self._ids]
        known = [state for state in states if state is not None]
        if self._model is None and len(known) < len(states):
            return "being pinned"  # the anchors come with one of the next frames
        self._states = known
        if not known:
            return self._lose("its anchors were removed", self._pinner.remove)
        found = sum(np.isfinite(state.place).all() for state in known)
        if found == 0 or (self._model is None and found < len(states)):
            if self._lost is not None and may_pin:
                self._lose(GONE, self._pinner.remove)
                return self._pin(frame)
            self._lost = f"lost: {GONE}"
            return self._lost
        self._lost, self._held_s, self._began_anew = None, frame.recorded_s, False
        if self._model is None:
            self._begin(frame, known)
        if self._refused is not None:
            self._pinner.remove(self._ids)
            self._ids, self._states = [], []
        return self._refused

    @property
    def ahead_s(self) -> float:
        """The time (s) by which it was placed ahead of its last frame."""
        return max((state.ahead for state in self._states), default=0.0)

    def status(self) -> dict[str, Any]:
        """Return for people and programs what it is, why it is not drawn, and the state of its anchors."""
        return {
            "name": self.spec.name,
            "reason": self.reason,
            "sure": self.is_sure,
            "unsure": self.unsure,
            "pinned": self.times_pinned,
            "error_mm": round(1e3 * self.error, 3),
            **({} if self._residual is None else self._residual.status()),
            **({} if self._bend is None else self._bend.status()),
            "anchors": [
                {
                    "id": anchor,
                    "visibility": round(state.visibility, 2),
                    "confidence": round(state.confidence, 2),
                    "depth_confidence": round(state.depth_confidence, 2),
                }
                for anchor, state in zip(self._ids, self._states, strict=False)
            ],
        }

    # ---- pinning -------------------------------------------------------------------------------------------

    def _lose(self, why: str, release: Callable[[list[int]], object]) -> str:
        release(self._ids)
        if self._bend is not None:
            self._bend.release(release)
        self._follow()
        self._ids, self._states, self._model, self._normal = [], [], None, None
        self._lost = f"lost: {why}"
        return self._lost

    def _may_pin_again(self, frame: TissueFrame) -> bool:
        """Whether `repin` is set, or a recording loops and is again where the object was pinned: its pixels
        then show the same tissue."""
        now, held, begun = frame.recorded_s, self._held_s, self._begun_s
        if now is not None and held is not None and now < held:
            self._began_anew = True
        return self._repin or (self._began_anew and now is not None and begun is not None and now >= begun)

    def _pin(self, frame: TissueFrame) -> str:
        if self._pinning is None:
            requests = self._requests(frame)
            if isinstance(requests, str):
                return requests
            requests = [request | self._asked for request in requests]
            self._pinning, self._session = self._pinner.pin(requests), frame.session
            self._begun_s = frame.recorded_s if self._begun_s is None else self._begun_s
        elif self._pinning.done():
            done, self._pinning = self._pinning, None
            error = done.exception()
            if isinstance(error, SagsError):
                return str(error)
            self._ids, self._lost = done.result(), None
            self.times_pinned += 1
        return "being pinned"

    def _requests(self, frame: TissueFrame) -> list[Request] | str:
        """Return what to ask the node for, or why not in this frame."""
        height, width = frame.depth.shape
        if not self.spec.anchors:
            pixel = _middle(frame)
            return "no tissue in the image" if pixel is None else [{"u": pixel[0], "v": pixel[1]}]
        self._size = self._size or (width, height)
        requests: list[Request] = []
        for anchor in self.spec.anchors:
            if anchor.pixel is None:
                requests.append(dict(zip("xyz", anchor.place or (), strict=True)))
                continue
            u, v = scale_pixels(np.array(anchor.pixel), self._size, (width, height)).tolist()
            if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                raise UsageError(
                    f"{self._where} {u:g} {v:g} lies outside the left image of {width}x{height} px"
                )
            if not frame.tissue[round(v), round(u)]:
                return f"pixel {u:g} {v:g} shows no tissue: an instrument, or vision.tissue.exclude"
            if not np.isfinite(frame.depth[round(v), round(u)]):
                return f"no depth at pixel {u:g} {v:g}"
            requests.append({"u": u, "v": v})
        return requests

    # ---- placing -------------------------------------------------------------------------------------------

    def _begin(self, frame: TissueFrame, states: Sequence[Anchor]) -> None:
        """From this frame on the object is fixed to its anchors."""
        T_world_cam = frame.camera.T_world_cam
        self._right = T_world_cam[:3, 0].copy()
        said = [anchor.at for anchor in self.spec.anchors]
        places = np.stack([state.place for state in states])
        if said and said[0] is not None:
            at = np.array(said, np.float64)
            unit = self._unit(at, places)
            self._model, self._doubt = at * unit, self._misread.get(unit)
        elif len(states) < LEAST_ANCHORS:
            self._model = np.zeros((1, 3))
        else:
            in_camera = self.spec.coordinates == "camera"
            self._model = np.asarray(transform(invert(T_world_cam), places)) if in_camera else places
        if self._is_of_another_world(frame):
            self._doubt = ELSEWHERE
        far = self._distance(self._model)
        if far > 0:
            hint = f"is `at` in the file's units, and is scale: {self.spec.scale:g} right?"
            if not said or said[0] is None:
                hint = "the origin of its coordinates is far from it; say `at`"
                if len(states) >= LEAST_ANCHORS:
                    hint = (
                        f"are the file's coordinates those of the {self.spec.coordinates}? If not, say `at`"
                    )
            self._refused = f"it lies {1e3 * far:.3g} mm from its anchors: {hint}"

    def _is_of_another_world(self, frame: TissueFrame) -> bool:
        """Tell whether it was registered before the node was started or began a new model: the scope may
        have been elsewhere then. A recording comes to the same place with each turn, in a new epoch."""
        stated, is_live = self.spec.registration, frame.recorded_s is None
        if stated is None:
            return False
        is_anew = is_live and stated.epoch not in (None, frame.epoch)
        return is_anew or stated.session not in (None, frame.session)

    def _misreadings(self) -> dict[float, str | None]:
        """What is wrong with its `at`, for either unit (m) they may be in; computed before frames come."""
        said = [anchor.at for anchor in self.spec.anchors if anchor.at is not None]
        if self.spec.file is None or len(said) < LEAST_ANCHORS:
            return {}
        shape, at = Shape(self._body.vertices, self._body.triangles), np.array(said, np.float64)
        return {unit: misread(shape, unit * at) for unit in {1.0, self.spec.scale}}

    def _unit(self, at: F64, places: F64) -> float:
        """Metres per unit of every `at` [k, 3]; if not stated, guessed by the anchors' places [k, 3] (m)."""
        scale = 1.0 if self.spec.file is None else self.spec.scale
        if self.spec.at_units is not None or scale == 1:
            return scale if self.spec.at_units != "m" else 1.0
        if len(at) >= LEAST_ANCHORS:  # how far they are apart
            wide, there = (float(np.linalg.norm(points - points.mean(0))) for points in (at, places))
            in_metres = abs(wide - there) < abs(scale * wide - there)
        else:
            in_metres = bool(at.any()) and self._distance(at) == 0
        if in_metres:
            log.warning(
                "%s: `at` is read in metres; say at_units: m, or give the file's units", self.spec.name
            )
        return 1.0 if in_metres else scale

    def _distance(self, points: F64) -> float:
        """The distance (m) from the object to the nearest of points [k, 3]; 0: plausibly near."""
        low, high = self._body.corners
        aside = np.maximum(np.maximum(low - points, points - high), 0)
        distance = float(np.linalg.norm(aside, axis=1).min())
        return distance if distance > np.linalg.norm(high - low) + FAR else 0.0

    def _held(self, frame: TissueFrame, states: Sequence[Anchor | None]) -> tuple[F64 | None, str | None]:
        assert self._model is not None
        holding = {i: state for i, state in enumerate(states) if state is not None and state.holds}
        chosen = {i: state for i, state in holding.items() if state.depth_confidence >= LEAST}
        if len(chosen) < min(len(holding), len(states), LEAST_ANCHORS):
            return None, "the depth at its anchors is not known well enough"
        if len(states) < LEAST_ANCHORS:
            return self._on_surface(frame, list(chosen.values()))
        model = self._model[list(chosen)]
        if len(chosen) < LEAST_ANCHORS:
            few = f"{len(chosen)} of its {len(states)} anchors hold it"
            return None, f"{few}, {LEAST_ANCHORS} are needed; {AGAIN}"
        if on_a_line(model):
            return None, "the anchors that hold it lie on a line"
        weights = np.array([state.confidence * state.depth_confidence for state in chosen.values()])
        places = np.stack([state.place for state in chosen.values()])
        T, self.error = rigid_fit(model, places, weights)
        off = np.linalg.norm(transform(T, model) - places, axis=1)
        if self._bend is not None and not self._bend.ids:
            self._off = dict(zip(chosen, off.tolist(), strict=True))
        elif self._bend is not None:  # what bends afterwards is no misfit
            off = np.array([self._off.get(i, each) for i, each in zip(chosen, off, strict=True)])
        sure = model[[state.is_sure for state in chosen.values()] & (off <= MISFIT)]
        self.unsure = self._doubt
        if self.unsure is None and (len(sure) < LEAST_ANCHORS or on_a_line(sure)):
            self.unsure = UNRECOGNISED
            if off.max() > MISFIT:
                self.unsure = (
                    f"an anchor is {1e3 * off.max():.1f} mm from where its shape has it: check `at` and "
                    "scale, unless the tissue was bent"
                )
        return T, None

    def _on_surface(self, frame: TissueFrame, holding: Sequence[Anchor]) -> tuple[F64 | None, str | None]:
        assert self._model is not None
        if not holding:
            return None, f"its anchor was not recognised for too long; {AGAIN}"
        normal = surface_normal(frame, holding[0].place)
        if normal is not None and self._normal is not None:
            normal = NORMAL_MEMORY * self._normal + (1 - NORMAL_MEMORY) * normal
            normal /= np.linalg.norm(normal)
        self._normal = self._normal if normal is None else normal
        if self._normal is None:
            return None, "no surface at its anchor"
        self.unsure = None if holding[0].is_sure else UNRECOGNISED
        return on_surface(holding[0].place, self._model[0], self._normal, self._right), None


def _middle(frame: TissueFrame) -> tuple[float, float] | None:
    """The pixel (u, v) with tissue and depth nearest to the middle of the tissue."""
    rows, columns = np.nonzero(frame.tissue & np.isfinite(frame.depth))
    if len(rows) == 0:
        return None
    best = int(np.argmin(np.hypot(columns - np.median(columns), rows - np.median(rows))))
    return float(columns[best]), float(rows[best])
