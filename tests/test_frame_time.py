"""What a frame may take: as long as it is until the next one, unless a person has set it."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import RUN_HERE
from frames import Frames
from places import SESSION
from synthetic import at_frame, plane_result

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import MappingConfig
from sags_node.mapping.budget import TimeBudget
from sags_node.node.health import TOO_SLOW, why_missed
from sags_node.node.node import Node
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.rig import load_rig
from sags_node.sources.clock import MEASURED, FrameRate
from sags_node.types import FrameResult, StereoFrame

PICTURE = np.zeros((256, 320, 3), np.uint8)  # as the calibration says


def frame(number: int, seconds: float, epoch: int = 0) -> StereoFrame:
    stamp = 10**18 + round(seconds * 1e9)
    return StereoFrame(number, stamp, stamp, PICTURE, PICTURE, epoch=epoch)


class Camera(Frames):
    """Sends faster than it said."""

    rate = 30.0

    def __init__(self, hz: float, frames: int) -> None:
        super().__init__(*(frame(number, number / hz) for number in range(frames)))

    def __iter__(self) -> Iterator[StereoFrame]:
        for one in self._frames:
            yield one
            time.sleep(0.002)


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, ms, that each frame got; nothing is made of it."""
    times, plane = [], plane_result()

    def process(self: Pipeline, one: StereoFrame, budget: TimeBudget, *_: object) -> FrameResult:
        times.append(1e3 * budget.ladder.seconds)
        return at_frame(plane, one.frame_id, one.t_capture_ns)

    monkeypatch.setattr(Pipeline, "process", process)
    return times


@pytest.mark.live
@pytest.mark.parametrize(
    ("overrides", "ms"),
    [
        (["source.rate:=60"], 0.9 * 1000 / 60),
        ([], 0.9 * 100),
        (["source.rate:=60", "mapping.budget_ms:=25"], 25),
        (["source.pace:=fast"], 33),
    ],
)
def test_a_node_gives_a_frame_the_time_until_the_next(
    overrides: list[str], ms: float, given: list[float], tmp_path: Path
) -> None:
    """Nine tenths of it. The recording has ten frames a second."""
    launch = ["source.frames:=3", *overrides, *RUN_HERE, f"publish.run_dir:={tmp_path}"]
    opened = open_session(SESSION, launch)
    node = Node(opened.config, opened.rig, opened.source)
    node.start()
    assert node.wait(30)
    node.stop()
    assert given and given == pytest.approx([ms] * len(given))


@pytest.mark.live
def test_a_node_follows_what_a_live_source_really_sends(given: list[float], tmp_path: Path) -> None:
    launch = ["source.kind:=push", f"rig:={SESSION / 'calib'}", *RUN_HERE, f"publish.run_dir:={tmp_path}"]
    node = Node(load_launch(None, launch), load_rig(SESSION / "calib"), Camera(60.0, 1000))
    node.start()
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline and given[-1:] != [pytest.approx(0.9 * 1000 / 60)]:
        time.sleep(0.05)
    node.stop()
    assert given[0] == pytest.approx(0.9 * 1000 / 30) and given[-1] == pytest.approx(0.9 * 1000 / 60)


def test_a_rate_is_measured_over_the_frames_that_are_taken() -> None:
    rate = FrameRate(30.0)
    rng = np.random.default_rng(0)
    taken = [frame(n, n / 60 + 1e-3 * rng.normal()) for n in range(0, 4 * MEASURED, 2)]  # every second
    changed = [rate.add(one) for one in taken]
    assert changed.index(True) == MEASURED and sum(changed) == 1 and rate.hz == pytest.approx(60, rel=0.02)


@pytest.mark.parametrize("hz", [28.0, 32.0])
def test_a_rate_that_is_nearly_what_was_said_changes_nothing(hz: float) -> None:
    rate = FrameRate(30.0)
    assert not any(rate.add(frame(n, n / hz)) for n in range(5 * MEASURED)) and rate.hz == 30


def test_gaps_new_epochs_and_stamps_that_stand_still_are_no_rate() -> None:
    rate = FrameRate(30.0)
    for n in range(5 * MEASURED):
        away = 10.0 * (n > 2 * MEASURED) - 5.0 * (n > 3 * MEASURED)  # a camera is unplugged, a clock set back
        assert not rate.add(frame(n, n / 30 + away, epoch=int(n > 3 * MEASURED)))
    for _ in range(2 * MEASURED):
        assert not rate.add(frame(n, n / 30 + away, epoch=1))


@pytest.mark.parametrize(
    ("mapping", "rate", "said"),
    [
        ({}, 60.0, TOO_SLOW),
        ({"budget_ms": 33}, 30.0, TOO_SLOW),
        ({"budget_ms": 33}, 60.0, "mapping.budget_ms of 33 is longer than the 16.7 ms from frame to frame"),
        ({"budget_ms": 33}, None, TOO_SLOW),
        ({"iterations": 20, "budget_ms": 33}, 60.0, "mapping.iterations fixes the work"),
        ({"rung": 12}, 60.0, "mapping.rung fixes the quality"),
    ],
)
def test_what_is_said_of_missed_frames_names_what_makes_them_late(
    mapping: dict[str, Any], rate: float | None, said: str
) -> None:
    assert why_missed(MappingConfig(**mapping), rate).startswith(said)
