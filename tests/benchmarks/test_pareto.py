"""`benchmarks pareto`: settings on common ground, and baselines that are what they say."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pareto import settings as pareto_settings
from benchmarks.pareto.measure import non_dominated, why_default
from benchmarks.pareto.settings import HURRIED_RULES, skip_settings, time_settings
from sags_node.config.launch_file import load_launch
from sags_node.mapping.devices import Skips
from sags_node.mapping.ladder import RUNGS
from sags_node.quality import metrics
from sags_node.rig import load_rig
from sags_node.sources.source import open_source
from sags_node.tools.evaluation.warp import right_pixels, warp_to_right
from sags_node.vision.rectify import Rectifier

RULES = {"skip_duplicates", "skip_depth", "skip_still"}


def row(name: str, ms: float, psnr: float) -> dict[str, Any]:
    return {"name": name, "frame_ms": {"p50": ms}, "online_at_full_size": {"psnr": psnr}}


# ---- settings and judgement ------------------------------------------------------------------------------


def test_settings_that_no_other_beats_in_both() -> None:
    points = [(33, 35), (25, 34), (40, 34.5), (100, 37), (33, 34.9), (100, 37), (20, 30)]
    assert non_dominated(points) == [True, True, False, True, False, True, True]
    assert non_dominated([]) == []


def test_why_the_default_says_what_was_measured() -> None:
    fast, default, slow = row("fast", 20, 33), row("default", 32, 35), row("slow", 60, 37)
    assert "best image of all that stay within the camera's 33.3 ms" in why_default(
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
