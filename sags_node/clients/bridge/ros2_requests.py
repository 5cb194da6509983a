"""What peers in a ROS 2 graph ask of the node: a topic for each operation, and one for all answers.

They are topics, not services: Fast DDS, ROS 2's default, marks the answer to a service in a header that
`cyclonedds` cannot write.
"""

import json
import re
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import numpy as np

from sags_node.clients.bridge.requests import ANSWER_TIME, Requests
from sags_node.errors import SagsError
from sags_node.messaging import cdr, topics
from sags_node.messaging.topics import VIEW_NAME
from sags_node.ros.graph import Delivery, Graph, Reader, Writer

ASK = "request"  # /sags/request/OPERATION
ANSWER = "answer"  # /sags/answer
POINT, PIXEL = "geometry_msgs/msg/PointStamped", "geometry_msgs/msg/Point"
NUMBER, NOTHING = "std_msgs/msg/UInt32", "std_msgs/msg/Empty"
WAITING = Delivery(reliable=True, depth=16)  # of each kind
RECORDING_TIME = 15.0  # s; it starts and ends slowly

Args = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Ask:
    """One topic for requests."""

    op: str  # of the node
    kind: str
    args: Callable[[Any], Args] = lambda message: {}  # raises SagsError
    seconds: float = ANSWER_TIME


def asks(views: Collection[str]) -> dict[str, Ask]:
    """Return the topics for requests, by the last part of their names."""
    view = partial(_view, views=views)
    return {
        "add_anchor": Ask("add_anchor", POINT, _point),
        "add_anchor_at_pixel": Ask("add_anchor", PIXEL, lambda pixel: {"u": pixel.x, "v": pixel.y}),
        "remove_anchor": Ask("remove_anchor", NUMBER, lambda number: {"id": number.data}),
        "open_view": Ask("open_view", topics.STRING, view),
        "close_view": Ask("close_view", topics.STRING, lambda text: {"name": text.data}),
        "pause": Ask("pause", NOTHING),
        "resume": Ask("resume", NOTHING),
        "reset_model": Ask("reset_model", NOTHING),
        "start_recording": Ask("start_recording", topics.STRING, _folder, RECORDING_TIME),
        "stop_recording": Ask("stop_recording", NOTHING, seconds=RECORDING_TIME),
    }


class Inbox:
    """Reads requests, and writes the node's answers; `take` is called from one thread."""

    def __init__(
        self, graph: Graph, ns: str, views: Collection[str], requests: Requests, answers: Writer
    ) -> None:
        self._requests, self._answers = requests, answers
        self._readers: dict[str, tuple[Ask, Reader]] = {
            name: (ask, graph.reader(f"/{ns}/{ASK}/{name}", ask.kind, WAITING))
            for name, ask in asks(views).items()
        }

    def take(self) -> None:
        """Pass on what has come."""
        for name, (ask, reader) in self._readers.items():
            for data in reader.take():
                try:
                    args = ask.args(cdr.decode(data, ask.kind))
                except SagsError as error:
                    self._answer({"request": name}, None, str(error))
                else:
                    about = {"request": name, "args": args}
                    self._requests.ask(ask.op, args, partial(self._answer, about), ask.seconds)

    def _answer(self, about: Args, result: Args | None, words: str) -> None:
        """Send an answer, from any thread. All peers hear it, and find their own by what was asked."""
        said = about | ({"error": words} if result is None else {"result": result})
        self._answers.write(cdr.string(msgspec.json.encode(said).decode()).cdr(), time.time_ns())


def _point(stamped: Any) -> Args:
    if stamped.header.frame_id != cdr.WORLD_FRAME:
        raise SagsError(f"a point must be in the frame {cdr.WORLD_FRAME!r}, not {stamped.header.frame_id!r}")
    place = {axis: float(getattr(stamped.point, axis)) for axis in "xyz"}
    if not np.isfinite(list(place.values())).all():
        raise SagsError("a point must be finite")
    return place


def _view(text: Any, views: Collection[str]) -> Args:
    try:
        args = json.loads(text.data)
    except (ValueError, RecursionError):
        args = None
    if not isinstance(args, dict) or args.get("name") not in views:
        known = ", ".join(views)
        raise SagsError(
            'a view is a JSON object such as {"name": "ros"}, named as in sags bridge ros2 --view: ' + known
        )
    return args


def _folder(text: Any) -> Args:
    """The argument of `start_recording`: peers may choose a name, but no path."""
    if re.fullmatch(VIEW_NAME, text.data) is None:
        raise SagsError(f"a recording is named with letters, digits and _, not {text.data!r}")
    return {"path": text.data}
