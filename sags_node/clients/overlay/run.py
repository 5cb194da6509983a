"""`sags overlay`: virtual geometry held by anchors in the tissue, published for both eyes of a display.

It fails transparent: when anything it needs is stale, missing or lost, empty images are sent and `status`
says why. The video itself does not pass through here, so nothing here can hide it.
"""

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sags_node.clients.overlay import draw as overlay_draw
from sags_node.clients.overlay.draw import Body, Placed
from sags_node.clients.overlay.frame import CONFIDENCE, NEEDED, RIGHT_INFO, TISSUE, TissueFrame, tissue_frame
from sags_node.clients.overlay.held import HeldObject
from sags_node.clients.overlay.mesh import mesh_of
from sags_node.clients.overlay.pinner import Pinner
from sags_node.clients.overlay.proximity import INSTRUMENTS, Proximity
from sags_node.clients.overlay.save import Layers, Output
from sags_node.clients.overlay.scene import SceneSpec, built_in, read_scene
from sags_node.clients.overlay.stream import OverlayStream
from sags_node.errors import SagsError, UsageError
from sags_node.findings import OF_THE_FLOW, STAGES
from sags_node.messaging.address import THE_NODE, NodeAddress
from sags_node.messaging.control import ControlClient
from sags_node.messaging.freezes import Freezes
from sags_node.messaging.node_clock import NodeClock
from sags_node.messaging.received import Received, ReceivedImage, ReceivedText, TopicName
from sags_node.messaging.rundir import NoNodeError
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.topics import NO_RIGHT_EYE
from sags_node.types import F32, U8

log = logging.getLogger(__name__)

PICTURE = TopicName("left/image_rect_color", ReceivedImage)
MAX_AGE = 0.5  # s since capture; an older overlay is taken away
WAIT_FOR_FRAME = 0.05  # s; also how soon a stale image is noticed
WAIT_FOR_REST = 0.05  # s for what belongs to the frame
PATIENCE = 5.0  # s for the very first frame, before it is said that none comes
UNSEEN = "nothing of it is in sight: beyond the image, or behind an instrument"
REMEMBERED = 54_000  # durations: half an hour at 30 Hz
RECENT = 300  # durations that the figures in `status` are of


@dataclass(frozen=True, slots=True)
class OverlayOptions:
    """How `sags overlay` runs; the defaults are those of the command."""

    node: NodeAddress = THE_NODE  # an endpoint needs its `control`, too; `run_dir` is also the overlay's
    own_ns: str = "overlay"
    scene: Path | None = None
    pin: tuple[float, float] | None = None  # u v, of the built-in shape; default: middle of the tissue
    shape: str = "target"
    seconds: float | None = None  # default: until Ctrl-C
    save: Path | None = None  # .mp4 for every image, .png for the last one with the overlay
    layers: Path | None = None  # the file of `Layers`
    force: bool = False  # it may replace a file
    max_age: float = MAX_AGE
    repin: bool = False
    show_latency: bool = False
    ahead: float | str = 0.0  # ms, or auto


def run_overlay(options: OverlayOptions, tell: Callable[[str], object] = log.warning) -> dict[str, Any]:
    """Publish an overlay of a node until its time is over or Ctrl-C. The node may be started later.

    Args:
        tell: called with what it waits for.

    Returns:
        frames, overlay (frames in which something of it was seen), blanked (reason -> frames without),
        latency_ms (capture to published) and draw_ms (p50, p90, p99), freezes (count, seconds; see
        `Freezes`), objects (see `HeldObject.status`), lost (messages), endpoints, saved (the file; None when
        too little was shown to write one).

    Raises:
        UsageError: a wrong scene, mesh, pin or kind of file.
        SagsError: no frame came until its time was over, the node refuses this client or has no control
            socket, an endpoint is malformed, or the file cannot be written.
    """
    if options.scene is not None and options.pin is not None:
        raise UsageError("--pin is for the built-in target; a scene file says where its objects are pinned")
    if options.node.endpoint is not None and options.node.control is None:
        raise UsageError("--endpoint needs --control, the node's control socket: anchors are asked for there")
    output = Output(options.save, options.force)
    layers = None if options.layers is None else Layers(options.layers, options.force)
    scene = built_in(options.pin, options.shape) if options.scene is None else read_scene(options.scene)
    overlay_draw.warm_up()
    bodies = [Body(mesh_of(spec), spec.opacity, spec.label) for spec in scene.objects]
    is_elsewhere = options.node.endpoint is not None
    with (
        OverlayStream(options.own_ns, options.node.run_dir, scene.color_key) as stream,
        NodeClock.at(options.node) if is_elsewhere else nullcontext() as clock,
    ):
        overlay = _Overlay(options, scene, bodies, stream, clock, output, layers, tell)
        try:
            overlay.run()
        except KeyboardInterrupt:
            pass
        finally:
            overlay.close()
        return overlay.summary()


