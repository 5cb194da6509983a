"""Reads the codes in what a screen would show of a node."""

import math
import threading
import time
from collections.abc import Callable

from sags_node.clients.latency.ledger import Moment
from sags_node.clients.latency.shown import Codes, Reader
from sags_node.clients.overlay.draw import over
from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.received import Received, ReceivedImage, TopicName
from sags_node.messaging.subscriber import KEPT, Subscriber

PICTURE = TopicName("left/image_rect_color", ReceivedImage)
OVERLAY = TopicName("left/overlay/image", ReceivedImage)
SETTLED = 2.0  # s after the first code; only later codes count, as a model has begun by then
LAST = 1.0  # s within which the last code must be seen
LOOK = 0.1  # s, the longest wait for an image
REMIND = 5.0  # s without a code until that is said, and said again
WAITING = 64  # images that are kept until their overlay comes: `LAST` at 60 Hz


def measure_latency(
    node: NodeAddress,
    overlay: NodeAddress | None,
    codes: Codes,
    seconds: float,
    tell: Callable[[str], object],
    stop: threading.Event,
) -> dict[str, object]:
    """Measure when codes come back in what a screen would show: the node's left image with its overlay.

    Args:
        overlay: where overlays come from, for which each image waits; None: images without overlay.
        seconds: how long codes count, beginning `SETTLED` after the first one that is seen.
        tell: called with what it waits for.
        stop: ends it early.

    Returns:
        As `Ledger.figures`.

    Raises:
        SagsError: no code was seen until it was stopped. That node and overlay start late is no error.
    """
    ledger, reader = codes.ledger, Reader()
    newest: Received | None = None
    since, ends_at, remind_at = None, math.inf, time.monotonic() + REMIND
    apart: str | None = None  # why an overlay that came has no image
    leading, kept = ((node, PICTURE), KEPT) if overlay is None else ((overlay, OVERLAY), WAITING)
    with (
        Subscriber.at(node, [PICTURE], kept=kept, may_be_absent=True) as pictures,
        Subscriber.at(leading[0], [leading[1]], may_be_absent=True) as subscriber,
    ):
        while not stop.is_set() and (now := time.monotonic()) < ends_at + LAST:
            due = codes.step(now < ends_at)
            came = subscriber.wait(leading[1], min(LOOK, due), after=newest)
            if since is None and now > remind_at:
                remind_at = now + REMIND
                silent = codes.problem or apart or pictures.problem(PICTURE) or subscriber.problem(leading[1])
                tell(f"waiting: {silent or 'there is no code in the images'}")
            if came is None:
                continue
            newest = came
            frame = pictures.aligned([PICTURE], came.stamp_ns, LOOK)
            if frame is None:
                blank = came.meta.frame_id < 0
                apart = "the overlay is blank" if blank else f"overlays are over {WAITING} images behind"
                continue
            apart, picture = None, frame[PICTURE]
            stamps = {"captured": picture.stamp_ns, "published": picture.meta.publish_ns}
            if overlay is not None:
                stamps["drawn"] = came.meta.publish_ns
            pixels = picture.array.copy() if overlay is None else over(picture.array, came.array)
            at = Moment.now()
            number = reader.read(pixels)
            ledger.seen(number, {**stamps, "received": max(came.received_ns, picture.received_ns)}, at)
            if number is not None and since is None:
                since, ends_at = at.later(SETTLED), now + SETTLED + seconds
    if since is None:
        raise SagsError(f"no code was seen: {codes.problem or apart or codes.hint}")
    return ledger.figures(since, Moment.now().later(-LAST))
