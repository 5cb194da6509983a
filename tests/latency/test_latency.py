"""`sags latency`: codes, the figures on a virtual clock, and chains whose delay their own stamps tell."""

import itertools
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browsers import new_page
from synthetic import plane_result, publisher
from waiting import beside, repeating, until

from sags_node.clients.latency.ledger import Ledger, Moment
from sags_node.clients.latency.run import WAITING, measure_latency
from sags_node.clients.latency.shown import NUMBERS, Codes, Page, Pushed, Reader, paint
from sags_node.clients.overlay.stream import OverlayStream
from sags_node.config.schema import PushSource
from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.publisher import Publisher
from sags_node.sources.push import PushedPictures
from sags_node.types import U8, Camera, FrameResult

MS = 1_000_000
HELD = 0.2  # s, by which a chain is known to hold images


def numbered(number: int) -> U8:
    """On tissue's colours."""
    picture = np.random.default_rng(0).integers(90, 150, (256, 320, 3)).astype(np.uint8)
    paint(picture, number)
    return picture


@pytest.mark.parametrize("number", [0, 7, 500, NUMBERS - 1])
def test_a_code_is_read_from_a_picture_that_was_filmed(number: int) -> None:
    picture, reader = numbered(number), Reader()
    seen = np.float32([[12, 9], [300, 30], [310, 250], [30, 235]])
    corners = np.float32([[0, 0], [319, 0], [319, 255], [0, 255]])
    filmed = cv2.warpPerspective(picture, cv2.getPerspectiveTransform(corners, seen), (320, 256))
    filmed = cv2.GaussianBlur(filmed, (0, 0), 1.0) // 2
    assert reader.read(picture) == reader.read(filmed) == number
    assert reader.read(np.full_like(picture, 90)) is None


def test_two_codes_in_one_exposure_are_not_taken_for_a_third() -> None:
    reader = Reader()
    for number in range(0, NUMBERS, 41):
        for share in (0.3, 0.5, 0.7):
            both = cv2.addWeighted(numbered(number), share, numbered(number + 1), 1 - share, 0)
            assert reader.read(both) in (None, number, (number + 1) % NUMBERS)


class Chain:
    """A camera of 30 Hz before a node and a screen, on a clock that only the test moves. Every eighth image
    is lost, and every eleventh unreadable; numbers begin anew on the way."""

    def __init__(self, mapped_ms: float, wall_ms: float = 0.0) -> None:
        self.ledger, jitter = Ledger("sent"), np.random.default_rng(1)
        self.delays = []
        for i in range(200):
            begun = Moment(i * 33 * MS, (i * 33 + 10**6) * MS)
            self.ledger.shown((i + NUMBERS - 50) % NUMBERS, begun)
            if i % 8 == 0:
                continue
            delay = int((20 + mapped_ms + jitter.uniform(0, 30)) * MS)
            is_set = round(wall_ms * MS) if i >= 190 else 0
            at = Moment(begun.monotonic + delay, begun.wall + delay + is_set)
            stamps = {"captured": begun.wall, "published": at.wall - 15 * MS - is_set}
            stamps["received"] = at.wall - 5 * MS
            number = None if i % 11 == 0 else (i + NUMBERS - 50) % NUMBERS
            self.ledger.seen(number, stamps, at)
            if number is not None:
                self.delays.append(delay / MS)
                again = Moment(*(clock + MS for clock in at))
                self.ledger.seen(number, stamps, again)  # it stays until the next one
        self.figures = self.ledger.figures(Moment(0, 0), Moment(10**18, 10**18))


def test_200_ms_more_on_the_way_are_found_as_200_ms_more_and_where_they_are() -> None:
    fast, slow = Chain(10), Chain(210)
    for chain in (fast, slow):
        exact = {f"p{q:g}": np.percentile(chain.delays, q) for q in (50, 95, 99, 99.9)}
        assert chain.figures["total_ms"] == pytest.approx(exact | {"max": max(chain.delays)}, abs=0.01)
    more = {key: slow.figures["total_ms"][key] - fast.figures["total_ms"][key] for key in exact}
    assert more == pytest.approx(dict.fromkeys(exact, 200.0), abs=0.02)
    for name, added in (("captured", 0), ("published", 200), ("received", 0), ("shown", 0)):
        parts = [chain.figures["parts_ms"][name]["p99"] for chain in (fast, slow)]
        assert parts[1] - parts[0] == pytest.approx(added, abs=0.02)
    assert fast.figures["parts_ms"]["shown"]["max"] == 5 and fast.figures["parts_ms"]["received"]["p50"] == 10


