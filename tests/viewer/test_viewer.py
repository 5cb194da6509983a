"""`sags view`: what it shows, what it takes away, and whom it lets in; the page in a real browser."""

import base64
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import Mock

import cv2
import msgspec
import numpy as np
import pytest
from browsers import new_page
from command_line import killed, refused, start, stopped
from waiting import START_SECONDS, repeating

from sags_node.clients.viewer import splats as viewer_splats
from sags_node.clients.viewer.cursor import depth_line
from sags_node.clients.viewer.feed import CONFIDENCE, DEPTH, LEFT, RIGHT, SHOWN, TISSUE, Moment, Rung, Status
from sags_node.clients.viewer.history import GAP, History
from sags_node.clients.viewer.overlay import Overlay, Thing
from sags_node.clients.viewer.pictures import BAR, VIEWS, Sheet, needs_of
from sags_node.clients.viewer.splats import splats_of
from sags_node.clients.viewer.still import SILENT_AFTER
from sags_node.config.schema import PhantomSource
from sags_node.messaging.address import THE_NODE
from sags_node.messaging.content import SPLAT_FIELDS
from sags_node.messaging.received import ReceivedCloud
from sags_node.messaging.subscriber import Subscriber
from sags_node.phantom import write_session
from sags_node.types import SH_DEGREE_0, Camera, Gaussians

pytestmark = [pytest.mark.live, pytest.mark.alone]

# Keeps what the page reports as an error.
KEEP_ERRORS = """
    window.errors = [];
    const report = console.error;
    console.error = (...said) => { window.errors.push(said.join(" ")); report(...said); };
"""
SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def viser() -> None:
    pytest.importorskip("viser", reason="viser is not installed (extra: viewer)")


class Served(NamedTuple):
    """The viewer's page without a node."""

    server: Any
    panel: Any
    scene: Any
    url: str


@pytest.fixture
def served(viser: None) -> Iterator[Served]:
    from sags_node.clients.viewer.panel import Panel
    from sags_node.clients.viewer.scene import Scene
    from sags_node.clients.viewer.server import serving

    def export(gaussians: Gaussians, camera: Camera, t_capture_ns: int, kind: str) -> bytes:
        return f"{kind} of {len(gaussians)} at {t_capture_ns}".encode()

    with serving("127.0.0.1", 0, False) as (server, url):
        scene = Scene(server)
        yield Served(server, Panel(server, scene, THE_NODE, export, 20.0), scene, url)


# ---- what a click meets ----------------------------------------------------------------------------------


def rows_of(count: int, **columns: Any) -> Any:
    rows = np.zeros(count, [(name, "<u4" if name == "id" else "<f4") for name in SPLAT_FIELDS])
    for name, values in columns.items():
        rows[name] = values
    return rows


def square(z: float, opacity: float, tilt: float = 0.0) -> Any:
    """Rows of 41 x 41 flat splats, 20 mm wide, their middle at (0, 0, z) m, turned about y."""
    side = np.linspace(-0.01, 0.01, 41)
    across, down = (each.ravel() for each in np.meshgrid(side, side))
    place = {"x": across * np.cos(tilt), "y": down, "z": z - across * np.sin(tilt)}
    shape = {"scale_0": 4e-4, "scale_1": 4e-4, "scale_2": 2e-5, "opacity": opacity}
    return rows_of(across.size, **place, **shape, rot_w=np.cos(tilt / 2), rot_y=np.sin(tilt / 2))


def test_a_ray_meets_the_nearest_opaque_surface() -> None:
    front, behind, veil = square(0.08, 0.9, tilt=0.6), square(0.1, 0.9), square(0.05, 0.05)
    tissue = splats_of(np.concatenate([behind, front, veil]))
    eye = np.array([0.004, -0.002, -0.01])
    for target in ([0.0, 0.0, 0.08], [0.003, 0.004, 0.08 - 0.003 * np.tan(0.6)]):
        met = tissue.hit(eye, 7 * (np.array(target) - eye))
        assert met is not None and np.linalg.norm(met - target) < 2e-4
    assert splats_of(veil).hit(eye, np.array([0.0, 0.0, 1.0])) is None, "that is clearer than opaque"
    assert tissue.hit(eye, np.array([0.0, 0.0, -1.0])) is None, "behind the eye"
    assert tissue.hit(eye, np.array([1.0, 0.0, 0.3])) is None, "beside the tissue"


