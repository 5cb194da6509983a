"""A ROS 2 node of rclpy's own that reads and writes topics. Runs without our package.

    python peer.py TYPE:TOPIC[:reliable|:kept] ...

Each message that comes is a JSON line: topic, stamp and arrival (ns), size, its checksum with the stamp of
its header set to zero, and its bytes where they are few. Orders come as JSON lines on stdin: `names` tells
who is in the graph, `publish` publishes.
"""

import importlib
import json
import sys
import threading
import time
import zlib

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

FEW = 4096  # bytes
HEADERLESS = "std_msgs/msg/String"


def type_of(name):
    package, _, last = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), last)


lock = threading.Lock()


def say(**fields):
    with lock:
        print(json.dumps(fields), flush=True)


def heard(topic, kind, data):
    stamp = 0
    body = bytearray(data)
    if kind != HEADERLESS:
        stamp = int.from_bytes(body[4:8], "little") * 10**9 + int.from_bytes(body[8:12], "little")
        body[4:12] = bytes(8)
    few = {"data": data.hex()} if len(data) <= FEW else {}
    say(topic=topic, stamp=stamp, size=len(data), crc=zlib.crc32(body), **few)


rclpy.init()
node = rclpy.create_node("peer")
for word in sys.argv[1:]:
    kind, topic, *how = word.split(":")
    reliable = ReliabilityPolicy.RELIABLE if how else ReliabilityPolicy.BEST_EFFORT
    kept = DurabilityPolicy.TRANSIENT_LOCAL if how == ["kept"] else DurabilityPolicy.VOLATILE
    node.create_subscription(
        type_of(kind),
        topic,
        lambda data, topic=topic, kind=kind: heard(topic, kind, data),
        QoSProfile(depth=5, reliability=reliable, durability=kept),
        raw=True,
    )
publishers = {}


def obey(order):
    if order["do"] == "names":
        topics = {}
        for topic, _ in node.get_topic_names_and_types():
            for each in node.get_publishers_info_by_topic(topic):
                topics[topic] = [
                    each.topic_type,
                    str(each.topic_type_hash),
                    each.qos_profile.reliability.name,
                ]
        say(nodes=[name for name, _ in node.get_node_names_and_namespaces()], topics=topics)
        return
    kind, topic, fields = type_of(order["type"]), order["topic"], order["fields"]
    if topic not in publishers:
        publishers[topic] = node.create_publisher(kind, topic, 10)
        deadline = time.monotonic() + 10
        while publishers[topic].get_subscription_count() == 0 and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(0.5)  # a reader knows a writer a moment later than the other way round
    message = kind()
    for path, value in fields.items():
        *outer, last = path.split(".")
        target = message
        for name in outer:
            target = getattr(target, name)
        setattr(target, last, value)
    publishers[topic].publish(message)


def listen():
    for line in sys.stdin:
        obey(json.loads(line))
    rclpy.shutdown()


say(ready=True)
threading.Thread(target=listen, daemon=True).start()
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
