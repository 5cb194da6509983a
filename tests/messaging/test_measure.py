"""Lengths and areas between anchors: their arithmetic, what is said of unsure ones, and the command."""

import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import pure_json, ran, refused
from made_messages import message_of
from synthetic import WIDTH, at_frame, plane_camera, plane_result, publisher, stream
from waiting import heard, until

from sags_node.cli.measure import follow
from sags_node.confidence import confidence_of
from sags_node.errors import UsageError
from sags_node.geometry import transform
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.content import FRAME_CONTENT
from sags_node.messaging.measure import MEASURING, SIDEWAYS, Measured, measure
from sags_node.messaging.received import Frame, interpret
from sags_node.types import AnchorStates, FrameResult

CAMERA = plane_camera()
# m, camera: 1 and 2 one behind the other on the axis, 3 beside 2, and 4 beside 1.
LOCAL = np.array([[0, 0, 0.06], [0, 0, 0.08], [0.012, 0, 0.08], [0.012, 0, 0.06]])


def pinned(errors: list[float], **changes: Any) -> FrameResult:
    """The plane's frame with the anchors 1 to 4, whose depths have these errors (m)."""
    points = transform(CAMERA.T_world_cam, LOCAL).astype(np.float32)
    ones = np.ones(4, np.float32)
    states = AnchorStates(
        ids=np.arange(1, 5),
        points=points,
        pixels=np.zeros((4, 2), np.float32),
        visibility=ones,
        confidence=ones,
        ages=ones,
        depth_confidence=confidence_of(np.array(errors, np.float32)),
    )
    return replace(plane_result(stamp_ns=1), anchors=replace(states, **changes))


def frame_of(result: FrameResult, **meta: Any) -> Frame:
    messages = {name: message_of(name, FRAME_CONTENT[name](result), **meta) for name in MEASURING}
    return Frame({name: interpret(message, 0) for name, message in messages.items()})


def sideways(depth: float) -> float:
    """m, at a depth: nine of ten anchors are nearer, along each axis of the image."""
    return SIDEWAYS * WIDTH / CAMERA.K[0, 0] * depth


def test_a_length_along_the_ray_errs_as_its_depths_and_one_across_as_its_pixels() -> None:
    frame = frame_of(pinned([1e-3, 2e-3, 2e-3, 1e-3]))
    along = measure(frame, [1, 2])
    assert along.value == pytest.approx(0.02, rel=1e-5) and along.unsure is None and along.metric
    # Independent errors of 1 and 2 mm; had both the same sign only 1 mm were left. Sideways: of second order.
    assert along.error == pytest.approx(5**0.5 * 1e-3, rel=2e-3)
    across = measure(frame, [2, 3])
    assert across.value == pytest.approx(0.012, rel=1e-5)
    # Anchor 2 is 2 mm deeper, or 3 is, whose ray leads 0.3 mm away in 2 mm: both of second order, and that.
    deeper = np.hypot(0.012, 0.002) - 0.012, np.hypot(0.0123, 0.002) - 0.012
    assert across.error == pytest.approx(np.hypot(np.hypot(*deeper), 2**0.5 * sideways(0.08)), rel=2e-3)
    way = measure(frame, [1, 2, 3])
    assert way.value == pytest.approx(0.032, rel=1e-5)
    back = measure(frame, [1, 2, 1])
    assert back.value == pytest.approx(0.04, rel=1e-5)
    assert back.error == pytest.approx(2 * along.error, rel=1e-3)  # it is twice the same length


def test_an_area_is_that_of_the_polygon_whichever_corner_is_first() -> None:
    frame = frame_of(pinned([1e-4] * 4))
    for corners in ([1, 2, 3, 4], [3, 4, 1, 2], [4, 3, 2, 1]):
        assert measure(frame, corners, area=True).value == pytest.approx(0.02 * 0.012, rel=1e-5)
    triangle = measure(frame, [1, 2, 3], area=True)
    assert triangle.value == pytest.approx(0.5 * 0.02 * 0.012, rel=1e-5)
    crossing = measure(frame, [1, 3, 2, 4], area=True)
    assert crossing.value is None and "crosses itself" in str(crossing.unsure)


def test_errors_told_are_those_of_points_that_err_so() -> None:
    """Nine of ten of many drawn errors are smaller: independent ones, and depths that err alike."""
    rng = np.random.default_rng(0)
    errors = np.array([1.5e-3, 1e-3, 2e-3, 1e-3])
    beside = np.array([sideways(z) for z in LOCAL[:, 2]]) / 1.645
    told = {numbers: measure(frame_of(pinned(list(errors))), numbers) for numbers in ((1, 3), (1, 2, 3, 4))}
    for drawn in (rng.normal(size=(4000, 4)), np.repeat(rng.normal(size=(4000, 1)), 4, 1)):
        deep = LOCAL * (1 + (drawn * errors / 1.645 / LOCAL[:, 2])[..., None])
        deep[..., :2] += rng.normal(size=(4000, 4, 2)) * beside[:, None]
        for numbers, said in told.items():
            rows = [number - 1 for number in numbers]
            found = np.linalg.norm(np.diff(deep[:, rows], axis=1), axis=-1).sum(1)
            assert said.value is not None and said.error is not None
            assert np.mean(np.abs(found - said.value) <= said.error) > 0.89  # 0.9, and its scatter of 0.005


