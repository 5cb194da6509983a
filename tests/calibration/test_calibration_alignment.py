"""A calibration that stops to fit while the node runs."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from places import SESSION
from synthetic import health

from sags_node.mapping.budget import StepBudget
from sags_node.messaging.cdr import decode
from sags_node.messaging.content import diagnostics
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.rig import load_rig
from sags_node.sources.pictures import read_picture
from sags_node.tools.calibration.check import measure_rows
from sags_node.types import F32, U8, Bool, StereoFrame, StereoRig
from sags_node.vision.alignment import FEWEST_FIELDS, WINDOW, RowMonitor
from sags_node.vision.matchers import match_patches
from sags_node.vision.pyramid import gray_pyramid
from sags_node.vision.rectify import Rectifier

SIZE = 640, 512
DISPARITIES = 8.0, 60.0  # px at the matching size
Turn = tuple[float, float, float]
Field = tuple[F32, Bool, int]  # row errors, where they are known, and the width of the image they are of


def rectified(session: Path, degrees: Turn) -> tuple[U8, U8]:
    """A pair of the phantom, rectified as if its right eye stood as calibrated; it is turned."""
    rig = load_rig(session / "calib")
    turn = cv2.Rodrigues(np.radians(degrees))[0]
    turned = StereoRig("turned", rig.left, replace(rig.right, R=turn @ rig.right.R))
    left, right = (read_picture(session / side / "0005.jpg") for side in ("left", "right"))
    pair = Rectifier(turned, *SIZE)(StereoFrame(0, 0, 0, left, right))
    assert pair.right is not None
    return pair.left, pair.right


def field(session: Path, degrees: Turn) -> Field:
    patches = match_patches(*map(gray_pyramid, rectified(session, degrees)), DISPARITIES, 1)
    return patches.field[..., 1], patches.good, SIZE[0] // 2


def monitor_after(fields: Field, count: int = FEWEST_FIELDS) -> RowMonitor:
    monitor = RowMonitor(SIZE[0])
    for _ in range(count):
        monitor.update(*fields)
    return monitor


@pytest.mark.parametrize(
    ("degrees", "median", "tolerance", "spread"),  # px
    [
        pytest.param((0, 0, 0), 0, 0.2, (0, 0.8), id="as calibrated"),
        pytest.param((0.3, 0, 0), 0.3, 0.3, (0, 1), id="looks down"),
        pytest.param((-0.3, 0, 0), 0.3, 0.3, (0, 1), id="looks up"),
        pytest.param((0, 0, 0.3), 0, 0.8, (2, 99), id="turned about its axis: only the spread tells"),
    ],
)
def test_an_eye_that_is_turned(
    phantom_session: Path, degrees: Turn, median: float, tolerance: float, spread: tuple[float, float]
) -> None:
    alignment = monitor_after(field(phantom_session, degrees)).alignment
    assert alignment is not None and ("rows of the eyes differ" in alignment.warning) == any(degrees)
    focal = load_rig(phantom_session / "calib").left.P[0, 0] * 2
    assert abs(alignment.median) == pytest.approx(focal * np.radians(median), abs=tolerance)
    assert spread[0] <= alignment.spread < spread[1]


@pytest.mark.parametrize("degrees", [0.6, 1.0])
def test_an_eye_turned_beyond_what_can_be_matched(phantom_session: Path, degrees: float) -> None:
    turned = field(phantom_session, (degrees, 0, 0))
    assert turned[1].mean() < 0.2  # the scene is what the test is for
    alignment = monitor_after(turned).alignment
    assert alignment is not None and alignment.warning


def test_slow_and_robust(phantom_session: Path) -> None:
    good, bad = field(phantom_session, (0, 0, 0)), field(phantom_session, (0.3, 0, 0))
    monitor = RowMonitor(SIZE[0])
    for _ in range(FEWEST_FIELDS - 1):
        monitor.update(*bad)
    assert monitor.alignment is None  # too early to say
    monitor = monitor_after(good, WINDOW)
    for _ in range(WINDOW // 2 - 2):  # smoke, an instrument: up to half of the last frames
        monitor.update(*bad)
    assert monitor.alignment is not None and monitor.alignment.warning == ""
    for _ in range(WINDOW // 2):
        monitor.update(*bad)
    assert monitor.alignment.warning
    for _ in range(WINDOW):
        monitor.update(*good)
    assert monitor.alignment.warning == ""


def test_fields_of_a_late_eye_tell_nothing_of_the_rig(phantom_session: Path) -> None:
    good, late = field(phantom_session, (0, 0, 0)), field(phantom_session, (0.3, 0, 0))
    monitor = monitor_after(good)
    for _ in range(WINDOW):
        monitor.update(*late)
        monitor.withdraw()
    assert monitor.alignment is not None and monitor.alignment.warning == ""


def flat(pixels: float) -> Field:
    """The same row error everywhere; px of the working size."""
    return np.full((256, 320), pixels / 2, np.float32), np.ones((256, 320), np.bool_), SIZE[0] // 2


def test_a_warning_does_not_flicker() -> None:
    monitor = monitor_after(flat(0.9), WINDOW)
    assert monitor.alignment is not None and monitor.alignment.warning == ""
    for pixels, warns in ((1.1, True), (0.9, True), (0.7, False), (0.9, False)):
        for _ in range(WINDOW):
            monitor.update(*flat(pixels))
        assert bool(monitor.alignment.warning) is warns, pixels


def test_pictures_without_any_match_say_nothing_of_spread() -> None:
    noise = np.random.default_rng(0).normal(0, 1, (256, 320)).astype(np.float32)
    alignment = monitor_after((noise, np.zeros((256, 320), np.bool_), SIZE[0] // 2)).alignment
    assert alignment is not None and alignment.spread == 0 and alignment.warning == ""


@pytest.mark.parametrize(("degrees", "expected"), [(0.0, 0.0), (0.15, 1.5)])
def test_dense_rows_of_a_pair(phantom_session: Path, degrees: float, expected: float) -> None:
    rows = measure_rows(*rectified(phantom_session, (degrees, 0, 0)), 16, 120)
    assert rows is not None and rows.matched > 0.8
    assert rows.median == pytest.approx(expected, abs=0.15)


def test_dense_rows_of_nothing() -> None:
    rng = np.random.default_rng(0)
    left, right = rng.integers(0, 255, (2, 256, 320, 3), np.uint8)
    assert measure_rows(left, right, 2, 60) is None


@pytest.mark.fault("calibration: the eyes have moved against each other")
@pytest.mark.parametrize(("degrees", "metric"), [(0.0, True), (0.3, True), (0.3, False)])
def test_the_node_warns_while_it_runs(degrees: float, metric: bool) -> None:
    """Not of a calibration that was guessed: that it is one says the warning of its own."""
    session = open_session(SESSION, ["source.pace:=step", "mapping.max_gaussians:=2000"])
    turn = cv2.Rodrigues(np.radians((degrees, 0.0, 0.0)))[0]
    right = replace(session.rig.right, R=turn @ session.rig.right.R)
    pipeline = Pipeline(session.config, StereoRig("turned", session.rig.left, right, metric=metric))
    with session.source as source:
        for frame, _ in zip(source, range(FEWEST_FIELDS + 2), strict=False):
            pipeline.process(frame, StepBudget(0))
    warnings = pipeline.warnings
    assert list(warnings) == (["calibration"] if degrees else [])
    content = diagnostics(replace(health(), warnings=warnings), 0)
    statuses = decode(b"".join(content.parts), "diagnostic_msgs/msg/DiagnosticArray").status
    said = " ".join(status.message for status in statuses)
    assert ("rows of the eyes differ" in said, "no calibration" in said) == (
        degrees > 0 and metric,
        not metric,
    )