def test_losses_and_what_cannot_be_read_are_counted() -> None:
    figures = Chain(10).figures
    lost = [i for i in range(200) if i % 8 == 0]
    unread = [i for i in range(200) if i % 11 == 0 and i % 8]
    assert (figures["codes"], figures["read"]) == (200, 200 - len(lost) - len(unread))
    assert (figures["lost"], figures["unreadable"]) == (len(lost) + len(unread), len(unread))
    assert figures["unknown"] == figures["clock_set"] == 0
    ledger = Ledger("sent")
    ledger.shown(3, Moment(5, 5))
    ledger.seen(3, {}, Moment(4, 4))  # before it was shown
    ledger.seen(9, {}, Moment(6, 6))
    figures = ledger.figures(Moment(0, 0), Moment(10, 10))
    assert (figures["unknown"], figures["read"], figures["total_ms"]) == (2, 0, {})


def test_a_clock_that_is_set_meanwhile_changes_no_delay() -> None:
    calm, jumped = Chain(10), Chain(10, wall_ms=-500.0)
    assert jumped.figures["total_ms"] == calm.figures["total_ms"]
    assert jumped.figures["clock_set"] == sum(i % 8 != 0 and i % 11 != 0 for i in range(190, 200))
    for name, spread in calm.figures["parts_ms"].items():
        assert jumped.figures["parts_ms"][name] == pytest.approx(spread, abs=0.7)  # ten of 160 fewer


def shows(left: U8, stamp_ns: int, frame_id: int) -> FrameResult:
    """A node's result with this left image."""
    result = plane_result(frame_id, stamp_ns)
    height, width = left.shape[:2]
    camera = Camera(width, height, result.pair.camera.K, np.eye(4))
    return replace(result, pair=replace(result.pair, camera=camera, left=left, right=None))


def show_late(node: Publisher, left: U8, stamp_ns: int, frame_id: int) -> None:
    """As a node that holds images for `HELD` s."""
    while time.time_ns() < stamp_ns + HELD * 1e9:
        time.sleep(0.001)
    node.publish_result(shows(left, stamp_ns, frame_id), dropped=0)
    node.poll(0)


@contextmanager
def measuring(
    codes: Codes, run_dir: Path, ended: Callable[[], object], overlay: NodeAddress | None = None
) -> Iterator[dict[str, Any]]:
    """In a thread that is joined; gives what it finds."""
    found: dict[str, Any] = {}
    node, stop = NodeAddress(run_dir=run_dir), threading.Event()

    def measure() -> None:
        try:
            with codes:
                found.update(measure_latency(node, overlay, codes, 2.0, print, stop))
        finally:
            ended()

    with beside(measure, stop.set):
        yield found


@pytest.mark.live
def test_a_chain_that_holds_pictures_is_so_slow(phantom_session: Path, tmp_path: Path) -> None:
    """By its own stamps: no image leaves before `HELD` after its capture."""
    source = PushedPictures(PushSource(endpoint="tcp://127.0.0.1:*"), (320, 256))
    with publisher(tmp_path / "run") as node, source:
        codes = Pushed(source.endpoint, phantom_session, rate=20.0)
        with measuring(codes, tmp_path / "run", source.stop) as found:
            for frame in source:
                show_late(node, frame.left, frame.t_capture_ns, frame.frame_id)
    assert found["read"] > 0 and found["read"] + found["lost"] == found["codes"]
    assert found["unknown"] == found["unreadable"] == found["clock_set"] == 0
    # Its stamp is that of the sending.
    assert found["parts_ms"]["captured"]["max"] == pytest.approx(0, abs=0.1)
    assert min(spread["p50"] for spread in (found["parts_ms"]["published"], found["total_ms"])) >= 1e3 * HELD
    assert found["total_ms"]["max"] >= found["parts_ms"]["published"]["max"]


class Painted(Codes):
    """Of images that the test itself publishes."""

    hint = "are codes painted?"

    def __init__(self) -> None:
        self.ledger = Ledger("sent")


