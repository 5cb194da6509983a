"""What the viewer takes from a node and from an overlay, over real sockets."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import HEIGHT, WIDTH, plane_depth, plane_result
from thin_sender import making, node_sockets
from waiting import repeating, until

from sags_node.clients.overlay.stream import OverlayStream
from sags_node.clients.viewer.feed import CONFIDENCE, DEPTH, LEFT, RIGHT, SHOWN, TISSUE, WHOLE, Feed
from sags_node.clients.viewer.overlay import OverlayFeed
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.publisher import Publisher
from sags_node.types import FrameResult

pytestmark = pytest.mark.live

FOUR = (LEFT, SHOWN, DEPTH, CONFIDENCE, TISSUE)


@contextmanager
def fed(
    run_dir: Path, result: FrameResult | None = None, right: bool = False
) -> Iterator[tuple[Publisher, Feed]]:
    """A node that sends this frame, and a viewer's feed beside it."""
    with node_sockets(run_dir, right) as running, making(running, result or plane_result()):
        feed = Feed(NodeAddress(run_dir=run_dir))
        yield running, feed
        feed.close()


@pytest.mark.parametrize("rate", [50.0, 2.0])
def test_the_node_makes_one_frame_for_each_update_and_nothing_between(rate: float, tmp_path: Path) -> None:
    plane = plane_result()
    with node_sockets(tmp_path / "run") as running, making(running, plane, rate=rate) as made:
        feed = Feed(NodeAddress(run_dir=tmp_path / "run"))
        until(lambda: feed.now(FOUR).camera is not None)
        shown = []
        for _ in range(3):
            until(lambda: not any(running.wanted(name) for name in (*WHOLE, *FOUR)))
            moment = feed.now(FOUR)
            assert moment.problem is None and moment.camera is not None, "the whole frame came"
            assert moment.splats is not None and moment.anchors is not None
            shown.append(moment.t_capture_ns)
        feed.close()
    assert shown == sorted(set(shown)), "a new one each time"
    assert set().union(*made) == set(FOUR), "no image that nobody looks at"
    near = moment.pictures[DEPTH][1:], plane_depth(plane.pair.camera)[::4, ::4][1:]
    np.testing.assert_allclose(*near, atol=2.6e-5)
    assert moment.pictures[LEFT].shape == (HEIGHT // 2, WIDTH // 2, 3)


def test_for_updates_that_follow_at_once_every_frame_comes(tmp_path: Path) -> None:
    with fed(tmp_path, right=True) as (running, feed):
        until(lambda: feed.now((RIGHT,), steady=True).camera is not None)
        for _ in range(5):
            moment = feed.now((RIGHT,), steady=True)
            assert set(moment.pictures) == {LEFT, RIGHT} and running.wanted("splats")
        feed.pause()
        until(lambda: not running.wanted("splats"))


def test_of_a_frame_that_was_not_taken_in_its_picture_alone_is_shown(tmp_path: Path) -> None:
    with fed(tmp_path, replace(plane_result(), held="blurred")) as (_, feed):
        until(lambda: LEFT in feed.now(FOUR).pictures)
        moment = feed.now(FOUR)
    assert set(moment.pictures) == {LEFT} and moment.camera is None and moment.splats is None
    assert moment.problem == "waiting for the model of this image"


def test_a_node_without_a_right_eye_shows_the_left_one_and_says_so(tmp_path: Path) -> None:
    with fed(tmp_path) as (_, feed):
        until(lambda: feed.now((SHOWN, RIGHT), steady=True).camera is not None)
        moment = feed.now((SHOWN, RIGHT), steady=True)
        assert set(moment.pictures) == {LEFT, SHOWN} and moment.splats is not None
        assert moment.problem is not None and "right/image_rect_color is not published" in moment.problem
        assert feed.now((SHOWN,), steady=True).problem is None, "nobody looks at that eye"


def test_of_the_overlay_of_this_node_the_picture_of_exactly_that_frame_is_shown(tmp_path: Path) -> None:
    """Anchors of another node are other points: their names must not stand beside this node's."""
    drawn, stamp, session = np.full((HEIGHT, WIDTH, 4), 200, np.uint8), time.time_ns(), "another"
    anchors = [{"id": 3, "confidence": None}]
    thing = {"name": "vessel", "reason": None, "unsure": "its anchors", "anchors": anchors}
    with OverlayStream("overlay", tmp_path, (0, 0, 255)) as stream, fed(tmp_path) as (running, feed):

        def send(_: int) -> None:
            stream.serve()
            stream.show({"left": drawn}, 1, stamp, 0)
            latency = {"p50": 41.0, "max": None}
            stream.tell({"session": session, "latency_ms": latency, "objects": [thing]})
            time.sleep(0.01)

        with repeating(send):
            beside = OverlayFeed(tmp_path)
            beside.ask(("left",))
            until(lambda: beside.pictures(("left",), stamp) != {} and feed.now((LEFT,)).camera is not None)
            assert (beside.pictures(("left",), stamp)["left"] == drawn).all()
            assert beside.pictures(("left",), stamp + 1) == beside.pictures((), stamp) == {}
            time.sleep(0.2)  # the feed hears of it as well
            assert feed.now((LEFT,)).overlay is None
            session = running.session
            said = until(lambda: feed.now((LEFT,)).overlay)
            beside.close()
    assert said.objects[0].name == "vessel" and said.objects[0].unsure == "its anchors"
