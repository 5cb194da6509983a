"""Warnings reach people, and every one of them can be looked up."""

import json
import re
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from places import ROOT
from rich.console import Console
from synthetic import health, plane_result, publisher, stream

from sags_node.cli.foreground import run_node
from sags_node.clients.overlay.draw import color_key, draw
from sags_node.clients.overlay.frame import TissueFrame
from sags_node.clients.overlay.mark import draw_mark, headlines
from sags_node.clients.viewer.feed import Moment, Status
from sags_node.findings import STAGES, by_code, by_stage, in_words
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.cdr import decode
from sags_node.messaging.content import diagnostics, status
from sags_node.messaging.introspection import topic_echo
from sags_node.messaging.received import ReceivedText
from sags_node.messaging.subscriber import Subscriber
from sags_node.node.health import MOST_LEFT_OUT, WINDOW, Statistics
from sags_node.node.node import HEALTH_PERIOD, Node
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.terminal import console as terminal
from sags_node.tools.evaluation.measure import FrameRow, MeasureOptions
from sags_node.tools.evaluation.report import warning_table
from sags_node.tools.evaluation.run import RunFacts
from sags_node.tools.evaluation.summary import summarise
from sags_node.types import Camera, Finding, NodeHealth

BLACK = Finding("right_eye_black", "the right image is black: check the light")
ROWS = Finding("rows_differ", "rows of the eyes differ by 1.2 px: the calibration no longer fits")


# ---- every code is known (docs/dev/check_docs.py: and explained) -----------------------------------------


def test_every_code_that_is_made_is_known() -> None:
    imported = re.compile(r"^from sags_node\.types import (\([^)]*|.*)\bFinding\b", re.MULTILINE)
    texts = [file.read_text(encoding="utf-8") for file in (ROOT / "sags_node").rglob("*.py")]
    # A calibration's findings are others. A code that is a variable `by_stage` refuses if it is unknown.
    own = "\n".join(filter(imported.search, texts))
    made = set(re.findall(r'\bFinding\(\s*f?"(.+?)"', own))
    assert len(made) >= 8  # or the search has lost them
    patterns = {re.sub(r"\{.*?\}", "[a-z]+", code) for code in made}
    assert [each for each in patterns if not any(re.fullmatch(each, code) for code in STAGES)] == []


def test_a_code_that_nobody_could_look_up_is_refused() -> None:
    with pytest.raises(KeyError, match="unheard_of"):
        by_stage([Finding("unheard_of", "something is wrong")])


# ---- on the wire -----------------------------------------------------------------------------------------


def test_codes_stand_beside_the_words() -> None:
    black, other = BLACK, Finding("left_eye_plain", "the left image is of one colour: check the lens")
    said = replace(health(), warnings=by_stage([black, ROWS, other]))
    fields = json.loads(json.dumps(status(said, None)))
    assert fields["warnings"] == {"eyes": f"{black.text}; {other.text}", "calibration": ROWS.text}
    assert fields["warning_codes"] == {found.code: found.text for found in (black, other, ROWS)}
    content = diagnostics(said, 0)
    statuses = decode(b"".join(content.parts), "diagnostic_msgs/msg/DiagnosticArray").status
    (eyes,) = (each for each in statuses if each.name == "eyes")
    assert eyes.level in (1, b"\x01")
    assert {value.key: value.value for value in eyes.values} == {
        black.code: black.text,
        other.code: other.text,
    }


