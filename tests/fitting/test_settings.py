"""What can be set about a fit, and the numbers of the authors' code."""

import dataclasses
from pathlib import Path

import pytest

from sags_node.errors import UsageError
from sags_node.model import columns
from sags_node.tools.fitting.field import marked, row_rates
from sags_node.tools.fitting.residuals import check_size
from sags_node.tools.fitting.score import published
from sags_node.tools.fitting.settings import (
    LEAST,
    ONLINE,
    ONLY_PAPER,
    PAPER,
    PRESETS,
    RELEASED,
    FieldShape,
    RowRates,
    Units,
    check_used,
    iterations_for,
    path_frames,
    with_changes,
)

SH_0 = 0.28209479  # of a spherical harmonic of degree 0, which their colour rate is of


def test_the_released_preset_has_the_numbers_of_the_released_code() -> None:
    """H-Wenfeng/SAGS and CUHK-AIM-Group/EndoGaussian, settings for EndoNeRF."""
    shape, rates, growth = RELEASED.shape, RELEASED.rates, RELEASED.growth
    assert (RELEASED.warm_up, RELEASED.iterations, RELEASED.tokens) == (1000, 3000, "self")
    assert (shape.levels, shape.cells, shape.channels) == (4, 64, 64)
    assert shape.slots(63) == pytest.approx(50, abs=1)
    assert shape.first_values == (0.1, 0.5) and shape.xavier
    assert shape.units == Units(mean=1e-3, log_scale=1, quat=1, color=0, logit=0)  # 1 mm; not deformed: 0
    assert (RELEASED.field_rates.cells, RELEASED.field_rates.decoder) == (1.6e-2, 1.6e-3)
    pixel = 60e-3 / 569.468  # m, where their clip's tissue is
    assert rates.mean_px * pixel == pytest.approx(1.6e-6, rel=0.02)
    assert rates.color == pytest.approx(2.5e-3 * SH_0, rel=1e-3)
    assert (rates.logit, rates.log_scale, rates.quat) == (0.05, 5e-3, 1e-3)
    assert rates.decaying == ("means",) and not RELEASED.slopes
    assert RELEASED.decay ** (RELEASED.iterations / 4000) == pytest.approx(0.0316, rel=1e-2)
    assert RELEASED.decay_over == 4000
    assert (growth.first, growth.every, growth.share) == (30_000, 300, 1.0)
    weights = RELEASED.weights
    assert (weights.color, weights.smoothness, weights.similarity) == (1, 0.03, 0)
    assert weights.inverse_depth == 1e-3  # of 1/m: 1 of 1/mm


def test_any_setting_can_be_changed() -> None:
    changes = "shape.levels=4 decay=5e-2 block=mlp tokens=self weights.color=2".split()
    found = with_changes(ONLINE, [*changes, "rates.decaying=[means, colors]"])
    assert found.shape.levels == 4 and found.rates.decaying == ("means", "colors")
    assert found.decay == 0.05 and found.block == "mlp" and found.weights.color == 2
    assert with_changes(ONLINE, []) == ONLINE
    for preset in PRESETS.values():
        assert with_changes(preset, []) == preset


