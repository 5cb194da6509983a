"""A video file: its images by number, and the stamps that the file gives them. Read by FFmpeg (PyAV).

Headers are not believed. The number of images, their stamps and the key frames are read from the packets,
once for each file. Images that an edit list hides do not count.
"""

from __future__ import annotations

import logging
import os
import shlex
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, cast

import av
import cv2
import numpy as np
from av.sidedata.sidedata import Type
from av.stream import Discard, Disposition
from av.video.reformatter import Colorspace, Interpolation, VideoReformatter
from numpy.typing import NDArray

from sags_node.errors import SagsError, UsageError
from sags_node.media.cut_off import ends_in_a_packet, lacks_its_end
from sags_node.types import I64, U8

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.sidedata.sidedata import SideDataContainer

log = logging.getLogger(__name__)

MAX_PIXELS = 64 << 20
ONE_THREAD = 2_500_000  # px: up to here one thread decodes, at less CPU; full HD takes 1/4 of its time
THREADS = min(4, os.cpu_count() or 1)
REORDERED = 32  # images by which order of decoding and of display may differ
LONGEST_PAUSE = 600.0  # s between two images; beyond, the stamps are of different clocks
LARGE = 1 << 22  # bytes of an image: from here on, a copy into new NumPy memory costs more than it saves
SAME = 1_000_000  # ns of rounding: stamps of most containers are whole milliseconds
FAR = 8  # images ahead; nearer ones are reached by decoding, not by a seek
SHORT = 1.0  # s that a file may be shorter than its header says
# Sizes of HD television, px. Untagged videos of these sizes are BT.709, all others BT.601: that is the matrix
# of old television, and the one by which FFmpeg and OpenCV encode RGB images of any size.
HD = {(1280, 720), (1440, 1080), (1920, 1080), (2048, 1080), (3840, 2160), (4096, 2160)}
BROKEN = (av.FFmpegError, IndexError)  # a file breaks off; PyAV, where another stream begins in it
_UNTAGGED = {2, 3}  # unspecified and reserved matrices of ISO/IEC 23091-2
_MATRICES = {0, 1, 4, 5, 6, 7, 9}  # those of ISO/IEC 23091-2 that FFmpeg converts
DEEP = 16  # bits of a sample
DEEP_FORMATS = {"gray16le", "rgb48le", "gbrp16le"}
NO_TIMES = 0x80  # AVFMT_NOTIMESTAMPS of FFmpeg
HDR = {16: "PQ", 18: "HLG"}  # transfer characteristics of ISO/IEC 23091-2


class LostPictureError(SagsError):
    """One image cannot be decoded; those behind it may be."""


@dataclass(frozen=True, slots=True)
class _Index:
    """The contents of a file by its packets; times in ticks."""

    count: int
    pts: I64 | None  # [count] rising; None: the packets have no usable stamps
    keys: I64  # [K, 3] pts, dts and size (bytes), rising, of the packets at which decoding can begin
    unused: str = ""  # why the stamps are not used
    cut_off: str = ""  # see `Video`


