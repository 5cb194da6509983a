"""The API for programs that use a node: subscribers, received messages, control requests, and senders of
images and poses.

Importing it loads NumPy, ZeroMQ and the message formats, but nothing of the mapper: no Numba, torch, OpenCV
or Open3D.
"""

from sags_node.errors import SagsError
from sags_node.messaging.address import ClientKeys, client_keys
from sags_node.messaging.async_subscriber import AsyncSubscriber
from sags_node.messaging.control import ControlClient
from sags_node.messaging.freshness import StaleError
from sags_node.messaging.measure import MEASURING, Measured, measure
from sags_node.messaging.node_clock import NodeClock, Offset
from sags_node.messaging.received import (
    Frame,
    Received,
    ReceivedCameraInfo,
    ReceivedCloud,
    ReceivedCompressed,
    ReceivedImage,
    ReceivedRos,
    ReceivedText,
    TopicName,
)
from sags_node.messaging.sender import FrameSender, PoseSender
from sags_node.messaging.subscriber import Subscriber

__all__ = [
    "MEASURING", "AsyncSubscriber", "ClientKeys", "ControlClient", "Frame", "FrameSender", "Measured",
    "NodeClock", "Offset", "PoseSender", "Received", "ReceivedCameraInfo", "ReceivedCloud",
    "ReceivedCompressed", "ReceivedImage", "ReceivedRos", "ReceivedText", "SagsError", "StaleError",
    "Subscriber", "TopicName", "client_keys", "measure",
]  # fmt: skip