def test_splats_keep_shape_and_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    half_turn = np.sqrt(0.5)  # 90 degrees about z
    row = rows_of(
        1, z=0.08, scale_0=1e-3, scale_1=2e-3, scale_2=3e-3, rot_w=half_turn, rot_z=half_turn,
        f_dc_0=0.5 / SH_DEGREE_0, f_dc_1=-0.25 / SH_DEGREE_0, opacity=0.7,
    )  # fmt: skip
    splats = splats_of(row)
    np.testing.assert_allclose(splats.covariances(1e-3)[0], np.diag([4.0, 1.0, 9.0]), atol=1e-5)
    np.testing.assert_allclose(splats.colors, [[1.0, 0.25, 0.5]], atol=1e-6)
    monkeypatch.setattr(viewer_splats, "MAX_SPLATS", 3)
    sizes = np.array([1, 5, 2, 4, 3], np.float32) * 1e-3
    many = rows_of(5, scale_0=sizes, scale_1=sizes, scale_2=1e-5, rot_w=1, opacity=[1, 0.01, 1, 1, 1])
    assert sorted(splats_of(many).scales[:, 0] * 1e3) == pytest.approx([2, 3, 4]), "those that cover most"


# ---- images and figures --------------------------------------------------------------------------------


ALL, UNDER_CURSOR = next(iter(VIEWS)), "Depth under the cursor"