@pytest.mark.live
def test_a_node_says_at_once_what_begins_and_what_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between two of the messages that come every second."""
    found: list[Finding] = []
    monkeypatch.setattr(Pipeline, "warnings", property(lambda self: by_stage(found)))
    overrides = ["source.loop:=true", "source.rate:=10", "mapping.iterations:=0", "publish.control:=null"]
    overrides += ["publish.data:=[tcp://127.0.0.1:*]", f"publish.run_dir:={tmp_path / 'run'}"]
    session = open_session(ROOT / "replay/phantom_pull", overrides)
    node = Node(session.config, session.rig, session.source)
    node.start()
    try:
        with Subscriber(["status"], run_dir=tmp_path / "run") as subscriber:
            last = subscriber.wait("status", 30)
            delays = []
            for wanted in 3 * ([BLACK], []):
                last = before = subscriber.wait("status", 60, after=last)
                found[:] = wanted
                while not isinstance(last, ReceivedText) or last.warnings() != by_code(by_stage(wanted)):
                    last = subscriber.wait("status", 60, after=last)
                delays.append((last.meta.publish_ns - before.meta.publish_ns) * 1e-9)
    finally:
        node.stop()
    assert min(delays) < 0.9 * HEALTH_PERIOD, "by the node's stamps, before the next one was due"


# ---- the flow of frames ----------------------------------------------------------------------------------


def flowing(
    statistics: Statistics, frames: int, dropped: int, slot: str, before: int = 0, latency_ms: float = 1.0
) -> set[str]:
    """Codes after so many frames more, over which so many were left out."""
    result = plane_result()
    for number in range(frames):
        statistics.add(result, latency_ms, {slot: before + dropped * (number + 1) // frames})
    said = statistics.health(
        dropped={}, stopping=False, paused=False, error=None, warnings={}, connections={}, views={}
    )
    return set(by_code(said.warnings))


@pytest.mark.fault("frames: left out, twice as many as may be")
@pytest.mark.parametrize(("slot", "code"), [("capture", "frames_missed"), ("source", "source_drops")])
def test_frames_that_are_left_out_are_told_of(slot: str, code: str) -> None:
    count = round(2 * MOST_LEFT_OUT * WINDOW)
    statistics = Statistics()
    assert flowing(Statistics(), WINDOW, count // 4, slot) == set()  # a few are no warning
    assert flowing(statistics, WINDOW, count, slot) == {code}
    assert flowing(statistics, WINDOW, 0, slot, before=count) == set()


# ---- people ----------------------------------------------------------------------------------------------


def test_the_mark_says_what_is_wrong_and_stays_on_the_rim() -> None:
    assert headlines(by_code({"eyes": (BLACK,)})) == ["the right image is black"]
    many = {str(number): f"number {number}: fix it" for number in range(5)}
    assert headlines(many) == ["number 0", "number 1 (and 3 more)"]
    rgba = np.zeros((512, 640, 4), np.uint8)
    draw_mark(rgba, in_words({"eyes": (BLACK,)}))
    rows = np.flatnonzero(rgba[..., 3].any(1))
    assert rows.max() == 511 and rows.min() > 0.9 * 512
    assert set(np.unique(rgba[..., 3])) == {0, 255}
    small = np.zeros((120, 160, 4), np.uint8)
    draw_mark(small, {"rows_differ": 3 * ROWS.text.replace(":", "")})
    assert small[-1, :, 3].any()


@pytest.mark.parametrize("shift", [7, 25])
def test_the_mark_lies_farther_left_in_the_right_eye(shift: int) -> None:
    left, right = np.zeros((2, 240, 320, 4), np.uint8)
    draw_mark(left, by_code({"eyes": (BLACK,)}))
    draw_mark(right, by_code({"eyes": (BLACK,)}), shift)
    assert left.any() and np.array_equal(left[:, shift:], right[:, :-shift])


def test_the_mark_is_drawn_over_instruments_in_both_eyes_and_survives_the_colour_key() -> None:
    size = (240, 320)
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    frame = TissueFrame(
        1, 1, "s", 0, Camera(320, 240, K, np.eye(4)), 0.004, np.full(size, 0.06, np.float32),
        np.zeros(size, np.bool_), {},
    )  # fmt: skip
    for baseline in (0.0, 0.004):
        assert not draw(frame, [], baseline).any()
        rgba = draw(frame, [], baseline, warnings=by_code({"eyes": (BLACK,)}))
        shown = rgba[..., 3] == 255
        assert shown.any() and np.array_equal(color_key(rgba, (0, 0, 255))[shown], rgba[shown][:, :3])


class Playing:
    """A node as `sags run` sees it: what it warns of at each look."""

    sent = 7

    def __init__(self, *looks: tuple[Finding, ...]) -> None:
        self._looks = list(looks)

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def wait(self, timeout: float) -> bool:
        return not self._looks

    def health(self) -> NodeHealth:
        found = self._looks.pop(0) if self._looks else ()
        return replace(health(), warnings=by_stage(found))


def test_sags_run_says_when_a_warning_begins_and_ends(capsys: pytest.CaptureFixture[str]) -> None:
    """Once, however its figure moves."""
    moving = ROWS._replace(text="rows of the eyes differ by 1.3 px")
    playing: Any = Playing((), (BLACK,), (BLACK, ROWS), (BLACK, moving), (moving,), ())
    run_node(playing, None, Console(quiet=True), stop=Event())
    began, more, over, last = capsys.readouterr().err.splitlines()
    assert BLACK.text in began and BLACK.code in began and "docs/warnings.md" in began
    assert ROWS.text in more and ROWS.code in more
    assert "over after" in over and BLACK.code in over and ROWS.code in last


def test_without_a_terminal_sags_run_says_now_and_then_what_it_does(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "SAY_EVERY", 0.0)
    playing: Any = Playing((), ())
    run_node(playing, None, Console(quiet=True), stop=Event())
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and all("running" in line and "published: 7" in line for line in lines)


def test_the_report_says_when_and_what_to_do() -> None:
    facts = RunFacts(0, 1.0, None, 1.0, {}, {}, 1, {})
    warned = replace(facts, warnings={BLACK.code: "<" + BLACK.text})
    rows = [FrameRow(k, k / 30, {}, warned if 3 <= k < 8 else facts) for k in range(10)]
    table = warning_table(rows)
    assert "5 frames, 3 to 7" in table and "&lt;" + BLACK.text in table and BLACK.code in table
    assert warning_table(rows[:3]) == ""
    assert summarise("s", rows, MeasureOptions(hold_out=0), {}, None)["warnings"] == {BLACK.code: 5}


@pytest.mark.live
def test_topic_echo_tells_of_warnings_whatever_the_topic(tmp_path: Path) -> None:
    warned = replace(health(), warnings=by_stage([BLACK]))
    told: list[dict[str, str]] = []
    with publisher(tmp_path / "run") as running:
        with stream(running, said=lambda: warned):
            node = NodeAddress(endpoint=running.connection.data[-1])
            records = []
            for record in topic_echo("tf", node, seconds=20, warned=lambda found: told.append(dict(found))):
                records.append(record["topic"])
                if told:
                    break
    assert set(records) == {"sags/tf"} and told[0] == {BLACK.code: BLACK.text}


def test_the_viewer_shows_them_below_the_status() -> None:
    panel = pytest.importorskip(
        "sags_node.clients.viewer.panel", reason="viser is not installed (extra: viewer)"
    )
    status = Status("running", warning_codes={BLACK.code: f"<b>{BLACK.text}"})
    shown = panel.status_line(Moment(None, status))
    assert f"&lt;b&gt;{BLACK.text}" in shown and BLACK.code in shown and "sags-warning" in shown
    assert "sags-warning" not in panel.status_line(Moment(None, Status("running")))
