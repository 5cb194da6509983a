"""The fit on a GPU, on Warp's and torch's CPU device: the same steps as by the kernels of the CPU."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import figures_of, ran
from engine_scenes import camera
from warp_on_cpu import use_warp_on_cpu

from sags_node.cli import fit_folder
from sags_node.errors import UsageError
from sags_node.field import twins
from sags_node.field.adam import RowAdam
from sags_node.field.canvas import smoothing
from sags_node.model import columns
from sags_node.model.alias_free import smoothing_variances
from sags_node.pipeline.session import open_session
from sags_node.tools.fitting.clip import Clip, read_clip
from sags_node.tools.fitting.fit import Fit
from sags_node.tools.fitting.settings import PAPER, FieldShape

SETTINGS = dataclasses.replace(
    PAPER, warm_up=0, coarse=1.0, iterations=4, max_gaussians=800, batch_size=1,
    shape=FieldShape(cells=16, channels=16, frames_per_slot=2, xavier=True),
    growth=dataclasses.replace(PAPER.growth, first=150, every=3, until=1),
)  # fmt: skip
SMALL = "source.pace:=step source.loop:=false source.frames:=5 vision.width:=80 vision.height:=64".split()


@pytest.fixture(scope="module")
def clip(phantom_session: Path) -> Clip:
    return read_clip(open_session(phantom_session, SMALL), lambda frame_id: False)


@pytest.mark.parametrize("tokens", ["self", "nodes"])
def test_steps_are_those_of_the_kernels(clip: Clip, tokens: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Adam's first moments after one step are a tenth of all gradients. Later steps go apart: where a
    gradient is as small as its rounding, the sign of it is chance, and Adam makes all steps equally long.
    On a face of the field's box, the derivative is that of one side, or 0."""
    settings = dataclasses.replace(SETTINGS, tokens=tokens)
    kernels, device = fits = Fit(clip, settings), Fit(clip, settings, "cpu")

    def each(step: Any) -> None:
        for fit in fits:  # on a GPU no table goes to Numba's kernels
            monkeypatch.setattr(twins, "by_kernels", lambda table, own=fit is kernels: own)
            step(fit)

    each(lambda fit: fit.start(lambda what, done, of: None))
    rows = kernels.model.table.copy()
    np.testing.assert_allclose(device.model.table, rows, rtol=1e-6, atol=1e-6)
    means, (low, high) = rows[:, columns.MEAN], kernels.model.field.deltas.hexplane.box
    inside = ((means > low + 1e-7) & (means < high - 1e-7)).all(axis=1)
    each(Fit.iterate)
    wanted, got = kernels.arrays(), device.arrays()
    for name in ["rows.moments", "cells.moments", *(name for name in wanted if name.endswith("exp_avg"))]:
        those = np.s_[0, inside] if name == "rows.moments" else np.s_[:]
        off = np.linalg.norm(got[name][those] - wanted[name][those])
        assert 0 <= off <= 2e-3 * np.linalg.norm(wanted[name][those]), name  # opaque: see `test_rasterizer`
    assert wanted["cells.moments"].any() and inside.mean() > 0.9
    assert device.residual == pytest.approx(kernels.residual, rel=1e-4)
    while not kernels.done:
        each(Fit.iterate)
    assert device.residual == pytest.approx(kernels.residual, rel=0.1)
    assert device.split > 0 and len(device.model) == len(kernels.model)


def test_rows_that_are_not_taken_or_not_finite_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    values, rates = torch.tensor(rng.normal(size=(50, 6)).astype(np.float32)), torch.linspace(0.1, 0.6, 6)
    tables, states = [values.clone(), values.clone()], [RowAdam.of(values), RowAdam.of(values)]
    for step in range(6):
        gradient = torch.tensor(rng.normal(size=(50, 6)).astype(np.float32))
        gradient[step, step] = torch.nan if step % 2 else torch.inf
        taken = torch.tensor(rng.random(50) < 0.7)
        for own, table, state in zip((True, False), tables, states, strict=True):
            monkeypatch.setattr(twins, "by_kernels", lambda table, own=own: own)
            state.step(table, gradient, rates, taken)
    for kernel, formula in (tables, *zip(*map(dataclasses.astuple, states), strict=True)):
        torch.testing.assert_close(formula, kernel, rtol=1e-5, atol=1e-6)


def test_the_3d_filter_is_that_of_the_kernels() -> None:
    """Also of what lies behind the camera or outside its image."""
    means = np.random.default_rng(0).normal(0, 0.1, (500, 3)).astype(np.float32)
    cameras = [camera(80, 64), camera(moved=True)]
    found = smoothing(torch.from_numpy(means), cameras).numpy()
    np.testing.assert_allclose(found, smoothing_variances(means, cameras), rtol=1e-5)


def test_where_a_fit_learns(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    use_warp_on_cpu(monkeypatch)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert fit_folder.device_of("auto", "paper") is None and "runs on the CPU" in caplog.text
    with pytest.raises(UsageError, match=r"torch .* finds no GPU.*device:=cpu"):
        fit_folder.device_of("cuda", "paper")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert fit_folder.device_of("auto", "paper") == fit_folder.device_of("cuda", "paper") == "cuda"
    assert fit_folder.device_of("cpu", "paper") is fit_folder.device_of("auto", "online") is None


@pytest.mark.fault("GPU: fails during a fit (simulated)")
def test_a_gpu_that_fails_leaves_a_checkpoint_to_go_on_from(
    phantom_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    iterate = Fit.iterate

    def failing(fit: Fit) -> None:
        if fit.iteration == 2:
            raise RuntimeError("CUDA error: an illegal memory access was encountered\nmore of it")
        iterate(fit)

    command = ["fit", phantom_session, *SMALL, "--out", tmp_path / "fit", "--json"]
    command += "--schedule paper --warm-up 2 --iterations 2 --max-gaussians 300".split()
    with monkeypatch.context() as patch:
        patch.setattr(fit_folder, "device_of", lambda wanted, schedule: "cpu")
        patch.setattr(Fit, "iterate", failing)
        code, out, said = ran(*command)
    assert code == 1 and "illegal memory access" in said and "more" not in said
    assert "--resume and set device:=cpu" in said and "Traceback" not in out + said
    assert figures_of(*command, "--resume", "device:=cpu")["device"] == "cpu"