class _Overlay:
    def __init__(
        self,
        options: OverlayOptions,
        scene: SceneSpec,
        bodies: Sequence[Body],
        stream: OverlayStream,
        clock: NodeClock | None,  # of a node that may be on another machine
        output: Output,
        layers: Layers | None,
        tell: Callable[[str], object],
    ) -> None:
        self._options, self._clock = options, clock
        # A mask comes with every frame, also while the camera is lost, and never before the image.
        self._leading = NEEDED[0] if options.save is None else TISSUE
        wanted: list[str] = [*NEEDED, CONFIDENCE, RIGHT_INFO, *([] if options.save is None else [PICTURE])]
        wanted += [INSTRUMENTS] if scene.asks_for_instruments else []
        self._node = Subscriber.at(options.node, wanted, clock=clock, may_be_absent=True)
        self._stream, self._output, self._layers, self._tell = stream, output, layers, tell
        self._waiting_because = ""
        self._pinner = Pinner(partial(ControlClient.at, options.node))
        self._worker = ThreadPoolExecutor(1, "sags-measure")
        called = ["pin" if options.scene is None else f"{spec.name}: pixel" for spec in scene.objects]
        self._objects = [
            HeldObject(spec, name, self._pinner, options.repin, options.ahead, body, self._worker)
            for spec, name, body in zip(scene.objects, called, bodies, strict=True)
        ]
        self._proximity = Proximity(scene, bodies) if scene.asks_for_instruments else None
        self._source: tuple[str, int] | None = None  # session and epoch of the node
        self._epoch = -1  # of what is published: grows with every new `_source`
        self._right = "nothing received yet"  # why there is no right eye
        self._frames = 0
        self._blanked: Counter[str] = Counter()
        self._latency_ms = Durations()
        self._draw_ms = Durations()
        self._freezes = Freezes()  # of what is not blank

    def run(self) -> None:
        """Draw every frame that comes.

        Raises:
            UsageError: a pixel lies outside the image, or the node's keys do not fit.
            SagsError: no frame came, or the node refuses this client or has no control socket.
        """
        seconds = self._options.seconds
        end = math.inf if seconds is None else time.monotonic() + seconds
        patient_until = time.monotonic() + PATIENCE
        last: Received | None = None
        while time.monotonic() < end:
            self._stream.serve()
            received = self._node.wait(self._leading, WAIT_FOR_FRAME, after=last)
            if received is not None:
                if last is None:  # a node without a control socket: better said now than never
                    with suppress(NoNodeError):  # it has ended since, and may come again
                        self._options.node.control_socket()
                last = received
                self._take(received)
            elif last is None and self._node.absent is not None:
                self._say_waiting(self._node.absent)
                patient_until = time.monotonic() + PATIENCE
            elif last is None and not self._node.endpoint and self._node.refusal is not None:
                raise UsageError(self._node.refusal)
            elif last is None and time.monotonic() > patient_until:
                if self._node.refusal is not None:
                    break
                self._say_waiting(self._silence)
            self._look_at_the_clock()
            self._stream.tell(self._facts())
        if last is None:
            raise SagsError(self._node.refusal or self._node.absent or self._silence)

    def _say_waiting(self, why: str) -> None:
        """Tell what it waits for once, and again when the reason changes."""
        if why != self._waiting_because:
            self._waiting_because = why
            self._tell(f"waiting (Ctrl-C ends): {why}")

    @property
    def _silence(self) -> str:
        return f"no frame came from {self._node.endpoint}; is the node running and not waiting?"

    def close(self) -> None:
        """Leave nothing standing: neither the last overlay nor anchors in the node."""
        self._node.close()  # what has come stays readable
        self._stream.blank("the overlay was stopped")
        self._stream.tell(self._facts())
        self._pinner.close()
        self._worker.shutdown(cancel_futures=True)
        try:
            if self._layers is not None:
                self._layers.close()
        finally:
            self._output.close()

    def summary(self) -> dict[str, Any]:
        """See `run_overlay`."""
        lost = [self._node.lost(name) for name in NEEDED if self._node.latest(name) is not None]
        return {
            **self._figures(),
            "lost": sum(lost),
            "endpoints": self._stream.endpoints,
            "saved": self._output.saved,
        }

    # ---- one frame -----------------------------------------------------------------------------------------

    def _take(self, leading: Received) -> None:
        """Show the overlay of one frame. If there is none, or nothing of it is visible, count why."""
        rgba, reason = self._overlay(leading.stamp_ns)
        self._frames += 1  # once it is known what became of it: Ctrl-C may come in between
        if reason is not None:
            self._blanked[reason] += 1
        if self._layers is not None:
            self._layers.add(leading.meta.frame_id, rgba)
        if self._options.save is None:
            return
        came = self._node.aligned([PICTURE], leading.stamp_ns, WAIT_FOR_REST)
        if came is not None:
            picture = came[PICTURE].array
            if rgba is None and self._stream.reason is not None:
                rgba = self._stream.notice((picture.shape[0], picture.shape[1]))
            shown = picture if rgba is None else overlay_draw.over(picture, rgba)
            self._output.add(shown, reason is None, leading.stamp_ns)

    def _overlay(self, stamp_ns: int) -> tuple[U8 | None, str | None]:
        """Publish a frame's overlay; return that of the left eye, and why nothing of it is visible."""
        messages = self._node.aligned(NEEDED, stamp_ns, WAIT_FOR_REST)
        if (stale := self._stale()) is not None:
            self._stream.blank(stale)
            return None, stale
        confidence = self._node.aligned([CONFIDENCE], stamp_ns)
        given = self._node.latest(CONFIDENCE) is not None  # else this node or recording has none
        frame = None
        if messages is not None and (confidence is not None or not given):
            sure = None if confidence is None else confidence[CONFIDENCE]
            frame = tissue_frame(messages, self._right_info(), sure)
        if frame is None:  # the next one may be whole; if not, the clock takes the overlay away
            return None, "incomplete frame"
        if (frame.session, frame.epoch) != self._source:
            self._source, self._epoch = (frame.session, frame.epoch), self._epoch + 1
        every = [held.placed(frame) for held in self._objects]
        placed = [put for put in every if put is not None]
        if self._proximity is not None:
            self._look_for_tips(self._proximity, frame, every)
            placed = self._proximity.shown(frame, every) if placed else []
        if not placed:
            reason = self._objects[0].reason or "nothing to draw"
            self._stream.blank(reason, (frame.camera.height, frame.camera.width))
            return None, reason
        return self._show(frame, placed)

    def _look_for_tips(
        self, proximity: Proximity, frame: TissueFrame, placed: Sequence[Placed | None]
    ) -> None:
        said = None if (problem := self._node.problem(INSTRUMENTS)) else self._node.latest(INSTRUMENTS)
        if said is None:
            proximity.reason = f"no instruments: {problem}"
        elif (rows := proximity.look(said, frame, placed)) is not None:
            self._stream.tell_proximity(rows, said.meta.frame_id, said.stamp_ns, self._epoch)

    def _show(self, frame: TissueFrame, placed: Sequence[Placed]) -> tuple[U8, str | None]:
        began = time.perf_counter()
        warnings = {
            code: said for code, said in self._warnings.items() if STAGES.get(code) not in OF_THE_FLOW
        }
        if self._proximity is not None and self._proximity.reason is not None:
            warnings["proximity"] = f"no distances of instruments: {self._proximity.reason}"
        pictures = {"left": overlay_draw.draw(frame, placed)}
        is_seen = cv2.hasNonZero(cv2.extractChannel(pictures["left"], 3))
        overlay_draw.annotate(pictures["left"], frame, 0.0, self._note(), warnings)
        if frame.baseline is not None and self._stream.wants("right"):
            pictures["right"] = overlay_draw.draw(frame, placed, frame.baseline, warnings=warnings)
        ahead = max(held.ahead_s for held in self._objects)
        self._stream.show(pictures, frame.frame_id, frame.stamp_ns, self._epoch, round(ahead * 1e9))
        self._draw_ms.add(1e3 * (time.perf_counter() - began))
        self._freezes.add(time.monotonic())
        self._latency_ms.add(1e-6 * (self._node.now_ns() - frame.stamp_ns))
        return pictures["left"], None if is_seen else UNSEEN

    def _right_info(self) -> Any:
        problem = self._node.problem(RIGHT_INFO)
        self._right = "" if problem is None else f"no right/camera_info ({problem}): {NO_RIGHT_EYE}"
        return self._node.latest(RIGHT_INFO) if problem is None else None

    # ---- what is not right ---------------------------------------------------------------------------------

    def _stale(self) -> str | None:
        """Why what is needed may not be shown as new any more; None: it may."""
        if self._clock is not None and self._clock.problem is not None:
            return "the node's clock is not known"
        for name in NEEDED:
            if self._node.problem(name, self._options.max_age) is not None:
                return f"stale {name}"
        return None

    def _look_at_the_clock(self) -> None:
        """Take the overlay away when what it shows has become too old."""
        shown_ns = self._stream.shown_ns
        if shown_ns is None:
            stale = self._stale() if self._source is not None else None  # before, nothing could be
            self._stream.blank(stale or self._stream.reason or "waiting for the node")
        elif max((self._node.now_ns() - shown_ns) * 1e-9, self._stream.shown_for) > self._options.max_age:
            self._stream.blank(self._stale() or "no whole frame came")

    # ---- what is said --------------------------------------------------------------------------------------

    def _figures(self, recent: int = REMEMBERED) -> dict[str, Any]:
        """Return what was shown; durations of the newest `recent` frames, or of all."""
        return {
            "frames": self._frames,
            "overlay": self._frames - self._blanked.total(),
            "blanked": dict(self._blanked),
            "latency_ms": self._latency_ms.percentiles(recent),
            "draw_ms": self._draw_ms.percentiles(recent),
            "freezes": self._freezes.status(),
            "objects": [held.status() for held in self._objects],
            **({} if self._proximity is None else {"proximity": self._proximity.status(self._node.now_ns())}),
        }

    def _facts(self) -> dict[str, Any]:
        return {
            **self._figures(RECENT),
            "max_age": self._options.max_age,
            "session": None if self._source is None else self._source[0],
            "clock": None if self._clock is None else self._clock.status(),
            "no_right_eye": self._right or None,
            "warning_codes": self._warnings,
        }

    @property
    def _warnings(self) -> dict[str, str]:
        """The node's latest warnings, by code."""
        status = self._node.latest("status")
        return status.warnings() if isinstance(status, ReceivedText) else {}

    def _note(self) -> str:
        recent = self._latency_ms.last(RECENT)
        if not self._options.show_latency or not len(recent):
            return ""
        p50, p99 = np.percentile(recent, (50, 99))
        return f"{recent[-1]:.0f} ms (p50 {p50:.0f}, p99 {p99:.0f})"


class Durations:
    """The newest half hour of one duration, milliseconds, in memory that never grows."""

    def __init__(self) -> None:
        self._ms = np.full(REMEMBERED, np.nan, np.float32)  # written once, so that its memory is allocated
        self._count = 0

    def add(self, ms: float) -> None:
        """Remember it in the place of the oldest."""
        self._ms[self._count % REMEMBERED] = ms
        self._count += 1

    def last(self, count: int = REMEMBERED) -> F32:
        """The newest `count` [N <= count], the newest last."""
        known = min(count, self._count, REMEMBERED)
        return self._ms[np.arange(self._count - known, self._count) % REMEMBERED]

    def percentiles(self, count: int = REMEMBERED) -> dict[str, float | None]:
        """p50, p90 and p99 of the newest `count`; None before there is one."""
        values = self.last(count)
        known = len(values) > 0
        return {f"p{q}": round(float(np.percentile(values, q)), 2) if known else None for q in (50, 90, 99)}
