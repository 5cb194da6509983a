"""Parts of a node, each alone."""

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import plane_result
from waiting import beside

from sags_node.confidence import SURE
from sags_node.config.schema import FoldersSource, LaunchConfig
from sags_node.errors import SagsError
from sags_node.files import whole
from sags_node.findings import by_code
from sags_node.messaging import cdr, content, topics
from sags_node.model.ply import write_ply
from sags_node.node import health as health_module
from sags_node.node import node as node_module
from sags_node.node import operations as node_operations
from sags_node.node.health import WAITING_AFTER, WINDOW, Statistics
from sags_node.node.latest import Latest
from sags_node.node.operations import NodeState, Operations
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.types import FrameResult, Gaussians, NodeHealth, RungState


def test_the_newest_is_kept_also_at_the_end_and_the_replaced_are_counted() -> None:
    """Of each, and of the end, one is told that asks for it."""
    calls = []
    slot: Latest[int] = Latest(on_put=lambda: calls.append(1))
    for value in (1, 2, 3):
        slot.put(value)
    assert slot.get() == 3 and slot.dropped == 2 and len(calls) == 3
    assert slot.get(timeout=0.01) is None
    slot.put(7)
    slot.close()
    assert len(calls) == 5 and not slot.closed
    assert slot.get() == 7 and slot.closed and slot.get() is None


def test_close_wakes_a_waiter() -> None:
    slot: Latest[int] = Latest()
    got: list[int | None] = []
    with beside(lambda: got.append(slot.get())):
        slot.close()
    assert got == [None]


def test_hand_over_drops_nothing() -> None:
    slot: Latest[int] = Latest()
    got = []
    with beside(lambda: [slot.hand_over(i) for i in range(50)] and slot.close()):
        while (value := slot.get(timeout=60)) is not None:
            time.sleep(0.001)
            got.append(value)
    assert got == list(range(50))
    assert slot.dropped == 0


# ---- what the node says of itself, on a clock that only the tests move ---------------------------------


PERIOD = 1 / 30
TAKEN_IN = plane_result()
HELD = replace(TAKEN_IN, held="the left image is black")


class Node:
    """Publishes at 30 Hz."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self._statistics = 0.0, Statistics()
        monkeypatch.setattr(health_module.time, "monotonic", lambda: self.now)

    def publish(self, seconds: float, held: bool = False, result: FrameResult = TAKEN_IN) -> NodeHealth:
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            self._statistics.add(HELD if held else result, 40.0, {})
        return self.health()

    def health(self, working: float = 0.0) -> NodeHealth:
        return self._statistics.health({}, False, False, None, {}, {}, {}, working=working)


def test_a_frame_that_takes_for_ever_is_no_fault_of_the_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    node = Node(monkeypatch)
    node.publish(1.0)
    node.now += 2 * WAITING_AFTER
    for working, code in ((0.0, "no_frames"), (2.0, "mapping_hangs")):
        said = node.health(working)
        assert content.health_answer(said) == {"healthy": False, "state": "waiting", "warnings": [code]}


@pytest.mark.fault("mapping: it hangs while the node stops")
def test_a_node_ends_beside_a_frame_that_does_not(
    phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    began, goes_on = threading.Event(), threading.Event()

    def hang(*_: object) -> FrameResult:
        began.set()
        goes_on.wait()
        raise SagsError("too late")

    monkeypatch.setattr(Pipeline, "process", hang)
    monkeypatch.setattr(node_module, "STOP_SECONDS", 0.1)
    own = ["publish.data:=[]", "publish.control:=null", f"publish.run_dir:={tmp_path / 'run'}"]
    session = open_session(phantom_session, own)
    running = node_module.Node(session.config, session.rig, session.source)
    running.start()
    assert began.wait(60) and (tmp_path / "run/sags.json").exists()
    running.stop()
    assert not (tmp_path / "run/sags.json").exists()  # nobody finds it any more
    assert "the mapping thread does not end" in caplog.text
    goes_on.set()


@pytest.mark.fault("camera: its cap is on, for longer than a second")
def test_a_node_that_takes_no_frame_in_is_not_well(monkeypatch: pytest.MonkeyPatch) -> None:
    node = Node(monkeypatch)
    said = node.publish(3.0)
    assert content.health_answer(said)["healthy"] and said.state == "running"
    assert node.publish(WAITING_AFTER - 3 * PERIOD, held=True).state == "running"
    said = node.publish(6 * PERIOD, held=True)
    assert content.health_answer(said) == {"healthy": False, "state": "held", "warnings": []}
    assert said.rate_hz == pytest.approx(30)  # images go on
    (part,) = content.diagnostics(said, 0).parts
    statuses = cdr.decode(bytes(part), topics.DIAGNOSTICS).status
    assert [int(status.level) for status in statuses[:2]] == [1, 0]  # of the node; of a stage, which works
    assert node.publish(PERIOD).state == "running"
    said = node.publish(0.5, held=True)
    assert said.state == "running" and content.health_answer(said)["healthy"]


@pytest.mark.parametrize(
    ("consumers", "rung", "said"),
    [
        (0, 3, "end other programs, or lower mapping.max_gaussians or vision.scale"),
        (2, 0, "2 consumers take messages: end some, or let them subscribe to thin/ topics; "
               "end other programs"),
    ],
)  # fmt: skip
def test_frames_that_are_missed_are_blamed_on_who_takes_part(consumers: int, rung: int, said: str) -> None:
    """On the lowest rung nothing is left to lower."""
    statistics = Statistics(FoldersSource(left=Path("left"), right=Path("right")))
    result = replace(TAKEN_IN, rung=RungState(rung, 15, "", 5000, 0.5, 1))
    for number in range(WINDOW):
        statistics.add(result, 40.0, {"capture": number, "source": number})
    sockets = {"data": {"open": consumers}}
    told = content.health_fields(statistics.health({}, False, False, None, {}, sockets, {}))["warning_codes"]
    assert told["frames_missed"].endswith(f"this machine is too slow for them: {said}")
    assert told["source_drops"].endswith(f"{said.partition(', or lower')[0]}, or is the disk slow?")


@pytest.mark.fault("depth: none is found")
@pytest.mark.parametrize(
    ("skipped", "tissue", "said"),
    [({}, True, "no depth is known"), ({"depth": "an eye is black"}, True, "an eye is black"),
     ({}, False, "no tissue is seen")],
)  # fmt: skip
def test_a_node_that_shows_nothing_is_not_well(
    skipped: dict[str, str], tissue: bool, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    node, seen, view = Node(monkeypatch), TAKEN_IN.observation, TAKEN_IN.views["left"]
    views = {"left": replace(view, alpha=np.zeros_like(view.alpha))}
    observation = replace(seen, tissue=seen.tissue & tissue)
    blank = replace(TAKEN_IN, views=views, observation=observation, skipped=skipped)
    for before in (0.0, 3.0):  # from the start, and later
        node.publish(before)
        assert content.health_answer(node.publish(0.9, result=blank))["healthy"]
        health = node.publish(0.3, result=blank)
        told = {"healthy": False, "state": "running", "warnings": ["no_model"]}
        assert content.health_answer(health) == told
        assert said in by_code(health.warnings)["no_model"]
    assert content.health_answer(node.publish(PERIOD))["healthy"]


def test_the_latency_is_told_while_the_health_is_being_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mapping thread reads it in every frame."""
    statistics = Statistics()
    assert statistics.latency_s == 0
    for latency_ms in (10.0, 20.0, 90.0):
        statistics.add(TAKEN_IN, latency_ms, {})
    counting, goes_on = threading.Event(), threading.Event()

    def resident_mb() -> float:
        counting.set()
        return float(goes_on.wait(60))

    monkeypatch.setattr(health_module, "resident_mb", resident_mb)
    with ThreadPoolExecutor(2) as others:
        others.submit(statistics.health, {}, False, False, None, {}, {}, {})
        try:
            assert counting.wait(60)
            latency = others.submit(lambda: statistics.latency_s)
            assert latency.result(timeout=10) == pytest.approx(0.020)
        finally:
            goes_on.set()