class Video:
    """One video file. Images are numbered as they are shown.

    Attributes:
        size: width and height of an image, px.
        count: number of images.
        stamps: [count] when each is shown, ns, rising; None where the file does not say it.
        rate: Hz, where no image is missing; None: not known.
        is_even: the stamps are those that the rate gives, or there are none.
        pixel_aspect: width of a pixel over its height.
        cut_off: what is missing of the file, with a remedy after a semicolon; "": nothing.
        tracks: number of video tracks; the first is read.
        is_interlaced: the file says that its first image is interlaced.
        oddities: warnings about the file, each with a remedy after a semicolon.

    Raises:
        UsageError: the file is missing or is not a video.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_dir():
            raise UsageError(f"video {path} is a folder; of images: source.kind:=folders")
        if not path.is_file():
            raise UsageError(f"video {path} does not exist; check the path, or SAGS_DATA if it is used")
        seen = path.stat()
        index = _read_index(path, seen.st_size, seen.st_mtime_ns)
        self._keys, self._pts = index.keys, index.pts
        # After a seek some containers give stamps that are one off.
        self._begins = {(pts, size) for pts, _, size in index.keys.tolist()}
        self._reformatter = VideoReformatter()
        self._frame: av.VideoFrame | None = None  # the newest that is decoded
        first = self._restart()
        if first is None and self._pts is not None:  # images have other stamps than their packets
            self._pts, first = None, self._restart()
        if first is None:
            raise UsageError(f"video {path} holds no image that can be decoded")
        self._coded = first.width, first.height
        self.is_interlaced = first.interlaced_frame
        self._matrix: NDArray[np.int32] | None = None
        said = cast("SideDataContainer", first.side_data)  # PyAV's stub names another type
        if Type.DISPLAYMATRIX in said:
            self._matrix = np.frombuffer(bytes(said[Type.DISPLAYMATRIX]), np.int32).reshape(3, 3)
        is_on_its_side = self._matrix is not None and self._matrix[0, 0] == 0
        self.size = self._coded[::-1] if is_on_its_side else self._coded
        aspect = float(self._stream.sample_aspect_ratio or 1)
        self.pixel_aspect = 1 / aspect if is_on_its_side else aspect
        self._untagged = Colorspace.ITU709 if _is_hd(*self.size) else Colorspace.ITU601
        self.stamps: I64 | None = None
        if self._pts is not None and first.pts is not None:
            # Images before the first one that can be decoded depend on some that the file lacks.
            self._pts = self._pts[self._pts >= first.pts]
            base = self._stream.time_base or Fraction(1, 1)
            self.stamps = np.array([round(int(ticks) * base * 10**9) for ticks in self._pts], np.int64)
        self.count = index.count if self.stamps is None else len(self.stamps)
        self.rate, self.is_even = self._find_rate()
        self.cut_off = index.cut_off
        self.tracks = len(_tracks(self._container))
        self.oddities = [f"{path}: {index.unused}"] if index.unused else []
        if self.tracks > 1:
            self.oddities.append(
                f"{path} holds {self.tracks} video tracks, and the first is shown; {self.split}"
            )
        if self._container.format.flags & NO_TIMES:
            self.oddities.append(
                f"{path} is a stream without a container, which holds no times: nobody can tell its rate, or "
                "whether it is whole; record it as MP4 or Matroska, or set source.rate"
            )
        if (tones := HDR.get(self._stream.codec_context.color_trc)) is not None:
            self.oddities.append(
                f"{path} has the tones of HDR ({tones}), which are shown as they are, with little contrast; "
                "record SDR (BT.709), or convert it (ffmpeg's zscale and tonemap)"
            )
        if gaps := self.gaps:
            many, (before, lost) = "a gap" if len(gaps) == 1 else f"{len(gaps)} gaps, the first", gaps[0]
            self.oddities.append(
                f"{path}: its stamps have {many} behind image {before}, as long as {lost} images; it is "
                "played by its stamps: were images lost, or was the recording paused?"
            )
        if (bits := _bits_used(first)) is not None:
            self.oddities.append(
                f"{path} has samples of {DEEP} bits, of which its first image uses {bits}: it may be "
                "played too dark; play its images as a folder, which finds the bits "
                f"(ffmpeg -i {self._name} %d.png)"
            )

    @property
    def split(self) -> str:
        """The advice how to split two tracks into two files."""
        tracks = " ".join(f"-map 0:v:{eye} -c copy {side}.mkv" for eye, side in enumerate(("left", "right")))
        return f"if each is an eye: ffmpeg -i {self._name} {tracks}"

    @property
    def _name(self) -> str:
        return shlex.quote(str(self.path))

    @property
    def gaps(self) -> list[tuple[int, int]]:
        """The number of the image before each gap in the stamps, and how many images the gap lacks."""
        if self.stamps is None or self.rate is None or self.is_even:
            return []
        steps = np.rint(np.diff(self.stamps) * self.rate * 1e-9).astype(int)
        return [(int(number), int(steps[number]) - 1) for number in np.flatnonzero(steps > 1)]

    def read(self, number: int) -> U8 | None:
        """Read an image, RGB [H, W, 3]; None past the end. Reading in order is fastest.

        Raises:
            LostPictureError: this one cannot be decoded, or only in part.
            SagsError: it is of another size than the first one.
        """
        if number >= self.count:
            if self.cut_off:
                log.warning("%s", self.cut_off)
            return None
        is_past = number < self._at or (number == self._at and self._frame is None)
        if is_past or self._key_of(number) > self._at + FAR:
            self._jump(number)
        while self._at < number:
            if self._decode() is None:
                log.warning(
                    "%s ends at image %d, not at %d; copy it again", self.path, self._at + 1, self.count
                )
                return None
        if self._at > number:
            raise LostPictureError(f"{self.path}: image {number} cannot be decoded; copy the file again")
        if self._damaged is not None and number >= self._damaged:
            raise LostPictureError(
                f"{self.path}: image {self._damaged} is damaged: it and those behind it, up to the next key "
                "frame, are left out; copy the file again"
            )
        assert self._frame is not None
        return self._converted(self._frame)

    def close(self) -> None:
        self._frame = None
        self._frames: Iterator[av.VideoFrame] = iter(())  # else garbage collection ends it, in any thread
        self._container.close()

    def _find_rate(self) -> tuple[float | None, bool]:
        """The rate in Hz, and whether all stamps are those that it gives."""
        told = [float(rate) for rate in (self._stream.average_rate, self._stream.guessed_rate) if rate]
        if self.stamps is None or len(self.stamps) < 2:
            return (told[0] if told else None), True
        steps = np.diff(self.stamps)
        for rate in (*told, 1e9 / float(np.mean(steps))):
            late = self.stamps - self.stamps[0] - np.arange(self.count) * (1e9 / rate)
            if np.abs(late).max() <= min(SAME, 0.25e9 / rate):
                return rate, True
        # The mean of usual steps, as stamps may be whole milliseconds.
        usual = 1e9 / float(np.mean(steps[steps < 1.5 * np.median(steps)]))
        return next((rate for rate in reversed(told) if abs(rate - usual) < 0.01 * usual), usual), False

    def _restart(self) -> av.VideoFrame | None:
        """Open the file anew and decode its first image."""
        self._container, self._stream = _opened(self.path)
        self._stream.thread_type = "AUTO"
        small = self._stream.width * self._stream.height <= ONE_THREAD
        self._stream.thread_count = 1 if small else THREADS
        return self._begin(is_sought=False)

    def _begin(self, is_sought: bool) -> av.VideoFrame | None:
        """Decode the first image from the position of the container on."""
        self._frames = self._pictures(is_sought)
        self._at = -1
        self._damaged: int | None = None  # the first image since a key frame of which a part was made up
        return self._decode()

    def _jump(self, number: int) -> None:
        """Seek so that this image, or one before it, has just been decoded."""
        if self._pts is not None and len(self._keys):
            at = int(np.searchsorted(self._keys[:, 0], self._pts[number], "right")) - 1
            with suppress(av.FFmpegError):  # from containers that cannot seek
                self._container.seek(int(self._keys[max(at, 0), 1]), stream=self._stream)
                # What begins behind its key frame, if there are none, lacks what was refreshed before.
                if self._begin(is_sought=True) is not None and self._at <= self._key_of(number):
                    return
        self._restart()

    def _key_of(self, number: int) -> int:
        """The number of the last key frame up to this image."""
        if self._pts is None or not len(self._keys):
            return 0
        at = int(np.searchsorted(self._keys[:, 0], self._pts[number], "right")) - 1
        return int(np.searchsorted(self._pts, self._keys[max(at, 0), 0]))

    def _decode(self) -> av.VideoFrame | None:
        """Decode the next image; None at the end."""
        self._frame = None  # its memory is used again
        for frame in self._frames:
            number = self._number_of(frame)
            if frame.is_corrupt:
                self._note_damage(number)
            elif self._damaged is not None and number > self._damaged:
                # Without key frames images are refreshed bit by bit, from one marked packet to the next.
                if frame.key_frame or self._key_of(max(0, self._key_of(number) - 1)) > self._damaged:
                    self._damaged = None
            if number > self._at:
                self._at, self._frame = number, frame
                return frame
        return None

    def _note_damage(self, number: int) -> None:
        if self._damaged is None and number >= 0:
            self._damaged = number

    def _number_of(self, frame: av.VideoFrame | av.Packet[av.VideoStream]) -> int:
        """The number of an image, or of a packet's, by its stamp; -1: it is not shown."""
        if self._pts is None:
            return self._at + 1
        if frame.pts is None:
            return -1
        number = int(np.searchsorted(self._pts, frame.pts))
        return number if number < len(self._pts) and self._pts[number] == frame.pts else -1

    def _pictures(self, is_sought: bool) -> Iterator[av.VideoFrame]:
        """Decode forward. Damaged packets are skipped, and after a seek those before the first key frame."""
        packets = self._container.demux(self._stream)
        begun = not is_sought
        while True:
            packet: av.Packet[av.VideoStream] | None = None  # the end
            with suppress(*BROKEN):
                packet = next(packets, None)
            if packet is not None and packet.size == 0:
                continue  # an image that a capture card dropped; or the end
            begun = begun or packet is None or (packet.pts, packet.size) in self._begins
            if not begun:
                continue
            try:
                yield from self._stream.decode(packet)
            except av.FFmpegError:
                if packet is not None and (is_sought or self._at >= 0):  # else nothing is built on it
                    self._note_damage(self._number_of(packet))
            if packet is None:
                return

    def _converted(self, frame: av.VideoFrame) -> U8:
        if (frame.width, frame.height) != self._coded:
            raise SagsError(
                f"{self.path}: image {self._at} is {frame.width}x{frame.height} px, the first one "
                f"{self._coded[0]}x{self._coded[1]}; cut the file there, e.g. with ffmpeg -ss and -t"
            )
        if frame.colorspace in _UNTAGGED:
            frame.colorspace = self._untagged
        elif frame.colorspace not in _MATRICES:
            raise SagsError(f"{self.path}: colour matrix {frame.colorspace} is not read; encode it as BT.709")
        rgb = self._reformatter.reformat(
            frame, format="rgb24", interpolation=Interpolation.BICUBIC, threads=1
        )
        decoded = rgb.to_ndarray()
        # FFmpeg's memory goes back at once, to be used again: new pages cost more than a small copy.
        picture = decoded.astype(np.uint8, copy=decoded.nbytes < LARGE)
        return picture if self._matrix is None else _upright(picture, self._matrix)