def moment(level: int = 90) -> Moment:
    """A frame that is shown 10 grey levels brighter in the right half, its depth not sure in the left one."""
    truth = np.full((64, 80, 3), level, np.uint8)
    drawn = truth.copy()
    drawn[:, 40:] += 10
    depth = np.full((32, 40), 0.08, np.float32)
    depth[:16], depth[0] = 0.05, np.nan
    sure = np.full((32, 40), 0.8, np.float32)
    sure[:, :20] = 0.4
    tissue = np.full((32, 40), 255, np.uint8)
    pictures = {LEFT: truth, SHOWN: drawn, RIGHT: truth // 2, DEPTH: depth, CONFIDENCE: sure, TISSUE: tissue}
    camera = Camera(160, 128, np.diag([100.0, 100.0, 1.0]), np.eye(4))
    status = Status("running", 30.0, {"p50": 20.0, "p99": None}, rung=Rung(3, 16))
    return Moment(None, status, pictures, camera)


def anchors_of(*numbers: int) -> np.ndarray:
    """Rows of `anchors` that are not sure of their place."""
    names = "x", "y", "z", "visibility", "confidence", "depth_confidence"
    rows = np.zeros(len(numbers), [("id", "u4"), *((name, "f4") for name in names)])
    rows["id"], rows["x"], rows["z"] = numbers, -0.0123, 0.1234
    return rows


def test_the_sheet_shows_what_is_new_and_nothing_else() -> None:
    sheet = Sheet()
    ground = sheet.draw(Moment("gone"), ALL)
    half, middle = ground.shape[1] // 2, ground.shape[0] // 2
    assert len(np.unique(ground[60 : middle - 30])) == 1, "empty but for the captions and the reason"
    full = sheet.draw(moment(), ALL)
    height = full.shape[0] // 2
    assert (full[100, 50] == 90).all() and (full[100, half + half - 50] == 100).all(), "input, what is shown"
    warm, cold = full[height + 80, 50].astype(int), full[-60, 50].astype(int)
    assert warm[0] > warm[2] and cold[2] > cold[0], "near is warm, and up is up"
    assert (full[height:, half:] == ground[60, 60]).all(), "three images: the fourth place is empty"
    alone = sheet.draw(Moment("no model", pictures={LEFT: moment().pictures[LEFT]}), ALL)
    assert (alone[100, 50] == 90).all() and (alone[100, half + 50] == ground[100, half + 50]).all()
    assert (sheet.draw(Moment("gone"), ALL)[60 : height - 30] == ground[60, 60]).all()


def test_both_eyes_stand_side_by_side_and_the_overlay_lies_on_them() -> None:
    drawn = np.zeros((128, 160, 4), np.uint8)
    drawn[:, 80:] = (250, 0, 0, 255)
    overlaid = replace(moment(), drawn={"left": drawn})
    stereo = Sheet().draw(moment(), "Stereo input")
    half = stereo.shape[1] // 2
    assert (stereo[100, 50] == 90).all() and (stereo[100, half + 50] == 45).all()
    both = Sheet().draw(overlaid, "Stereo overlay")
    assert (both[100, 50] == 90).all() and (both[100, half - 50] == (250, 0, 0)).all()
    assert (both[BAR + 10 :, half:] == 45).all(), "no overlay of the right eye came for this frame"
    every = [Overlay("running"), Overlay("blank", "the node is paused"), None]
    sheets = [Sheet().draw(replace(overlaid, overlay=overlay), "Stereo overlay") for overlay in every]
    captions = {sheet[:BAR, half:].tobytes() for sheet in (stereo, *sheets)}
    assert len(captions) == 4, "it came too late, it is blank, none runs: it is said"


def test_the_depth_colours_have_the_range_of_known_depths_or_that_which_is_asked_for() -> None:
    sheet, seen = Sheet(), moment()
    for unknown in (np.full((32, 40), np.nan, np.float32), np.zeros((32, 40), np.float32)):
        for depth in (unknown, seen.pictures[DEPTH], unknown):
            sheet.draw(replace(seen, pictures={**seen.pictures, DEPTH: depth}), ALL)
        assert sheet.shown == pytest.approx((0.05, 0.08))
    followed = sheet.draw(seen, UNDER_CURSOR)[100, -50]
    sheet.fixed = (0.01, 0.3)
    assert (sheet.draw(seen, UNDER_CURSOR)[100, -50] != followed).any() and sheet.shown == (0.01, 0.3)


@pytest.mark.parametrize("plane", [0.05, 0.08])
def test_a_range_of_one_depth_has_colours_for_nearer_and_further(plane: float) -> None:
    sheet = Sheet()
    sheet.fixed = (plane, plane)
    with np.errstate(all="raise"):
        drawn = sheet.draw(moment(), UNDER_CURSOR).astype(int)
    near, far = drawn[100, -50], drawn[-60, -50]
    assert near[0] > near[2] and (far[2] > far[0]) == (plane < 0.08)


def test_the_rim_of_the_overlay_is_of_its_own_colour() -> None:
    """The overlay's image is not premultiplied: beside what is drawn lies black, which must not count."""
    drawn = np.zeros((576, 720, 4), np.uint8)
    drawn[:, 361:] = (250, 0, 0, 102)  # from the middle of a pixel on
    row = Sheet().draw(replace(moment(250), drawn={"left": drawn}), "Overlay")[150]
    assert (row[:, 0] == 250).all(), "red over as bright a red"
    assert (row[:180, 1] == 250).all() and row[180, 1] == 200 and (row[181:, 1] == 150).all(), "0.4 of it"


def test_the_depth_under_the_cursor_is_the_drawn_one_and_a_guess_is_said_to_be_one() -> None:
    assert {DEPTH, CONFIDENCE} <= set(needs_of(UNDER_CURSOR)) and CONFIDENCE not in needs_of(ALL)
    line = depth_line(moment(), UNDER_CURSOR, BAR + 288, "mm")
    told = dict(re.findall(r'data-(\w+)="([^"]*)"', line))
    steps = np.frombuffer(base64.b64decode(told["depths"]), "<u2").reshape(32, 40)
    assert (told["columns"], told["rows"], told["left"]) == ("2", "1", "11")
    assert (steps[0] == 0).all(), "not known"
    assert (steps[1:16, 20:] == 500).all() and (steps[16:, 20:] == 800).all(), "tenths of mm"
    assert (steps[16:, :20] == 800 + 2**15).all(), "a guess"
    assert depth_line(Moment("gone"), UNDER_CURSOR, 300, "mm") == ""


def test_figures_grow_by_the_second_and_go_after_a_gap() -> None:
    now = [100.0]
    history = History(lambda: now[0])
    for _ in range(30):
        history.add(moment())
        now[0] += 0.25
    times, rate, late, rung = history.series("rate", "p99", "rung")
    assert len(times) == 8 and times[-1] == 0 and np.diff(times).min() >= 1
    assert (rate == 30).all() and np.isnan(late).all() and (rung == 3).all()
    now[0] += GAP - 2
    assert not history.add(Moment("stale"))
    now[0] += 3
    assert history.add(Moment("stale")) and len(history.series("p50")[0]) == 0


@pytest.mark.usefixtures("viser")
def test_a_place_and_a_distance_of_anchors_are_a_guess_unless_they_are_sure() -> None:
    from sags_node.clients.viewer.panel import anchor_table, distance

    sure: dict[str, float] = {"id": 3, "x": 0, "y": 0, "z": 0.1, "confidence": 0.9, "depth_confidence": 0.5}
    sure["visibility"] = 1.0
    guess, lost = sure | {"depth_confidence": 0.49}, sure | {"x": np.nan, "depth_confidence": 0.0}
    beside = {"x": 0.003, "y": 0.004}
    for row, place, apart in (
        (sure, "0.0 0.0 100.0<", "Distance: 5.0 mm"),
        (guess, "0.0 0.0 100.0, a guess<", "5.0 mm, a guess"),
        (lost, "lost<", "lost"),
    ):
        table, told = anchor_table([row], "mm"), distance(sure | beside, row, "mm")
        assert place in table and ("guess" in table) == (row is guess) == ("guess" in told)
        assert apart in told


@pytest.mark.usefixtures("viser")
def test_an_anchor_that_is_seen_and_not_sure_in_space_has_a_colour_of_its_own() -> None:
    from sags_node.clients.viewer.scene import HIDDEN, SEEN, UNSURE, anchor_color

    names = ("visibility", "confidence", "depth_confidence")
    rows = [(1.0, 0.9, 0.9), (0.2, 0.5, 0.5), (1.0, 0.49, 0.9), (1.0, 0.9, 0.49), (0.0, 0.9, 0.9), (0, 0, 0)]
    colors = [anchor_color(dict(zip(names, row, strict=True))) for row in rows]
    assert colors == [SEEN, SEEN, UNSURE, UNSURE, HIDDEN, HIDDEN] and len({SEEN, UNSURE, HIDDEN}) == 3


def test_what_is_chosen_goes_with_the_node_that_numbered_it(served: Served) -> None:
    panel = served.panel
    status = moment().status
    panel.show(replace(moment(), status=msgspec.structs.replace(status, session="first")))
    panel.choose(1)
    panel.show(Moment("stale", Status(session="first")))
    assert panel.chosen == 1, "nothing fresh came: it stays"
    panel.show(Moment("the node is starting", Status(session="second")))
    assert panel.chosen is None, "number 1 is another anchor now"


def test_an_anchor_that_was_just_pinned_stays_chosen_until_a_frame_has_it(served: Served) -> None:
    panel = served.panel
    without, with_it = (replace(moment(), anchors=anchors_of(*ids)) for ids in ((1, 2), (1, 2, 3)))
    panel.show(without)
    panel.choose(3)
    panel.show(without)
    assert panel.chosen == 3, "that frame was captured before"
    panel.show(with_it)
    assert panel.chosen == 3
    panel.show(without)
    assert panel.chosen is None, "somebody has removed it"


# ---- the command -----------------------------------------------------------------------------------------


def test_without_viser_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    refused(2, "view", said=("pip install '.[viewer]'",))


@pytest.mark.usefixtures("viser")
def test_other_machines_and_taken_ports_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "nice", lambda increment: 0)  # that is for a process of its own
    refused(2, "view", "--host", "0.0.0.0", said=("without keys", "--insecure", "ssh -L"))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        refused(1, "view", "--port", port, said=(f"port {port}",))
    refused(1, "view", "--port", "0", "--endpoint", "nonsense", said=("e.g. tcp://127.0.0.1:5556",))


