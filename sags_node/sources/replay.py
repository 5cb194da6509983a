"""Plays a recording: at its own pace, as fast as it is taken, or step by step with its own stamps."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Self

import cv2
import numpy as np

from sags_node.config import schema as cfg
from sags_node.errors import UsageError
from sags_node.media.video import LostPictureError, Video
from sags_node.sources.bags import BagPairs
from sags_node.sources.dvrk import DvrkPairs
from sags_node.sources.endonerf import EndoNerfPairs
from sags_node.sources.layout import Layout
from sags_node.sources.pictures import FolderPairs, Pairs, say
from sags_node.sources.scared import ScaredPairs
from sags_node.sources.truth import References, read_poses
from sags_node.sources.videos import OneVideoPairs, VideoPairs
from sags_node.types import U8, StereoFrame
from sags_node.wall_clock import WallClock

Recording = (
    cfg.FoldersSource
    | cfg.VideosSource
    | cfg.EndoNerfSource
    | cfg.ScaredSource
    | cfg.BagSource
    | cfg.DvrkSource
)
DEFAULT_RATE = 30.0  # Hz, of recordings that do not tell theirs
ASSUMED = " (assumed: the files do not say it; set source.rate)"
# Check for the same image in both eyes, in images so small that noise and compression are averaged away.
WIDTH = 80  # px of these images
SURELY = 0.25  # times the change by a shift of one pixel; a scope's eyes differ by 1 to 5 times that
LEAST = 1.0  # grey levels of that change: if it is less, the image has no texture, and is not judged
# Largest difference of both greens, smallest of red and blue, as shares of the sum of four pixels.
GREENS, RED_BLUE = 0.005, 0.03
MOSAIC = (
    "the images are grey, and a Bayer mosaic: each pixel holds one colour; take it apart (OpenCV's "
    "cvtColor with COLOR_BayerRG2BGR or another pattern), and save images in colour"
)


class Replay:
    """A `Source` that plays a recording.

    Each pair (or each stride-th) has a turn, whose number is `frame_id`: its place in the first pass, counted
    on when the recording loops. `rate` is the rate of turns. In `realtime` pace turn `n` is due `n / rate`
    seconds after the first, by a monotonic clock. Its stamp is the wall clock's time then. A pair that would
    come more than one period late is left out and counted as dropped. In `fast` pace no pair waits, and the
    stamp is the wall clock's. In `step` pace the stamp is `frame_id / rate`. `epoch` grows with each loop,
    and when a stamp goes back.

    A recording that holds a stamp for each image is played by these, unless `config.rate` is set.

    Attributes:
        first: number of the first frame.
        pairs: the reader of the recording.
        assumed: text to show behind the rate if it is a guess; else empty.

    Args:
        config: which recording, and how to play it.
        references: read the recording's ground truth with each frame.
        clock: monotonic, s.
        wall_ns: wall clock, ns.
        sleep: waits for seconds; the default is cut short by `stop`.
        quiet: do not log warnings about the recording: whoever plays it later does.

    Raises:
        UsageError: files are missing or do not match, pairs are missing before `frames`, `start` lies behind
            the end, or a reference is of a frame that does not exist.
    """

    def __init__(
        self,
        config: Recording,
        *,
        references: bool = True,
        clock: Callable[[], float] = time.monotonic,
        wall_ns: Callable[[], int] = time.time_ns,
        sleep: Callable[[float], object] | None = None,
        quiet: bool = False,
    ) -> None:
        self._config, self._quiet = config, quiet
        self._stopped = threading.Event()
        self._clock = clock
        self._wall_ns = wall_ns
        self._sleep = sleep or self._stopped.wait
        self._poses = None if config.poses is None else read_poses(config.poses)
        self._references = References(config.reference) if references else None
        self.pairs = open_pairs(config, references)
        lefts = self.pairs.count if self.pairs.left_count is None else self.pairs.left_count
        if self._poses is not None:
            self._compare_poses(len(self._poses), lefts)
        if self._references is not None:
            self._compare_references(self._references, lefts)
        self._count = -(-self.pairs.count // config.stride)  # rounded up
        self.rate = (config.rate or self.pairs.rate or DEFAULT_RATE) / config.stride
        self.assumed = "" if "rate" in config.model_fields_set or self.pairs.rate else ASSUMED
        for finding in [] if quiet else self.pairs.findings:
            say(f"{finding.what}; {finding.fix}")
        stamps = None if self.pairs.stamps is None else self.pairs.stamps[:: config.stride]
        self._stamps = stamps if config.rate is None else None  # [turns, 2] ns, of both eyes' images
        # Stamps of the left images, ns: to look up poses in the same bag.
        self._recorded = stamps[:, 0] if stamps is not None and isinstance(self.pairs, BagPairs) else None
        self.dropped = 0
        self._began: float | None = None  # monotonic seconds of the first turn
        self._wall = WallClock()
        self._dropped_in_a_row = 0
        self.first = self.frame_at(config.start)
        if self.first >= self._count:
            self.pairs.close()
            seconds = self._count / self.rate
            raise UsageError(
                f"source.start {config.start} s lies behind the recording's end at {seconds:.2f} s"
            )
        if self.pairs.cut_off:
            there = -(-self.pairs.reach // config.stride) - self.first
            if config.frames is None or config.frames > there:
                self.pairs.close()
                raise UsageError(f"{self.pairs.cut_off}, or play what is there with source.frames:={there}")

    def _compare_poses(self, there: int, lefts: int) -> None:
        if there == lefts or (self.pairs.cut_off and there > lefts):  # the cut-off part has poses, too
            return
        self.pairs.close()
        raise UsageError(
            f"{self._config.poses} holds {there} poses, the recording {lefts} images of the left eye; "
            "T_world_cam must hold one for each of them, in their order, also for those that are not played"
        )

    def _compare_references(self, references: References, lefts: int) -> None:
        if not self.pairs.cut_off and (beyond := references.beyond(lefts)):
            self.pairs.close()
            raise UsageError(beyond)
        if references.oddity and not self._quiet:
            say(references.oddity)
        if isinstance(self.pairs, FolderPairs) and not self._quiet:
            if misnamed := references.misnamed(self.pairs.files):
                say(misnamed)

    def frame_at(self, start: float) -> int:
        """Return the number of the frame with which this `source.start` (s) begins."""
        if self._stamps is None:
            return round(start * self.rate)
        return int(np.searchsorted(self._stamps[:, 0], self._stamps[0, 0] + round(start * 1e9)))

    def seconds_of(self, frame_id: int) -> float:
        """Return the `source.start` (s, to the nanosecond) that begins with this frame of the first pass, or
        with the first frame that has the same stamp."""
        if self._stamps is None:
            return round(frame_id / self.rate, 9)
        return round(int(self._stamps[frame_id, 0] - self._stamps[0, 0]) * 1e-9, 9)

    @property
    def frame_count(self) -> int | None:
        """The number of turns; None for an endless loop."""
        if self._config.loop:
            return self._config.frames
        there = self._count - self.first
        return there if self._config.frames is None else min(there, self._config.frames)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self.pairs.close()

    def stop(self) -> None:
        """End the iteration; any thread may call this."""
        self._stopped.set()

    def __iter__(self) -> Iterator[StereoFrame]:
        """Play from the start.

        Raises:
            UsageError: both eyes begin with the same image.
            SagsError: an image is damaged, or the right eye ends before the left one.
        """
        stride = self._config.stride
        self._began = None
        self._dropped_in_a_row = 0
        epoch, index, frame_id, last = 0, self.first, self.first, 0
        limit = None if self._config.frames is None else self.first + self._config.frames
        while not self._stopped.is_set() and frame_id != limit:
            pair = None
            if self._is_too_late(frame_id):
                ended = index * stride >= self.pairs.count
            else:
                try:
                    pair = self.pairs.at(index * stride)
                    ended = pair is None
                except LostPictureError as lost:
                    say(str(lost))
                    ended = False
            if ended:
                if not self._config.loop or index == self.first:
                    return
                epoch, index = epoch + 1, self.first
                continue
            if pair is None:
                self.dropped += 1
                self._dropped_in_a_row += 1
            else:
                self._dropped_in_a_row = 0
                numbers = self.pairs.left_numbers
                number = index * stride if numbers is None else int(numbers[index * stride])
                pose = pair.T_world_cam if self._poses is None else self._poses[number]
                reference = pair.reference
                if reference is None and self._references is not None:
                    reference = self._references.at(number, pair.left.shape[1::-1])
                stamp = self._wait_for_turn(frame_id)
                if self._stopped.is_set():
                    return
                if frame_id == self.first and pair.depth is None:
                    refuse_one_eye_twice(pair.left, pair.right)
                if frame_id == self.first and not self._quiet and is_mosaic(pair.left):
                    say(MOSAIC)
                epoch, last = epoch + (stamp < last), stamp
                yield StereoFrame(
                    frame_id,
                    t_capture_ns=stamp,
                    t_capture_right_ns=stamp + self._skew(index),
                    left=pair.left,
                    right=pair.right,
                    epoch=epoch,
                    T_world_cam=pose,
                    tissue=pair.tissue,
                    reference=reference,
                    depth=pair.depth,
                    t_device_ns=0 if self._recorded is None else int(self._recorded[index]),
                    warm_up=frame_id < self.first + self._config.warm_up,
                    recorded_s=self.seconds_of(index),
                    recorded_number=number,
                )
            index += 1
            frame_id += 1

    def _due_in(self, frame_id: int) -> float:
        """The seconds until this frame's turn, negative if it is late. The first call starts the clock."""
        if self._began is None:
            self._began = self._clock()
        return self._began + self._elapsed(frame_id) * 1e-9 - self._clock()

    def _elapsed(self, frame_id: int) -> int:
        """The time from the first turn to this one in the recording, ns."""
        turns = frame_id - self.first
        if self._stamps is None:
            return round(turns * 1e9 / self.rate)
        times = self._stamps[self.first :, 0]
        passes, turn = divmod(turns, len(times))
        one_pass = int(times[-1] - times[0]) + round(1e9 / self.rate)
        return passes * one_pass + int(times[turn] - times[0])

    def _skew(self, index: int) -> int:
        """The delay of the right image after the left one, ns."""
        if self._stamps is None:
            return round(self.pairs.later * 1e9 / (self.rate * self._config.stride))
        return int(self._stamps[index, 1] - self._stamps[index, 0])

    def _is_too_late(self, frame_id: int) -> bool:
        """Tell whether to leave this frame out.

        One frame per second is let through even if skipping itself is slower than the recording.
        """
        if self._config.pace != "realtime" or self._began is None or self._dropped_in_a_row >= self.rate:
            return False
        return self._due_in(frame_id) < -1.0 / self.rate

    def _wait_for_turn(self, frame_id: int) -> int:
        """Wait as the pace demands; return the capture stamp of this frame, ns."""
        if self._config.pace == "step":
            if self._stamps is not None:
                return int(self._stamps[self.first, 0]) + self._elapsed(frame_id)
            return round(frame_id * 1e9 / self.rate)
        if self._config.pace == "fast":
            return self._wall_ns()
        wait = self._due_in(frame_id)
        if wait > 0:
            self._sleep(wait)
        assert self._began is not None
        return self._wall.at(self._began, self._clock, self._wall_ns) + self._elapsed(frame_id)