@contextmanager
def overlaid(run_dir: Path, behind: int, codes: Painted) -> Iterator[NodeAddress]:
    """Publishes coded images at up to 30 Hz, and an overlay `behind` images behind them; it is given."""
    with publisher(run_dir) as node, OverlayStream("overlay", run_dir, (0, 0, 255)) as overlay:
        stamps: list[int] = []

        def step(number: int) -> None:
            at = Moment.now()
            stamps.append(at.wall)
            codes.ledger.shown(number % NUMBERS, at)
            node.publish_result(shows(numbered(number % NUMBERS), at.wall, number), dropped=0)
            if number >= behind:
                empty, old = np.zeros((256, 320, 4), np.uint8), number - behind
                overlay.show({"left": empty}, old, stamps[old], 0)
            overlay.serve()
            node.poll(33)

        with repeating(step):
            yield NodeAddress("overlay", run_dir=run_dir)


@pytest.mark.live
def test_an_overlay_ten_pictures_behind_is_measured(tmp_path: Path) -> None:
    def measured() -> dict[str, Any] | None:
        """Where this process stood still most images are lost, and it is measured again."""
        codes, ended = Painted(), threading.Event()
        with overlaid(tmp_path, 10, codes) as overlay:
            with measuring(codes, tmp_path, ended.set, overlay) as found:
                until(ended.is_set)
        return found if found["read"] > found["lost"] else None

    found = until(measured)
    assert found["unknown"] == found["unreadable"] == 0
    assert found["parts_ms"]["drawn"]["p50"] >= 10 * 33 - 50  # the image itself leaves up to so much later


@pytest.mark.live
def test_an_overlay_that_is_behind_all_pictures_is_named(tmp_path: Path) -> None:
    codes, said, stop = Painted(), list[str](), threading.Event()
    with overlaid(tmp_path, WAITING + 10, codes) as overlay:

        def tell(why: str) -> None:
            said.append(why)
            if "images behind" in why or len(said) == 10:
                stop.set()

        with pytest.raises(SagsError, match="images behind"):
            measure_latency(NodeAddress(run_dir=tmp_path), overlay, codes, 2.0, tell, stop)
    assert "images behind" in said[-1]


@pytest.mark.live
@pytest.mark.alone
def test_a_camera_that_films_the_page_closes_the_circle(tmp_path: Path) -> None:
    """Screenshots are what the camera sees; they are published `HELD` later."""
    ended, run_dir = threading.Event(), tmp_path / "run"
    with new_page(viewport={"width": 400, "height": 400}) as display, publisher(run_dir) as node:
        codes = Page(0)  # serves from now on until it was measured
        with measuring(codes, run_dir, ended.set) as found:
            display.goto(codes.address)
            for number in itertools.count():
                if ended.is_set():
                    break
                shot = cv2.imdecode(np.frombuffer(display.screenshot(), np.uint8), cv2.IMREAD_COLOR)
                show_late(node, shot[..., ::-1].copy(), time.time_ns(), number)
            until(lambda: "ended" in display.inner_text("#said"))
    assert found["from"] == "displayed" and found["read"] > 0 and found["unknown"] == 0
    assert found["parts_ms"]["published"]["p50"] >= 1e3 * HELD
    assert found["total_ms"]["p50"] >= 1e3 * HELD
    assert found["parts_ms"]["captured"]["p50"] > 0  # it is drawn before it is filmed


@pytest.mark.live
def test_only_the_page_itself_says_what_is_shown() -> None:
    """Else any page that is open in the browser could; and the newest page is the one that counts."""
    good = '{"page": 1e12, "number": 5, "shown_ms": 100.0, "now_ms": 104.5}'
    with Page(0) as page:
        own = page.address.rstrip("/")
        wrong = ("", "[]", good.replace("5,", "1000,"), good.replace("100.0", "1e300"), good + " " * 2000)
        for said, headers, status in (
            (good, {"Origin": own}, 200),
            (good, {"Origin": "http://elsewhere.example"}, 409),
            (good, {"Origin": "http://elsewhere.example", "Host": "elsewhere.example"}, 409),
            *((each, {"Origin": own}, 400) for each in wrong),
            (good.replace("1e12", "2e12"), {"Origin": own}, 200),
            (good, {"Origin": own}, 409),
        ):
            request = urllib.request.Request(f"{page.address}shown", said.encode(), headers)
            try:
                with urllib.request.urlopen(request, timeout=60) as answer:
                    came = answer.status
            except urllib.error.HTTPError as error:
                came = error.code
            assert came == status, (said, headers)
        figures = page.ledger.figures(Moment(0, 0), Moment.now())
        assert (figures["codes"], figures["read"]) == (2, 0)
