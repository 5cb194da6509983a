"""What watchers say of a frame. All answer one question: what of it may be trusted?"""

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

from sags_node.types import F32, Bool, Finding, FrameResult, RectifiedPair, StereoFrame


class Evidence(NamedTuple):
    """What a frame is judged by."""

    frame: StereoFrame
    pair: RectifiedPair
    last: FrameResult | None  # the frame mapped last, and what was made of it
    is_repeat: bool = False  # it shows the same as that one
    eyes_are_late: bool = False  # one eye showed another moment than the other when they were matched last


@dataclass(frozen=True, slots=True)
class Judgement:
    """What of a frame may be used."""

    hold: str = ""  # why nothing of it is taken in; empty: it is
    stage: str = "picture"  # the stage to which `hold` belongs
    repeats: bool = False  # it shows the same as the frame mapped last
    no_stereo: str = ""  # why its eyes are not matched; empty: they are
    learn: bool = True  # False: it is followed, but not learnt
    is_new_scene: bool = False  # it shows another scene for good: begin a new model
    covered: Bool | None = None  # [h, w] in a small image: what is not tissue now
    covered_left: Bool | None = None  # [rows, columns] cells that the left eye does not see
    covered_right: Bool | None = None  # and the right one
    gain: F32 | None = None  # [3] exposure to be taken out of the images
    guess: F32 | None = None  # [rows, columns, 2] px of square cells, where the motion search is to begin


class Watcher(Protocol):
    """Looks at every frame."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what is wrong, and how to fix it. May be read from any thread."""

    def judge(self, evidence: Evidence, judged: Judgement) -> Judgement:
        """Return what may be used of a frame: `judged`, which the watchers before it returned, or less."""


class PoseWatch:
    """Looks at what the robot says of every frame.

    Attributes:
        findings: why the newest frame's pose is not known. May be read from any thread.
    """

    def __init__(self, needed: bool) -> None:
        self.findings: tuple[Finding, ...] = ()
        self._needed = needed

    def judge(self, evidence: Evidence, judged: Judgement) -> Judgement:
        """Hold a frame without a pose: nobody knows where it shows the tissue."""
        problem = evidence.frame.pose_problem if self._needed else None
        self.findings = () if problem is None else (problem,)
        return judged if problem is None else replace(judged, hold=problem.text, stage="pose")
