"""A node and a client as two machines: network namespaces of their own, and clocks that are 80 ms apart."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

NODE, CLIENT = "sags-test-node", "sags-test-client"  # network namespaces
ADDRESS = "10.77.0.1"
AHEAD = 0.08  # s
SENDS = f"""
import sys
from pathlib import Path
from synthetic import publisher, stream
data, control = "tcp://{ADDRESS}:5556", "tcp://{ADDRESS}:5557"
with publisher(Path(sys.argv[1]), data=(data,), control=control, insecure=True) as running, stream(running):
    print("ready", flush=True)
    sys.stdin.read()
"""
ASKS = f"""
import json, time
from sags_node.client import NodeClock, Subscriber
data, control, name = "tcp://{ADDRESS}:5556", "tcp://{ADDRESS}:5557", "left/render/depth"
with NodeClock(control) as clock, Subscriber([name], data, clock=clock) as subscriber:
    end = time.monotonic() + 60
    while not (clock.offset and clock.offset.bound < 1e-3 and subscriber.ok(name)) and time.monotonic() < end:
        time.sleep(0.01)
    newest = subscriber.latest(name)
    ages = newest.age(), newest.age(subscriber.now_ns()), newest.age()
    print(json.dumps({{**clock.status(), "problem": subscriber.problem(name), "ages": ages}}))
"""


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, timeout=10, capture_output=True)


def can_make_machines() -> bool:
    tools = all(shutil.which(tool) for tool in ("ip", "faketime"))
    if not tools or os.geteuid() != 0:
        return False
    made = subprocess.run(["ip", "netns", "add", NODE], check=False, timeout=10, capture_output=True)
    if made.returncode == 0:
        ip("netns", "del", NODE)
    return made.returncode == 0


@pytest.fixture
def machines() -> Iterator[None]:
    if not can_make_machines():
        pytest.skip("needs root, network namespaces, and Debian's iproute2 and faketime")
    for name in (NODE, CLIENT):
        ip("netns", "add", name)
    try:
        ip("link", "add", "node", "netns", NODE, "type", "veth", "peer", "name", "client", "netns", CLIENT)
        for name, link, address in ((NODE, "node", ADDRESS), (CLIENT, "client", "10.77.0.2")):
            ip("-n", name, "addr", "add", f"{address}/24", "dev", link)
            ip("-n", name, "link", "set", link, "up")
        yield
    finally:
        for name in (NODE, CLIENT):
            ip("netns", "del", name)


def test_ages_are_right_between_machines_whose_clocks_differ(machines: None, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
    on_node = ["ip", "netns", "exec", NODE, "faketime", "-f", f"+{AHEAD}s", sys.executable, "-c", SENDS]
    on_client = ["ip", "netns", "exec", CLIENT, sys.executable, "-c", ASKS]
    node = subprocess.Popen(
        [*on_node, str(tmp_path / "run")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
    )
    try:
        assert node.stdout is not None and node.stdout.readline() == b"ready\n"
        began = time.monotonic()
        asked = subprocess.run(on_client, env=environment, timeout=120, capture_output=True, check=True)
        took = time.monotonic() - began
    finally:
        node.communicate(timeout=60)
    said = json.loads(asked.stdout)
    bound = said["bound_ms"]
    assert said["problem"] is None and bound < 1
    assert abs(said["offset_ms"] - 1e3 * AHEAD) <= bound
    own_before, by_node, own_after = said["ages"]  # asked for one after the other
    assert 0 <= by_node < took
    off = 2e-3 * bound
    assert own_before + AHEAD - off <= by_node <= own_after + AHEAD + off
