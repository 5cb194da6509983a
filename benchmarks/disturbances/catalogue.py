"""All disturbances by name, how long each lasts, and a stream of frames with one of them for some time."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from benchmarks.disturbances import lens, light, signal, tissue
from benchmarks.disturbances.moment import Moment
from benchmarks.disturbances.scene import Scene
from sags_node.types import StereoFrame


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A kind of disturbance."""

    name: str
    change: Callable[[Moment], StereoFrame | None]  # the frame as it arrives; None: it is lost
    seconds: float | None = None  # how long it lasts; None: all the time that is given
    frames: int | None = None  # how many frames it lasts, at any rate; None: see `seconds`

    def length(self, whole: int, rate: float) -> int:
        """Return how many of `whole` given frames it lasts, at `rate` frames per second."""
        if self.frames is not None:
            return min(self.frames, whole)
        return whole if self.seconds is None else min(max(1, round(self.seconds * rate)), whole)


DISTURBANCES = {
    each.name: each
    for each in (
        Disturbance("clean", signal.clean),
        Disturbance("smoke", tissue.smoke),
        Disturbance("blood", tissue.blood),
        Disturbance("fog_right", lens.fog_right),
        Disturbance("fog_left", lens.fog_left),
        Disturbance("black_right", signal.black_right),
        Disturbance("frozen_right", signal.frozen_right),
        Disturbance("frozen", signal.frozen),
        Disturbance("late_right", signal.late_right),
        Disturbance("swapped", signal.swapped),
        Disturbance("equal", signal.equal),
        Disturbance("drops", lens.drops),
        Disturbance("dark", light.dark, seconds=0.5),
        Disturbance("flicker", light.flicker),
        Disturbance("flash", light.flash, frames=2),
        Disturbance("cut", signal.cut, frames=10),
        Disturbance("blur", lens.blur),
        Disturbance("lost_frames", signal.lost_frames),
        Disturbance("jpeg", signal.jpeg),
        Disturbance("knocked", signal.knocked),
    )
}


class Taken(NamedTuple):
    """One frame of a disturbed stream."""

    clean: StereoFrame  # as it was taken: the true image of that time
    given: StereoFrame | None  # as it arrives; None: it is lost


def disturbed(
    disturbance: Disturbance, frames: Iterable[StereoFrame], during: range, rate: float, scene: Scene
) -> Iterator[Taken]:
    """Yield the frames with one disturbance. Numbers, stamps, poses and ground truth stay as they are.

    Args:
        frames: of a source, both eyes.
        during: numbers (`frame_id`) of the frames that it changes.
        rate: frames per second.
        scene: where the tissue is.
    """
    history: list[StereoFrame] = []
    for frame in frames:
        history.append(frame)
        if frame.frame_id not in during:
            del history[: -signal.LATE]
            yield Taken(frame, frame)
            continue
        moment = Moment(frame.frame_id - during.start, len(during), rate, tuple(history), scene)
        yield Taken(frame, disturbance.change(moment))
