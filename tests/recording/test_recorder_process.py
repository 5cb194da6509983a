"""The recorder that a node starts: whatever it does or does not do, the node gets an answer and can end."""

import os
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from synthetic import publisher, stream
from waiting import until

from benchmarks.node.processes import children
from sags_node.clients.recording.info import bag_info
from sags_node.errors import SagsError
from sags_node.findings import Finding, by_stage
from sags_node.messaging.content import health_answer
from sags_node.node import recorder as child
from sags_node.node.recorder import RecorderProcess
from sags_node.types import NodeHealth

pytestmark = pytest.mark.live

ANSWER = 60.0  # s: a child starts in one or two


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[RecorderProcess]:
    """Of a node that publishes a plane."""
    with publisher(tmp_path / "run", ipc=True) as running, stream(running):
        made = RecorderProcess("sags", f"ipc://{tmp_path / 'run/sags.ipc'}")
        yield made
        for process in recorders():  # what a failed test leaves behind must not keep it from ending
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        made.close()


def recorders() -> list[int]:
    """The processes that this one has started to record."""
    return children("record")


@pytest.mark.fault("node: it runs in a folder whose name is no text, and is to record into it")
def test_a_folder_that_nobody_can_be_told_of_is_refused(
    recorder: RecorderProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = Path(os.fsdecode(os.fsencode(tmp_path / "caf") + b"\xe9"))
    here.mkdir()
    monkeypatch.chdir(here)
    with pytest.raises(SagsError, match=r"no UTF-8 text.*rename it") as refused:
        recorder.start({"path": "case1"}).result(ANSWER)
    str(refused.value).encode()  # it can be sent
    assert recorder.status() is None


@pytest.mark.fault("process: the recorder hangs")
@pytest.mark.fault("process: the recorder is late with a snapshot")
@pytest.mark.fault("process: the recorder hangs while the node stops")
def test_a_recorder_that_does_not_answer_is_ended(
    recorder: RecorderProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a disk that hangs: every request is answered, a late snapshot is not taken for the next one, the
    next recording begins, and a node can end."""
    recorder.start({"path": str(tmp_path / "ring"), "snapshot_seconds": 5}).result(ANSWER)
    (process,) = recorders()
    os.kill(process, signal.SIGSTOP)
    with monkeypatch.context() as patched:
        patched.setattr(child, "SNAPSHOT_SECONDS", 0.2)
        with pytest.raises(SagsError, match="no snapshot came from the recorder"):
            recorder.snapshot().result(ANSWER)
    with pytest.raises(SagsError, match="still writes the snapshot before; ask again later"):
        recorder.snapshot().result(ANSWER)
    os.kill(process, signal.SIGCONT)

    def next_one() -> dict[str, object] | None:
        try:
            return recorder.snapshot().result(ANSWER)
        except SagsError as error:
            assert "still writes" in str(error)
            return None

    assert until(next_one)["snapshot"] == str(tmp_path / "ring/snapshot_001")
    os.kill(process, signal.SIGSTOP)
    monkeypatch.setattr(child, "FINISH_SECONDS", 0.2)
    with pytest.raises(SagsError, match=r"did not finish in 0\.2 s.*sags bag recover"):
        recorder.stop().result(ANSWER)
    assert recorders() == []
    recorder.start({"path": str(tmp_path / "bag")}).result(ANSWER)
    (process,) = recorders()
    os.kill(process, signal.SIGSTOP)
    recorder.close()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def ended(recorder: RecorderProcess) -> list[Finding]:
    """What it tells of a recording that ended by itself; on a busy machine one may also lose messages."""
    return [told for told in recorder.findings() if told.code == "recording_ended"]


@pytest.mark.fault("process: the recorder is killed while a node records")
def test_a_recording_that_has_ended_by_itself_is_told(recorder: RecorderProcess, tmp_path: Path) -> None:
    assert recorder.status() is None and not list(recorder.findings())
    recorder.start({"path": str(tmp_path / "bag")}).result(ANSWER)
    until(lambda: (recorder.status() or {}).get("messages"))
    assert recorder.status()["ended"] is None and not ended(recorder)
    (process,) = recorders()
    os.kill(process, signal.SIGKILL)
    (told,) = until(lambda: ended(recorder))
    assert f"sags bag recover {tmp_path / 'bag'}" in told.text
    health = NodeHealth("running", 30.0, {}, {}, {}, {}, 1, 1.0, {}, warnings=by_stage([told]))
    assert health_answer(health) == {"healthy": False, "state": "running", "warnings": ["recording_ended"]}
    with pytest.raises(SagsError):
        recorder.start({"path": str(tmp_path / "bag")}).result(ANSWER)  # it is there already
    assert ended(recorder) == [told]  # still nothing is recorded
    with pytest.raises(SagsError, match="the recorder was ended; save what it wrote"):
        recorder.stop().result(ANSWER)
    recorder.start({"path": str(tmp_path / "next")}).result(ANSWER)
    assert not ended(recorder)
    recorder.stop().result(ANSWER)
    assert recorder.status() is None


def test_a_ring_outlives_a_snapshot_that_fails(recorder: RecorderProcess, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SagsError, match="cannot write"):
        recorder.start({"path": str(tmp_path / "file"), "snapshot_seconds": 5}).result(ANSWER)
    ring = tmp_path / "ring"
    (ring / "snapshot_000").mkdir(parents=True)
    (ring / "snapshot_000/of_yesterday").touch()
    recorder.start({"path": str(ring), "snapshot_seconds": 50, "max_bag_size": 300_000}).result(ANSWER)
    ring.rename(tmp_path / "away")
    ring.touch()
    with pytest.raises(SagsError, match="cannot write"):
        recorder.snapshot().result(ANSWER)
    ring.unlink()
    (tmp_path / "away").rename(ring)
    until(lambda: (recorder.status().get("kept_s") or 0) > 0.2)  # more than one file holds
    taken = recorder.snapshot().result(ANSWER)
    assert taken["snapshot"] == str(ring / "snapshot_001")
    saved = bag_info(ring / "snapshot_001")
    assert saved["messages"] == taken["messages"] > 0 and len(saved["files"]) > 1
    assert (ring / "snapshot_000/of_yesterday").exists()
    assert recorder.stop().result(ANSWER)["messages"] == taken["messages"]


@pytest.mark.fault("process: the recorder does not begin")
def test_a_recorder_that_does_not_begin_is_ended(
    recorder: RecorderProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child, "START_SECONDS", 0.01)
    with pytest.raises(SagsError, match=r"did not begin in 0\.01 s"):
        recorder.start({"path": str(tmp_path / "bag")}).result(ANSWER)
    assert recorders() == []
    with pytest.raises(SagsError, match="nothing is being recorded"):
        recorder.stop().result(ANSWER)
