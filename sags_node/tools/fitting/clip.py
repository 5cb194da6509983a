"""A whole recording in memory, as the fit sees it: rectified images, tissue and depth of every frame."""

from __future__ import annotations

import logging
import os
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sags_node.errors import SagsError, UsageError
from sags_node.geometry import transform
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session, open_posed
from sags_node.types import F32, U8, Bool, Camera, Observation, Reference, StereoFrame
from sags_node.vision.observe import resized

log = logging.getLogger(__name__)

OnFrame = Callable[[StereoFrame, Bool], None]  # the frame as it was recorded, and its tissue mask [H, W]

MEMORY_SHARE = 0.5  # of the free memory: the fit itself needs the rest
CUT = 0.08  # mean difference of two frames, 0..1; a beating heart stays below half of it


@dataclass(frozen=True, slots=True)
class ClipFrame:
    """One frame, as small as it can be kept."""

    frame_id: int
    t_capture_ns: int
    camera: Camera
    image: U8  # [H, W, 3] RGB
    tissue: Bool  # [H, W]
    bare: Bool  # [H, W] the same mask without its margin around instruments, only for `paper_psnr`
    depth: F32  # [H, W] m, 0 unknown
    reference: Reference | None

    def observation(self) -> Observation:
        """The frame as the mapper takes it."""
        return Observation(
            frame_id=self.frame_id,
            t_capture_ns=self.t_capture_ns,
            camera=self.camera,
            image=self.image,
            gray=cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY),
            tissue=self.tissue,
            depth=self.depth,
            depth_confidence=(self.depth > 0).astype(np.float32),
        )

    def halved(self) -> ClipFrame:
        """The frame at half its size, without its ground truth."""
        small = resized(self.observation(), 0.5)
        return ClipFrame(
            self.frame_id, self.t_capture_ns, small.camera, small.image, small.tissue, small.tissue,
            small.depth, None,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Clip:
    """The frames a fit learns from, and those it is tested on."""

    train: Sequence[ClipFrame]
    test: Sequence[ClipFrame]

    def around(self, t_ns: int) -> tuple[ClipFrame, ClipFrame] | None:
        """The training frames before and after a time; None: one has that very time, or a side has none."""
        place = bisect_left(self.train, t_ns, key=lambda frame: frame.t_capture_ns)
        if place in {0, len(self.train)} or self.train[place].t_capture_ns == t_ns:
            return None
        return self.train[place - 1], self.train[place]


def is_cut(before: ClipFrame, after: ClipFrame) -> bool:
    """Tell whether two frames show different scenes. Every eighth pixel is enough."""
    both = (before.tissue & after.tissue)[::8, ::8]
    apart = cv2.absdiff(before.image, after.image)[::8, ::8][both]
    return bool(apart.size > 0 and apart.mean() > CUT * 255)


def play(
    session: Session, references: bool, on_frame: OnFrame = lambda frame, tissue: None
) -> Iterator[ClipFrame]:
    """Yield the frames of a session, opened anew, as the node's own front end makes them.

    Frames without a pose from the robot are left out: nobody knows where the camera was. So are those of the
    warm-up: a fit has no model that must settle first. With `vision.pose` fixed, the world frame is that of
    the camera, also for true points.

    Args:
        session: it is played from its start.
        references: also deliver its ground truth.
        on_frame: called with each frame that is delivered.

    Raises:
        UsageError: the camera's pose is not that of the recording.
        SagsError: the recording cannot be read.
    """
    if (way := session.config.vision.pose) in ("estimate", "refine"):
        raise UsageError(
            f"vision.pose {way} is for a running node (sags run) and sags eval: a fit takes the recorded "
            "poses as they are. Set vision.pose:=session for these, or fixed where the scope stands still"
        )
    pipeline = Pipeline(session.config, session.rig)
    unposed = 0
    with open_posed(session.config, session.rig, references) as source:
        for frame in source:
            if frame.warm_up:
                continue
            if frame.pose_problem is not None:
                unposed += 1
                continue
            pair, reference = pipeline.rectifier(frame), frame.reference
            if way == "fixed":
                if reference is not None and reference.points is not None:
                    there = transform(pair.camera.viewmat, reference.points)
                    reference = replace(reference, points=np.asarray(there, np.float64))
                pair = replace(pair, camera=pipeline.rectifier.camera)
            tissue = pipeline.tissue(frame, pair)
            depth = pipeline.depth(frame, pair, tissue).depth
            on_frame(frame, tissue)
            yield ClipFrame(
                pair.frame_id, pair.t_capture_ns, pair.camera, pair.left, tissue, pipeline.tissue.bare,
                depth, reference,
            )  # fmt: skip
    if unposed:
        log.warning("%d frames are left out, since the robot tells no pose of them", unposed)


def read_clip(
    session: Session,
    held_out: Callable[[int], bool],
    progress: Callable[[int], None] = lambda done: None,
    on_frame: OnFrame = lambda frame, tissue: None,
    midway: bool = False,
) -> Clip:
    """Play a session once through the node's own front end and keep every frame.

    Args:
        session: it is opened anew, with its ground truth.
        held_out: whether the frame of that number is for testing only.
        progress: called with the frames done.
        on_frame: called with each frame.
        midway: whether images half way between frames must fit into memory, too (`fitting.midway`).

    Raises:
        UsageError: see `play`.
        SagsError: no frame to learn from, the recording cannot be read, or it does not fit into memory.
    """
    train: list[ClipFrame] = []
    test: list[ClipFrame] = []
    for frame in play(session, references=True, on_frame=on_frame):
        if not train and not test:
            _check_memory(frame, session.source.frame_count, midway)
        (test if held_out(frame.frame_id) else train).append(frame)
        progress(len(train) + len(test))
    if not train:
        raise SagsError(
            "no frame to learn from; check source.start, source.frames, source.warm_up and the hold-out"
        )
    return Clip(train, test)


def _check_memory(frame: ClipFrame, count: int | None, midway: bool) -> None:
    """Check that `count` frames of this size fit into memory, and as many half way between them if `midway`.
    None: the count is unknown, and nothing is checked."""
    kept = frame.image, frame.tissue, frame.bare, frame.depth
    needed = (2 if midway else 1) * (count or 0) * sum(array.nbytes for array in kept)
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > MEMORY_SHARE * free:
        more, without = (" and images half way between them", "--set midway=false, ") if midway else ("", "")
        raise SagsError(
            f"{count} frames{more} take {needed / 1e9:.1f} GB, {MEMORY_SHARE * free / 1e9:.1f} GB may be "
            f"used; give {without}source.frames, source.stride or a smaller vision.width and vision.height"
        )
