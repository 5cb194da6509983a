"""The fit on a GPU, on Warp's and torch's CPU device: the same steps as by the kernels of the CPU."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from engine_scenes import camera
from warp_on_cpu import use_warp_on_cpu

from sags_node.cli import fit_folder
from sags_node.cli.main import main
from sags_node.errors import UsageError
from sags_node.field import twins
from sags_node.field.adam import RowAdam
from sags_node.field.canvas import smoothing
from sags_node.fitting.clip import Clip, ClipFrame
from sags_node.fitting.fit import Fit
from sags_node.fitting.settings import PAPER, FieldShape
from sags_node.model.alias_free import smoothing_variances

WIDTH, HEIGHT = 80, 64
SETTINGS = dataclasses.replace(
    PAPER, warm_up=0, iterations=8, max_gaussians=400,
    shape=FieldShape(cells=16, channels=16, frames_per_slot=2, xavier=True),
    growth=dataclasses.replace(PAPER.growth, first=300, every=6, until=1),
)  # fmt: skip


def some_clip() -> Clip:
    """Texture that moves right on a surface that breathes."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    tissue = (x > 9) | (y > 7)
    frames = []
    for number in range(5):
        waves = np.sin((x - 2 * number) / 5) * np.sin(y / 7)
        image = np.stack([150 + 40 * waves, 90 + 20 * waves, 70 - 15 * waves], -1).astype(np.uint8)
        depth = (0.06 + 0.004 * np.sin(x / 15 + number / 3)).astype(np.float32) * tissue
        frames.append(
            ClipFrame(number, number * 33_000_000, camera(WIDTH, HEIGHT), image, tissue, depth, None)
        )
    return Clip(frames, [])


def in_torch(patch: pytest.MonkeyPatch) -> None:
    """As on a GPU: no table goes to Numba's kernels."""
    patch.setattr(twins, "by_kernels", lambda table: False)


def started(device: str | None, **changed: Any) -> Fit:
    fit = Fit(some_clip(), dataclasses.replace(SETTINGS, **changed), device)
    fit.start(lambda what, done, of: None)
    return fit


@pytest.mark.parametrize("tokens", ["self", "nodes"])
def test_a_step_is_that_of_the_kernels(tokens: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Adam's first moments after one step are a tenth of all gradients. Later steps go apart: where a
    gradient is as small as its rounding, the sign of it is chance, and Adam makes all steps equally long.
    On a face of the field's box, the derivative is that of one side, or 0."""
    fits = [started(None, tokens=tokens, batch_size=1)]
    in_torch(monkeypatch)
    fits.append(started("cpu", tokens=tokens, batch_size=1))
    rows = [fit.model.table.copy() for fit in fits]
    np.testing.assert_allclose(*rows, rtol=1e-6, atol=1e-6)
    for fit in fits:
        monkeypatch.setattr(twins, "by_kernels", lambda table, kernels=fit is fits[0]: kernels)
        fit.iterate()
    kernels, device = (fit.arrays() for fit in fits)
    low, high = fits[0].model.field.deltas.hexplane.box
    inside = ((rows[0][:, :3] > low + 1e-7) & (rows[0][:, :3] < high - 1e-7)).all(axis=1)
    assert inside.mean() > 0.9
    for name in ["rows.moments", "cells.moments", *(name for name in kernels if name.endswith("exp_avg"))]:
        wanted, got = kernels[name], device[name]
        if name == "rows.moments":
            wanted, got = wanted[0, inside], got[0, inside]
        assert np.linalg.norm(got - wanted) <= 1e-3 * np.linalg.norm(wanted), name
    assert kernels["cells.moments"].any() and kernels["rows.moments"].any()
    assert fits[1].residual == pytest.approx(fits[0].residual, rel=1e-5)
    while not fits[0].done:
        for fit in fits:
            monkeypatch.setattr(twins, "by_kernels", lambda table, kernels=fit is fits[0]: kernels)
            fit.iterate()
    assert fits[1].residual == pytest.approx(fits[0].residual, rel=0.1)
    assert fits[1].split > 0 and len(fits[1].model) == len(fits[0].model)


def test_rows_that_are_not_taken_or_not_finite_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    values, rates = torch.tensor(rng.normal(size=(50, 6)).astype(np.float32)), torch.linspace(0.1, 0.6, 6)
    tables = [values.clone(), values.clone()]
    states = [RowAdam.of(values), RowAdam.of(values)]
    for step in range(6):
        gradient = torch.tensor(rng.normal(size=(50, 6)).astype(np.float32))
        gradient[step, step] = torch.nan if step % 2 else torch.inf
        taken = torch.tensor(rng.random(50) < 0.7)
        for number, (table, state) in enumerate(zip(tables, states, strict=True)):
            monkeypatch.setattr(twins, "by_kernels", lambda table, kernels=number == 0: kernels)
            state.step(table, gradient, rates, taken)
        assert torch.equal(tables[1][~taken], values[~taken]) or step
    for kernel, formula in ((tables[0], tables[1]), *zip(*map(dataclasses.astuple, states), strict=True)):
        torch.testing.assert_close(formula, kernel, rtol=1e-5, atol=1e-6)


def test_the_3d_filter_is_that_of_the_kernels() -> None:
    """Also of what lies behind the camera or outside its picture."""
    means = np.random.default_rng(0).normal(0, 0.1, (500, 3)).astype(np.float32)
    cameras = [camera(WIDTH, HEIGHT), camera(40, 32)]
    found = smoothing(torch.from_numpy(means), cameras).numpy()
    np.testing.assert_allclose(found, smoothing_variances(means, cameras), rtol=1e-5)


def test_where_a_fit_learns(monkeypatch: pytest.MonkeyPatch) -> None:
    use_warp_on_cpu(monkeypatch)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert fit_folder.device_of("auto", "paper") is None
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

    command = ["fit", str(phantom_session), "source.frames:=6", "--out", str(tmp_path / "fit"), "--json"]
    command += ["--schedule", "paper", "--warm-up", "2", "--iterations", "2", "--max-gaussians", "300"]
    with monkeypatch.context() as patch:
        patch.setattr(fit_folder, "device_of", lambda wanted, schedule: "cpu")
        patch.setattr(Fit, "iterate", failing)
        failed = CliRunner().invoke(main, command)
    assert failed.exit_code == 1 and "illegal memory access" in failed.stderr and "more" not in failed.stderr
    assert "--resume and set device:=cpu" in failed.stderr and "Traceback" not in failed.output
    again = CliRunner().invoke(main, [*command, "--resume", "device:=cpu"])
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout)["device"] == "cpu"
