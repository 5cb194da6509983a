"""Stereo pairs and calibration from ROS recordings.

A bag is read through once when it is opened. That finds all damage, the stamps that pair the eyes, and the
calibration. Playing reads it forward again.
"""

import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sags_node.bags.bag import BagMessage, read_messages
from sags_node.bags.camera_info import Said, changes, in_force, read_eye, topic_of
from sags_node.bags.pictures import IMAGE_TYPES, decode_picture, header_stamp
from sags_node.config.schema import BagSource
from sags_node.errors import SagsError, UsageError
from sags_node.messaging.topics import CAMERA_INFO
from sags_node.rig import accept_rig
from sags_node.sources.bag_stamps import DIFFER_FIX, Key, judge_stamps, pair_messages
from sags_node.sources.layout import Layout, refuse_turned
from sags_node.sources.pictures import Pairs, RawPair, size_text
from sags_node.types import I64, U8, Eye, StereoRig

# Names that drivers and this node give to image topics, the usual first; "/compressed" may follow.
PICTURE_NAMES = ("image_raw", "image_rect_color", "image_color", "image_rect", "image", "image_mono")
COMPRESSED = "/compressed"
MAX_WAITING = 64  # images that may wait for their partner
STAMP_END = 12  # bytes of a message up to the end of its stamp: CDR encapsulation and stamp
MOST_INFOS = 10_000  # camera_info of one topic that are kept; a moving zoom makes each differ


@dataclass(frozen=True, slots=True)
class Contents:
    """The contents of a bag, from one pass over it."""

    types: dict[str, str]  # by topic, of all topics
    pictures: dict[str, list[Key]]  # by topic
    infos: dict[str, list[tuple[int, bytes]]]  # stamp and camera_info by topic, where it changed


class Eyes(NamedTuple):
    """The topics of both eyes."""

    left: str
    right: str


def read_contents(path: Path) -> Contents:
    """Read topics, stamps and calibration of a bag. The last bag is cached.

    Raises:
        UsageError: there is no bag.
        SagsError: it is damaged.
    """
    changed = path.stat().st_mtime_ns if path.exists() else 0
    return _read_contents(path, changed)


@lru_cache(maxsize=1)
def _read_contents(path: Path, changed: int) -> Contents:
    types: dict[str, str] = {}
    pictures: dict[str, list[Key]] = {}
    infos: dict[str, list[tuple[int, bytes]]] = {}
    newest: dict[str, bytes] = {}
    used = *IMAGE_TYPES, CAMERA_INFO
    for message in read_messages(path, wanted=lambda topic, kind: kind in used):
        types.setdefault(message.topic, message.type)
        if message.type in IMAGE_TYPES:
            pictures.setdefault(message.topic, []).append((message.log_ns, _stamp(path, message)))
        elif message.type == CAMERA_INFO:
            data, said = bytes(message.data), infos.setdefault(message.topic, [])
            if newest.get(message.topic) != data[STAMP_END:] and len(said) < MOST_INFOS:
                said.append((_stamp(path, message) or message.log_ns, data))
            newest[message.topic] = data[STAMP_END:]
    return Contents(types, pictures, infos)


def _stamp(path: Path, message: BagMessage) -> int:
    """The header stamp, ns; 0 where the driver left it out, or a simulator's clock begins."""
    try:
        return header_stamp(message.data)
    except SagsError as error:
        raise SagsError(f"{path}: {message.topic}: {error}") from None


