"""An eye that is late, by what the matched rows tell of it: also where few frames are matched."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from frames import played

from sags_node.config.schema import PhantomSource
from sags_node.findings import by_code
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.ladder import RUNGS
from sags_node.phantom import write_session
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.types import F32, GrayPyramid
from sags_node.vision.alignment import RowErrors
from sags_node.vision.pyramid import gray_pyramid
from sags_node.vision.watch.match_watch import MatchWatch

NOISE = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (256, 320)).astype(np.float32), (0, 0), 3)
TEXTURE = cv2.normalize(NOISE, None, 20, 230, cv2.NORM_MINMAX)
SHARE = np.linspace(0, 1, 320, dtype=np.float32)  # of the motion that each column has
BEGINS, ENDS = 1.0, 3.0  # s: the tissue goes down and up meanwhile, once a second
SECOND = 1_000_000_000

Row = Callable[[float], float]  # px, at a time in s


def down(t: float) -> float:
    """px that the tissue has gone down on the right; 19 px/s at most."""
    return 3.0 * float(np.sin(2 * np.pi * t)) if BEGINS <= t < ENDS else 0.0


@lru_cache(maxsize=128)
def picture(t: float) -> GrayPyramid:
    y, x = np.mgrid[:256, :320].astype(np.float32)
    moved = cv2.remap(
        TEXTURE, x, y - np.float32(down(t)) * SHARE, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    return gray_pyramid(moved.astype(np.uint8))


def codes_at(
    row: Row, rate: float, kept: str, every: int, share: F32 = SHARE[4::8], lasting: float = 0.0
) -> dict[float, tuple[str, ...]]:
    """What is found at the times (s) of the frames that come, of which every so many are matched.

    Args:
        kept: which frames come, again and again.
        row: how far below its row in the left image a point lies in the right one, on the right.
        lasting: px of that, there from the beginning: the calibration fits badly.
    """
    watch, found = MatchWatch(), {}
    frames = [i / rate for i in range(round(4 * rate)) if kept[i % len(kept)] == "1"]
    for number, t in enumerate(frames):
        stamp = round(t * SECOND)
        watch.see(stamp, picture(t))
        if number % every == 0:
            errors = (lasting + row(t)) * share + np.random.default_rng(number).normal(
                0, 0.3, (32, 40)
            ).astype(np.float32)
            watch(stamp, RowErrors(errors, np.ones((32, 40), np.bool_), float(np.median(errors))))
        found[t] = tuple(finding.code for finding in watch.findings)
    return found


@pytest.mark.parametrize(
    ("rate", "kept", "every"),
    [
        *[(30, "1", 1), (25, "1", 3), (25, "1101", 3), (25, "10", 3), (25, "110", 2)],
        *[(12.5, "1", 2), (12.5, "110", 2)],
    ],
)
def test_a_late_eye_is_found_however_few_frames_are_matched(rate: float, kept: str, every: int) -> None:
    """Within three of the fields that show it, and half a period: at its turns the tissue hardly moves."""
    for late, lasting in ((0.12, 0.0), (-0.08, 0.0), (0.12, 2.5)):
        found = codes_at(lambda t, late=late: down(t - late) - down(t), rate, kept, every, lasting=lasting)
        assert {code for codes in found.values() for code in codes} == {"eyes_late"}
        field = every * len(kept) / kept.count("1") / rate
        first = min(t for t, codes in found.items() if codes)
        assert BEGINS < first < BEGINS + 0.5 + 3 * field
    for lasting in (0.0, 2.5):
        in_time = codes_at(lambda t: 0.0, rate, kept, every, lasting=lasting)
        assert set(in_time.values()) == {()}


@pytest.mark.parametrize("at", [1.08, 1.32, 1.56])
def test_one_field_that_looks_late_is_no_late_eye(at: float) -> None:
    """Tissue that slips out of the grasper did so."""
    found = codes_at(lambda t: 0.3 * (down(t) - down(t - 0.1)) if abs(t - at) < 0.06 else 0.0, 25, "1", 3)
    assert set(found.values()) == {()}


def test_a_knock_while_tissue_moves_is_no_late_eye() -> None:
    found = codes_at(lambda t: 2.0 if t > 1.5 else 0.0, 25, "1", 3, share=np.ones(40, np.float32))
    assert {code for codes in found.values() for code in codes} == {"eyes_knocked"}


@pytest.mark.fault("image: one eye is three frames late, and every sixth frame is matched")
def test_what_a_slow_node_says_of_a_late_eye_is_that(tmp_path: Path) -> None:
    """Every third frame matched of every second: 200 ms apart. No other cause is blamed."""
    write_session(PhantomSource(seconds=2.0, width=160, height=128), tmp_path / "session")
    session = open_session(tmp_path / "session", ["source.pace:=step"])
    frames = played(session.config.source)
    for delay, expected in ((3, {"eyes_late"}), (0, set())):
        pipeline, budget, codes = Pipeline(session.config, session.rig), StepBudget(1, RUNGS[0]), set()
        for frame, late in list(zip(frames[delay:], frames, strict=False))[::2]:
            pipeline.process(replace(frame, right=late.right), budget)
            codes |= by_code(pipeline.warnings).keys()
        assert codes == expected


def test_a_gap_makes_no_loss_of_matches_usual() -> None:
    """A second of a gap counts: what has been lost since is noticed in more than the first frame after it."""
    watch, errors = MatchWatch(), np.random.default_rng(0).normal(0, 0.3, (32, 40)).astype(np.float32)
    said = []
    for t, share in [(0.0, 1.0), (0.1, 1.0), *((12 + 0.1 * i, 0.4) for i in range(10))]:
        matched = np.random.default_rng(1).random((32, 40)) < share
        watch.see(round(t * SECOND), picture(t))
        said.append(watch(round(t * SECOND), RowErrors(errors, matched, 0.0)))
    assert not any(said[:2]) and all("far fewer" in why for why in said[2:])
