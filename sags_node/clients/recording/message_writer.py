"""From messages of the wire to a bag: topics, compressed images; calibration and parameters attached."""

from pathlib import Path
from typing import Literal

import cv2
import msgspec
from mcap.records import Schema

from sags_node import __version__
from sags_node.bags.bag import AHEAD, RECORDED, RELATIVE
from sags_node.bags.camera_info import read_eye
from sags_node.bags.pictures import encode_file
from sags_node.clients.recording.backlog import Arrived
from sags_node.clients.recording.bag_writer import NO_LIMITS, BagWriter, Limits
from sags_node.errors import SagsError
from sags_node.media.picture_file import PNG
from sags_node.messaging import cdr, topics
from sags_node.messaging.received import told_in_ros
from sags_node.messaging.topics import CAMERA_INFO, IMAGE
from sags_node.messaging.wire import PROTOCOL, Message, WireError
from sags_node.rig import eye_text

Compression = Literal["none", "jpeg", "png"]
JPEG_QUALITY = 92
AHEAD_STEP_MS = 10  # to which a bag rounds how far ahead a prediction is: each value is a channel
_COMPRESSIBLE = ("rgb8", "rgba8", "mono8")


def is_latched(name: str, ns: str) -> bool:
    """Tell whether late subscribers of a node `ns` get the last message of a topic, too."""
    known = topics.BY_NAME.get(name.removeprefix(f"{ns}/"))
    return known is not None and known.cached


class MessageWriter:
    """Writes messages as they came into a new bag.

    Args:
        compression: of 8-bit images. `jpeg` takes colour images only: alpha, masks and what lies on a key
            colour must stay exact and become PNG. Depth is never compressed.
        limits: of each file in the bag.

    Raises:
        UsageError: something is at `folder` already.
        SagsError: it cannot be written.
    """

    def __init__(self, folder: Path, ns: str, compression: Compression, limits: Limits = NO_LIMITS) -> None:
        self.bag = BagWriter(folder, limits)
        self._ns = ns
        self._compression = compression
        self._channels: dict[tuple[object, ...], int] = {}  # topic, type, marks
        self._attached: set[str] = set()
        self._source: tuple[str, int] | None = None  # session and epoch of the node

    def write(self, arrived: Arrived) -> None:
        """Write one message.

        Raises:
            WireError: its content does not match its header.
        """
        message, meta = arrived.message, arrived.message.meta
        if (meta.session, meta.epoch) != self._source:
            self._source = meta.session, meta.epoch
            said = {"session": meta.session, "epoch": str(meta.epoch), "protocol": PROTOCOL}
            self.bag.note(RECORDED, {**said, "ns": self._ns, "version": __version__})
        relative = meta.units is not msgspec.UNSET
        if not (relative and meta.type == CAMERA_INFO):
            self._attach(arrived)
        name, kind, data = message.topic, meta.type, told_in_ros(meta, b"".join(message.parts))
        if self._compression != "none" and kind == IMAGE and meta.encoding in _COMPRESSIBLE:
            lossy = (
                self._compression == "jpeg" and meta.encoding == "rgb8" and not name.endswith("/color_key")
            )
            form = "jpeg" if lossy else "png"
            name, kind, data = f"{name}/compressed", cdr.COMPRESSED, _compressed(message, data, form)
        marks = dict(RELATIVE) if relative else {}  # the node may be another one, calibrated by now
        if meta.ahead_ns:
            marks[AHEAD] = str(-(-meta.ahead_ns // (AHEAD_STEP_MS * 1_000_000)) * AHEAD_STEP_MS)  # rounded up
        key = name, kind, *marks.items()
        if key not in self._channels:
            self._channels[key] = self._announce(name, kind, marks)
        self.bag.write(self._channels[key], arrived.received_ns, meta.stamp_ns, meta.seq, data)

    def _announce(self, name: str, kind: str, marks: dict[str, str]) -> int:
        schema = Schema(id=0, name=kind, encoding="ros2msg", data=cdr.definition(kind).encode())
        latched = is_latched(name, self._ns)
        return self.bag.add_topic(f"/{name}", kind, schema, cdr.type_hash(kind), latched, marks)

    def _attach(self, arrived: Arrived) -> None:
        """Calibration and parameters lie in the file as files too, for people who open it years later."""
        topic, message = arrived.message.topic, arrived.message
        if topic in self._attached:
            return
        if topic.endswith("/parameters"):
            text = cdr.parse(message).data.encode()
            self.bag.attach("parameters.json", "application/json", text, arrived.received_ns)
        elif message.meta.type == CAMERA_INFO and topic.removeprefix(f"{self._ns}/") in topics.BY_NAME:
            side, eye = topic.split("/")[-2], read_eye(message.cdr(), topic)
            if eye is not None:  # else there is none to keep
                text = eye_text(eye, side).encode()
                self.bag.attach(f"calib/{side}.yaml", "application/yaml", text, arrived.received_ns)
        else:
            return
        self._attached.add(topic)


def _compressed(message: Message, data: bytes, form: str) -> bytes:
    """The CDR of the compressed image."""
    encoding = message.meta.encoding
    options = (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY) if form == "jpeg" else PNG
    try:
        file = encode_file(message.array(), encoding, form, options)
    except SagsError as error:
        raise WireError(f"{message.topic}: {error}") from None
    header = cdr.decode(data, IMAGE).header
    return cdr.compressed_image(file, cdr.file_form(encoding, form), header)