def _opened(path: Path) -> tuple[InputContainer, av.VideoStream]:
    """Open a file and its first video track; packets of other tracks are discarded.

    Raises:
        UsageError: it is no video.
    """
    try:
        # `file:` for names that look like an address; what a playlist names is not fetched from elsewhere.
        container = av.open(f"file:{path}", options={"protocol_whitelist": "file"}, metadata_errors="ignore")
    except (av.FFmpegError, ValueError):
        raise UsageError(f"{path} cannot be read as a video; is it complete?") from None
    streams = _tracks(container)
    if not streams:
        container.close()
        raise UsageError(f"{path} cannot be read as a video: it holds no images; is it the right file?")
    if streams[0].codec_context is None:
        container.close()
        raise UsageError(f"{path} cannot be read as a video: its codec is not known; convert it to H.264")
    for stream in container.streams:
        if stream is not streams[0]:
            stream.discard = Discard.all
    streams[0].codec_context.options = {"max_pixels": str(MAX_PIXELS)}
    return container, streams[0]


def _tracks(container: InputContainer) -> list[av.VideoStream]:
    """The video tracks that are not cover images."""
    return [each for each in container.streams.video if not each.disposition & Disposition.attached_pic]


@lru_cache(maxsize=16)
def _read_index(path: Path, size: int, mtime_ns: int) -> _Index:
    """Read all packets of a file once. Size (bytes) and time are in the key: a changed file is read anew."""
    container, stream = _opened(path)
    with container:
        base = stream.time_base or Fraction(1, 1)
        named = len(stream.index_entries)
        shown: list[int | None] = []
        keys: list[tuple[int, int, int]] = []
        ticks: list[int] = []  # decoding times (dts)
        total, latest, is_broken = 0, 0, False
        with suppress(*BROKEN):
            for packet in container.demux(stream):
                is_broken = packet.is_corrupt or (is_broken and not packet.size)
                total += packet.size > 0
                ticks += [] if packet.dts is None else [packet.dts]
                latest = max(latest, packet.dts or 0, packet.pts or 0)
                if packet.size and not packet.is_discard:
                    shown.append(packet.pts)
                if packet.is_keyframe and packet.pts is not None:
                    keys.append((packet.pts, packet.pts if packet.dts is None else packet.dts, packet.size))
        is_broken = is_broken or ends_in_a_packet(path, size, container.format.name)
        is_short = lacks_its_end(path, size, container.format.name)
        if (is_broken or is_short) and shown:
            shown.pop()  # a part of an image
        known = np.array([pts for pts in shown if pts is not None], np.int64)
        # AVI holds the decoding order only. FFmpeg guesses the stamps, which fails with codecs that reorder.
        is_guessed = container.format.name == "avi" and stream.codec_context.has_b_frames
        are_few = 2 * len(known) <= len(shown) or (is_guessed and (np.diff(known) > 0).all())
        unused = "" if are_few else _why_unused(path, known, base)
        is_used = not are_few and not unused
        pts = np.unique(known) if is_used else None
        ends = 0.0 if not ticks else float((latest + np.diff(ticks).max(initial=0)) * base)
        missing = 0.0  # s
        if container.format.name == "avi":  # its header counts frame periods, each of which has an entry
            missing = float(stream.frames * base) - ends
        elif len(container.streams) == 1 and container.duration is not None:
            missing = container.duration * 1e-6 - ends - SHORT
        cut_off = ""
        if named > total:
            cut_off = f"of {named} images it holds {total}"
        elif missing > float(0.5 * base) or is_short:
            cut_off = "its end is missing"
        elif is_broken:
            cut_off = "of its last image a part is there"
        cut_off = cut_off and f"{path} is cut off: {cut_off}; copy it again"
        return _Index(len(shown), pts, np.array(sorted(keys), np.int64).reshape(-1, 3), unused, cut_off)


