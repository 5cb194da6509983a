"""The WebSocket gateway: what its peers get and may ask for, and the page in a real browser."""

import json
import shutil
import socket
import struct
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from bridging import anchored, anchored_at, bridged, options_of, plane_bridged, sockets
from browsers import new_page
from places import ROOT
from synthetic import HEIGHT, WIDTH, at_frame, plane_result, stream
from thin_sender import making, node_sockets
from waiting import beside, until

pytest.importorskip("websockets", reason="no gateway without: pip install '.[bridges]'")

from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import ServerConnection, serve

from sags_node.clients.bridge import web as gateway
from sags_node.clients.bridge.relay import MAX_AGE
from sags_node.clients.bridge.web import LONGEST_MESSAGE, MOST_PEERS, WebOptions, run_web
from sags_node.messaging import content

pytestmark = pytest.mark.live

T = TypeVar("T", str, bytes)

DEPTH, IMAGE = "sags/left/render/depth", "sags/left/render/image"
options = partial(options_of, WebOptions, port=0)


@contextmanager
def peer(port: int, *names: str, origin: str | None = None) -> Iterator[ClientConnection]:
    with connect(f"ws://127.0.0.1:{port}/ws", origin=origin, max_size=None, open_timeout=60) as joined:  # type: ignore[arg-type]
        if names:
            joined.send(json.dumps({"subscribe": names}))
        yield joined


def parts(message: bytes) -> tuple[dict[str, Any], list[bytes]]:
    """By docs/bridges.md alone."""
    (length,) = struct.unpack_from("<I", message)
    head = json.loads(message[4 : 4 + length])
    at, found = 4 + length, []
    for size in head["parts"]:
        found.append(message[at : at + size])
        at += size
    assert at == len(message)
    return head, found


def said_as(kind: type[T], joined: ClientConnection, seconds: float) -> Iterator[T]:
    """The texts or the messages that come, for so long."""
    deadline = time.monotonic() + seconds
    while True:
        said = joined.recv(timeout=deadline - time.monotonic())
        if isinstance(said, kind):
            yield said


def next_of(
    joined: ClientConnection, topic: str, seconds: float = 60.0
) -> tuple[dict[str, Any], list[bytes]]:
    came = map(parts, said_as(bytes, joined, seconds))
    return next((head, found) for head, found in came if head["topic"] == topic)


def told(joined: ClientConnection, seconds: float = 60.0) -> dict[str, Any]:
    """The next text."""
    return json.loads(next(said_as(str, joined, seconds)))


