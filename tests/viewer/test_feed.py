"""What the viewer takes from a node and from an overlay, over real sockets."""

import time
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

pytestmark = pytest.mark.live

FOUR = (LEFT, SHOWN, DEPTH, CONFIDENCE, TISSUE)


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
    with node_sockets(tmp_path / "run", right=True) as running, making(running, plane_result()):
        feed = Feed(NodeAddress(run_dir=tmp_path / "run"))
        until(lambda: feed.now((RIGHT,), steady=True).camera is not None)
        for _ in range(5):
            moment = feed.now((RIGHT,), steady=True)
            assert set(moment.pictures) == {LEFT, RIGHT} and running.wanted("splats")
        feed.pause()
        until(lambda: not running.wanted("splats"))
        feed.close()


def test_of_a_frame_that_was_not_taken_in_its_picture_alone_is_shown(tmp_path: Path) -> None:
    held = replace(plane_result(), held="blurred")
    with node_sockets(tmp_path / "run") as running, making(running, held):
        feed = Feed(NodeAddress(run_dir=tmp_path / "run"))
        until(lambda: LEFT in feed.now(FOUR).pictures)
        moment = feed.now(FOUR)
        feed.close()
    assert set(moment.pictures) == {LEFT} and moment.camera is None and moment.splats is None
    assert moment.problem == "waiting for the model of this image"


def test_a_node_without_a_right_eye_shows_the_left_one_and_says_so(tmp_path: Path) -> None:
    with node_sockets(tmp_path / "run") as running, making(running, plane_result()):
        feed = Feed(NodeAddress(run_dir=tmp_path / "run"))
        until(lambda: feed.now((SHOWN, RIGHT), steady=True).camera is not None)
        moment = feed.now((SHOWN, RIGHT), steady=True)
        assert set(moment.pictures) == {LEFT, SHOWN} and moment.splats is not None
        assert moment.problem is not None and "right/image_rect_color is not published" in moment.problem
        assert feed.now((SHOWN,), steady=True).problem is None, "nobody looks at that eye"
        feed.close()


def test_of_the_overlay_the_picture_of_exactly_that_frame_is_shown(tmp_path: Path) -> None:
    drawn = np.full((HEIGHT, WIDTH, 4), 200, np.uint8)
    anchors = [{"id": 3, "confidence": None}]
    thing = {"name": "vessel", "reason": None, "unsure": "its anchors", "anchors": anchors}
    with OverlayStream("overlay", tmp_path / "run", (0, 0, 255)) as stream:
        stamp = time.time_ns()

        def send(_: int) -> None:
            stream.serve()
            stream.show({"left": drawn}, 1, stamp, 0)
            stream.tell({"latency_ms": {"p50": 41.0, "max": None}, "objects": [thing]})
            time.sleep(0.01)

        with repeating(send):
            feed = OverlayFeed(tmp_path / "run")
            feed.ask(("left",))
            until(lambda: feed.pictures(("left",), stamp) != {})
            assert (feed.pictures(("left",), stamp)["left"] == drawn).all()
            assert feed.pictures(("left",), stamp + 1) == feed.pictures((), stamp) == {}
            said = feed.says()
            feed.close()
    assert said is not None and said.objects[0].name == "vessel" and said.objects[0].unsure == "its anchors"


def test_an_overlay_of_another_node_is_none_of_this_one(tmp_path: Path) -> None:
    """Its anchors are other points: their names must not stand beside this node's."""
    run_dir, session = tmp_path / "run", "another"
    with node_sockets(run_dir) as running, making(running, plane_result()):
        with OverlayStream("overlay", run_dir, (0, 0, 255)) as stream:

            def send(_: int) -> None:
                stream.serve()
                stream.blank(session)  # a new reason is told at once
                stream.tell({"session": session, "objects": []})
                time.sleep(0.01)

            with repeating(send):
                feed, beside = Feed(NodeAddress(run_dir=run_dir)), OverlayFeed(run_dir)
                until(lambda: beside.says() is not None and feed.now((LEFT,)).camera is not None)
                time.sleep(0.2)
                assert feed.now((LEFT,)).overlay is None
                session = running.session
                until(lambda: feed.now((LEFT,)).overlay is not None)
                feed.close()
                beside.close()
