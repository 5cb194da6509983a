"""What a disturbance knows of one frame; what it does depends on nothing else."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.disturbances.scene import Scene
from sags_node.types import U8, StereoFrame

SEED = 18  # of all that is random; the same in every run
RISES, FALLS = 0.6, 0.15  # share of the time in which smoke or blood comes, and in which it goes


@dataclass(frozen=True, slots=True)
class Moment:
    """One frame while something is wrong."""

    index: int  # frames since it began, 0 in the first
    count: int  # frames that it lasts
    rate: float  # frames per second
    history: Sequence[StereoFrame]  # as they were taken, oldest first; the newest is this moment's
    scene: Scene

    @property
    def frame(self) -> StereoFrame:
        """The frame as it was taken."""
        return self.history[-1]

    @property
    def right(self) -> U8:
        """The right image [H, W, 3] as it was taken."""
        return right_of(self.frame)

    def earlier(self, frames: int) -> StereoFrame:
        """Return the frame that was taken `frames` frames before, or the oldest that is kept."""
        return self.history[max(0, len(self.history) - 1 - frames)]

    def swell(self) -> float:
        """Return the strength 0..1 of what rises, stays and falls again while it lasts. Never 0."""
        rising = (self.index + 1) / (RISES * self.count)
        falling = (self.count - self.index) / (FALLS * self.count)
        return float(min(1.0, rising, falling))

    def random(self, eye: int) -> np.random.Generator:
        """Return the random generator of this frame and eye (0 left, 1 right)."""
        return np.random.default_rng([SEED, self.frame.frame_id, eye])

    def both(self, change: Callable[[U8, int], U8]) -> StereoFrame:
        """Return the frame with both images changed; `change` is given the image and its eye, 0 or 1."""
        return replace(self.frame, left=change(self.frame.left, 0), right=change(self.right, 1))


def right_of(frame: StereoFrame) -> U8:
    """Return the right image; a stream is only disturbed if it has one."""
    assert frame.right is not None
    return frame.right
