"""`sags topic`: rates, sizes and contents of a live publisher."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from synthetic import HEIGHT, WIDTH, publisher, stream

from sags_node.apps.topic import topic_bw, topic_delay, topic_echo, topic_hz, topic_list
from sags_node.errors import SagsError, UsageError
from sags_node.messaging import topics

RATE = 40.0


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with publisher(tmp_path_factory.mktemp("topic") / "run") as running:
        running.publish_parameters({"seed": 1})
        with stream(running, rate=RATE):
            yield running.connection.data[-1]


def test_hz(endpoint: str) -> None:
    figures = topic_hz("left/depth", endpoint, seconds=1.0)
    assert RATE / 3 < figures["average_rate"] < RATE * 1.2
    assert figures["min_s"] <= 1 / figures["average_rate"] <= figures["max_s"]
    assert figures["window"] >= figures["average_rate"] * 0.5


def test_bw(endpoint: str) -> None:
    figures = topic_bw("sags/left/depth", endpoint, seconds=1.0)  # the full name is understood too
    assert figures["mean_bytes"] == pytest.approx(4 * WIDTH * HEIGHT, rel=0.01)
    assert figures["bytes_per_s"] > 10 * figures["mean_bytes"]


def test_delay(endpoint: str) -> None:
    figures = topic_delay("tf", endpoint, seconds=1.0)
    assert 0 < figures["min_s"] <= figures["average_delay_s"] <= figures["max_s"] < 1


def test_list(endpoint: str) -> None:
    rows = {row["topic"]: row for row in topic_list(endpoint, seconds=1.0)}
    assert set(rows) == {f"sags/{name}" for name in topics.BY_NAME}
    assert rows["sags/left/depth"]["rate_hz"] > 5
    assert rows["sags/left/depth"]["type"] == "sensor_msgs/msg/Image"
    assert rows["sags/parameters"]["messages"] == 1  # the last value, sent again
    assert rows["sags/right/camera_info"]["messages"] == 0  # off by default


@pytest.mark.parametrize("name", [t.name for t in topics.TOPICS if not t.right])
def test_echo(endpoint: str, name: str) -> None:
    (record,) = topic_echo(name, endpoint, count=1, seconds=10)
    assert json.loads(json.dumps(record))["topic"] == f"sags/{name}"
    assert record["type"] == topics.BY_NAME[name].type and record["content"]
    if name == "left/depth":
        assert record["content"]["encoding"] == "32FC1" and record["content"]["shape"] == [HEIGHT, WIDTH]
        assert record["content"]["unknown"] == pytest.approx(1 / HEIGHT)
        assert 0.03 < record["content"]["min"] < record["content"]["max"] < 0.2


def test_silence_and_mistakes_are_named(endpoint: str) -> None:
    with pytest.raises(UsageError, match="did you mean 'left/depth'"):
        topic_hz("left/dept", endpoint)
    with pytest.raises(SagsError, match=r"no messages on sags/tf from tcp://127\.0\.0\.1:9 in 0\.2 s"):
        topic_hz("tf", "tcp://127.0.0.1:9", seconds=0.2)
    with pytest.raises(SagsError, match="no messages on other/"):
        topic_list(endpoint, ns="other", seconds=0.3)
    with pytest.raises(SagsError, match="no messages"):
        list(topic_echo("right/camera_info", endpoint, seconds=0.2))
