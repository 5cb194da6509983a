"""The examples, run as their first lines say; others stand beside the tests of what they use."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from places import ROOT, SESSION
from waiting import until

from sags_node.errors import SagsError
from sags_node.messaging.received import ReceivedCloud, ReceivedText
from sags_node.messaging.subscriber import Subscriber

pytestmark = [pytest.mark.live, pytest.mark.alone]


def says_that_it_runs(overlay: Subscriber) -> bool:
    status = overlay.latest("status")
    return isinstance(status, ReceivedText) and json.loads(status.text)["state"] == "running"


def holds_one(node: Subscriber) -> bool:
    cloud = node.latest("anchors")
    return isinstance(cloud, ReceivedCloud) and len(cloud.points) == 1


def test_all_start_and_end_together_and_the_notebook_plots_what_was_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plt = pytest.importorskip("matplotlib.pyplot", reason="plots need the extra report")
    (tmp_path / "run").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.setenv("BRIDGE", "web --port 0")
    monkeypatch.chdir(tmp_path)
    words = [SESSION, "source.loop:=true", "publish.data:=[]", "publish.control:=tcp://127.0.0.1:*"]
    together = subprocess.Popen([ROOT / "examples/all_at_once.sh", *words], start_new_session=True)
    try:
        with (
            Subscriber(["anchors"], patience=60) as node,
            Subscriber([], ns="overlay", patience=60) as overlay,
        ):
            until(lambda: says_that_it_runs(overlay) and holds_one(node))
            topics = [
                word for name in ("left/render/depth", "points", "anchors") for word in ("--topics", name)
            ]
            record = [sys.executable, "-m", "sags_node", "bag", "record", "-o", "out/case1", *topics]
            recorder = subprocess.Popen(record)
            last = node.latest("anchors")
            until(lambda: (node.latest("anchors") or last).meta.seq > last.meta.seq + 50)
            recorder.send_signal(signal.SIGINT)
            assert recorder.wait(60) in (0, 3), "3: some messages were lost"
    finally:
        together.terminate()
        together.wait(60)
    with pytest.raises(ProcessLookupError):
        os.killpg(together.pid, 0)  # nothing of it is left
    with pytest.raises(SagsError):
        Subscriber([], ns="overlay", patience=0)

    monkeypatch.setattr(plt, "show", lambda: None)
    notebook = json.loads((ROOT / "examples/play_a_bag.ipynb").read_text(encoding="utf-8"))
    assert all(cell.get("outputs", []) == [] for cell in notebook["cells"])
    code = "\n".join("".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code")
    names: dict[str, object] = {}
    plt.switch_backend("agg")
    exec(code.replace("SECONDS = 5.0", "SECONDS = 1.0"), names)
    plt.close("all")
    depth, path = np.asarray(names["depth"]), np.asarray(names["path"])
    assert 0.03 < np.nanmedian(depth) < 0.2 and len(np.unique(path[:, 0])) > 1, (
        "a frame, and the anchor in more"
    )
