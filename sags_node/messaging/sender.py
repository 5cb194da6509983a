"""Send images and poses to a node, from a simulator or any program that has them.

with FrameSender() as sender:
    sender.send(left, right)  # [H, W, 3] uint8 RGB

The node must have `source.kind: push`; for poses `robot.kind: push`.
"""

import logging
import time
import uuid
from collections import Counter
from typing import Any, Literal

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray

from sags_node.errors import SagsError
from sags_node.geometry import is_rigid
from sags_node.messaging import cdr
from sags_node.messaging.address import Address, ClientKeys, connect
from sags_node.messaging.cdr import Content
from sags_node.messaging.sockets import Closes
from sags_node.messaging.wire import Message, Meta, Receipt, encode
from sags_node.types import F64

log = logging.getLogger(__name__)

Picture = NDArray[Any] | bytes  # [H, W] or [H, W, C] uint8; or the bytes of a JPEG or PNG file
MAX_RECEIPT_BYTES = 1 << 16
CONNECT_MS = 500  # longest wait for the node when a sender is made, so that the first image is not left out
SILENT = 3.0  # s without a receipt, after which no node is there; one comes each second


class Sender(Closes):
    """Sends to a node without ever waiting: what does not fit into the queue is left out and counted.

    Used from one thread. A node that was away or restarted gets what is sent after it is back. Only the
    constructor waits for it, up to `CONNECT_MS`.

    Attributes:
        receipt: the last one of the node; None before the first, which comes after a second.
        left_out: messages that did not fit.

    Args:
        endpoint: of the node.
        ns: namespace of the topics.
        keys: for a node that wants them.

    Raises:
        SagsError: the endpoint is malformed.
    """

    _queued: int  # messages that may wait for the network
    _key: str  # of the launch file, which must be `push` for the node to take what is sent

    def __init__(self, endpoint: str, ns: str, keys: ClientKeys | None) -> None:
        self.receipt: Receipt | None = None
        self.left_out = 0
        self._ns = ns
        self._endpoint = endpoint
        self._session = uuid.uuid4().hex
        self._seq: Counter[str] = Counter()
        self._said: str | None = None
        self._unanswered: float | None = None  # s, monotonic: since when no receipt has come
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.SNDHWM, self._queued)
        self._socket.setsockopt(zmq.IMMEDIATE, 1)  # queue nothing for an absent node: it would be late
        try:
            self._watch = connect(self._socket, Address(endpoint, keys), MAX_RECEIPT_BYTES)
        except SagsError:
            self.close()
            raise
        self._socket.poll(CONNECT_MS, zmq.POLLOUT)

    @property
    def problem(self) -> str | None:
        """The node's objection to what is sent, or that no node is there; None: all is well."""
        self._listen()
        if (refusal := self._watch.refusal()) is not None:
            return refusal
        if self._unanswered is not None and time.monotonic() - self._unanswered > SILENT:
            return f"no answer from {self._endpoint}: does a node with {self._key}:=push run there?"
        return None if self.receipt is None else self.receipt.problem

    def _send(self, name: str, body: Content, stamp_ns: int) -> bool:
        self._seq[name] += 1
        meta = Meta(
            type=body.type, type_hash=cdr.type_hash(body.type), seq=self._seq[name], frame_id=self._seq[name],
            stamp_ns=stamp_ns, publish_ns=time.time_ns(), session=self._session, epoch=0, step=0,
            encoding=body.encoding, shape=list(body.shape), dtype=body.dtype, dropped=self.left_out,
        )  # fmt: skip
        self._complain()
        if self._unanswered is None:
            self._unanswered = time.monotonic()
        try:
            # Copied: whoever sends may draw the next image into the same memory.
            self._socket.send_multipart(encode(Message(f"{self._ns}/{name}", meta, body.parts)), zmq.NOBLOCK)
        except zmq.Again:
            self.left_out += 1
            return False
        return True

    def _listen(self) -> None:
        while self._socket.poll(0):
            try:
                self.receipt = msgspec.msgpack.decode(self._socket.recv(), type=Receipt)
            except msgspec.MsgspecError:
                continue
            self._unanswered = None

    def _complain(self) -> None:
        """Log each problem once, when it begins."""
        problem = self.problem
        if problem is not None and problem != self._said:
            log.warning("%s: %s", self._endpoint, problem)
        self._said = problem

    def close(self) -> None:
        self._context.destroy(linger=0)


