"""`sags topic`: rates, sizes and contents of a live publisher."""

import json
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import figures_of
from made_messages import MS, meta
from synthetic import HEIGHT, WIDTH, at_frame, health, plane_result, publisher, stream
from waiting import heard, repeating, until

from sags_node.clients.overlay.draw import color_key
from sags_node.clients.overlay.stream import OverlayStream
from sags_node.errors import SagsError, UsageError
from sags_node.findings import by_stage
from sags_node.messaging import cdr, topics
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.introspection import topic_echo, topic_figures, topic_list
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.wire import Message
from sags_node.terminal.text import hz_text
from sags_node.types import Finding

pytestmark = pytest.mark.live

NOWHERE = NodeAddress(endpoint="tcp://127.0.0.1:9")
KEY = (0, 0, 255)


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeAddress]:
    with publisher(tmp_path_factory.mktemp("topic") / "run") as running:
        running.publish_parameters({"seed": 1})
        with stream(running, rate=40.0):
            yield NodeAddress(endpoint=running.connection.data[-1])


def test_figures_are_those_of_the_arrivals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four messages that come 10, 20 and 70 ms one after the other, and 5 ms after their capture."""
    came = np.cumsum([1000, 10, 20, 70])  # ms
    sizes = [500, 100, 200, 300]
    heard = [
        (Message("sags/left/depth", meta(seq, at - 5.0), (bytes(size),)), int(at * MS))
        for seq, (at, size) in enumerate(zip(came, sizes, strict=True))
    ]
    monkeypatch.setattr("sags_node.messaging.introspection.listen_to", lambda *_, **__: iter([*heard, None]))
    monkeypatch.setattr("sags_node.messaging.introspection.time.time_ns", lambda: int(1110 * MS))
    hz = topic_figures("hz", "left/depth", NOWHERE)
    assert (hz["window"], hz["freezes"]) == (4, 0)
    steps = [0.01, 0.02, 0.07]
    expected = {"average_rate": 30.0, "min_s": 0.01, "max_s": 0.07, "std_dev_s": np.std(steps)}
    assert {key: hz[key] for key in expected} == pytest.approx(expected)
    bw = topic_figures("bw", "left/depth", NOWHERE)  # the first one only starts the clock
    assert (bw["bytes_per_s"], bw["mean_bytes"]) == (pytest.approx(600 / 0.1), 275)
    delay = topic_figures("delay", "left/depth", NOWHERE)
    for key in ("min_s", "average_delay_s", "max_s"):
        assert delay[key] == pytest.approx(5e-3)
    (row,) = (row for row in topic_list(NOWHERE) if row["messages"])
    assert (row["topic"], row["rate_hz"], row["mean_bytes"]) == ("sags/left/depth", 30.0, 275)


@pytest.fixture(scope="module")
def overlay(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OverlayStream]:
    """An overlay's own socket, served on a thread: an image and `status` ten times a second."""
    run_dir = tmp_path_factory.mktemp("overlay") / "run"
    color_key(np.zeros((HEIGHT, WIDTH, 4), np.uint8), KEY)  # its kernel takes a second to load
    with OverlayStream("overlay", run_dir, KEY) as stream:

        def serve(number: int) -> None:
            time.sleep(0.1)
            stream.serve()
            picture = np.full((HEIGHT, WIDTH, 4), number % 256, np.uint8)
            stream.show({"left": picture}, number, time.time_ns(), 0)
            stream.tell({"frames": number})

        with repeating(serve):
            yield stream


def test_an_overlay_is_listed_and_measured(overlay: OverlayStream, monkeypatch: pytest.MonkeyPatch) -> None:
    """As people type it, ROS's slashes too."""
    run_dir = Path(overlay.endpoints[0].removeprefix("ipc://")).parent
    monkeypatch.setattr("sags_node.messaging.rundir.default_run_dir", lambda: run_dir)

    def listed(seconds: float) -> dict[str, Any] | None:
        found = figures_of("topic", "list", "--ns", "/overlay/", "--seconds", seconds, "--json")
        rows = {row["topic"]: row for row in found}
        return rows if rows["overlay/left/overlay/image"]["rate_hz"] else None

    rows = heard(listed, 0.5)
    assert set(rows) == {f"overlay/{topic.name}" for topic in topics.OVERLAY_TOPICS}
    assert rows["overlay/left/overlay/image"]["mean_bytes"] > 4 * WIDTH * HEIGHT
    assert all(rows[f"overlay/{name}"]["messages"] for name in ("status", "right/overlay/image"))
    assert rows["overlay/right/overlay/color_key"]["type"] == topics.IMAGE
    where = NodeAddress("overlay", overlay.endpoints[-1])
    hz, bw = (
        heard(partial(topic_figures, kind, f"left/overlay/{name}", where), 0.5)
        for kind, name in (("hz", "color_key"), ("bw", "image"))
    )
    assert hz["window"] >= 2
    assert bw["mean_bytes"] > 4 * WIDTH * HEIGHT
    (said,) = topic_echo("status", where, count=1, seconds=60)
    assert said["content"]["state"] == "running"