def test_stretch_is_a_ratio_with_the_errors_of_both() -> None:
    longer, before = Measured(0.022, 2.2e-4, None), Measured(0.020, 1e-4, None)
    stretch = longer.stretch(before)
    assert stretch == pytest.approx((1.1, 1.1 * np.hypot(0.01, 0.005)))
    assert longer.stretch(Measured(None, None, "lost")) is None
    assert Measured(0.022, None, "unsure").stretch(before) is None


def test_what_is_lost_hidden_or_unsure_is_never_given_as_sure() -> None:
    ones = np.ones(4, np.float32)
    points = pinned([1e-3] * 4).anchors.points.copy()
    points[1] = np.nan
    second = np.arange(4) == 1

    def but(value: float) -> np.ndarray:
        return np.where(second, np.float32(value), ones)

    for changes, has_value, has_error, said in (
        ({"points": points}, False, False, "anchor 2 is lost"),
        ({"visibility": but(0.9)}, True, True, "anchor 2 is not wholly in sight"),
        ({"confidence": but(0.49)}, True, False, "anchor 2 may be on other tissue"),
        ({"depth_confidence": but(0.49)}, True, True, "anchor 2 has a depth that is a guess"),
        ({"depth_confidence": but(np.nan)}, True, False, "anchor 2 has a depth that is a guess"),
    ):
        frame = frame_of(pinned([1e-3] * 4, **changes))
        for numbers in ([1, 2], [2, 3, 4]):
            measured = measure(frame, numbers)
            assert (measured.value is not None, measured.error is not None) == (has_value, has_error)
            assert said in str(measured.unsure)
        assert measure(frame, [1, 3]).unsure is None
    guessed = measure(frame_of(pinned([1e-3] * 4, depth_confidence=0.4 * ones)), [3, 1])
    assert guessed.unsure == "anchors 3, 1 have depths that are guesses"
    unknown = measure(frame_of(pinned([1e-3] * 4)), [1, 9])
    assert unknown.value is None and unknown.unsure == "there is no anchor 9"
    assert not measure(frame_of(pinned([4e-3] * 4), units="relative"), [1, 2]).metric
    for numbers, area in (([1], False), ([1, 1], False), ([1, 2], True), ([1, 2, 1], True)):
        with pytest.raises(UsageError, match="twice" if 1 in numbers[1:] else "or more"):
            measure(frame, numbers, area)


@pytest.mark.live
def test_the_command_follows_a_node(tmp_path: Path) -> None:
    """It stretches by half, then an anchor is lost, then the node is silent for long: each once it was told.
    The clock is set back when it stretches; the seconds go on. An age that grows is no news."""
    stages = ["rest", "longer", "lost", "silent"]
    now = [stages[0]]
    with publisher(tmp_path / "run") as running:

        def frame(number: int) -> FrameResult:
            until(lambda: now[0] != "silent")
            result = pinned([1e-3] * 4)
            points = result.anchors.points.copy()
            stage = now[0]
            points[1] += {"longer": 0.5, "lost": np.nan}.get(stage, 0) * (points[1] - points[0])
            anchors = replace(result.anchors, points=points)
            set_back = stage != "rest"
            stamp_ns = time.time_ns() - 300_000_000 * set_back
            return at_frame(replace(result, anchors=anchors), number, stamp_ns, epoch=2 + set_back)

        with stream(running, frame):
            address = NodeAddress(endpoint=running.connection.data[-1])
            stop = threading.Event()
            values, said, seconds = [], [], []
            for record in follow(address, (1, 2), False, 1000.0, None, stop):
                seconds.append(record["seconds"])
                is_new = record["stretch"] is None or record["stretch"] > 1.4
                if now[0] in ("rest", "longer") and record["sure"] and (now[0] == "rest" or is_new):
                    values.append((record["value"], record["stretch"], record["unit"]))
                    now[0] = stages[stages.index(now[0]) + 1]
                elif record["value"] is None:
                    said.append(record["unsure"])
                    now[0] = "silent"
                    if record["stamp_ns"] is None:
                        threading.Timer(1.0, stop.set).start()
            now[0] = "again"
            node = ("--endpoint", address.endpoint)
            measured = ("measure", 2, 3, *node, "--json")
            (first, *_) = heard(lambda seconds: ran(*measured, "--seconds", seconds)[1].splitlines(), 2.0)
            missing = "there is no anchor 9; there are 1, 2, 3, 4"
            refused(1, "measure", 1, 9, *node, said=(missing, "sags anchor pin"))
    assert values == [
        (pytest.approx(20, rel=1e-4), 1.0, "mm"),
        (pytest.approx(30, rel=1e-4), pytest.approx(1.5), "mm"),
    ]
    assert said[0] == "anchor 2 is lost" and len(said) >= 2 and said[-1] != said[0]
    assert all(now is None or then is None or 0 <= now - then for then, now in pairwise(seconds))
    assert not any(then is now is None for then, now in pairwise(seconds))
    assert pure_json(first)["kind"] == "distance" and pure_json(first)["value"] == pytest.approx(12, rel=1e-4)
    refused(2, "measure", 1, 1, said=("twice",))
