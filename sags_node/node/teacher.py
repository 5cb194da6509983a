"""The detail of consumers' views, and lessons on how far to trust it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sags_node.detail.seen import SeenFrame
from sags_node.detail.show import ASIDE_EVERY, LESSON_EVERY, Detail, Lessons
from sags_node.messaging import published
from sags_node.model.forecast import gaussians_ahead, reached
from sags_node.types import FrameResult, Gaussians, RenderedView, Shown, Snapshot

ROUNDING = 1e-3  # s, tolerance for rounded stamps


class Teacher:
    """Adds detail to views from any viewpoint; learns from frame to frame, and from the right eye."""

    def __init__(self) -> None:
        self._detail = Detail(Lessons())
        self._before: tuple[Snapshot, SeenFrame] | None = None
        self._now: tuple[Snapshot, SeenFrame] | None = None
        self._whole: SeenFrame | None = None  # with its left view, if nobody else looks at it
        self._step = 0.0  # s between the last two scenes
        self._ahead = self._aside = 0  # views of either kind that were drawn

    def take(self, scene: FrameResult, now: SeenFrame) -> None:
        """Remember a scene: the next one shows how good views ahead of it were."""
        self._before, self._now = self._now, (scene.snapshot, now)
        if self._before is not None:
            seconds = (now.t_capture_ns - self._before[1].t_capture_ns) * 1e-9
            self._step = seconds if seconds > 0 else self._step

    def _learn_ahead(self, now: SeenFrame) -> None:
        self._ahead += 1
        if self._before is None or self._ahead % LESSON_EVERY != 1:
            return
        snapshot, seen = self._before
        seconds = (now.t_capture_ns - seen.t_capture_ns) * 1e-9
        if 0 < seconds <= reached(snapshot, seconds) + ROUNDING:
            self._detail.learn_ahead(seen, gaussians_ahead(snapshot, seconds), now)

    def _learn_aside(self, scene: FrameResult, now: SeenFrame) -> None:
        self._aside += 1
        pair = scene.pair
        if pair.right is not None and self._aside % ASIDE_EVERY == 1:
            self._detail.learn_aside(now, scene.snapshot, published.picture(pair, "right"), pair.baseline)

    def detail(
        self, scene: FrameResult, seen: Sequence[SeenFrame], gaussians: Gaussians, view: RenderedView,
        ahead: float, right: bool,
    ) -> Shown:  # fmt: skip
        """Return a view with detail. Every few views of a kind, first learn how far to trust the detail.

        Args:
            seen: the scene's frame, and older ones.
            gaussians: of the scene, moved to `ahead` seconds after it.
            right: the view has the colours that the right eye sees.
        """
        now, *older = seen
        if ahead > 0:
            self._learn_ahead(now)
        if np.any(view.camera.T_world_cam[:3, 3] != now.camera.T_world_cam[:3, 3]):
            self._learn_aside(scene, now)
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
