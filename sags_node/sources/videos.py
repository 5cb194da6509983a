"""Stereo pairs from video files: one file per eye, or one file that shows both."""

import shlex
from pathlib import Path

import numpy as np

from sags_node.errors import SagsError, UsageError
from sags_node.media.video import Video
from sags_node.sources.layout import Layout
from sags_node.sources.pairing import NEAR, pair
from sags_node.sources.pictures import Pairs, RawPair, size_text
from sags_node.types import I64

PARTNERED = 0.5  # share of images that must find a partner by stamps; else they pair by number
TORN = (
    "the file says that its images are interlaced: what moves is torn, unless both fields are of one moment"
)
UNEVEN_RATES = 0.1  # relative difference allowed between the rates of two files with gaps or jitter


class VideoPairs(Pairs):
    """Two videos, or the left one alone. The number of pairs follows the left one.

    Images with the same number are a pair. If stamps show that some are missing, the nearest in time are.

    Attributes:
        left, right: the videos; right None: there is one eye.
        by_number: images are paired by number, not by stamps.
        oddities: see `Video`; also the number of images without a partner.

    Args:
        layout: geometry of each eye's image.

    Raises:
        UsageError: a file is missing or not a video, or the two differ in size or rate.
    """

    oddities: list[str]

    def __init__(self, left: Path, right: Path | None, layout: Layout) -> None:
        self.left = Video(left)
        self.right = None if right is None else Video(right)
        self._layout = layout
        self.rate = self.left.rate
        self.oddities = [said for video in self._videos for said in _oddities(video, layout)]
        self._late = 0  # ns to subtract from the right file's stamps
        try:
            numbers = None if self.right is None else self._joined(self.left, self.right)
            layout.size(*self.left.size, str(left))
        except UsageError:
            self.close()
            raise
        self.by_number = numbers is None
        self._numbers = np.arange(self.left.count)[:, None].repeat(2, axis=1) if numbers is None else numbers
        self.count = len(self._numbers)
        self.left_count, self.left_numbers = self.left.count, self._numbers[:, 0]
        self.stamps = self._find_stamps()
        self.pixel_aspect = layout.pixel_aspect(*self.left.size, self.left.pixel_aspect)
        self.cut_off = next((each.cut_off for each in self._videos if each.cut_off), "")
        self.reach = min(self.count, *(each.count for each in self._videos))
        self._compare_lengths()

    def at(self, index: int) -> RawPair | None:
        if index >= self.count:
            return None
        of_left, of_right = (int(number) for number in self._numbers[index])
        left = self.left.read(of_left)
        if left is None:
            return None
        seen = self._layout.eye(left, "left")
        if self.right is None:
            return RawPair(seen, None, None)
        right = self.right.read(of_right)
        if right is None:
            raise SagsError(
                f"{self.right.path} ends at frame {index} but {self.left.path} goes on; set source.frames "
                "to stop there"
            )
        return RawPair(seen, self._layout.eye(right, "right"), None)

    def close(self) -> None:
        for video in self._videos:
            video.close()

    @property
    def _videos(self) -> list[Video]:
        return [self.left] if self.right is None else [self.left, self.right]

    def _joined(self, left: Video, right: Video) -> I64 | None:
        """The numbers of the images of each pair [N, 2]; None: images with the same number are pairs."""
        if left.size != right.size:
            sizes = (
                f"{left.path} has {size_text(*left.size)} px but {right.path} has {size_text(*right.size)}"
            )
            raise UsageError(f"{sizes}; they are not one stereo pair")
        if abs(left.pixel_aspect / right.pixel_aspect - 1) > 0.01:
            self.oddities.append(
                f"{left.path} has pixels {left.pixel_aspect:.3g} times as wide as high, {right.path} "
                f"{right.pixel_aspect:.3g}; both are taken for those of the left one: record both alike"
            )
        is_even = left.is_even and right.is_even
        if left.rate is not None and right.rate is not None:
            apart = abs(left.rate - right.rate) / left.rate
            if apart > (0.01 if is_even else UNEVEN_RATES):
                said = "they are not one stereo pair: record both at one rate, or bring one to it"
                way = f"-i {shlex.quote(str(right.path))} -r {left.rate:g}"
                if left.count == right.count:  # so no image may be added
                    said = f"both have {left.count} images, so one rate is wrong; is it the right one's"
                    way = f"-r {left.rate:g} -i {shlex.quote(str(right.path))}"
                raise UsageError(
                    f"{left.path} has {left.rate:g} frames/s but {right.path} has {right.rate:g}; {said} "
                    f"(ffmpeg {way} NEW)"
                )
        if left.stamps is None or right.stamps is None or left.rate is None:
            return None
        period = 1e9 / left.rate
        late, ends_late = (int(right.stamps[at] - left.stamps[at]) for at in (0, -1))
        of_one_clock = min(abs(late), abs(ends_late)) <= NEAR * period
        if not of_one_clock:  # two recorders, whose stamps begin at different times
            self.oddities.append(
                f"the stamps of the right video begin {abs(late) * 1e-9:.3f} s "
                f"{'after' if late > 0 else 'before'} those of the left one; their first images are taken "
                "for one moment: is an eye late, cut its beginning off"
            )
        if is_even and (not of_one_clock or abs(late) <= NEAR * period):
            return self._drifted(left, right, period) if of_one_clock else None
        self._late = 0 if of_one_clock else late
        found = pair(left.stamps, right.stamps - self._late, NEAR * period * 1e-9)
        alone = left.count - len(found), right.count - len(found)
        if len(found) < PARTNERED * min(left.count, right.count):
            self.oddities.append(
                f"{left.path}, {right.path}: the stamps of {alone[0]} images have no partner; both "
                "are paired by number: is that what they show?"
            )
            return None
        if any(alone):
            self.oddities.append(
                f"{left.path}, {right.path}: {alone[0]} and {alone[1]} images have no partner at "
                "their time, and are left out; were they lost while recording?"
            )
        return found

    def _compare_lengths(self) -> None:
        """Note what it means that images are paired by number, and one eye has more of them."""
        left, right = self.left, self.right
        if right is None or not self.by_number or left.count == right.count:
            return
        said = f"{right.path} has {right.count} images, {left.path} {left.count}"
        if right.count > left.count:
            self.oddities.append(
                f"{said}; were both begun at the same moment? What the left one has is played"
            )
        elif not self.cut_off:
            self.cut_off = (
                f"{said}; if one was begun later (sags import --check looks), cut so much off the "
                "beginning of the other one"
            )

    def _drifted(self, left: Video, right: Video, period: float) -> I64 | None:
        """Do as `_joined` for two even videos that begin together: small differences of rate add up."""
        assert left.stamps is not None and right.stamps is not None
        last = min(left.count, right.count) - 1
        apart = abs(right.stamps[last] - left.stamps[last])
        if apart <= NEAR * period:
            return None
        by_time = left.count != right.count and abs(right.stamps[-1] - left.stamps[-1]) <= period
        how, fits = "number", "took each image together: then one rate is wrong"
        if by_time:
            how, fits = "time", "ended at one moment"
        self.oddities.append(
            f"{left.path} has {left.rate:.6g} frames/s but {right.path} has {right.rate:.6g}: stamps of one "
            f"number get {apart * 1e-9:.2f} s apart; they are paired by {how}, which is right if both {fits}"
        )
        return pair(left.stamps, right.stamps, NEAR * period * 1e-9) if by_time else None

    def _find_stamps(self) -> I64 | None:
        left, right = self.left, self.right
        if left.stamps is None or (left.is_even and self.by_number):
            return None
        of_left = left.stamps[self._numbers[:, 0]]
        if right is None or self.by_number:
            return np.stack([of_left, of_left], axis=1)
        assert right.stamps is not None
        return np.stack([of_left, right.stamps[self._numbers[:, 1]] - self._late], axis=1)


