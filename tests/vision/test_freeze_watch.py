"""A live feed that repeats its image is found; one that only looks alike, and a recording, are not."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count, islice

import cv2
import numpy as np
import pytest
from watching import judged

from sags_node.types import U8, StereoFrame
from sags_node.vision.watch.freeze_watch import Box, FreezeWatch

HEIGHT, WIDTH = 48, 64
S = 1_000_000_000
NOISE = np.random.default_rng(5).normal(0, 1, (300, 380, 3)).astype(np.float32)


def picture(seed: int) -> U8:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def live(i: int, rate: float, left: U8, right: U8 | None) -> StereoFrame:
    stamp = 100 * S + round(i * S / rate)
    return StereoFrame(i, stamp, stamp, left, right, t_arrival_ns=stamp + 1)


def feed(rate: float = 30.0, eyes: int = 2, start: int = 0) -> Iterator[StereoFrame]:
    """The same images for ever, in memory of their own."""
    return (live(i, rate, picture(0), picture(1) if eyes == 2 else None) for i in count(start))


def told(watch: FreezeWatch, frame: StereoFrame) -> bool:
    """Whether it is held, which goes with the warning."""
    why = judged(watch, frame).hold
    assert [finding.text for finding in watch.findings] == [why] * bool(why)
    assert all(finding.code == "picture_frozen" for finding in watch.findings)
    return bool(why)


@pytest.mark.parametrize("eyes", [1, 2])
@pytest.mark.parametrize(("rate", "first"), [(60, 18), (30, 9), (25, 8), (10, 3), (2, 1)])
def test_a_feed_is_frozen_after_three_tenths_of_a_second_by_its_stamps(
    rate: float, first: int, eyes: int
) -> None:
    watch = FreezeWatch()
    found = [told(watch, frame) for frame in islice(feed(rate, eyes), first + 5)]
    assert found == [False] * first + [True] * 5


def test_it_is_over_with_the_first_picture_that_differs() -> None:
    watch, frames = FreezeWatch(), feed()
    assert any([told(watch, next(frames)) for _ in range(20)])
    assert not told(watch, replace(next(frames), left=picture(2)))
    again = [told(watch, next(frames)) for _ in range(12)]
    assert again.index(True) >= 9


Change = Callable[[U8, int], U8]  # of an image in a frame


def shown(change: Change, captions: tuple[Box, ...] = (), rate: float = 30.0) -> list[bool]:
    """Which of two seconds' frames are held, of a feed that shows one image but for the change."""
    watch, eyes = FreezeWatch(captions), [cv2.resize(picture(seed), (320, 240)) for seed in (0, 1)]
    return [
        told(watch, live(i, rate, *(change(eye.copy(), i) for eye in eyes))) for i in range(round(2 * rate))
    ]


def caption(every: int, x: int = 8, y: int = 232) -> Change:
    """A counter that goes on all so many frames."""
    return lambda eye, i: cv2.putText(eye, f"{i // every:04d}", (x, y), 0, 0.4, (255, 255, 255), 1)


def dot(eye: U8, i: int) -> U8:
    return cv2.circle(eye, (308, 12), 4, (255, 0, 0) if i // 8 % 2 else (40, 0, 0), -1)


def noisy(sigma: float, every: int = 1) -> Change:
    """Of a sensor; with `every` of a codec, whose images are equal from one key frame to the next."""

    def change(eye: U8, i: int) -> U8:
        moment = i // every
        noise = NOISE[moment : moment + 240, moment : moment + 320]
        return np.clip(np.rint(eye + sigma * noise), 0, 255).astype(np.uint8)

    return change


def both(first: Change, second: Change) -> Change:
    return lambda eye, i: second(first(eye, i), i)


@pytest.mark.fault("image: a live feed is frozen under a caption that goes on, or with key frames")
@pytest.mark.parametrize(
    "change",
    [caption(1), caption(3), caption(30, 270, 20), dot, both(caption(3), dot), noisy(1, 9), noisy(2, 15),
     both(noisy(1, 9), caption(3))],
)  # fmt: skip
def test_a_caption_or_key_frames_hide_no_frozen_feed(change: Change) -> None:
    held = shown(change)
    assert not any(held[:9]) and all(held[18:]), held  # from half a second and a key frame on


def test_what_the_user_leaves_out_counts_for_nothing() -> None:
    """A monitor's curves over a tenth of the image, up to its middle."""
    box = (0, 100, 320, 24)

    def curves(eye: U8, i: int) -> U8:
        eye[box[1] : box[1] + box[3]] = picture(i)[:24].repeat(5, 1)
        return eye

    assert not any(shown(curves)) and all(shown(curves, (box,))[9:])


@pytest.mark.parametrize("sigma", [0.3, 0.7, 2.0])
def test_a_scope_at_rest_is_not_frozen(sigma: float) -> None:
    """A sensor has noise everywhere, and beside a caption too; it may come at 5 Hz."""
    for change in (noisy(sigma), both(noisy(sigma), caption(3)), noisy(sigma, 6)):
        assert not any(shown(change))


@pytest.mark.parametrize("size", [3, 100])
def test_what_moves_in_the_middle_or_widely_is_alive(size: int) -> None:
    """Also without any noise, as simulators draw."""

    assert not any(shown(lambda eye, i: cv2.circle(eye, (160 + i % 7, 120), size, (200, 60, 60), -1)))


def test_a_picture_that_hardly_changes_for_two_seconds_is_said() -> None:
    """Behind a codec that refines it a frozen image looks as a scene at rest: it is not held."""
    watch, eye = FreezeWatch(), cv2.resize(picture(0), (320, 240))
    for i in range(75):
        refined = eye.copy()
        refined[100:140, 100 + i : 120 + i] ^= 1
        assert not judged(watch, live(i, 30, refined, None)).hold
        assert [finding.code for finding in watch.findings] == ["picture_still"] * (i >= 60)


def test_what_may_repeat_itself_is_not_frozen() -> None:
    """One eye, which is compared with the other elsewhere; a recording; a scope of 25 or 5 Hz behind what
    repeats its images to reach 60."""
    still = (replace(frame, right=picture(i)) for i, frame in enumerate(islice(feed(), 60)))
    recorded = (replace(frame, t_arrival_ns=0) for frame in islice(feed(), 60))
    at = [[i * rate // 60 for i in range(240)] for rate in (25, 5)]
    repeated = [[live(i, 60, picture(2 * n), picture(2 * n + 1)) for i, n in enumerate(each)] for each in at]
    for frames in (still, recorded, *repeated):
        watch = FreezeWatch()
        assert not any(told(watch, frame) for frame in frames)


def test_a_clock_that_is_set_back_thaws_nothing() -> None:
    watch, frames = FreezeWatch(), feed(start=100)
    assert [told(watch, next(frames)) for _ in range(12)][-1]
    assert all(told(watch, frame) for frame in islice(feed(), 5))
