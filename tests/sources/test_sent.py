"""What is common to images that other programs send: their stamps, their loss, their clock."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from synthetic import plane_result
from waiting import beside, until

from sags_node.cli.foreground import inputs_text
from sags_node.config import schema as cfg
from sags_node.errors import SagsError
from sags_node.findings import by_code, by_stage
from sags_node.messaging import cdr, content, topics
from sags_node.node.health import Statistics
from sags_node.sources.clock import KEPT, CaptureClock
from sags_node.sources.sent import WINDOW, Arrivals, SentPictures
from sags_node.types import U8, ClockStatus, Finding, Side, StereoFrame

MS, S = 1_000_000, 1_000_000_000
PERIOD = 33 * MS


EYES: tuple[Side, Side] = "left", "right"


def picture() -> U8:
    return np.zeros((4, 8, 3), np.uint8)


@pytest.mark.fault("network: images of a sender are lost")
@pytest.mark.parametrize("away_s", [0, 20])
@pytest.mark.parametrize("lost", [0, 1, 3])
def test_loss_is_counted_by_the_gaps_and_none_while_the_sender_was_away(lost: int, away_s: int) -> None:
    """Of every eight images `lost` do not come."""
    rng = np.random.default_rng(3)
    arrivals = Arrivals()
    for number in range(16 * WINDOW):
        if number % 8 >= lost:
            begun = away_s * S * (number > 8 * WINDOW)
            arrivals.add(begun + number * PERIOD + int(rng.integers(-4 * MS, 4 * MS)))
    assert arrivals.share_lost == pytest.approx(lost / 8, abs=0.04)  # 4 of 33 ms jitter on the median step
    assert arrivals.rate == pytest.approx((8 - lost) / 8 / 0.033, rel=0.03)
    assert arrivals.lost == pytest.approx(16 * WINDOW * lost / 8, abs=16 * WINDOW * 0.04)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (cfg.PushSource(endpoint="tcp://127.0.0.1:5999"), "start the sender at tcp://127.0.0.1:5999"),
        (cfg.Ros2Source(left="/a/left", right="/a/right"), "start what publishes /a/left and /a/right"),
        (cfg.FoldersSource(left=Path("left"), right=Path("right")), "is the disk slow?"),
        (cfg.V4l2Source(), "check the camera, its cable and the capture card"),
    ],
)
def test_what_helps_depends_on_the_source(
    source: cfg.Source, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr("sags_node.node.health.time.monotonic", lambda: now)
    statistics = Statistics(source)
    statistics.add(plane_result(), 1.0, {})
    now += 10  # of a pause
    statistics.resume()
    now += 0.5  # nothing can have come yet
    health = statistics.health({}, False, False, None, {}, {}, {})
    assert health.state == "running" and not health.warnings
    now += 1.0
    warnings = by_code(statistics.health({}, False, False, None, {}, {}, {}).warnings)
    assert warnings["no_frames"] == f"no frame comes: {said}"
    for code in ("calibration_changed", "sent_refused"):
        why = by_stage([Finding(code, "the zoom was turned")])
        assert statistics.health({}, False, False, None, why, {}, {}).warnings == why, "it says it already"


@pytest.mark.fault("stamp: 3.2 s old, or 0.5 s ahead")
@pytest.mark.fault("stamp: an hour ahead or back for a second, then right again")
@pytest.mark.parametrize(
    ("age", "said"),
    [(3.2, "3.2 s old"), (-0.5, "0.5 s ahead"), (3600, "3600.0 s old"), (-3600, "3600.0 s ahead")],
)
def test_a_wrong_stamp_is_refused_with_its_age_and_that_is_not_told_of_what_comes_after(
    age: float, said: str
) -> None:
    sent = SentPictures(cfg.PushSource(), None)
    for number in range(-30, WINDOW):
        stamp = number * PERIOD - round((age if number < 0 else 0) * S)
        for eye in EYES:
            refused = pytest.raises(SagsError, match=f"{said}.*source.stamps:=own")
            with nullcontext() if number >= 0 else refused:
                sent.put(eye, stamp, number * PERIOD, picture)
        assert sent.slowness() is None


def test_pictures_of_both_eyes_are_taken_apart_and_cropped() -> None:
    both = np.random.default_rng(3).integers(0, 256, (12, 8, 3), np.uint8)
    geometry = cfg.GeometryConfig(layout="over_under", first="right", crop=(2, 1, 5, 4), flip="vertical")
    sent = SentPictures(cfg.PushSource(geometry=geometry), (5, 4))
    sent.put_both(S, S, lambda: both)
    for eye, half in (("left", both[6:]), ("right", both[:6])):
        sent.put(eye, S + PERIOD, S + PERIOD, lambda half=half: half)  # and one eye's in the same way
    for frame in islice(sent, 2):
        assert (frame.left == both[7:11, 2:7][::-1]).all() and (frame.right == both[1:5, 2:7][::-1]).all()
    for wrong, said in (
        (both[:11], "an image is 11 px high, which is odd"),
        (both[:, :6], "leaves the image: an eye of an image is 6x6 px"),
    ):
        with pytest.raises(SagsError, match=said):
            sent.put_both(2 * S, 2 * S, lambda wrong=wrong: wrong)
    with pytest.raises(ValueError, match="frame_sequential is for cameras"):
        cfg.PushSource(geometry=cfg.GeometryConfig(layout="frame_sequential"))


@contextmanager
def taken(
    config: cfg.PushSource,
) -> Iterator[tuple[list[StereoFrame], Callable[[int, int, int, Side], None]]]:
    """The frames that come, and what hands in an image: the how many-th moment, stamp, arrival, eye. It waits
    until what was handed in of the moments before is taken in."""
    sent, frames = SentPictures(config, None), list[StereoFrame]()

    def put(count: int, stamp: int, arrival: int, eye: Side) -> None:
        until(lambda: len(frames) + sent.dropped >= count)
        sent.put(eye, stamp, arrival, picture)

    with beside(lambda: frames.extend(sent), sent.end):
        yield frames, put


@pytest.mark.fault("network: a sender's first image is 150 ms late, stamps of its own clock")
def test_a_late_first_picture_makes_no_new_epoch() -> None:
    """The offset of the clocks is known better with each image that comes sooner."""
    with taken(cfg.PushSource(stamps="own")) as (frames, put):
        for number in range(30):
            stamp = number * PERIOD
            for eye in EYES:
                put(number, stamp, 100 * S + stamp + (150 if number == 0 else 5) * MS, eye)
    assert {frame.epoch for frame in frames} == {0}
    # Its stamp was 145 ms too late: four of the next are older than it seemed to be, and left out.
    stamps = [frame.t_capture_ns for frame in frames]
    assert stamps == [100 * S + 150 * MS] + [100 * S + n * PERIOD + 5 * MS for n in range(5, 30)]


@pytest.mark.fault("network: images of a sender with a clock of its own get 0.8 s late")
@pytest.mark.parametrize("apart", [0, -7 * S])
@pytest.mark.parametrize("order", [EYES, EYES[::-1]])
@pytest.mark.parametrize("skew", [-20, 5, 20])
def test_what_is_late_is_never_told_as_new(skew: int, order: tuple[Side, Side], apart: int) -> None:
    """The eyes are exposed one after the other, stamped by one clock or two. One moment overtakes another."""
    numbers = [*range(50), 51, 50, *range(52, 60)]
    with taken(cfg.PushSource(stamps="own", pair_tolerance_ms=25)) as (frames, put):
        for count, number in enumerate(numbers):
            shown, way = 10 * S + number * PERIOD, (10 if number < 40 else 800) * MS
            for eye in order:
                stamp = shown + (apart + skew * MS if eye == "right" else 0)
                put(count, stamp, 100 * S + shown + max(skew, 0) * MS + way, eye)
    assert len(frames) >= 55
    for frame in frames:  # 10 ms is the shortest way, and what is exposed first waits for the other
        for told, late in ((frame.t_capture_ns, 0), (frame.t_capture_right_ns, skew * MS)):
            assert 0 <= told - (100 * S + frame.t_device_ns + late) <= 50 * MS


def test_the_latency_is_taken_off_and_all_stamps_are_kept() -> None:
    sent = SentPictures(cfg.PushSource(latency_ms=40), None)
    sent.put("left", 100 * S, 100 * S + 5 * MS, picture)
    sent.put("right", 100 * S + 3 * MS, 100 * S + 6 * MS, picture)
    frame = next(iter(sent))
    assert (frame.t_capture_ns, frame.t_capture_right_ns) == (100 * S - 40 * MS, 100 * S - 37 * MS)
    assert (frame.t_device_ns, frame.t_arrival_ns) == (100 * S, 100 * S + 5 * MS)


@pytest.mark.fault("network: a sender is 300 ms late")
@pytest.mark.parametrize(
    ("step", "late", "said"),
    [
        (2 * PERIOD, 0, "15.2 of 30 images a second come: send faster, or set source.rate:=15.2"),
        (PERIOD, 300 * MS, "300 ms old"),
        (PERIOD, 0, "None"),
    ],
)
def test_who_sends_too_slowly_or_late_is_told(step: int, late: int, said: str) -> None:
    sent = SentPictures(cfg.PushSource(rate=30), None)
    for number in range(WINDOW):
        for eye in EYES:
            sent.put(eye, number * step, number * step + late, picture)
    assert said in str(sent.slowness())


# ---- clocks ----------------------------------------------------------------------------------------------


def watched(clock: CaptureClock, seconds: float, drift: float, offset: int = 7 * S, begun: int = 0) -> int:
    """Thirty images a second; each is 2 ms on the way, and up to 20 ms more. The last difference, ns."""
    rng = np.random.default_rng(4)
    for stamp in range(begun, begun + round(seconds * S), S // 30):
        difference = offset + round(drift * (stamp - begun))
        clock.add(stamp, stamp + difference + 2 * MS + int(rng.exponential(5 * MS)))
    return difference


@pytest.mark.parametrize(("seconds", "drift"), [(60, 0.0), (60, 100e-6), (60, -40e-6), (KEPT + 30, 0.0)])
def test_the_drift_is_found_under_the_jitter_and_the_watch_is_bounded(seconds: int, drift: float) -> None:
    clock = CaptureClock()
    difference = watched(clock, seconds, drift)
    status = clock.status()
    # The smallest of thirty exponential delays is 5/30 ms: over a minute that bounds the slope to some ppm.
    assert status.drift_ppm == pytest.approx(drift * 1e6, abs=5)
    assert clock.to_wall(seconds * S) == pytest.approx(seconds * S + difference + 2 * MS, abs=MS)
    assert status.seconds <= KEPT * 1.05  # a second's bin begins with an image


@pytest.mark.fault("camera: away for half a minute soon after the start")
@pytest.mark.parametrize("before", [0.02, 1.5, 2.5])
def test_few_pictures_long_apart_tell_the_clock_too(before: float) -> None:
    clock = CaptureClock()
    watched(clock, before, 0)
    watched(clock, 1, 0, begun=30 * S)
    status = clock.status()
    # The smallest of at least one and of thirty delays, 30 s apart: 20 ms in 30 s.
    assert abs(status.drift_ppm) < 700
    assert clock.to_wall(31 * S) == pytest.approx(38 * S + 2 * MS, abs=20 * MS)


def test_a_short_watch_says_no_drift() -> None:
    clock = CaptureClock()
    assert clock.status() is None
    watched(clock, 5, 0)
    status = clock.status()
    assert status is not None and status.drift_ppm is None


@pytest.mark.fault("clock: a camera's is set by 3 s, forward or back")
@pytest.mark.fault("clock: a sender's is set forward, by half a second to an hour")
@pytest.mark.parametrize(
    ("jump", "within"), [(S // 2, 1), (3 * S, 1), (3600 * S, 1), (-3 * S, 3)], ids=lambda value: f"{value:g}"
)
def test_a_jump_is_no_drift_and_followed_within_three_seconds(jump: int, within: int) -> None:
    """A slope over it would let stamps stand still, and no image would be newer than the one before."""
    clock = CaptureClock()
    watched(clock, 15, 0)
    for second in range(30):
        stamp = (15 + second) * S + jump
        watched(clock, 1, 0, offset=7 * S - jump, begun=stamp)
        if second + 1 >= within:
            assert clock.to_wall(stamp + S) == pytest.approx((23 + second) * S + 2 * MS, abs=MS)


def test_a_slow_way_is_no_clock_that_was_set_for_ten_seconds() -> None:
    clock = CaptureClock()
    watched(clock, 30, 0)
    for begun in range(30, 39):
        watched(clock, 1, 0, offset=8 * S, begun=begun * S)
        assert clock.to_wall(begun * S) == pytest.approx((begun + 7) * S + 2 * MS, abs=MS)
    watched(clock, 4, 0, offset=8 * S, begun=39 * S)  # after twelve it is
    assert clock.to_wall(43 * S) == pytest.approx(51 * S + 2 * MS, abs=MS)


def test_it_is_said_where_pictures_and_poses_are_taken_from() -> None:
    ros = cfg.LaunchConfig(source=cfg.Ros2Source(domain=7, left="/a", right="/b"), robot=cfg.PushRobot())
    assert inputs_text(ros) == [
        "taking images from ROS 2 domain 7, interface lo: /a and /b",
        "taking poses at tcp://127.0.0.1:5559",
    ]
    assert inputs_text(cfg.LaunchConfig()) == []


def test_the_clock_is_told_in_status_and_diagnostics() -> None:
    clock = ClockStatus(offset_ms=12.5, drift_ppm=-31.0, seconds=40.0)
    health = Statistics().health({}, False, False, None, {}, {}, {}, clock)
    assert content.status(health, None)["clock"] == {"offset_ms": 12.5, "drift_ppm": -31.0, "seconds": 40.0}
    (part,) = content.diagnostics(health, 0).parts
    values = cdr.decode(bytes(part), topics.DIAGNOSTICS).status[0].values
    assert {"capture_clock_drift_ppm": "-31.0"}.items() <= {v.key: v.value for v in values}.items()