class FrameSender(Sender):
    """Hands images in to a node with `source.kind: push`, at its `source.endpoint`; see `Sender`."""

    _queued = 4  # two pairs: a slow node gets new images, not old ones
    _key = "source.kind"

    def __init__(
        self, endpoint: str = "tcp://127.0.0.1:5558", ns: str = "camera", keys: ClientKeys | None = None
    ) -> None:
        super().__init__(endpoint, ns, keys)

    def send(
        self, left: Picture, right: Picture, stamp_ns: int | None = None, encoding: str | None = None
    ) -> bool:
        """Send both eyes' images of one moment; return False when one of them was left out.

        Args:
            stamp_ns: when they were taken, wall clock (`time.time_ns`); default: now.
            encoding: of arrays, one of `cdr.IMAGE_ENCODINGS`; default: by the channels mono8, rgb8 or rgba8.

        Raises:
            ValueError: an array is not uint8 [H, W] or [H, W, C], or does not fit the encoding.
        """
        stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
        went = [self.send_eye("left", left, stamp_ns, encoding)]
        went.append(self.send_eye("right", right, stamp_ns, encoding))
        return all(went)

    def send_eye(
        self, eye: Literal["left", "right"], picture: Picture, stamp_ns: int, encoding: str | None = None
    ) -> bool:
        """Send one eye's image, where each eye has its own program. Their stamps say which form a pair."""
        return self._send_picture(eye, picture, stamp_ns, encoding)

    def send_side_by_side(
        self, picture: Picture, stamp_ns: int | None = None, encoding: str | None = None
    ) -> bool:
        """Send one image of both eyes, the left one in its left half; see `send`."""
        return self._send_picture("stereo", picture, stamp_ns, encoding)

    def _send_picture(self, whose: str, picture: Picture, stamp_ns: int | None, encoding: str | None) -> bool:
        stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
        frame = cdr.RIGHT_FRAME if whose == "right" else cdr.LEFT_FRAME
        if isinstance(picture, bytes):
            return self._send(
                f"{whose}/image_raw/compressed", cdr.picture_file(picture, stamp_ns, frame), stamp_ns
            )
        encoding = encoding or _usual_encoding(picture)
        fits = cdr.IMAGE_ENCODINGS.get(encoding)
        shape = picture.shape[2:] or (1,)
        if fits is None or picture.dtype != fits[0] or shape != (fits[1],):
            raise ValueError(f"an image {picture.shape} of {picture.dtype} is not {encoding}")
        return self._send(f"{whose}/image_raw", cdr.image(picture, encoding, stamp_ns, frame), stamp_ns)


class PoseSender(Sender):
    """Hands poses in to a node with `robot.kind: push`, at its `robot.endpoint`; see `Sender`."""

    _queued = 1000  # poses are small, and each of them counts
    _key = "robot.kind"

    def __init__(
        self, endpoint: str = "tcp://127.0.0.1:5559", ns: str = "robot", keys: ClientKeys | None = None
    ) -> None:
        super().__init__(endpoint, ns, keys)

    def send(self, T_base_hand: F64, stamp_ns: int | None = None, topic: str = "pose") -> bool:
        """Send the pose [4, 4] (m), at one moment, of the robot's part that carries the camera.

        Args:
            stamp_ns: wall clock (`time.time_ns`); default: now.
            topic: default: the camera's; that of one of the node's `robot.tools` sends the pose of its tip.

        Raises:
            ValueError: it is no rotation and translation; the quaternion on the wire would hide that.
        """
        T = np.asarray(T_base_hand, np.float64)
        if not is_rigid(T):
            raise ValueError(
                f"T_base_hand {T.shape} is no rotation and translation (m) above a last row 0 0 0 1, [4, 4]: "
                "is it transposed, mirrored (of an engine with left-handed axes) or scaled?"
            )
        stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
        return self._send(topic.lstrip("/"), cdr.pose(T, stamp_ns), stamp_ns)


def _usual_encoding(picture: NDArray[Any]) -> str:
    return {2: "mono8", 3: {3: "rgb8", 4: "rgba8"}.get(picture.shape[-1], "")}.get(picture.ndim, "")