class BagPairs(Pairs):
    """The stereo pairs of a bag: images whose stamps are each other's nearest, and near enough. To go back,
    it reads the bag anew.

    Raises:
        UsageError: there is no bag, its topics are ambiguous, or there is no pair.
        SagsError: it is damaged.
    """

    def __init__(self, config: BagSource) -> None:
        self._path = config.path
        contents = read_contents(config.path)
        self._eyes = find_eyes(config, contents)
        left, right = (contents.pictures[name] for name in self._eyes)
        self._keys, self.stamps = pair_messages(config, left, right)
        self.count = len(self._keys)
        numbers = {key: number for number, key in enumerate(left)}
        self.left_count = len(left)
        self.left_numbers = np.array([numbers[key] for key, _ in self._keys], np.int64)
        steps = np.diff(self.stamps[:, 0])
        self.rate = float(1e9 / np.median(steps)) if len(steps) and np.median(steps) > 0 else None
        self.judged = judge_stamps(self._keys, self.stamps, self.rate, (left, right))
        self._layout = Layout(config.geometry)
        self._turns = [{keys[eye]: turn for turn, keys in enumerate(self._keys)} for eye in (0, 1)]
        self._size: tuple[int, int] | None = None
        self._messages: Iterator[BagMessage] | None = None
        self._index = -1  # of the pair that was read last
        if self._layout.shows_both:
            width, height = self._picture_size()
            self.pixel_aspect = self._layout.pixel_aspect(width, height, 1.0)

    def at(self, index: int) -> RawPair | None:
        if index >= self.count:
            return None
        if self._messages is None or index <= self._index:
            self._waiting: dict[tuple[int, Key], BagMessage] = {}
            start_ns = min(key[0] for keys in self._keys[index:] for key in keys)
            self._messages = read_messages(self._path, self._eyes, start_ns)
        self._index = index
        left_key, right_key = self._keys[index]
        if self._layout.shows_both:
            left, right = self._layout.eyes(self._picture(0, left_key))
        else:
            left = self._layout.eye(self._picture(0, left_key), "left")
            right = self._layout.eye(self._picture(1, right_key), "right")
        return RawPair(left, right, None)

    def close(self) -> None:
        self._messages = None

    def _picture_size(self) -> tuple[int, int]:
        """The width and height of an image as it was sent, px."""
        self.at(0)
        assert self._size is not None  # it was just read
        return self._size

    def _picture(self, eye: int, key: Key) -> U8:
        message = self._find(eye, key)
        where = f"{self._path}: {message.topic} at {key[1]} ns"
        picture = decode_picture(message.data, message.type, where)
        size = picture.shape[1], picture.shape[0]
        if self._size is None:
            self._layout.size(*size, where)  # refuses what cannot be split
            self._size = size
        if size != self._size:
            raise SagsError(
                f"{where}: {size_text(*size)} px, but the images before are {size_text(*self._size)}; "
                f"all images must have one size: play what is before with source.frames:={self._index}"
            )
        return picture

    def _is_sorted(self) -> bool:
        topics = read_contents(self._path).pictures
        return all((np.diff([key[0] for key in topics[eye]]) >= 0).all() for eye in self._eyes)

    def _find(self, eye: int, key: Key) -> BagMessage:
        """Read forward to one message. Messages of later pairs are kept in memory."""
        assert self._messages is not None
        if (eye, key) in self._waiting:
            return self._waiting.pop((eye, key))
        for message in self._messages:
            side = self._eyes.index(message.topic)
            found = message.log_ns, _stamp(self._path, message)
            if (side, found) == (eye, key):
                return message
            if self._turns[side].get(found, -1) >= self._index:
                self._waiting[side, found] = message
            if len(self._waiting) > MAX_WAITING:
                raise SagsError(
                    f"{self._path}: left and right images of one stamp lie too far apart in the file; "
                    + (DIFFER_FIX if self._is_sorted() else "sort it by time (ros2 bag convert)")
                )
        raise SagsError(f"{self._path} changed while it was read")


# ---- which topics ----------------------------------------------------------------------------------------


def find_eyes(config: BagSource, contents: Contents) -> Eyes:
    """Return the image topics that are named, or else the only ones that look like a stereo pair.

    Raises:
        UsageError: a named topic is missing or holds no images, or there is no such pair or several.
    """
    if config.geometry.layout != "separate":
        named = [config.left] if config.left is not None else sorted(contents.pictures)
        if len(named) != 1:
            raise UsageError(f"source.left is missing, the topic of both eyes: {', '.join(named) or 'none'}")
        both = _named(config, contents, "left", named[0])
        return Eyes(both, both)
    if config.left is not None:
        left = _named(config, contents, "left", config.left)
        right = config.right or _counterpart(config.left)
        if right is None:
            raise UsageError(f"source.right is missing: {config.left} does not tell the right eye's topic")
        return Eyes(left, _named(config, contents, "right", right))
    if config.right is not None:
        raise UsageError("source.left is missing: name both eyes, or neither")
    found = sorted((rank, eyes) for eyes in _pairs(contents) if (rank := _rank(eyes.left)) is not None)
    best = [eyes for rank, eyes in found if rank == found[0][0]]
    if len(best) == 1:
        return best[0]
    listed = "; ".join(f"{eyes.left} and {eyes.right}" for eyes in best) or "none"
    there = ", ".join(sorted(contents.pictures)) or "none"
    raise UsageError(
        f"{config.path}: stereo pairs of topics that look usable: {listed}; set source.left and "
        f"source.right, or where one topic shows both eyes source.left and source.geometry.layout. Image "
        f"topics: {there}. (sags bag record takes both eyes, unless topics are named)"
    )


def _pairs(contents: Contents) -> Iterator[Eyes]:
    for name in contents.pictures:
        right = _counterpart(name)
        if right in contents.pictures:
            yield Eyes(name, right)


