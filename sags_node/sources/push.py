"""Live stereo that another program pushes over ZeroMQ: a simulator, a game engine, a capture program."""

from functools import partial

import cv2

from sags_node.bags.pictures import ENCODINGS, decode_picture
from sags_node.config.schema import PushSource
from sags_node.errors import SagsError
from sags_node.messaging.cdr import COMPRESSED
from sags_node.messaging.inbox import Inbox
from sags_node.messaging.topics import IMAGE
from sags_node.messaging.wire import Message, WireError
from sags_node.sources.sent import SentPictures
from sags_node.types import U8, Finding

NEWEST = 2  # images of each eye that may wait; older ones will not be shown


class PushedPictures(SentPictures):
    """A `Source` of live stereo frames that other programs push.

    Args:
        size: width and height that images must have, px; None: those of the first.

    Raises:
        UsageError, SagsError: see `Inbox`.
    """

    def __init__(self, config: PushSource, size: tuple[int, int] | None = None) -> None:
        super().__init__(config, size)
        self._inbox = Inbox(config.endpoint, config, "source", self._take_in, self.slowness, NEWEST, _eyes_of)
        self.endpoint = self._inbox.endpoint

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what is wrong with the sender, and how to fix it. Thread-safe."""
        return self._inbox.findings

    def close(self) -> None:
        self._inbox.close()

    def _take_in(self, message: Message, arrival_ns: int) -> None:
        eye, last = _eye_and_kind(message)
        stamp_ns = message.meta.stamp_ns
        if last == "image_raw" and eye in ("left", "right"):
            self.put("left" if eye == "left" else "right", stamp_ns, arrival_ns, partial(_picture, message))
        elif last == "image_raw" and eye == "stereo":
            self.put_both(stamp_ns, arrival_ns, partial(_picture, message))
        else:
            raise SagsError(
                f"topic {message.topic}: images come on NAME/left/image_raw, NAME/right/image_raw or "
                "NAME/stereo/image_raw, files of images with /compressed behind"
            )


def _eye_and_kind(message: Message) -> tuple[str, str]:
    whose, _, last = message.topic.removesuffix("/compressed").rpartition("/")
    return whose.rpartition("/")[2], last


def _eyes_of(message: Message) -> list[str]:
    """The names of the eyes whose images a message holds."""
    eye = _eye_and_kind(message)[0]
    return [f"the {one} eye's images" for one in ("left", "right") if eye in (one, "stereo")]


def _picture(message: Message) -> U8:
    """The image, RGB [H, W, 3]; a view of the received memory if that holds RGB.

    Raises:
        SagsError: the message is damaged, or its encoding is not supported.
    """
    meta, where = message.meta, message.topic
    if meta.type == COMPRESSED:
        return decode_picture(message.cdr(), COMPRESSED, where)
    encoding = ENCODINGS.get(meta.encoding)
    if meta.type != IMAGE or encoding is None:
        known = ", ".join(ENCODINGS)
        raise WireError(f"{where}: {meta.type} of {meta.encoding!r} is not read; known encodings: {known}")
    channels = meta.shape[2:] or [1]
    if meta.dtype != "uint8" or len(meta.shape) < 2 or channels != [encoding.bytes_per_pixel]:
        raise WireError(f"{where}: {meta.encoding} does not fit {meta.dtype} {meta.shape}")
    picture: U8 = message.array()
    try:
        return picture if encoding.to_rgb is None else cv2.cvtColor(picture, encoding.to_rgb)
    except cv2.error:
        raise WireError(f"{where}: {meta.shape} cannot be {meta.encoding}") from None