def open_pairs(config: Recording, references: bool) -> Pairs:  # noqa: PLR0911, one return per kind
    """Open the reader for this kind of recording; `references`: also of ground truth that is part of it."""
    match config:
        case cfg.FoldersSource():
            numbered = config.poses is not None or config.reference != cfg.ReferenceConfig()
            return FolderPairs(
                *(config.left, config.right, config.tools),
                instruments=config.instruments,
                levels=config.levels,
                numbered=numbered,
            )
        case cfg.VideosSource():
            layout = Layout(config.geometry, config.tools)
            if layout.shows_both or layout.is_sequential:
                return OneVideoPairs(Video(config.left), layout)
            return VideoPairs(config.left, config.right, layout)
        case cfg.EndoNerfSource():
            return EndoNerfPairs(config)
        case cfg.ScaredSource():
            return ScaredPairs(config.folder, references)
        case cfg.BagSource():
            return BagPairs(config)
        case cfg.DvrkSource():
            return DvrkPairs(config)


def is_mosaic(picture: U8) -> bool:
    """Tell whether a grey image [H, W, 3] is a Bayer mosaic of tissue. In each 2x2 block the greens on one
    diagonal are about equal; red and blue on the other one differ."""
    grey = picture[..., 1]
    if not all(np.array_equal(grey, picture[..., channel]) for channel in (0, 2)):
        return False
    (a, b), (c, d) = ([float(grey[y::2, x::2].mean()) for x in (0, 1)] for y in (0, 1))
    alike, apart = sorted((abs(a - d), abs(b - c)))
    return alike < GREENS * (a + b + c + d) and apart > RED_BLUE * (a + b + c + d)


def refuse_one_eye_twice(left: U8, right: U8 | None) -> None:
    """Check that the first pair [H, W, 3] of a recording is not one eye twice, which gives no depth.

    Live cameras are not refused: both may send a test image until the scope is plugged in. They get the
    warning `eyes_equal` instead.

    Raises:
        UsageError: both images are clearly of the same eye.
    """
    if right is None or left.shape != right.shape:
        return
    size = WIDTH, max(1, round(left.shape[0] * WIDTH / left.shape[1]))
    a, b = (cv2.resize(eye, size, interpolation=cv2.INTER_AREA).astype(np.float32) for eye in (left, right))
    shifted = float(np.abs(a[:, 1:] - a[:, :-1]).mean())
    if shifted > LEAST and float(np.abs(a - b).mean()) < SURELY * shifted:
        raise UsageError(
            "both eyes get the same image, so there is no depth; name the other eye's camera or file in "
            "source.right, or check the cables"
        )