class RunningView(NamedTuple):
    """`sags view` in its own process, for nodes of its own run directory."""

    runtime: Path
    process: subprocess.Popen[str]
    url: str
    port: int


@pytest.fixture(scope="module")
def view(viser: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningView]:
    runtime = tmp_path_factory.mktemp("runtime")
    process = start(["view", "--port", "0", "--json"], XDG_RUNTIME_DIR=runtime)
    said = json.loads(process.stdout.readline())
    yield RunningView(runtime, process, said["url"], said["port"])
    stdout, _ = stopped(process)
    assert process.returncode == 0 and stdout == ""


def test_only_its_own_page_may_connect(view: RunningView) -> None:
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    url, port = view.url, view.port
    assert url == f"http://127.0.0.1:{port}"
    to_it: Any = {"uri": f"ws://127.0.0.1:{port}", "subprotocols": [f"viser-v{version('viser')}"]}
    for own in (url, f"http://localhost:{port}"):
        connect(**to_it, origin=own).close()
    for stranger in ("https://example.org", f"http://example.org:{port}", f"{url}.example.org", "null"):
        with pytest.raises(InvalidStatus, match="HTTP 403"):
            connect(**to_it, origin=stranger)
    peer = socket.socket()
    peer.settimeout(1)
    with peer, pytest.raises(OSError):  # another address of this machine
        peer.connect(("127.0.0.2", port))


