"""What `sags overlay` on this machine publishes: its images, and the state of its objects."""

from collections.abc import Iterable
from pathlib import Path

import msgspec

from sags_node.messaging.received import ReceivedImage, ReceivedText, TopicName
from sags_node.messaging.subscriber import SILENT_AFTER, Subscriber
from sags_node.types import U8

NS = "overlay"  # default namespace of its topics and its connection file
EYES = {eye: TopicName(f"{eye}/overlay/image", ReceivedImage) for eye in ("left", "right")}
LEAST_HZ = 1e-3  # Hz; it is looked at now and then, so lost images are no fault
WAIT = 0.1  # s for the overlay of a frame: it takes some ms to draw


class Thing(msgspec.Struct, frozen=True):
    """An object of the overlay."""

    name: str
    reason: str | None = None  # why it is not drawn
    unsure: str | None = None  # why its place is not sure
    anchors: tuple[dict[str, float | None], ...] = ()


class Overlay(msgspec.Struct, frozen=True):
    """What the overlay says of itself, see docs/wire.md."""

    state: str = ""
    reason: str | None = None  # why it is blank
    latency_ms: dict[str, float | None] = {}
    objects: tuple[Thing, ...] = ()
    session: str | None = None  # of the node that it draws for; None: not said


class OverlayFeed:
    """Follows the overlay, which may come and go; used from one thread."""

    def __init__(self, run_dir: Path | None) -> None:
        rates: dict[str, float] = dict.fromkeys(EYES.values(), LEAST_HZ)
        self._subscriber = Subscriber(
            EYES.values(), ns=NS, run_dir=run_dir, rates=rates, paused=True, may_be_absent=True
        )

    def ask(self, eyes: Iterable[str]) -> None:
        """Let the overlay draw these eyes from now on, and no others for this viewer."""
        self._subscriber.ask(EYES[eye] for eye in eyes)

    def says(self) -> Overlay | None:
        """Return what the overlay says of itself; None: none runs, or it says nothing."""
        status = self._subscriber.latest("status")
        if not isinstance(status, ReceivedText) or status.age() > SILENT_AFTER:
            return None
        try:
            return msgspec.json.decode(status.text, type=Overlay)
        except (msgspec.MsgspecError, RecursionError):
            return None

    def pictures(self, eyes: Iterable[str], stamp_ns: int) -> dict[str, U8]:
        """Return the overlay [H, W, 4] of each eye for the frame captured at `stamp_ns`; empty: none came."""
        names, said = {eye: EYES[eye] for eye in eyes}, self.says()
        if not names or said is None or said.state != "running":
            return {}
        frame = self._subscriber.aligned(names.values(), stamp_ns, WAIT)
        return {} if frame is None else {eye: frame[name].array for eye, name in names.items()}

    def close(self) -> None:
        self._subscriber.close()
