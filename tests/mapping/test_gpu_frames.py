"""Frames of a recorded session on Warp's CPU device, each from the state that the CPU left."""

import numpy as np
import pytest
from places import SESSION
from warp_on_cpu import use_warp_on_cpu

from sags_node.mapping import mapper
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.quality.metrics import as_float, psnr
from sags_node.types import FrameResult

SMALL = ["vision.width:=160", "vision.height:=128", "mapping.max_gaussians:=2000", "source.frames:=20"]


def test_each_of_twenty_frames_is_the_cpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """Left alone, two runs drift apart: rounding decides now and then if a Gaussian counts in a pixel."""
    monkeypatch.setattr(mapper, "FIRST_STEPS", 3)  # Warp's CPU device is slow
    session = open_session(SESSION, ["source.pace:=step", *SMALL])
    cpu = Pipeline(session.config, session.rig)
    use_warp_on_cpu(monkeypatch)
    on_device = Pipeline(session.config.model_copy(update={"device": "cuda"}), session.rig)
    budget = StepBudget(1)
    with session.source as source:
        for frame in source:
            expected, found = cpu.process(frame, budget), on_device.process(frame, budget)
            a, b = expected.snapshot, found.snapshot
            assert b.counts == a.counts and np.array_equal(b.gaussians.ids, a.gaussians.ids), frame.frame_id
            assert _psnr(found) == pytest.approx(_psnr(expected), abs=0.02), frame.frame_id
            _hand_over(cpu, on_device)
    assert frame.frame_id == 19 and 1000 < len(a.gaussians) < 2000
    assert "device" not in on_device.warnings  # it did not fail


def _psnr(result: FrameResult) -> float:
    seen = result.observation
    return psnr(as_float(result.views["left"].rgb), as_float(seen.image), seen.tissue)


def _hand_over(source: Pipeline, to: Pipeline) -> None:
    """Write one pipeline's Gaussians and nodes into another's. Adam's moments on the device stay."""
    count = source.mapper.model.count
    for name, column in source.mapper.model.rows.items():
        if name != "origin":  # which of the device's moments belong to a row
            to.mapper.model.rows[name][:count] = column[:count]
    nodes, theirs = source.map.deformation, to.map.deformation
    assert nodes is not None and theirs is not None
    theirs.nodes[:] = nodes.nodes
