"""Whether the right eye is drawn is up to who looks: a node in this process, real sockets."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import independent_client as client
import numpy as np
import pytest
import zmq
from command_line import RUN_HERE
from waiting import until

from sags_node.messaging.control import ControlClient
from sags_node.node.node import Node
from sags_node.pipeline.session import open_session
from sags_node.types import FrameResult

pytestmark = pytest.mark.live

RENDER, PICTURE, INFO = "right/render/image", "right/image_rect_color", "right/camera_info"
ENOUGH = 5  # frames in a row


class Watched:
    """A running node, and what its newest frames held."""

    def __init__(self, session: Path, run_dir: Path, *overrides: str) -> None:
        self.run_dir = run_dir
        opened = open_session(
            session,
            [*RUN_HERE, f"publish.run_dir:={run_dir}", "source.loop:=true", "source.pace:=fast",
             "mapping.iterations:=1", "mapping.max_gaussians:=2000", *overrides],
        )  # fmt: skip
        self._newest: deque[bool] = deque(maxlen=ENOUGH)
        self.node = Node(opened.config, opened.rig, opened.source, self._note)
        self.data = next(each for each in self.node.endpoints if each.startswith("tcp"))

    def _note(self, result: FrameResult, latency_ms: float) -> None:
        self._newest.append("right" in result.views)

    def draws(self, right: bool) -> bool:
        """Whether each of the next frames is, or is not, drawn for the right eye."""
        self._newest.clear()
        until(lambda: len(self._newest) == ENOUGH)
        return list(self._newest) == ENOUGH * [right]

    def subscribed(self, *prefixes: str) -> AbstractContextManager[zmq.Socket[bytes]]:
        return client.subscribed(self.data, *prefixes)

    def heard(self, *names: str, count: int = 3) -> dict[str, list[client.Received]]:
        return client.collect(self.data, names, count, timeout=60)


@contextmanager
def watched(session: Path, run_dir: Path, *overrides: str) -> Iterator[Watched]:
    running = Watched(session, run_dir, *overrides)
    running.node.start()
    try:
        until(lambda: running.node.health().gaussians > 0, 90)
        yield running
    finally:
        running.node.stop()


@pytest.fixture(scope="module")
def running(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    with watched(phantom_session, tmp_path_factory.mktemp("run")) as one:
        yield one


def test_nobody_asked_for_it_and_nothing_is_drawn(running: Watched) -> None:
    """What is not the drawn image costs nothing: the camera's image and its calibration come all the
    same."""
    with running.subscribed("sags/left/", "sags/status", f"sags/{PICTURE}", f"sags/{INFO}"):
        time.sleep(0.2)  # for the subscriptions to arrive
        assert running.draws(False)
        assert all(running.heard(PICTURE, INFO).values())


@pytest.mark.parametrize(
    "prefix", [f"sags/{RENDER}", "sags/right/", "sags/", "", f"sags/thin/half/{RENDER}/jpeg"]
)
def test_it_is_drawn_for_as_long_as_somebody_looks(running: Watched, prefix: str) -> None:
    with running.subscribed(prefix):
        until(lambda: running.draws(True))
    until(lambda: running.draws(False))


def test_who_comes_gets_every_frame_from_then_on(running: Watched) -> None:
    messages = running.heard(RENDER, count=8)[RENDER]
    assert client.check_sequence(messages) == 0
    frames = [message.meta["frame_id"] for message in messages]
    assert frames == list(range(frames[0], frames[0] + 8))
    client.check_image(messages[0], "rgba8", 320, 256)


def test_a_pair_of_eyes_from_elsewhere_is_a_look_at_the_right_one(running: Watched) -> None:
    """Of a view nobody subscribes to, and of its left eye alone, it is not."""
    until(lambda: running.draws(False))  # those of the tests before have gone
    aside = np.eye(4)
    aside[0, 3] = 0.002
    with ControlClient(run_dir=running.run_dir) as asker:
        request = {"name": "pair", "stereo": True, "width": 64, "height": 48, "T_left_cam": aside.tolist()}
        asker.request("open_view", request)
        with running.subscribed("sags/view/pair/left/image"):
            time.sleep(0.2)
            assert running.draws(False)
        with running.subscribed("sags/view/pair/right/image") as socket:
            until(lambda: running.draws(True))
            assert socket.poll(60_000)
        asker.request("close_view", {"name": "pair"})
    until(lambda: running.draws(False))


@pytest.mark.parametrize(("right", "drawn"), [("true", True), ("false", False)])
def test_one_may_have_it_always_or_never(
    right: str, drawn: bool, phantom_session: Path, tmp_path: Path
) -> None:
    with watched(phantom_session, tmp_path, f"publish.right:={right}") as one:
        assert one.draws(drawn)
        with one.subscribed("sags/right/") as socket:
            assert bool(socket.poll(60_000 if drawn else 500)) == drawn
        assert one.draws(drawn)