def answered(port: int, *headers: str) -> str:
    """What is said to a request for the page with these headers, sent as they are."""
    with socket.create_connection(("127.0.0.1", port), 60) as peer, peer.makefile("rb") as stream:
        peer.sendall("\r\n".join(("GET / HTTP/1.1", *headers, "", "")).encode())
        head = b"".join(iter(stream.readline, b"\r\n")).decode()
        return head if "101 Switching" in head else head + stream.readline().decode()


def an_upgrade(host: str) -> tuple[str, ...]:
    """The headers of a websocket that the page under this host opens to where it came from."""
    said = ("Host: ", "Origin: http://")
    key = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Key: MDEyMzQ1Njc4OTAxMjM0NQ==")
    protocol = f"Sec-WebSocket-Protocol: viser-v{version('viser')}"
    return (*(name + host for name in said), *key, "Sec-WebSocket-Version: 13", protocol)


@pytest.mark.fault("network: a hostile page reaches the viewer by a name of its own for this machine")
def test_it_answers_by_its_own_addresses_only(view: RunningView) -> None:
    port = view.port
    for own in (f"127.0.0.1:{port}", f"localhost:{port}", f"LocalHost:{port}", f"[::1]:{port}"):
        assert "200 OK" in answered(port, f"Host: {own}") and "101 " in answered(port, *an_upgrade(own))
    rebound, elsewhere = f"example.org:{port}", f"localhost:{port + 1}"
    others = (rebound, elsewhere, "localhost", f"127.0.0.1:{port}.org", f"10.0.0.1:{port}", "")
    for host in ((f"Host: {other}",) for other in others):
        refusal = answered(port, *host)
        assert "403 " in refusal and f"Open {view.url};" in refusal
    assert "403 " in answered(port), "no name at all"
    assert "403 " in answered(port, f"Host: localhost:{port}", f"Host: {rebound}"), "two"
    for other in others:
        assert "403 " in answered(port, *an_upgrade(other))
    assert "403 " in answered(port, f"Host: localhost:{port}", *an_upgrade(rebound)[1:])


@pytest.mark.usefixtures("viser")
def test_open_to_the_network_it_answers_by_numbers_and_the_machines_name() -> None:
    from sags_node.clients.viewer.server import serving

    with serving("0.0.0.0", 0, True) as (server, _):
        port = server.get_port()
        for own in ("10.1.2.3", "[fe80::1]", "localhost", socket.gethostname()):
            assert "101 " in answered(port, *an_upgrade(f"{own}:{port}"))
        for other in ("example.org", f"{socket.gethostname()}.example.org", "10.example.org", "1.2.3.4.de"):
            assert "403 " in answered(port, *an_upgrade(f"{other}:{port}"))
            assert "403 " in answered(port, f"Host: {other}:{port}")


@pytest.mark.fault("process: a browser that shows the viewer hangs, beside another")
def test_a_page_that_hangs_keeps_no_other_page_waiting(viser: None) -> None:
    """One that answers has three updates before the one that hangs is done with its first."""
    from sags_node.clients.viewer.run import Pages

    hangs, answers, goes_on = Mock(), Mock(), threading.Event()
    hangs.local_storage.get_item.side_effect = lambda *_, **__: goes_on.wait(60)
    with Pages() as pages:
        for _ in range(3):
            pages.wait({1: hangs, 2: answers})
        assert answers.local_storage.get_item.call_count == 3
        assert hangs.local_storage.get_item.call_count == 1
        goes_on.set()