# ---- `save_model`: the disk is written by a thread that nobody waits for -------------------------------


def operations(newest: FrameResult | None, metric: bool = True) -> Operations:
    pipeline = SimpleNamespace(newest=newest, mapper=None, metric=metric, may_be_sure=metric)
    return Operations(NodeState(LaunchConfig(), pipeline, None, None, ""), lambda *_: None)  # type: ignore[arg-type]


@pytest.mark.fault("disk: hangs while a model is saved")
def test_a_disk_that_hangs_keeps_no_frame_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    goes_on = threading.Event()

    def write(file: Path, gaussians: Gaussians, metric: bool) -> None:
        assert goes_on.wait(30)
        write_ply(file, gaussians, metric=metric)

    monkeypatch.setattr(node_operations, "write_ply", write)
    asked = operations(plane_result())
    file = tmp_path / "model.ply"
    try:
        with ThreadPoolExecutor(1) as mapping:
            answer = asked.handlers()["save_model"]({"path": str(file)})
            mapping.submit(asked.for_mapping.serve).result(timeout=10)  # between two frames
            assert not answer.done()
    finally:
        goes_on.set()
    asked.finish(30)
    assert answer.result(0) == {"path": str(file), "gaussians": len(plane_result().snapshot.gaussians)}
    assert file.stat().st_size > 0
    with pytest.raises(SagsError, match="exists already"):
        asked.handlers()["save_model"]({"path": str(file)}).result(30)
    with pytest.raises(SagsError, match="exists now"), whole(tmp_path / "other", new=True) as late:
        late.touch()  # and meanwhile somebody else is quicker
        (tmp_path / "other").write_text("somebody else's work")
    assert (tmp_path / "other").read_text() == "somebody else's work"


def test_a_model_without_a_calibration_says_so_and_is_nowhere_sure(tmp_path: Path) -> None:
    most = {}
    for metric in (True, False):
        file = tmp_path / f"{metric}.ply"
        operations(plane_result(), metric).handlers()["save_model"]({"path": str(file)}).result(30)
        head, body = file.read_bytes().split(b"end_header\n")
        assert (b"comment units relative" in head) == (not metric)
        most[metric] = np.frombuffer(body, "<f4").reshape(-1, head.count(b"property"))[:, -1].max()
    assert most[True] > SURE > most[False]


@pytest.mark.fault("file: a model is to be saved under a name that nobody can write, or nobody can be told")
def test_a_model_that_cannot_be_saved_is_refused_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SagsError, match="no model yet"):
        operations(None).handlers()["save_model"]({"path": str(tmp_path / "model.ply")})
    save = operations(plane_result()).handlers()["save_model"]
    with pytest.raises(SagsError, match=r"cannot write .*name too long; name another place"):
        save({"path": f"{tmp_path / ('n' * 300)}.ply"}).result(30)
    here = Path(os.fsdecode(os.fsencode(tmp_path / "caf") + b"\xe9"))  # as an old disk or archive has names
    here.mkdir()
    monkeypatch.chdir(here)
    with pytest.raises(SagsError, match=r"no UTF-8 text.*rename it") as refused:
        save({"path": "model.ply"})
    str(refused.value).encode()  # it can be sent
