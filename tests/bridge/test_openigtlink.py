"""What a peer with OpenIGTLink's own library gets, and asks for; and what strangers can do."""

import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bridging import Pinned, anchored_at, asked, bridged, options_of, plane_bridged, sockets
from igtl_peer import PEER, Peer, built
from synthetic import DISTANCE, HEIGHT, NORMAL, WIDTH, at_frame, plane_camera, plane_result, stream
from waiting import until

pytest.importorskip("pyigtl", reason="no OpenIGTLink without: pip install '.[bridges]'")

from pyigtl.messages import PointMessage

from sags_node.cli.bridge import openigtlink
from sags_node.clients.bridge import igtl, igtl_peers
from sags_node.clients.bridge.igtl import MAX_BODY_BYTES
from sags_node.clients.bridge.igtl_peers import MOST_PEERS, Peers
from sags_node.clients.bridge.openigtlink import IgtlOptions, request_of, run_openigtlink
from sags_node.clients.bridge.pins import Pins
from sags_node.clients.overlay.stream import OverlayStream
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import invert, transform, unproject
from sags_node.types import FrameResult

pytestmark = pytest.mark.live

RECEIVE_CLIENT = Path("/usr/share/doc/openigtlink-examples/examples/Receiver/ReceiveClient.cxx")
SEEN, HIDDEN, LOST, UNSURE = anchored_at(0).anchors.ids.tolist()
RAS = np.diag([-1.0, -1.0, 1.0])
EXAMPLE_SAYS = (
    *(f"({WIDTH}, {HEIGHT}, 1)", "SagsPicture", "Receiving TRANSFORM data type.", "Receiving : POLYDATA"),
    *(f"anchor {SEEN}", "( -10.000000, -20.000000, 70.000000 )", "Status    : all is new"),
)
NO_ANCHOR = "none;0.0000;0.0000;0.0000;0;0"  # a point that cannot be seen
options = partial(options_of, IgtlOptions, port=0)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(PEER, tmp_path_factory.mktemp("peer"))


def weighted(picture: np.ndarray) -> int:
    """As the peer sums pixels up."""
    flat = picture.ravel().astype(np.int64)
    return int((flat * (np.arange(len(flat)) % 251 + 1)).sum())


def matrix(fields: list[str]) -> np.ndarray:
    return np.array(fields, np.float64).reshape(3, 4)