def _counterpart(left: str) -> str | None:
    """The right eye's topic: the last "left" in the name becomes "right"."""
    before, said, after = left.rpartition("left")
    return f"{before}right{after}" if said else None


def _rank(left: str) -> int | None:
    """The rank of a name, 0: most usual; None for images not of a camera (render, depth, masks)."""
    compressed = left.endswith(COMPRESSED)
    parts = left.removesuffix(COMPRESSED).split("/")
    if parts[-1] not in PICTURE_NAMES or "render" in parts:
        return None
    return 2 * PICTURE_NAMES.index(parts[-1]) + compressed


def _named(config: BagSource, contents: Contents, key: str, name: str) -> str:
    """The bag's name of an image topic, which may have a leading slash or /compressed added."""
    for candidate in (name, f"/{name}", name.lstrip("/")):
        for full in (candidate, candidate + COMPRESSED):
            if full in contents.pictures:
                return full
            if full in contents.types:
                raise UsageError(
                    f"source.{key}: {full} in {config.path} is {contents.types[full]}, not an image topic"
                )
    near = difflib.get_close_matches(name, contents.pictures, n=1, cutoff=0.3)
    hint = f"did you mean '{near[0]}'?" if near else "it has no image topics"
    raise UsageError(f"source.{key}: {config.path} has no topic {name}; {hint}")


# ---- calibration -----------------------------------------------------------------------------------------


def read_rig(config: BagSource, judged: bool = True) -> StereoRig | None:
    """Read the calibration from the bag's camera_info topics; None if both are missing or uncalibrated.

    Raises:
        UsageError: a named topic is missing, only one eye is calibrated, the images are turned, or the
            calibration is implausible.
        SagsError: the bag is damaged.
    """
    contents = read_contents(config.path)
    eyes = find_eyes(config, contents)
    found = [
        _info(config, contents, "left_info", config.left_info, eyes.left),
        _info(config, contents, "right_info", config.right_info, eyes.right),
    ]
    played = _played(config, contents, eyes)
    left, right = (
        None if topic is None else _eye_of(config, contents, topic, played[:, eye])
        for eye, topic in enumerate(found)
    )
    if left is None and right is None:
        return None
    if left is None or right is None:
        side = "left" if left is None else "right"
        raise UsageError(f"{config.path} calibrates one eye only, the {side} one is missing; set rig")
    refuse_turned(config.geometry, config.path)
    rig = StereoRig(config.path.stem, left, right, path=config.path)
    return accept_rig(rig, config.path) if judged else rig


def _played(config: BagSource, contents: Contents, eyes: Eyes) -> I64:
    """The stamps [N, 2] of the pairs that are played, ns."""
    left, right = (contents.pictures[name] for name in eyes)
    stamps = pair_messages(config, left, right)[1][:: config.stride]
    first = int(np.searchsorted(stamps[:, 0], stamps[0, 0] + round(config.start * 1e9)))
    return stamps[first:][: config.frames]


def _eye_of(config: BagSource, contents: Contents, topic: str, played: I64) -> Eye | None:
    """The calibration in a camera_info topic for images with these stamps; None: not calibrated.

    Raises:
        UsageError: it changes while they are played.
    """
    read = [(since, read_eye(data, topic)) for since, data in contents.infos[topic]]
    said = changes([Said(since, eye) for since, eye in read if eye is not None])
    if not said:
        return None
    counts = in_force(said, played)
    turns = np.flatnonzero(np.diff(counts))
    if len(turns):
        before, after = (said[counts[turns[0] + k]].eye.K[0, 0] for k in (0, 1))
        # rounded down: playing begins with the first image at or after `start`
        start = int(round(config.start * 1e4) + (played[turns[0] + 1] - played[0]) // 100_000) / 1e4
        raise UsageError(
            f"{config.path}: {topic} changes while it is played ({len(turns)} times), first {start:g} s from "
            f"the start (fx {before:g} to {after:g} px): zoom, focus or image size was changed; play what "
            f"is before with source.frames:={turns[0] + 1}, what is after with source.start:={start:g}, or "
            "set rig"
        )
    return said[counts[0]].eye if len(counts) else said[0].eye


def _info(config: BagSource, contents: Contents, key: str, name: str | None, topic: str) -> str | None:
    if name is None:
        return topic_of(topic) if topic_of(topic) in contents.infos else None
    for candidate in (name, f"/{name}", name.lstrip("/")):
        if candidate in contents.infos:
            return candidate
    kind = contents.types.get(name, "not there")
    raise UsageError(f"source.{key}: {name} in {config.path} is {kind}, not a camera_info topic")