def test_rates_fall_by_a_factor_all_along_or_in_a_line_at_the_end() -> None:
    falling = with_changes(ONLINE, ["decay=0.01"])
    assert [falling.rate_share(done, 100) for done in (0, 50, 100)] == pytest.approx([1, 0.1, 0.01])
    stable = with_changes(falling, ["stable=0.5"])
    shares = [stable.rate_share(done, 100) for done in (0, 50, 75, 100)]
    assert shares == pytest.approx([1, 1, 0.505, 0.01])
    assert with_changes(falling, ["decay_over=200"]).rate_share(100, 100) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("shape.level=4", "shape.levels"),
        ("shape=4", "shape.levels"),
        ("levels", "KEY=VALUE"),
        ("shape.levels=many", "shape.levels"),
        ("rates.decaying=[everything]", "means"),
        ("stable=1.0", "below 1"),
        ("batch_size=0", "at least 1"),
        ("block=big", "adaptive"),
        ("slopes=true", "color_softness"),
    ],
)
def test_a_change_that_cannot_be_says_why(change: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        with_changes(ONLINE, [change])


WITHOUT_EFFECT = {
    "rates.decaying": "[means]", "growth": "7", "weights": "0.2", "slopes": "true", "coarse": "0.5",
    "stable": "0.5", "smooth_everywhere": "true",
}  # fmt: skip


@pytest.mark.parametrize("key", ONLY_PAPER)
def test_a_setting_without_effect_is_refused(key: str) -> None:
    """What only the paper's schedule reads; and what only some of its settings do."""
    part = {"growth": ".every", "weights": ".color"}.get(key, "")
    change = f"{key}{part}={WITHOUT_EFFECT.get(key, '9')}"
    with pytest.raises(UsageError, match=rf"{key}.* nothing after an online start; give --schedule paper"):
        check_used(with_changes(ONLINE, [change, "color_softness=0.1"][: 1 + (key == "slopes")]), ONLINE)
    if key != "slopes":
        released = dataclasses.replace(RELEASED, slopes=False, stable=None)
        check_used(with_changes(released, [change]), RELEASED)


def test_settings_that_hide_others_are_said() -> None:
    for preset in PRESETS.values():
        check_used(preset, preset)
    check_used(with_changes(ONLINE, ["rates.mean_px=0.2", "decay=0.1", "midway=true"]), ONLINE)
    with pytest.raises(UsageError, match="decay_over would change nothing beside stable"):
        check_used(with_changes(PAPER, ["decay_over=100"]), PAPER)
    check_used(with_changes(PAPER, ["decay_over=100", "stable=null"]), PAPER)
    with pytest.raises(UsageError, match=r"rates\.color would change nothing beside slopes"):
        check_used(with_changes(PAPER, ["rates.color=0.1"]), PAPER)
    check_used(with_changes(PAPER, ["rates.color=0.1", "slopes=false"]), PAPER)


def test_slots_of_time_grow_with_the_clip() -> None:
    shape = FieldShape(frames_per_slot=3.0)
    assert [shape.slots(frames) for frames in (1, 3, 30, 300)] == [2, 2, 11, 101]
    shape = FieldShape(frames_per_slot=3.0, most_slots=25)
    assert [shape.slots(frames) for frames in (1, 30, 63, 300)] == [2, 11, 22, 25]


def test_the_number_of_gaussians_follows_the_clip() -> None:
    by_clip = dataclasses.replace(PAPER, max_gaussians=90_000, pixels_each=4.0)
    found = [by_clip.of_clip(pixels, 10).max_gaussians for pixels in (0, 20_000, 280_000, 500_000)]
    assert found == [LEAST, LEAST, 70_000, 90_000]
    given = dataclasses.replace(PAPER, max_gaussians=900, pixels_each=0.0)
    assert given.of_clip(9000, 10) == given and RELEASED.of_clip(9000, 10) == RELEASED
    # a long clip has fewer, so that all times of its residuals have room
    most = ONLINE.of_clip(330_000, 2000).max_gaussians
    check_size(len(path_frames(2000)), most)
    assert 0 < most < PAPER.of_clip(330_000, 2000).max_gaussians == 100_000


def test_the_number_of_iterations_follows_the_clip() -> None:
    """Those of the clips on which rates were chosen, of up to 157 training frames, are 2000."""
    assert [iterations_for(frames) for frames in (1, 157, 200, 525, 5000)] == [2000, 2000, 2400, 6300, 8000]


@pytest.mark.parametrize("frames", [30, 63, 179, 1000])
def test_the_paths_tell_the_field_of_each_slot_of_time(frames: int) -> None:
    train = [frame for frame in range(frames) if frame % 8]  # as `sags fit` does
    told = [train[place] for place in path_frames(len(train))]
    slots = ONLINE.shape.slots(frames)
    for slot in range(slots - 1):
        begin, end = (frames - 1) * slot / (slots - 1), (frames - 1) * (slot + 1) / (slots - 1)
        assert any(begin <= time <= end for time in told)


def test_parts_of_a_row_have_their_own_rates() -> None:
    rates = row_rates(RowRates(mean_px=0.5, color=7.0), pixel=0.25)
    assert (rates[columns.MEAN] == 0.125).all() and (rates[columns.COLOR] == 7).all()
    found = marked(("quats", "logits"))
    assert found[columns.QUAT].all() and found[columns.LOGIT] == 1 and found.sum() == 5


# ---- published figures stand beside the clip that they belong to, and beside no other ------------------


def test_only_the_clip_itself_measured_their_way_has_published_figures() -> None:
    way = 8, (640, 512)
    pulling = Path("pulling_soft_tissues")
    assert published(pulling, 63, *way)["SAGS"] == 38.3
    assert published(Path("cutting_tissues_twice"), 156, *way)["SAGS"] == 39.5
    assert published(pulling, 40, *way) == {}  # a part of it
    assert published(Path("my_pulling"), 100, *way) == {}
    assert published(Path("other"), 63, *way) == published(None, 63, *way) == {}
    assert published(pulling, 63, 4, (640, 512)) == published(pulling, 63, 8, (320, 256)) == {}
