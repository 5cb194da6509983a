"""`benchmarks pareto`: settings on common ground, and baselines that are what they say."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result
from command_line import figures_of
from places import ROOT

from benchmarks.__main__ import main
from benchmarks.pareto import measure as pareto
from benchmarks.pareto import settings as pareto_settings
from benchmarks.pareto.measure import non_dominated, why_default
from benchmarks.pareto.settings import HURRIED_RULES, skip_settings, time_settings
from sags_node.config.launch_file import load_launch
from sags_node.evaluation import metrics
from sags_node.evaluation.warp import right_pixels, warp_to_right
from sags_node.mapping.devices import Skips
from sags_node.mapping.ladder import RUNGS
from sags_node.rig import load_rig
from sags_node.sources.source import open_source
from sags_node.vision.rectify import Rectifier

RULES = {"skip_duplicates", "skip_depth", "skip_still"}


def bench(*arguments: Any) -> Result:
    return CliRunner().invoke(main, ["pareto", *(str(argument) for argument in arguments)])


def row(name: str, ms: float, psnr: float) -> dict[str, Any]:
    return {"name": name, "frame_ms": {"p50": ms}, "online_at_full_size": {"psnr": psnr}}


# ---- settings and judgement ------------------------------------------------------------------------------


def test_settings_that_no_other_beats_in_both() -> None:
    points = [(33, 35), (25, 34), (40, 34.5), (100, 37), (33, 34.9), (100, 37), (20, 30)]
    assert non_dominated(points) == [True, True, False, True, False, True, True]
    assert non_dominated([]) == []


def test_why_the_default_says_what_was_measured() -> None:
    fast, default, slow = row("fast", 20, 33), row("default", 32, 35), row("slow", 60, 37)
    assert "best picture of all that stay within the camera's 33.3 ms" in why_default(
        [default, fast, slow], 33.3
    )
    better = row("better", 30, 35.5)
    assert "so does better, +0.50 dB" in why_default([default, better, slow], 33.3)
    assert "though it takes 60.0 of the camera's 33.3 ms" in why_default([slow, default], 33.3)


def test_each_rung_is_a_setting() -> None:
    pinned = [load_launch(None, setting.overrides).mapping for setting in pareto_settings.rung_settings()]
    assert [mapping.rung for mapping in pinned] == list(range(len(RUNGS)))
    assert {mapping.iterations for mapping in pinned} == {1}


def test_each_setting_is_played_once_and_the_default_first() -> None:
    config = load_launch(None, ["mapping.budget_ms:=40"])
    settings = time_settings(config, (640, 512), pareto_settings.PARTS)
    assert settings[0].overrides == () and settings[0].name == "40 ms, 640x512"
    assert len({setting.overrides for setting in settings}) == len(settings) == 1 + 5 + 2 + 2 * 5
    assert ("vision.width:=320", "vision.height:=256") in [setting.overrides for setting in settings]
    for setting in settings:
        found = load_launch(None, ["mapping.budget_ms:=40", *setting.overrides])
        said = f"{found.mapping.budget_ms:g} ms, {found.vision.width or 640}x{found.vision.height or 512}"
        count = found.mapping.max_gaussians
        assert setting.name == (f"{said}, {count / 1e3:g}k" if count else said)


def test_each_skip_rule_alone_is_turned_off() -> None:
    pairs = skip_settings()
    assert set(pairs) == RULES
    for rule, (on, off) in pairs.items():
        assert on.overrides == off.overrides and on.skips == Skips()
        assert [name for name, used in asdict(off.skips).items() if not used] == [rule.removeprefix("skip_")]
        hurried = load_launch(None, on.overrides).mapping.rung is not None
        assert hurried == (rule.removeprefix("skip_") in HURRIED_RULES)


# ---- baselines -------------------------------------------------------------------------------------------


def test_warp_by_the_exact_depth_is_the_right_picture(phantom_session: Path) -> None:
    config = load_launch(phantom_session)
    assert config.rig is not None
    rig = load_rig(config.rig)
    rectifier = Rectifier(rig, 320, 256)
    with open_source(config.source.model_copy(update={"pace": "step"})) as frames:
        frame = next(iter(frames))
    camera, usable = rectifier.camera, right_pixels(rectifier, frame, ((0, 0, 60, 30),))
    assert not usable[:25, :55].any() and usable[40:200, 40:280].all()
    pair = rectifier(frame)
    assert pair.right is not None and frame.reference is not None and frame.reference.depth is not None
    left, right, depth = metrics.as_float(pair.left), metrics.as_float(pair.right), frame.reference.depth

    def warped(depth: np.ndarray) -> tuple[float, np.ndarray]:
        picture, known = warp_to_right(left, depth, float(camera.K[0, 0]), rectifier.baseline)
        assert (picture[~known] == 0).all()
        known &= usable
        return metrics.psnr(metrics.fit_gain_offset(picture, right, known), right, known), known

    exact, known = warped(depth)
    assert known[:, :280].mean() > 0.7
    assert exact > 33  # noise of both eyes and highlights that move are what is left
    assert exact > warped(depth * np.float32(1.1))[0] + 5
    focal_baseline = np.float32(camera.K[0, 0] * rectifier.baseline)
    for shift in (-0.25, 0.25):  # px of disparity: the warp has no bias of its own
        shifted = np.divide(
            focal_baseline, focal_baseline / np.maximum(depth, np.float32(1e-3)) + np.float32(shift)
        )
        assert exact > warped(shifted * (depth > 0))[0] + 0.4


def test_near_tissue_hides_far_tissue_in_the_warp() -> None:
    depth = np.full((8, 60), 0.1, np.float32)
    depth[:, 30:40] = 0.05
    left = np.zeros((8, 60, 3), np.float32)
    left[:, 30:40] = 1
    picture, known = warp_to_right(left, depth, 100.0, 0.005)  # 5 px far, 10 px near
    np.testing.assert_allclose(picture[:, 20:29], 1, atol=1e-6)
    assert (picture[:, :19] == 0).all() and known[:, :20].all()
    assert not known[
        :, 30:35
    ].any()  # behind the near tissue, which the left eye looks past on the other side
    assert not known[:, 55:].any()
    assert not warp_to_right(left, np.zeros_like(depth), 100.0, 0.005)[1].any()


# ---- the command -----------------------------------------------------------------------------------------


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pareto_settings, "BUDGETS_MS", (33.0, 20.0))
    monkeypatch.setattr(pareto_settings, "SIZES", (0.5,))
    monkeypatch.setattr(pareto_settings, "COUNTS", (1000,))


@pytest.mark.usefixtures("small")
def test_everything_is_measured_on_a_tiny_session(phantom_session: Path, tmp_path: Path) -> None:
    fit = {
        "session": phantom_session.name,
        "seconds": 9.0,
        "gaussians": 800,
        "heldout": {"psnr": 41.0},
        "depth": None,
    }
    fits = {"fit": fit, "slow": fit | {"seconds": 900.0}, "other": fit | {"session": "other"}}
    for name, figures in fits.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(figures))
    out, plot = tmp_path / "pareto.json", tmp_path / "pareto.png"
    given = [word for name in fits for word in ("--fit", tmp_path / f"{name}.json")]
    files = [*given, "--out", out, "--plot", plot]
    asked = ["mapping.max_gaussians:=3000", "mapping.rung:=8", "--frames", 10]  # whatever the machine affords
    found = figures_of("pareto", phantom_session, *asked, *files, "--json", command=main)
    assert json.loads(out.read_text()) == {"provenance": ANY} | found
    (session,) = found["sessions"]
    rows = {tuple(each["overrides"]): each for each in session["settings"]}
    default = rows[()]
    half = rows["vision.width:=160", "vision.height:=128"]
    assert session["settings"][0] == default and default["name"] in session["why_default"]
    assert {each["part"] for each in rows.values()} == {"default", "budgets", "resolutions", "gaussians"}
    assert any(each["non_dominated"] for each in rows.values())
    assert default["online_at_full_size"] == default["online"]
    # What is sharp at half the size is not at full size: the noise is averaged away, and detail is missing.
    assert half["online_at_full_size"]["psnr"] < half["online"]["psnr"] - 1
    assert 20 < half["online_at_full_size"]["psnr"] < default["online"]["psnr"]
    assert rows["mapping.max_gaussians:=1000",]["gaussians"]["max"] <= 1000
    for each in rows.values():
        assert each["frame_ms"]["p50"] > 0 and each["depth"]["median_mm"] > 0 and each["novel"]["psnr"] > 15
        assert each["cpu_ms"]["p50"] > 0

    copied, stereo, warp, model, full, halved, offline, slow = session["baselines"]
    assert slow["name"] == "offline fit, 900 s in all"
    assert copied["predict"]["psnr"] == default["predict"]["copy_psnr"]
    assert stereo["depth"] == default["measured_depth"]
    assert 0.3 < warp["coverage"] <= 1 and warp["novel"]["psnr"] > 20 and model["novel"]["psnr"] > 20
    assert full["depth"]["median_mm"] < halved["depth"]["median_mm"] < 3 and full["frame_ms"]["p50"] > 0
    assert offline["heldout"]["psnr"] == 41.0
    assert session["receipt"]["frames"]["ids"] == "0, 2-8"  # every eighth is held out

    assert {each["rule"] for each in session["skips"]} == RULES
    for each in session["skips"]:
        gained = each["on"]["online"]["psnr"] - each["off"]["online"]["psnr"]
        assert each["online_db"] == pytest.approx(gained)
    depth = next(each for each in session["skips"] if each["rule"] == "skip_depth")
    assert depth["on"]["skipped"]["depth"] > 0 and "depth" not in depth["off"]["skipped"]
    skip = next(each for each in session["skips"] if each["rule"] == "skip_duplicates")
    assert skip["online_db"] == 0  # no frame repeats: the rule changes nothing
    picture = cv2.imdecode(np.frombuffer(plot.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and (picture != 255).any(-1).mean() > 0.005


@pytest.mark.usefixtures("small")
def test_tables_name_the_default_and_repeats_are_kept(phantom_session: Path, tmp_path: Path) -> None:
    out = tmp_path / "pareto.json"
    asked = ["--only", "budgets", "--frames", 5, "--repeat", 2, "--out", out]
    result = bench(phantom_session, phantom_session, "mapping.max_gaussians:=1000", *asked)
    assert result.exit_code == 0, result.output
    assert result.stdout.count("is the default") == 2
    assert "default   33 ms, 320x256, 1k" in result.stdout and "20 ms, 320x256, 1k" in result.stdout
    found = json.loads(out.read_text())
    assert len(found["sessions"]) == 2
    for each in found["sessions"][0]["settings"]:
        assert len(each["repeats"]["ms"]) == 2 and each["frame_ms"]["p50"] == min(each["repeats"]["ms"])
    assert found["sessions"][0]["skips"] == []


def test_wrong_requests_get_one_message(phantom_session: Path, tmp_path: Path) -> None:
    wrong_part = bench(phantom_session, "--only", "budgets,speed")
    assert wrong_part.exit_code == 2 and "unknown part 'speed'; choose from budgets" in wrong_part.output
    (tmp_path / "fit.json").write_text("[1]")
    no_fit = bench(phantom_session, "--fit", tmp_path / "fit.json")
    assert no_fit.exit_code == 2 and "holds no figures of a fit" in no_fit.output
    cameras = bench(ROOT / "launch/v4l2.yaml")
    assert cameras.exit_code == 2 and "plays recordings" in cameras.output
    short = bench(phantom_session, "--frames", 2, "--only", "budgets")
    assert short.exit_code == 1 and "play more" in short.output
    assert pareto.SHORTEST > 1