def _why_unused(path: Path, pts: I64, base: Fraction) -> str:
    """Return what is wrong with the stamps of images, given in decoding order; "": nothing."""
    order = np.argsort(pts, kind="stable")
    moved = np.abs(order - np.arange(len(pts)))
    steps = np.diff(pts[order]) * float(base)
    again = f"ffmpeg -fflags +genpts -i {shlex.quote(str(path))} NEW"
    remedy = f"it is played by number, at its rate; {again} writes new stamps"
    if len(pts) and moved.max() > REORDERED:
        return f"its stamps begin anew near image {int(np.argmax(moved > REORDERED))}; {remedy}"
    if np.count_nonzero(steps == 0) > 0.1 * len(pts):
        return f"several images have one stamp; {remedy}"
    if steps.max(initial=0) > LONGEST_PAUSE:
        return f"its stamps jump by {steps.max():.0f} s after image {int(np.argmax(steps))}; {remedy}"
    return ""


def _upright(picture: U8, matrix: NDArray[np.int32]) -> U8:
    """The image, mirrored and turned by quarters as a display matrix [3, 3] (ISO/IEC 14496-12) says."""
    across, down = matrix[0, 0], matrix[1, 1]
    if across == 0:
        picture = cv2.transpose(picture)
        across, down = matrix[1, 0], matrix[0, 1]
    return np.ascontiguousarray(picture[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])


def _bits_used(frame: av.VideoFrame) -> int | None:
    """The number of bits that samples of 16 bit use, if it is 8 to 14; None otherwise."""
    if frame.format.name not in DEEP_FORMATS:
        return None
    bits = int(frame.to_ndarray().max()).bit_length()
    return bits if 8 <= bits <= DEEP - 2 else None


def _is_hd(width: int, height: int) -> bool:
    """Tell whether this is the size of one or two images of HD television."""
    return not HD.isdisjoint({(width, height), (width // 2, height), (width, height // 2)})
