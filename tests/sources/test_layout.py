"""One geometry for all sources: images are split, cropped and turned to the pixel."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from sags_node.config.schema import GeometryConfig, VideosSource
from sags_node.errors import UsageError
from sags_node.sources.layout import Layout
from sags_node.sources.pairing import Alternation, Shot

RNG = np.random.default_rng(5)
LEFT, RIGHT = RNG.integers(0, 256, (2, 24, 32, 3), np.uint8)


def layout(**said: Any) -> Layout:
    return Layout(GeometryConfig(**said))


def lines_of(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.stack([one, other], axis=1).reshape(-1, *one.shape[1:])


TOGETHER = {
    "side_by_side": lambda one, other: np.concatenate([one, other], axis=1),
    "over_under": lambda one, other: np.concatenate([one, other], axis=0),
    "row_interleaved": lines_of,
}


@pytest.mark.parametrize("kind", TOGETHER)
@pytest.mark.parametrize("first", ["left", "right"])
def test_a_picture_of_both_eyes_is_split_to_the_pixel(kind: str, first: str) -> None:
    eyes = (LEFT, RIGHT) if first == "left" else (RIGHT, LEFT)
    both = TOGETHER[kind](*eyes)
    split = layout(layout=kind, first=first)
    assert split.size(both.shape[1], both.shape[0], "it") == (32, 24)
    left, right = split.eyes(both)
    assert (left == LEFT).all() and (right == RIGHT).all()
    assert left.flags.c_contiguous and right.flags.c_contiguous


@pytest.mark.parametrize(
    ("flip", "turned"),
    [
        ("none", lambda p: p),
        ("horizontal", lambda p: p[:, ::-1]),
        ("vertical", lambda p: p[::-1]),
        ("both", lambda p: p[::-1, ::-1]),
    ],
)
def test_each_eye_is_cropped_and_then_turned(flip: str, turned: Any) -> None:
    split = layout(layout="over_under", crop=(3, 2, 20, 10), crop_right=(5, 1, 20, 10), flip=flip)
    left, right = split.eyes(TOGETHER["over_under"](LEFT, RIGHT))
    assert (left == turned(LEFT[2:12, 3:23])).all()
    assert (right == turned(RIGHT[1:11, 5:25])).all()
    assert split.size(32, 48, "it") == (20, 10)


@pytest.mark.parametrize("height", [24, 23])
@pytest.mark.parametrize("field", ["top", "bottom"])
def test_one_field_is_kept_and_the_rows_between_are_means(field: str, height: int) -> None:
    picture = LEFT[:height]
    whole = layout(deinterlace=field).eye(picture, "left")
    for y in range(height):
        kept = y % 2 == (field == "bottom")
        rows = [picture[k] for k in ((y,) if kept else (y - 1, y + 1)) if 0 <= k < height]
        assert np.abs(whole[y] - np.mean(rows, axis=0)).max() <= (0 if kept else 0.5)


def test_the_lower_eye_may_begin_with_the_other_field() -> None:
    eye = np.zeros((9, 32, 3), np.uint8)
    both = np.concatenate([eye, eye])
    both[0::2] = 7  # the first field, of the whole image
    for picture in layout(layout="over_under", deinterlace="top").eyes(both):
        assert (picture == 7).all()


@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("levels", [(0.0, 1.0), (0.25, 0.5)])
def test_levels_keep_the_tones(levels: tuple[float, float], bits: int) -> None:
    """Of counts of 10 bit in 16, each of 256 tones is there between black and white, and right."""
    if bits == 10:
        picture = np.repeat((np.arange(1024) << 6).astype(np.uint16).reshape(32, 32, 1), 3, axis=2)
    else:
        picture = LEFT
    found = layout(levels=levels).eye(picture, "left")
    black, white = levels
    expected = np.clip(255 * (picture / np.iinfo(picture.dtype).max - black) / (white - black), 0, 255)
    assert np.abs(found - expected).max() <= 0.5 + 1e-9
    assert bits == 8 or len(np.unique(found)) == 256


def test_nothing_to_do_costs_no_copy() -> None:
    assert layout().eye(LEFT, "left") is LEFT


@pytest.mark.parametrize(
    ("said", "size", "words"),
    [
        ({"layout": "side_by_side"}, (33, 24), "33 px wide, which is odd"),
        ({"layout": "row_interleaved"}, (32, 25), "25 px high, which is odd"),
        ({"crop": (10, 0, 30, 24)}, (32, 24), "leaves the image: an eye of it is 32x24 px"),
        ({"crop": (0, 0, 8, 8), "crop_right": (0, 0, 8, 9)}, (32, 24), "8x8 px but crop_right 8x9"),
        ({"layout": "panes", "crop": (0, 0, 32, 24), "crop_right": (32, 0, 32, 24)}, (64, 24),
         r"tools is 16x24 px but source\.geometry\.crop 32x24; all panes"),
        ({"layout": "row_interleaved", "deinterlace": "top"}, (32, 24), "leave deinterlace out"),
        ({"crop": (0, 0, 0, 5)}, (32, 24), "is no box"),
        ({"levels": (0.5, 0.5)}, (32, 24), "black < white"),
    ],
)  # fmt: skip
def test_what_does_not_fit_or_makes_no_sense_is_refused(said: Any, size: tuple[int, int], words: str) -> None:
    tools = (0, 0, 16, 24) if said.get("layout") == "panes" else None
    with pytest.raises((UsageError, ValidationError), match=words):
        Layout(GeometryConfig(**said), tools=tools).size(*size, "it")


# ---- eyes in turn ----------------------------------------------------------------------------------------


def pairs_of(
    indices: list[int], jitter_ms: float, stamped: bool, set_ms: float = 0.0
) -> tuple[list[tuple[int, int]], int]:
    """Of a camera of 60 Hz, by number; even ones are of the first eye. `stamped`: by its clock as well;
    the wall clock is set before the eleventh."""
    moments = [round(1e9 / 60 * i) for i in indices]
    jitter = np.random.default_rng(1).uniform(-jitter_ms, jitter_ms, len(indices))
    times = iter([moment + round(late * 1e6) for moment, late in zip(moments, jitter, strict=True)])
    joining, found = Alternation(1e9 / 60, lambda: next(times)), []
    for i, moment in zip(indices, moments, strict=True):
        wall = 10**18 + moment + round((i > 10) * set_ms * 1e6)
        shot = Shot(wall, np.full((2, 2, 3), i, np.uint8), device_ns=moment if stamped else None)
        if (pair := joining.add(shot)) is not None:
            found.append(pair)
    return [(int(a.image[0, 0, 0]), int(b.image[0, 0, 0])) for a, b in found], joining.alone


@pytest.mark.fault("clock: the wall clock is set while the eyes come in turn")
@pytest.mark.parametrize("stamped", [True, False])
def test_a_clock_that_is_set_does_not_exchange_the_eyes(stamped: bool) -> None:
    for by in (-1000, -50, 17, 50, 150, 950):
        assert pairs_of(list(range(30)), 4, stamped, by) == ([(i, i + 1) for i in range(0, 30, 2)], 0)


@pytest.mark.parametrize(
    ("late_ms", "stamped", "lost", "firsts"),
    [
        (4, False, (), range(0, 20, 2)),
        (100, True, (), range(0, 20, 2)),
        (4, True, (3, 8, 12, 13), (0, 4, 6, 10, 14, 16, 18)),  # 2 and 9 are alone
    ],
)
def test_lost_pictures_do_not_exchange_eyes_in_turn(
    late_ms: float, stamped: bool, lost: tuple[int, ...], firsts: Sequence[int]
) -> None:
    """A camera's own stamps tell, from the first image on, however late a busy machine takes it in."""
    pairs, alone = pairs_of([i for i in range(20) if i not in lost], late_ms, stamped)
    assert pairs == [(i, i + 1) for i in firsts] and alone == 20 - len(lost) - 2 * len(pairs)


def test_one_video_of_both_eyes_needs_no_other() -> None:
    both = Path("both.avi")
    with pytest.raises(ValidationError, match="leave right out"):
        VideosSource(left=both, right=both, geometry=GeometryConfig(layout="over_under"))