def test_what_a_node_sends_beside_its_fixed_topics_is_listed(tmp_path: Path) -> None:
    with publisher(tmp_path / "run") as running:
        endpoint = running.connection.data[-1]

        def serve(_: int) -> None:
            running.publish_health(health())
            running.publish_content("clock", cdr.clock(5), -1, time.time_ns(), 0)
            running.poll(100)

        def listed(seconds: float) -> dict[str, Any] | None:
            rows = {row["topic"]: row for row in topic_list(NodeAddress(endpoint=endpoint), seconds=seconds)}
            return rows if "sags/clock" in rows and rows["sags/clock"]["rate_hz"] else None

        with repeating(serve):
            rows = heard(listed, 0.5)
    assert set(rows) == {f"sags/{name}" for name in (*topics.BY_NAME, "clock")}
    assert rows["sags/clock"]["rate_hz"] > 0 and rows["sags/clock"]["type"] == topics.CLOCK


@pytest.mark.parametrize("name", topics.BY_NAME)
def test_echo(node: NodeAddress, name: str) -> None:
    (record,) = topic_echo(name, node, count=1, seconds=60)
    assert json.loads(json.dumps(record))["topic"] == f"sags/{name}"
    assert record["type"] == topics.BY_NAME[name].type and record["content"]
    if name == "left/depth":
        assert record["content"]["encoding"] == "32FC1" and record["content"]["shape"] == [HEIGHT, WIDTH]
        assert record["content"]["unknown"] == pytest.approx(1 / HEIGHT)
        assert 0.03 < record["content"]["min"] < record["content"]["max"] < 0.2


def test_silence_and_mistakes_are_named(node: NodeAddress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sags_node.messaging.introspection.STATUS_WAIT", 0.1)  # nobody says why
    with pytest.raises(UsageError, match="did you mean 'left/depth'"):
        topic_figures("hz", "left/dept", node)
    with pytest.raises(SagsError, match=r"no messages on sags/tf from tcp://127\.0\.0\.1:9 in 0\.2 s"):
        topic_figures("hz", "tf", NOWHERE, seconds=0.2)
    with pytest.raises(SagsError, match="no messages on other/"):
        topic_list(NodeAddress("other", node.endpoint), seconds=0.3)
    with pytest.raises(SagsError, match="no messages"):
        list(topic_echo("clock", node, seconds=0.2))


@pytest.mark.parametrize(
    ("state", "why"), [("paused", "sags resume goes on"), ("held", "the lens is covered")]
)
def test_a_node_that_sends_no_frames_says_why(tmp_path: Path, state: str, why: str) -> None:
    said = replace(health(state), warnings=by_stage([Finding("picture_covered", "the lens is covered")]))
    with publisher(tmp_path / "run") as running:

        def serve(_: int) -> None:
            running.publish_health(said)
            running.poll(100)

        node, told = NodeAddress(endpoint=running.connection.data[-1]), list[str]()
        words = f"the sender says it is '{state}'.*{why}"
        with repeating(serve), Subscriber(["anchors"], node.endpoint) as subscriber:
            with pytest.raises(SagsError, match=f"no messages on sags/anchors .*; {words}"):
                topic_figures("hz", "anchors", node, seconds=0.3)
            with pytest.raises(SagsError, match=words):
                list(topic_echo("anchors", node, seconds=1.0, silent=told.append))
            until(lambda: re.search(words, str(subscriber.problem("anchors"))))
        assert len(told) == 1 and re.search(words, told[0]), "once, as it does not change"


@pytest.mark.fault("node: paused while its rate is measured")
def test_a_rate_is_no_rate_of_now_once_nothing_comes_any_more(tmp_path: Path) -> None:
    plane, sent = plane_result(), list[int]()
    with publisher(tmp_path / "run") as running:

        def serve(number: int) -> None:
            goes = len(sent) < 20
            if goes and running.wanted("left/depth"):
                running.publish_result(at_frame(plane, number, time.time_ns()), dropped=0)
                sent.append(number)
            running.publish_health(health("running" if goes else "paused"))
            running.poll(25)

        def measured(seconds: float) -> dict[str, Any] | None:
            sent.clear()
            figures = topic_figures("hz", "left/depth", where, seconds)
            return figures if "silent" in figures else None

        where = NodeAddress(endpoint=running.connection.data[-1])
        with repeating(serve):
            stops = heard(measured, 3.0)
    assert stops["freezes"] > 0 and stops["frozen_s"] > 0.15
    assert "still: the sender says it is 'paused'" in hz_text(stops)
