"""What the overlay publishes on its own socket: both eyes' images, and what it says of itself.

An image is never left standing: when nothing fresh can be drawn, an empty one is sent at once and again
every `BLANK_PERIOD`. For the first `SAID` seconds, these images say why on their lower edge.
"""

import time
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from sags_node.clients.overlay.draw import color_key
from sags_node.clients.overlay.mark import draw_lines
from sags_node.clients.overlay.proximity import FIELDS
from sags_node.config.schema import PublishConfig
from sags_node.messaging import cdr, content
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.sockets import Closes
from sags_node.messaging.topics import OVERLAY_TOPICS
from sags_node.types import F32, U8

BLANK_PERIOD = 0.5  # s between two empty images
SAID = 5.0  # s for which empty images say why
STATUS_PERIOD = 1.0  # s
EYES = {"left": cdr.LEFT_FRAME, "right": cdr.RIGHT_FRAME}


class OverlayStream(Closes):
    """The overlay's socket, in a namespace of its own: ipc, and a free port of this machine.

    Args:
        ns: of its topics and its connection file.
        key: RGB of the pixels without overlay in the `color_key` topics.

    Raises:
        SagsError: another overlay has this namespace.
    """

    def __init__(self, ns: str, run_dir: Path | None, key: tuple[int, int, int]) -> None:
        config = PublishConfig(data=("tcp://127.0.0.1:*",), control=None, run_dir=run_dir, right=True)
        self._publisher = Publisher(config, ns, uuid.uuid4().hex, offered=OVERLAY_TOPICS)
        self._key = key
        self._size: tuple[int, int] | None = None  # height and width of what was shown last
        self._blank_due = 0.0
        self._blank_since = 0.0  # since when it is blank for the same reason, monotonic s
        self._status_due = 0.0
        self._state: tuple[str, str | None, tuple[str, ...], set[tuple[int, str]]] | None = None
        self._epoch = 0
        self.reason: str | None = (
            "waiting for the node"  # why nothing is shown; None: the last image sent is an overlay
        )
        self.shown_ns: int | None = None  # capture time of the frame shown last, while it is shown
        self._shown_at = 0.0  # monotonic s

    @property
    def endpoints(self) -> list[str]:
        return self._publisher.connection.data

    @property
    def shown_for(self) -> float:
        """The seconds since the last frame was shown, by the monotonic clock."""
        return time.monotonic() - self._shown_at

    def serve(self) -> None:
        """Take note of subscribers that have come or gone."""
        self._publisher.poll(0)

    def wants(self, eye: str) -> bool:
        """Tell whether somebody looks at this eye."""
        return any(self._publisher.wanted(f"{eye}/overlay/{kind}") for kind in ("image", "color_key"))

    def show(
        self, pictures: dict[str, U8], frame_id: int, stamp_ns: int, epoch: int, ahead_ns: int = 0
    ) -> None:
        """Send the overlay [H, W, 4] of each eye that is looked at, for the frame captured at `stamp_ns`, or
        for what is expected `ahead_ns` later.

        An eye that has no image gets an empty one.
        """
        self.reason, self.shown_ns, self._epoch = None, stamp_ns, epoch
        self._shown_at = time.monotonic()
        self._size = next(iter(pictures.values())).shape[:2]
        for eye in EYES:
            if self.wants(eye):
                self._send(eye, pictures.get(eye, self._empty()), frame_id, stamp_ns, ahead_ns)

    def tell_proximity(self, rows: F32, frame_id: int, stamp_ns: int, epoch: int) -> None:
        """Send the rows [N, FIELDS] of tips that are too near or unknown, for the frame captured at
        `stamp_ns`. A message without rows is sent, too."""
        body = cdr.point_cloud(rows, FIELDS, stamp_ns)
        self._publisher.publish_content("proximity", body, frame_id, stamp_ns, epoch)

    def blank(self, reason: str, size: tuple[int, int] | None = None) -> None:
        """Show nothing, because of `reason`; to be called again and again while that is so.

        An empty image belongs to no frame: its stamp is the time at which it is sent.

        Args:
            size: height and width of the node's images, where they are known; default: as before.
        """
        new, now = self.reason is None, time.monotonic()
        if reason != self.reason:
            self._blank_since = now
        self.reason, self.shown_ns, self._size = reason, None, size or self._size
        if self._size is None or not (new or now >= self._blank_due):
            return
        self._blank_due, stamp_ns = now + BLANK_PERIOD, time.time_ns()
        for eye in EYES:
            if self.wants(eye):
                self._send(eye, self.notice(), -1, stamp_ns)

    def notice(self, size: tuple[int, int] | None = None) -> U8:
        """Return the image in place of an overlay: empty, or for `SAID` with the reason. `size`: see
        `blank`."""
        rgba, since = self._empty(size), time.monotonic() - self._blank_since
        if self.reason is not None and BLANK_PERIOD <= since < BLANK_PERIOD + SAID:
            draw_lines(rgba, [f"no overlay: {self.reason}"])
        return rgba

    def tell(self, facts: dict[str, Any]) -> None:
        """Send `status` when it is due, and at once when the state, a warning, or what is too near
        changes."""
        warned = tuple(facts.get("warning_codes", ()))
        near = {(each["instrument"], each["zone"]) for each in facts.get("proximity", {}).get("near", ())}
        state = ("running" if self.reason is None else "blank", self.reason, warned, near)
        if state == self._state and time.monotonic() < self._status_due:
            return
        self._state, self._status_due = state, time.monotonic() + STATUS_PERIOD
        said = {"state": state[0], "reason": state[1], "color_key": self._key, **facts}
        self._publisher.publish_content("status", content.json_text(said), -1, time.time_ns(), self._epoch)

    def _empty(self, size: tuple[int, int] | None = None) -> U8:
        size = size or self._size
        assert size is not None  # else nothing is sent
        return np.zeros((*size, 4), np.uint8)

    def _send(self, eye: str, rgba: U8, frame_id: int, stamp_ns: int, ahead_ns: int = 0) -> None:
        for kind, encoding in (("image", "rgba8"), ("color_key", "rgb8")):
            topic = f"{eye}/overlay/{kind}"
            if self._publisher.wanted(topic):
                picture = rgba if kind == "image" else color_key(rgba, self._key)
                body = cdr.image(picture, encoding, stamp_ns, EYES[eye])
                self._publisher.publish_content(topic, body, frame_id, stamp_ns, self._epoch, ahead_ns)

    def close(self) -> None:
        self._publisher.close()