class OneVideoPairs(Pairs):
    """One video of both eyes: in halves or boxes of an image, in alternating rows or images.

    Attributes:
        size: width and height of an eye's image, px.

    Raises:
        UsageError: its images cannot be split as asked.
    """

    def __init__(self, video: Video, layout: Layout) -> None:
        self._video = video
        self._layout = layout
        try:
            self.size = layout.size(*video.size, str(video.path))
        except UsageError:
            self.close()
            raise
        in_turn = 2 if layout.is_sequential else 1
        self.rate = None if video.rate is None else video.rate / in_turn
        self._numbers = np.arange(video.count)[:, None]
        left = 0
        if layout.is_sequential:
            turns, left = _turns(video), layout.order.index("left")
            self.later = 0.5 - left
            seconds = 1 + np.flatnonzero((turns[1:] % 2 == 1) & (np.diff(turns) == 1))
            self._numbers = np.stack([seconds - 1, seconds], axis=1)
            lefts = np.cumsum(turns % 2 == left)
            self.left_count, self.left_numbers = int(lefts[-1]), lefts[self._numbers[:, left]] - 1
        self.count = len(self._numbers)
        if video.stamps is not None and not video.is_even:
            of_eyes = video.stamps[self._numbers]
            self.stamps = np.stack([of_eyes[:, left], of_eyes[:, -1 - left]], axis=1)
        self.pixel_aspect = layout.pixel_aspect(*video.size, video.pixel_aspect)
        self.cut_off, self.reach = video.cut_off, self.count
        self.oddities = _oddities(video, layout)

    def at(self, index: int) -> RawPair | None:
        if index >= self.count:
            return None
        pictures = [self._video.read(int(number)) for number in self._numbers[index]]
        first, last = pictures[0], pictures[-1]
        if first is None or last is None:
            return None
        if self._layout.is_sequential:
            left, right = self._layout.in_turn(first, last)
        else:
            left, right = self._layout.eyes(first)
        return RawPair(left, right, self._layout.tissue(first, left))

    def close(self) -> None:
        self._video.close()


def _oddities(video: Video, layout: Layout) -> list[str]:
    """Warnings about a video that is played with this layout."""
    if not video.is_interlaced or layout.takes_fields:
        return video.oddities
    return [*video.oddities, f"{video.path}: {TORN}; set source.geometry.deinterlace:=top, or bottom"]


def _turns(video: Video) -> I64:
    """The turn of each image [N] if the eyes come in turn; even: the first eye. The time between two
    images tells how many were lost, so that a lost image does not swap the eyes."""
    turns = np.arange(video.count)
    if video.stamps is not None and video.rate is not None:
        steps = np.maximum(1, np.rint(np.diff(video.stamps) * (video.rate * 1e-9))).astype(np.int64)
        turns = np.concatenate([[0], np.cumsum(steps)])
    return turns