@pytest.fixture(scope="module")
def web(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of a gateway to a node that sends the plane."""
    with plane_bridged(run_web, options(tmp_path_factory.mktemp("run"))) as (_, port):
        yield port


def test_messages_are_the_nodes_own(tmp_path: Path) -> None:
    thin = "sags/thin/half/left/render/depth/png"
    with (
        node_sockets(tmp_path) as running,
        making(running, anchored()),
        bridged(run_web, options(tmp_path)) as port,
        peer(port, DEPTH, thin) as joined,
    ):
        head, found = next_of(joined, DEPTH)
        small, (_, file) = next_of(joined, thin)
    frame = at_frame(plane_result(), head["frame_id"], head["stamp_ns"])
    assert found == [bytes(part) for part in content.FRAME_CONTENT["left/render/depth"](frame).parts]
    assert head["encoding"] == "32FC1" and head["shape"] == [HEIGHT, WIDTH] and head["epoch"] == frame.epoch
    assert small["window"] == [0, 0, 2] and file[:4] == b"\x89PNG"


def test_what_stops_is_taken_back_with_the_reason(tmp_path: Path) -> None:
    with bridged(run_web, options(tmp_path)) as port, peer(port, DEPTH, "overlay/status") as joined:
        said = [told(joined), told(joined)]
        assert {each["topic"] for each in said} == {DEPTH, "overlay/status"} and "no node" in said[0]["stale"]
        with sockets(tmp_path) as running:
            with stream(running, anchored_at):
                next_of(joined, DEPTH)
            last = told(joined)
            assert last["topic"] == DEPTH and "too old" in last["stale"]
            with stream(running, anchored_at):
                next_of(joined, DEPTH)


def test_only_what_was_let_in_is_asked_of_the_node(tmp_path: Path) -> None:
    asked = []
    handlers = {"add_anchor": lambda args: asked.append(args) or {"id": 7}, "reset_model": asked.append}
    request = {"id": 3, "op": "add_anchor", "args": {"u": 10, "v": 20}}
    with sockets(tmp_path, handlers), bridged(run_web, options(tmp_path)) as port, peer(port) as joined:
        joined.send(json.dumps(request))
        assert "--pin" in told(joined)["error"] and not asked
        joined.send(json.dumps({"id": 4, "op": "get_clock"}))
        before, answer, after = time.time_ns(), told(joined), time.time_ns()
        assert answer["id"] == 4 and answer["ok"]
        assert before - 1e9 < answer["result"]["received_ns"] <= after
    pinning = options(tmp_path, pin=True)
    with plane_bridged(run_web, pinning, handlers=handlers) as (_, port), peer(port) as joined:
        joined.send(json.dumps(request))
        assert told(joined) == {"id": 3, "ok": True, "result": {"id": 7}} and asked == [request["args"]]
        joined.send(json.dumps({"id": 5, "op": "reset_model"}))
        assert "not passed on" in told(joined)["error"] and len(asked) == 1


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ("{", "neither a subscription nor a request"),
        ('{"subscribe": "all"}', "neither a subscription nor a request"),
        ('{"subscribe": ["sags/left/dept"]}', "did you mean 'left/depth'"),
        ('{"subscribe": ["sags/thin/half/left/depth/jpeg"]}', "comes as png, not as jpeg"),
        ('{"subscribe": ["other/left/depth"]}', "must begin with sags/"),
        (json.dumps({"subscribe": [f"sags/view/a{n}/image" for n in range(17)]}), "at most 16"),
        (b"\xff\xfe", "neither a subscription nor a request"),
        ("[" * 10_000, "neither a subscription nor a request"),
    ],
)
def test_a_wrong_word_is_answered_and_the_rest_goes_on(said: str | bytes, why: str, web: int) -> None:
    with peer(web, DEPTH) as joined:
        next_of(joined, DEPTH)
        joined.send(said)
        assert why in told(joined)["error"]
        next_of(joined, DEPTH)


def test_strangers_are_kept_out(web: int) -> None:
    for origin in ("http://evil.example", f"http://evil.example:{web}", "null", f"https://127.0.0.1:{web}"):
        with pytest.raises(InvalidStatus, match="403"), peer(web, origin=origin):
            pass
    with peer(web, DEPTH, origin=f"http://127.0.0.1:{web}") as joined:
        next_of(joined, DEPTH)
        with pytest.raises(ConnectionClosed):
            joined.send("x" * (LONGEST_MESSAGE + 1))
            next_of(joined, "none")
    with ExitStack() as open_ones, pytest.raises((OSError, EOFError, InvalidMessage, ConnectionClosed)):
        for _ in range(MOST_PEERS + 1):
            open_ones.enter_context(peer(web))
    until(lambda: urllib.request.urlopen(f"http://127.0.0.1:{web}/sags.js").read().startswith(b"//"))
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"http://127.0.0.1:{web}/../web.py")


def test_who_reads_slowly_misses_some_and_nobody_waits_for_him(
    web: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gateway, "STUCK", struct.pack("@ll", 600, 0))  # he is not cut off
    slow = socket.create_connection(("127.0.0.1", web))
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 17)
    with (
        connect(f"ws://127.0.0.1:{web}/ws", sock=slow, max_size=None, max_queue=1) as late,
        peer(web, IMAGE) as quick,
    ):
        late.send(json.dumps({"subscribe": [IMAGE]}))
        first, _ = next_of(late, IMAGE)
        newest = first["seq"]
        while newest < first["seq"] + 60:  # 1.5 MB, of which the kernel keeps a third
            newest = next_of(quick, IMAGE)[0]["seq"]
        came = [first["seq"]]
        while came[-1] < newest:
            head, _ = next_of(late, IMAGE)
            came.append(head["seq"])
        assert len(came) < 0.8 * (came[-1] - came[0]), "some were left out"


# ---- the page ----------------------------------------------------------------------------------------------

PIXELS = """(id) => {
  const canvas = document.getElementById(id);
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  return [canvas.width, canvas.height, Array.from(data)];
}"""
ALL_DRAWN = "() => Object.keys(window.sags?.drawn ?? {}).length === 3"
EMPTY = """() => [...document.querySelectorAll('canvas')].every((canvas) => {
  const shown = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  return !shown.data.some((value) => value);
})"""
# Which topics are shown at two ages, ms, by a clock that stands: the first of the oldest, the second of the
# newest of them; and whether all is blank then. Null: they were not all shown. The gateway hangs from then
# on.
AT_AGES = """([first, second]) => {
  const sags = window.sags, ways = [...sags.topics.values()], shown = ways.map((way) => way.shownMs);
  if (shown.includes(null)) return null;
  sags.socket.onmessage = () => {};
  const ahead = Math.min(...sags.ahead);
  const at = (ms) => {
    sags.now = () => ms - ahead;
    sags.look();
    return ways.map((way) => way.shownMs !== null);
  };
  return [at(Math.min(...shown) + first), at(Math.max(...shown) + second), (EMPTY)()];
}""".replace("EMPTY", EMPTY)  # at once: a newer image may still be on its way through the decoder


@pytest.fixture
def page() -> Iterator[Any]:
    with new_page() as page:
        page.set_default_timeout(60_000)
        yield page


def pixels(page: Any, canvas: str) -> np.ndarray:
    width, height, data = page.evaluate(PIXELS, canvas)
    return np.array(data, np.uint8).reshape(height, width, 4)


def all_drawn(page: Any) -> dict[str, np.ndarray] | None:
    """All three canvases; None where the page stood still so long that it blanked one meanwhile."""
    found = {canvas: pixels(page, canvas) for canvas in ("render", "depth", "marks")}
    return found if all(each.any() for each in found.values()) else None


def test_a_browser_draws_what_comes_and_goes_blank(page: Any, tmp_path: Path) -> None:
    result = anchored()
    with node_sockets(tmp_path) as running, bridged(run_web, options(tmp_path)) as port:
        with making(running, result, rate=30):
            shown = {}
            for thin in ("raw", "half"):
                page.goto(f"http://127.0.0.1:{port}/?thin={thin}")
                page.wait_for_function(ALL_DRAWN)
                shown[thin] = until(lambda: all_drawn(page))
            page.wait_for_function("() => Object.values(window.sags.drawn).every((count) => count > 20)")
        page.wait_for_function(EMPTY)
        assert "too old" in page.evaluate("() => Object.values(window.sags.reasons).join()")
        with making(running, result):  # and comes back by itself
            just = [1000 * MAX_AGE - 1, 1000 * MAX_AGE + 1]
            shown_at: list[Any] = []
            until(lambda: shown_at.append(page.evaluate(AT_AGES, just)) or shown_at[-1])
            assert shown_at[-1] == [[True] * 3, [False] * 3, True]
    raw, half = shown["raw"], shown["half"]
    view = result.views["left"]
    opaque = raw["render"][..., 3]
    assert np.all(opaque == round(0.75 * 255)), "the video shows through"
    expected = view.rgb.astype(int)
    assert np.abs(raw["render"][..., :3] - expected).max() <= 255 / 191 + 1, (
        "a canvas stores colour times alpha"
    )
    assert np.array_equal(raw["depth"][..., 3] > 0, view.depth > 0)
    assert half["render"].shape == (HEIGHT // 2, WIDTH // 2, 4)
    # 25 um are 0.11 of the 255 colours over 1.9 nepers from 30 mm on: at most the next colour, by 2 levels.
    assert np.abs(half["depth"].astype(int) - raw["depth"][::2, ::2]).max() <= 2
    assert raw["marks"].shape[:2] == (HEIGHT, WIDTH)
    colors = [(0, 255, 0), (255, 0, 0), (255, 165, 0)]  # seen; hidden; seen and not sure
    for color, (u, v) in zip(colors, result.anchors.pixels[[0, 1, 3]].astype(int), strict=True):
        ring = raw["marks"][v - 8 : v + 9, u - 8 : u + 8].reshape(-1, 4).astype(int)
        assert np.abs(ring[np.argmax(ring[:, 3])][:3] - color).max() < 20


@pytest.mark.fault("gateway: falls silent without closing, to a page")
def test_a_page_connects_again_to_a_gateway_that_fell_silent(page: Any, web: int) -> None:
    """Which hears it and never answers, so that nothing is closed."""
    connections: list[str] = []

    def attend(connection: ServerConnection) -> None:
        connections.append("one")
        for _ in connection:
            pass

    with serve(attend, "127.0.0.1", 0) as silent, beside(silent.serve_forever, silent.shutdown):
        page.goto(f"http://127.0.0.1:{web}/")
        page.wait_for_function("() => window.sags")
        port = silent.socket.getsockname()[1]
        page.evaluate("(url) => { new window.sags.constructor(url); }", f"ws://127.0.0.1:{port}/ws")
        until(lambda: len(connections) > 1)
        page.goto("about:blank")


def test_the_page_says_that_lengths_have_no_unit(page: Any, tmp_path: Path) -> None:
    with sockets(tmp_path, metric=False) as running, bridged(run_web, options(tmp_path)) as port:
        with stream(running, anchored_at):
            page.goto(f"http://127.0.0.1:{port}/?thin=raw")
            page.wait_for_function("() => document.getElementById('range').textContent.startsWith('no unit')")
            assert page.evaluate("() => window.sags.units[`sags/left/render/depth`]") == "relative"


def test_the_example_shows_the_model_in_a_page_of_its_own(page: Any, tmp_path: Path) -> None:
    """examples/web, as its first lines say."""
    shutil.copytree(ROOT / "examples/web", tmp_path / "page")
    shutil.copy(ROOT / "sags_node/clients/bridge/web_page/sags.js", tmp_path / "page")
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path / "page"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        site = f"http://127.0.0.1:{server.server_port}"
        run_dir, origin = tmp_path / "run", {"origins": (site,)}
        with node_sockets(run_dir) as running, bridged(run_web, options(run_dir, **origin)) as port:
            with making(running, anchored()):
                page.goto(f"{site}/?from=ws://127.0.0.1:{port}/ws")
                until(lambda: pixels(page, "model").any())
                told = until(lambda: page.text_content("#anchors"))
                seen, hidden, lost, unsure = anchored().anchors.ids
                places = f"{seen}: 20 20 px, {hidden}: 50 30 px"
                assert told == f"{places}, {lost}: not recognised, {unsure}: not recognised"
        server.shutdown()
