"""Whether the scope's pose is known where it is to be given."""

from __future__ import annotations

from dataclasses import replace

from sags_node.types import Finding
from sags_node.vision.watch.judgement import Evidence, Judgement


class PoseWatch:
    """Looks at what the robot says of every frame.

    Attributes:
        findings: why the newest frame's pose is not known. May be read from any thread.
    """

    def __init__(self, needed: bool) -> None:
        self.findings: tuple[Finding, ...] = ()
        self._needed = needed

    def judge(self, evidence: Evidence, judged: Judgement) -> Judgement:
        """Without its pose a frame is held: nobody knows where it shows the tissue."""
        problem = evidence.frame.pose_problem if self._needed else None
        self.findings = () if problem is None else (problem,)
        return judged if problem is None else replace(judged, hold=problem.text, stage="pose")