# ---- in a browser ----------------------------------------------------------------------------------------


@contextmanager
def opened(url: str, width: int, height: int) -> Iterator[Any]:
    """A page in a headless browser; `page.requests` are the addresses it asked for."""
    with new_page(SOFTWARE_GL, viewport={"width": width, "height": height}) as page:
        page.set_default_timeout(30_000)
        page.requests = []
        page.add_init_script(KEEP_ERRORS)
        page.on("request", lambda request: page.requests.append(request.url))
        page.goto(url)
        page.wait_for_selector("#sags-status")
        yield page


@pytest.fixture(scope="module")
def page(view: RunningView) -> Iterator[Any]:
    with opened(view.url, 1050, 400) as page:
        page.wait_for_selector("canvas")
        yield page


@pytest.fixture
def node(view: RunningView, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A node that the viewer finds by itself; small, for the browser draws without a graphics card."""
    session = tmp_path / "session"
    write_session(PhantomSource(seconds=2.0, width=160, height=128, seed=1), session, rate=10.0)
    played = ["source.loop:=true", "source.rate:=5", "vision.scale:=1"]
    heard = ["publish.data:=[]", "publish.control:=tcp://127.0.0.1:*"]
    with killed(start(["run", session, *played, *heard], XDG_RUNTIME_DIR=view.runtime)) as running:
        yield running


def status(page: Any) -> str:
    return str(page.locator("#sags-status").text_content())


def until(met: Callable[[], bool], page: Any, seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < deadline, f"the page says: {status(page)}"
        page.wait_for_timeout(300)  # keeps its events going; looking oftener slows it down


def contrast(page: Any) -> float:
    """Standard deviation of the pixels in the 3D scene between what floats above and the counter below."""
    box = page.locator("canvas").first.bounding_box()
    clip = {**box, "y": box["y"] + box["height"] / 2, "height": 0.4 * box["height"]}
    picture = cv2.imdecode(np.frombuffer(page.screenshot(clip=clip), np.uint8), cv2.IMREAD_COLOR)
    return float(picture.astype(np.float32).std())


def anchors(subscriber: Subscriber) -> dict[int, np.ndarray]:
    cloud = subscriber.latest("anchors")
    if not isinstance(cloud, ReceivedCloud):
        return {}
    return dict(zip(cloud.points["id"].tolist(), cloud.xyz(), strict=True))


def test_without_a_node_it_says_so(page: Any) -> None:
    until(lambda: "no node runs as 'sags'" in status(page), page)
    assert contrast(page) < 2, "an empty scene"


@pytest.mark.fault("link: stands still, to the viewer's page")
def test_a_page_that_hears_nothing_covers_itself_but_not_a_folded_one(page: Any, view: RunningView) -> None:
    cover = page.locator("#sags-still")
    page.mouse.click(1037, 8)  # viser's button that folds the panels away, and the status with them
    page.wait_for_function("() => document.getElementById('sags-status') === null")
    page.wait_for_timeout(1000 * (SILENT_AFTER + 2))
    assert cover.count() == 0
    view.process.send_signal(signal.SIGSTOP)
    try:
        page.wait_for_function("() => document.elementFromPoint(300, 250)?.id === 'sags-still'")
        assert "no word from sags view for" in cover.text_content()
        assert "Start it again, or mend the link" in cover.text_content()
    finally:
        view.process.send_signal(signal.SIGCONT)
    page.wait_for_function("() => document.getElementById('sags-still') === null")
    page.mouse.click(1037, 8)
    page.wait_for_function("() => document.getElementById('sags-status') !== null")


def test_a_live_node_is_shown_obeys_and_disappears(
    page: Any, view: RunningView, node: subprocess.Popen[str]
) -> None:
    run_dir = view.runtime / "sags"
    until(lambda: "running" in status(page), page, START_SECONDS)
    until(lambda: contrast(page) > 15, page)
    with Subscriber(["anchors"], run_dir=run_dir) as subscriber:
        box = page.locator("canvas").first.bounding_box()
        refusal = page.get_by_text("the model has no tissue within")
        for _ in range(3):  # tissue moves: it may have left the place before the node is asked
            page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            until(lambda: len(anchors(subscriber)) == 1 or refusal.count() > 0, page)
            until(lambda: refusal.count() == 0, page)
            if anchors(subscriber):
                break
        ((number, place),) = anchors(subscriber).items()
        assert np.abs(place[:2]).max() < 5e-3, "the page looks at the middle of the tissue"
        assert 0.04 < place[2] < 0.15
        until(lambda: page.locator(f"td:text-is('{number}')").count() == 1, page)

        page.get_by_label("Anchor", exact=True).click()
        page.get_by_role("option", name=str(number)).click()
        page.get_by_role("button", name="Remove", exact=True).click()
        until(lambda: anchors(subscriber) == {}, page)
    page.get_by_label("Show", exact=True).click()
    page.get_by_role("option", name=UNDER_CURSOR).click()
    picture = page.locator("img").first.bounding_box()
    page.mouse.move(picture["x"] + picture["width"] / 4, picture["y"] + 60)
    until(lambda: " mm" in str(page.locator("#sags-depth").text_content()), page)

    page.get_by_role("button", name="Freeze").click()
    until(lambda: "FROZEN" in status(page), page)
    page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + 0.9 * box["height"])
    until(lambda: page.get_by_text("what you see is old: Go on first").count() > 0, page)
    with page.expect_download() as download:
        page.get_by_role("button", name="Screenshot").click()
    kept = cv2.imread(str(download.value.path()))
    assert contrast(page) > 15 and kept.std() > 15, "the frozen moment stays"
    page.get_by_role("button", name="Go on").click()
    until(lambda: "running" in status(page), page)
    assert page.evaluate("window.errors") == []

    page.get_by_role("button", name="Pause").click()
    until(lambda: "paused" in status(page) and contrast(page) < 2, page)
    assert page.get_by_text("nothing new").count() == 1, "whether there are anchors is not known now"
    with page.expect_download() as download:
        page.get_by_role("button", name="Screenshot").click()
    assert "_1970" not in download.value.suggested_filename
    page.get_by_role("button", name="Resume").click()
    until(lambda: "running" in status(page) and contrast(page) > 15, page)

    node.kill()
    until(lambda: "stale for" in status(page), page)
    until(lambda: contrast(page) < 2, page)
    own = (view.url, f"blob:{view.url}", "data:")
    assert page.requests and all(request.startswith(own) for request in page.requests)


# ---- in a browser, without a node ------------------------------------------------------------------------


class Shown(NamedTuple):
    """A page of moments that a test makes."""

    served: Served
    page: Any
    moments: list[Moment]

    def update(self, _: int) -> None:
        """Bring the page up to date, as the command does again and again: else it covers itself."""
        with self.served.server.atomic():
            self.served.scene.show(self.moments[-1])
            self.served.panel.show(self.moments[-1])
        self.served.server.flush()
        time.sleep(0.5)

    def show(self, moment: Moment) -> None:
        """Show it, and wait until the page has it."""
        self.moments.append(moment)
        expected = str(moment.t_capture_ns)
        until(lambda: self.page.locator("#sags-status").get_attribute("data-frame") == expected, self.page)


@pytest.fixture
def narrow(served: Served) -> Iterator[Shown]:
    """The viewer's page in a window of 600 px."""
    served.server.on_client_connect(served.panel.fit)
    with opened(served.url, 600, 800) as page:
        shown = Shown(served, page, [Moment("nothing yet")])
        with repeating(shown.update):
            yield shown
        assert page.evaluate("window.errors") == []


def at(stamp_ns: int) -> Moment:
    """With an anchor whose depth is a guess, and an object that it holds."""
    why = "its anchors were not recognised for 2 s"
    overlay = Overlay("running", objects=(Thing("the hepatic artery", None, why, ({"id": 12.0},)),))
    return replace(moment(), t_capture_ns=stamp_ns, anchors=anchors_of(12), overlay=overlay)


def test_the_page_counts_the_frames_that_come_to_it(narrow: Shown) -> None:
    stamps = [7, 7, 0, 8, 9, 0, 9, 10]  # shown again, and nothing to show
    before = narrow.page.evaluate("performance.now()")
    for stamp_ns in stamps:
        narrow.show(at(stamp_ns) if stamp_ns else Moment("gone"))
    came = narrow.page.evaluate("sagsFrames")
    assert came["count"] == 4 and before < came["first"] < came["last"]
    corner, marked = narrow.page.locator("#sags-rate"), narrow.page.locator("html[data-old]")
    until(
        lambda: re.fullmatch(r"0 /s: what you see came \d+ s ago", corner.text_content() or ""), narrow.page
    )
    assert marked.count() == 1
    narrow.show(Moment("gone"))
    until(lambda: corner.text_content() == "0 /s" and marked.count() == 0, narrow.page)


def test_the_buttons_give_the_moment_that_is_shown_as_files(narrow: Shown) -> None:
    from sags_node.clients.viewer.saving import KINDS

    page, stamp_ns = narrow.page, 10**16  # in April 1970
    splats = rows_of(4, z=0.08, scale_0=1e-3, scale_1=1e-3, scale_2=1e-4, rot_w=1, opacity=0.9)
    narrow.show(replace(at(stamp_ns), splats=splats))
    page.get_by_text("Export", exact=True).click()
    for kind in KINDS:
        page.get_by_label("What", exact=True).click()
        page.get_by_role("option", name=kind, exact=True).click()
        with page.expect_download() as download:
            page.get_by_role("button", name="Download").click()
        assert Path(download.value.path()).read_text() == f"{kind} of 4 at {stamp_ns}"
        assert "_1970" in download.value.suggested_filename, "its time, not that of the click"
    with page.expect_download() as download:
        page.get_by_role("button", name="Screenshot").click()
    kept = cv2.imread(str(download.value.path()))
    sheet = Sheet().draw(at(7), ALL)
    width = round(sheet.shape[1] * kept.shape[0] / sheet.shape[0])
    assert kept.shape[1] > width and (kept[100 * kept.shape[0] // sheet.shape[0], 50 - width] == 90).all()
    narrow.show(Moment("gone"))
    page.get_by_role("button", name="Download").click()
    page.get_by_text("there is no model now: gone").wait_for()


OUT_OF_REACH = """() => [...document.querySelectorAll("button, input, img, .u-wrap")].filter((each) => {
    if (each.type === "hidden" || !each.checkVisibility()) return false;  // viser's own settings are folded
    each.scrollIntoView({ block: "center" });
    const { left, right, top, width, height } = each.getBoundingClientRect();
    const met = document.elementFromPoint(left + width / 2, top + height / 2);
    const there = each.contains(met) || met?.parentElement === each.parentElement;
    return left < 0 || right > innerWidth || !there;
}).map((each) => each.outerHTML.slice(0, 200))"""
SIDEWAYS = """() => [...document.querySelectorAll("*")].filter((each) =>
    each.scrollWidth > each.clientWidth + 1 && /auto|scroll/.test(getComputedStyle(each).overflowX)
).map((each) => each.outerHTML.slice(0, 200))"""


def test_in_a_window_of_600_px_all_is_reached_without_scrolling_sideways(narrow: Shown) -> None:
    page = narrow.page
    narrow.show(at(1))
    for folded, inside in (("Depth colours", "Near (mm)"), ("Export", "Download"), ("Recording", "Stop")):
        page.get_by_text(folded, exact=True).click()
        page.get_by_text(inside, exact=True).wait_for()
    said = {text.strip() for text in page.get_by_role("button").all_inner_texts()}
    assert {"Freeze", "Screenshot", "left camera", "Remove", "Pause", "Reset model", "Start"} <= said
    for stamp_ns, view in enumerate(VIEWS, 2):
        page.get_by_label("Show", exact=True).click()
        page.get_by_role("option", name=view, exact=True).click()
        until(lambda view=view: narrow.served.panel.view == view, page)
        narrow.show(at(stamp_ns))
        assert page.evaluate("document.documentElement.scrollWidth") <= 600
        assert page.evaluate(SIDEWAYS) == [] and page.evaluate(OUT_OF_REACH) == []
