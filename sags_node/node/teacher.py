"""The detail of consumers' views, and what it takes to know how far to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sags_node.detail.seen import SeenFrame
from sags_node.detail.show import LESSON_EVERY, Detail, Lessons
from sags_node.messaging import published
from sags_node.model.forecast import gaussians_ahead, reached
from sags_node.types import FrameResult, Gaussians, RenderedView, Shown, Snapshot

ROUNDING = 1e-3  # s, of stamps


class Teacher:
    """Adds detail to views from anywhere; learns from frame to frame, and from the right eye."""

    def __init__(self) -> None:
        self._detail = Detail(Lessons())
        self._before: tuple[Snapshot, SeenFrame] | None = None
        self._whole: SeenFrame | None = None  # with its left view, where nobody else looks at that
        self._step = 0.0  # s between the last two scenes
        self._scenes = 0

    def take(self, scene: FrameResult, now: SeenFrame, ahead: bool, aside: bool) -> None:
        """Learn from a new scene what views of it, and those before it, are worth.

        Args:
            ahead: somebody wants views of later moments.
            aside: somebody wants views from elsewhere than the left eye.
        """
        before, self._before = self._before, (scene.snapshot, now)
        self._scenes += 1
        if before is not None:
            snapshot, seen = before
            seconds = (now.t_capture_ns - seen.t_capture_ns) * 1e-9
            self._step = seconds if seconds > 0 else self._step
            due = ahead and self._scenes % LESSON_EVERY == 0
            if due and 0 < seconds <= reached(snapshot, seconds) + ROUNDING:
                self._detail.learn_ahead(seen, gaussians_ahead(snapshot, seconds), now)
        pair = scene.pair
        if aside and pair.right is not None and self._scenes % LESSON_EVERY == 2:
            self._detail.learn_aside(now, scene.snapshot, published.picture(pair, "right"), pair.baseline)

    def detail(
        self, scene: FrameResult, seen: Sequence[SeenFrame], gaussians: Gaussians, view: RenderedView,
        ahead: float, right: bool,
    ) -> Shown:  # fmt: skip
        """Return what is shown of a view.

        Args:
            seen: the scene's frame, and older ones.
            gaussians: of the scene, there or moved by `ahead` seconds.
            right: it has the colours that the right eye sees.
        """
        now, *older = seen
        if now.whole is None:
            if self._whole is None or self._whole.t_capture_ns != now.t_capture_ns:
                left, camera = scene.views["left"], published.camera_of(scene.pair)
                drawn = left.colours.at(camera.width, camera.height)
                whole = self._detail.left(drawn, left.depth, camera, now, older)
                self._whole = replace(now, whole=whole)
            now = self._whole
        frames = ahead / self._step if self._step > 0 else float(ahead > 0)
        tint = self._detail.tint(scene.snapshot, gaussians, view.camera) if right else None
        baseline = scene.pair.baseline
        return self._detail.view(view.rgb, view.depth, view.camera, gaussians, now, baseline, frames, tint)


def is_of(seen: Sequence[SeenFrame], snapshot: Snapshot) -> bool:
    """Tell whether the newest of these frames is that of the snapshot."""
    return bool(seen) and np.shares_memory(seen[0].gaussians.means, snapshot.gaussians.means)
