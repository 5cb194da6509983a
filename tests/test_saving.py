"""`save_model`: the disk is written by a thread that nobody waits for."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from synthetic import plane_result

from sags_node.config.schema import LaunchConfig
from sags_node.errors import SagsError
from sags_node.model.ply import write_ply
from sags_node.node import operations as node_operations
from sags_node.node.operations import NodeState, Operations
from sags_node.types import FrameResult, Gaussians


def operations(newest: FrameResult | None) -> Operations:
    pipeline = SimpleNamespace(newest=newest, mapper=None)
    return Operations(NodeState(LaunchConfig(), pipeline, None, None), lambda *_: None)  # type: ignore[arg-type]


@pytest.mark.fault("disk: hangs while a model is saved")
def test_a_disk_that_hangs_keeps_no_frame_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    goes_on = threading.Event()

    def write(file: Path, gaussians: Gaussians) -> None:
        assert goes_on.wait(30)
        write_ply(file, gaussians)

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


def test_before_the_first_frame_there_is_nothing_to_save(tmp_path: Path) -> None:
    with pytest.raises(SagsError, match="no model yet"):
        operations(None).handlers()["save_model"]({"path": str(tmp_path / "model.ply")})