def in_camera(surface: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Its corners [N, 3], mm in the camera's frame, and its triangles [M, 3]."""
    corners, triangles = int(surface[0]), int(surface[1])
    places = np.array([corner.split(";") for corner in surface[2 : 2 + corners]], np.float64)
    moved = transform(invert(plane_camera().T_world_cam), places @ RAS * 1e-3) * 1e3
    return moved, np.array(surface[2 + corners :], int).reshape(triangles, 3)


@contextmanager
def joined_to(program: Path, asked: IgtlOptions, result: FrameResult | None = None) -> Iterator[Peer]:
    """A peer of a bridge to a node that sends one result, or the plane with its anchors, over and over."""
    shown = result or anchored_at(0)
    with plane_bridged(run_openigtlink, asked, lambda i: at_frame(shown, i, time.time_ns())) as (_, port):
        with Peer(program, port) as joined:
            yield joined


# ---- what comes ------------------------------------------------------------------------------------------


def test_every_device_says_in_millimetres_what_the_node_says(tmp_path: Path, program: Path) -> None:
    truth, camera = plane_result(), plane_camera()
    devices = ("SagsPicture", "SagsRender", "SagsSurface", "SagsAnchors", "SagsLeftCamera")
    with joined_to(program, options(tmp_path, surface_step=8)) as joined:
        until(lambda: all(joined.newest(device) for device in devices))
        picture, render, surface, anchors, pose = (joined.newest(device) or [] for device in devices)

    assert picture[:4] == [str(WIDTH), str(HEIGHT), "3", "1"], "RGB, and the numbers are said to be RAS"
    assert int(picture[4]) == weighted(truth.pair.left)
    assert render[:4] == [str(WIDTH), str(HEIGHT), "3", "1"]

    # A pixel of the image lies on the ray that it shows, 100 mm before the camera, turned as the world is.
    T_picture = matrix(picture[5:])  # of pixels counted from the middle, as OpenIGTLink does
    pixel = np.array([70.0, 12.0])
    at = T_picture @ [pixel[0] - (WIDTH - 1) / 2, pixel[1] - (HEIGHT - 1) / 2, 0, 1]
    ray = unproject(replace(camera, T_world_cam=np.eye(4)), pixel, np.float64(0.1))
    assert np.allclose(at, RAS @ ray * 1e3, atol=1e-3)

    T = matrix(pose)
    point = np.array([0.002, -0.003, 0.05])  # m, in the camera's frame
    assert np.allclose(
        T[:, :3] @ (RAS @ point * 1e3) + T[:, 3], RAS @ transform(camera.T_world_cam, point) * 1e3, atol=1e-3
    )

    points = " ".join(anchors).replace("anchor ", "anchor-").split()
    said = {name: fields for name, *fields in (point.split(";") for point in points)}
    names = [f"anchor-{number}" for number in (SEEN, UNSURE, HIDDEN)]
    assert said.keys() == set(names), f"{LOST} is lost: it has no place"
    assert np.allclose([float(x) for x in said[f"anchor-{SEEN}"][:3]], [-10, -20, 70], atol=1e-3)
    greens = [int(said[name][3]) for name in names]
    assert greens[0] > greens[1] > greens[2], "green where it is seen, orange where it may be elsewhere"

    corners, triangles = in_camera(surface)
    assert len(corners) > 60 and np.allclose(corners @ NORMAL, 1e3 * DISTANCE, atol=0.01), "on the plane"
    a, b, c = (corners[triangles[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] < 0).all(), "every triangle turns its front to the camera"


def test_an_anchor_whose_depth_is_a_guess_is_no_sure_place(tmp_path: Path, program: Path) -> None:
    result = anchored_at(1)
    guessed = replace(result.anchors, depth_confidence=np.array([0.49, 1, 1, 1], np.float32))
    with joined_to(program, options(tmp_path, send=("anchors",)), replace(result, anchors=guessed)) as joined:
        seen, _, unsure = np.array(until(lambda: joined.newest("SagsAnchors"))).reshape(-1, 2)[:, 1]
    assert seen.split(";")[4] == unsure.split(";")[4], "orange, as one that is not recognised"


def test_debians_own_example_receives_it_unchanged(tmp_path: Path) -> None:
    if not RECEIVE_CLIENT.exists():
        pytest.skip("no example without the Debian package openigtlink-examples")
    client = built(RECEIVE_CLIENT, tmp_path)
    with plane_bridged(run_openigtlink, options(tmp_path)) as (_, port):
        said = tmp_path / "said"
        with said.open("w") as file, subprocess.Popen([client, "127.0.0.1", str(port)], stderr=file) as shown:
            try:
                until(lambda: all(words in said.read_text() for words in EXAMPLE_SAYS))
            finally:
                shown.kill()


def test_a_surface_has_holes_where_the_depth_is_not_sure_or_jumps(tmp_path: Path, program: Path) -> None:
    plane = plane_result()
    view = plane.views["left"]
    depth, confidence = view.depth.copy(), view.confidence.copy()
    depth[:, : WIDTH // 3] += 0.05  # a step of 50 mm between two neighbours, 8 px or 5 mm apart
    confidence[:, 2 * WIDTH // 3 :] = 0.49
    torn = replace(plane, views=plane.views | {"left": replace(view, depth=depth, confidence=confidence)})
    with joined_to(program, options(tmp_path, send=("surface",), surface_step=8), torn) as joined:
        surface = until(lambda: joined.newest("SagsSurface"))
    corners, triangles = in_camera(surface)
    K = plane_camera().K
    columns = corners[:, 0] / corners[:, 2] * K[0, 0] + K[0, 2]
    assert (columns < 2 * WIDTH / 3).all() and (columns < WIDTH / 3).any() and (columns > WIDTH / 3).any()
    left = columns[triangles] < WIDTH // 3
    assert (left.all(axis=1) | ~left.any(axis=1)).all(), "no triangle spans the step"


def test_the_overlay_comes_over_its_picture(tmp_path: Path, program: Path) -> None:
    rgba = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    rgba[10:20, 30:50] = (0, 255, 0, 255)
    expected = plane_result().pair.left.copy()
    expected[10:20, 30:50] = (0, 255, 0)
    newest: list[tuple[int, int]] = []

    def frame(number: int) -> Any:
        result = anchored_at(number)
        newest.append((number, result.pair.t_capture_ns))
        return result

    def drawn() -> bool:
        overlay.serve()
        overlay.show({"left": rgba}, *newest[-1], 0)
        return joined.newest("SagsOverlay") is not None

    with (
        OverlayStream("overlay", tmp_path, (0, 0, 255)) as overlay,
        plane_bridged(run_openigtlink, options(tmp_path, send=("overlay",)), frame) as (_, port),
        Peer(program, port) as joined,
    ):
        until(drawn)
        assert int((joined.newest("SagsOverlay") or [])[4]) == weighted(expected)


# ---- nothing old is shown as new -------------------------------------------------------------------------


def test_what_stops_is_dark_and_empty_and_comes_back(tmp_path: Path, program: Path) -> None:
    with bridged(run_openigtlink, options(tmp_path)) as port, Peer(program, port) as joined:
        until(lambda: "no node" in " ".join(joined.newest("SagsState") or []).lower())
        assert {fields[3] for fields in joined.came if fields[1] == "SagsState"} == {"13"}
        with sockets(tmp_path) as running:
            with stream(running, anchored_at):
                until(lambda: joined.newest("SagsAnchors") and joined.newest("SagsSurface"))
                bright = int(until(lambda: joined.newest("SagsPicture"))[4])
            # The node is there, and silent.
            until(lambda: joined.newest("SagsAnchors") == [NO_ANCHOR])
            until(lambda: joined.newest("SagsSurface") == ["0", "0"])
            until(lambda: int((joined.newest("SagsPicture") or [])[4]) < bright / 3)
            until(lambda: (joined.newest("SagsState") or [])[0] == "13")
            shown = len(joined.came)
        with sockets(tmp_path) as running, stream(running, anchored_at):  # another node, on other ports
            until(lambda: joined.newest("SagsAnchors"))
            until(lambda: int((joined.newest("SagsPicture") or [])[4]) == bright)
            until(lambda: (joined.newest("SagsState") or [])[:1] == ["1"])
            assert len(joined.came) > shown


def test_a_slow_peer_holds_nobody_up(tmp_path: Path, program: Path) -> None:
    with plane_bridged(run_openigtlink, options(tmp_path, send=("camera",), rate=30.0)) as (_, port):
        with Peer(program, port, "slow", 1000) as slow, Peer(program, port) as quick:
            until(lambda: len(slow.came) > 4)
            assert len(quick.came) > 3 * len(slow.came), "it is not slowed down by the other"


@pytest.mark.fault("socket: peers of OpenIGTLink take every place and never read")
def test_who_takes_nothing_gives_its_place_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(igtl_peers, "STUCK_MS", 300)
    listener = socket.create_server(("127.0.0.1", 0))
    peers = Peers(listener, lambda said: None, lambda: None)
    peers.start()
    with closing(peers), ExitStack() as connected:
        for _ in range(MOST_PEERS):
            connected.enter_context(socket.create_connection(listener.getsockname()))
        until(lambda: len(peers) == MOST_PEERS)
        peers.send("SagsPicture", bytes(64 << 20))  # more than a kernel holds
        until(lambda: len(peers) == 0)
    peers.send("SagsAnswer", b"late")  # as the requests' thread may while the bridge ends: it goes nowhere


def test_only_what_is_looked_at_and_due_is_asked_of_the_node(tmp_path: Path, program: Path) -> None:
    sent = options(tmp_path, send=("picture", "anchors", "surface"), surface_rate=0.5)
    of_frames = {"left/image_rect_color", "left/render/image", "left/render/depth", "anchors", "tf"}
    with plane_bridged(run_openigtlink, sent) as (running, port):
        until(lambda: "status" in asked(running))
        time.sleep(0.5)
        assert not asked(running) & of_frames
        with Peer(program, port) as joined:
            until(lambda: joined.newest("SagsPicture") and joined.newest("SagsSurface"))
            # Depth only when a surface is due: between two `tf` tells that the node goes on.
            until(lambda: asked(running) & of_frames == {"left/image_rect_color", "anchors", "tf"})
        until(lambda: not asked(running) & of_frames)


# ---- requests --------------------------------------------------------------------------------------------


def test_a_peer_pins_anchors_by_point_and_by_pixel(tmp_path: Path, program: Path) -> None:
    node = Pinned()
    with plane_bridged(run_openigtlink, options(tmp_path), handlers=node.handlers) as (_, port):
        with Peer(program, port, "point", "SagsPin", -10, -20, 70) as joined:
            until(lambda: node.added)
            assert np.allclose([node.added[0][axis] for axis in "xyz"], [0.01, 0.02, 0.07])
            assert "depth_confidence" in " ".join(until(lambda: joined.newest("SagsAnswer")))
        with Peer(program, port, "point", "SagsPin", -10, -20, 70):  # the same list again: nothing new
            time.sleep(1.0)
        with Peer(program, port, "point", "SagsPin", -10, -20, 71):  # moved
            until(lambda: len(node.added) == 2 and node.removed == [1])
        with Peer(program, port, "say", "SagsRequest", "pin 320 256.5"):
            until(lambda: len(node.added) == 3)
        with Peer(program, port, "say", "SagsRequest", "dance"):
            pass
    assert node.added[2] == {"u": 320.0, "v": 256.5}


def dialled(port: int) -> socket.socket:
    """A peer of plain bytes."""
    return socket.create_connection(("127.0.0.1", port), timeout=60)


def points(*places: tuple[float, float, float]) -> bytes:
    names = [f"F-{number}" for number, _ in enumerate(places)]
    return PointMessage(np.array(places, float), names, device_name="SagsPin").pack()


@pytest.mark.fault("node: restarted, then a point of Slicer's list is deleted")
def test_anchors_of_a_node_that_was_restarted_are_left_to_whoever_has_their_numbers(
    tmp_path: Path, program: Path
) -> None:
    before, after = Pinned(), Pinned()
    with bridged(run_openigtlink, options(tmp_path)) as port, Peer(program, port) as told:

        def said(words: str) -> bool:
            return any(each[1] == "SagsAnswer" and words in " ".join(each) for each in told.came)

        with sockets(tmp_path, before.handlers) as running, stream(running, anchored_at):
            peer = dialled(port)
            peer.sendall(points((0, 0, 80), (20, 0, 80)))
            until(lambda: len(before.added) == 2 and said("'id': 2"))
        with sockets(tmp_path, after.handlers) as running, stream(running, anchored_at):
            until(lambda: said("started anew"))
            peer.sendall(points((0, 0, 80)))  # the other one is deleted
            peer.sendall(points((0, 0, 70)))  # and this one moved
            until(lambda: len(after.added) == 1)
            peer.sendall(points((0, 0, 60)))  # that anchor is this node's, and is given back
            until(lambda: after.removed)
            peer.close()
    assert after.removed == [1] and not before.removed


@pytest.mark.parametrize(
    "text", ["", "pin", "pin 1", "pin 1 2 3", "pin nan 1", "remove -1", "remove 1; pin 1 2", "pin 1e9 1"]
)
def test_other_words_are_no_request(text: str) -> None:
    assert request_of(text) is None


def test_messages_of_the_newer_header_are_read_too() -> None:
    """Slicer sends these to peers that have not said which they know."""
    sent = PointMessage(np.array([[1.0, 2.0, 3.0]]), ["F-1"], device_name="SagsPin")
    sent.header_version, sent.metadata = 2, {"key": "value"}
    raw = sent.pack()
    head = igtl.header(raw[: igtl.HEADER_BYTES])
    assert head is not None
    heard = igtl.said(head, raw[igtl.HEADER_BYTES :])
    assert heard is not None and heard.device == "SagsPin"
    ((name, place),) = heard.points
    assert name == "F-1" and place.tolist() == [1.0, 2.0, 3.0]
    assert igtl.said(head, raw[igtl.HEADER_BYTES : -1] + b"!") is None, "damaged on the way"


# ---- strangers -------------------------------------------------------------------------------------------


def test_strangers_are_cut_off_and_disturb_nobody(tmp_path: Path, program: Path) -> None:
    large = (1).to_bytes(2, "big") + b"STRING".ljust(12, b"\0") + b"x".ljust(20, b"\0") + bytes(8)
    large += (MAX_BODY_BYTES + 1).to_bytes(8, "big") + bytes(8)
    damaged = large[:42] + (40).to_bytes(8, "big") + bytes(8) + b"\xff" * 40  # its CRC is wrong
    with plane_bridged(run_openigtlink, options(tmp_path)) as (_, port), Peer(program, port) as joined:
        until(lambda: joined.came)  # it has its place
        for attack in (
            b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://evil.example\r\n\r\n",
            large,
            b"\xff" * 4096,
        ):
            with dialled(port) as stranger:
                stranger.sendall(attack)
                with pytest.raises((ConnectionError, EOFError)):
                    while stranger.recv(1 << 16):
                        pass
                    raise EOFError
        with dialled(port) as stranger:
            stranger.sendall(damaged)  # passed over
            assert stranger.recv(10)
        with ExitStack() as crowd:
            for _ in range(20):
                crowd.enter_context(dialled(port))
            before = len(joined.came)
            until(lambda: len(joined.came) > before + 20)


def test_points_that_are_named_alike_are_all_pinned_and_given_back() -> None:
    pins, places = Pins(), [np.array([x, 0.0, 80.0]) for x in (0, 20)]
    pins.hear([("vessel", place) for place in places], 0.0)
    due = pins.due(1.0)
    assert [(pin.name, pin.place.tolist()) for pin in due] == [("vessel", each.tolist()) for each in places]
    assert not any(pins.pinned(pin, anchor) for anchor, pin in enumerate(due, 7))
    assert pins.hear([("vessel", places[0])], 2.0) == [8] and pins.due(3.0) == []


def test_a_taken_port_and_an_unknown_output_are_said(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(SagsError, match=f"port {port}.*choose another --port"):
            run_openigtlink(options(tmp_path, port=port), lambda *_: None, threading.Event())
    with pytest.raises(UsageError, match="--send depth: there is picture") as refused:
        run_openigtlink(options(tmp_path, send=("depth",)), lambda *_: None, threading.Event())
    offered = str(refused.value).split("there is ")[1].replace(", ", ",")
    assert f"Some of {offered};" in str([option.to_info_dict() for option in openigtlink.params])  # --help
