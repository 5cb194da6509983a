"""Which findings stand: one bad frame makes none, and a warning ends soon after its cause. Also, how much of
the time was watched."""

from collections import Counter, deque
from collections.abc import Sequence

from sags_node.types import Finding

WINDOW_NS = 250_000_000  # ns: half of the time within which a person must be warned
BEGINS, ENDS = 0.6, 0.3  # of the frames in that time: a finding begins at the first and ends below the second
FEWEST = 2  # frames that must show a finding
LONGEST_STEP_NS = 1_000_000_000  # ns: of a longer gap between two frames only so much counts as watched


def watched_ns(before_ns: int | None, now_ns: int) -> int:
    """Return how much of the time between two frames was watched: none if the clock was set back."""
    return 0 if before_ns is None else min(max(0, now_ns - before_ns), LONGEST_STEP_NS)


class Debounced:
    """What watchers have in common: it keeps the findings of the last frames, and tells which of them last.

    Attributes:
        findings: those that stand. May be read from any thread.
    """

    def __init__(self) -> None:
        self.findings: tuple[Finding, ...] = ()
        self._frames: deque[tuple[int, tuple[Finding, ...]]] = deque()  # stamp, and what was found

    def note(self, stamp_ns: int, found: Sequence[Finding]) -> None:
        """Take what was found in one frame."""
        frames = self._frames
        if frames and stamp_ns < frames[-1][0]:  # the clock has jumped back
            frames.clear()
        frames.append((stamp_ns, tuple(found)))
        while len(frames) > FEWEST and stamp_ns - frames[0][0] > WINDOW_NS:
            frames.popleft()
        newest = {finding.code: finding for _, findings in frames for finding in findings}
        if not newest:  # nearly always
            self.findings = ()
            return
        counts = Counter(code for _, findings in frames for code in dict.fromkeys(f.code for f in findings))
        stood = {finding.code for finding in self.findings}
        self.findings = tuple(
            newest[code]
            for code, count in counts.items()
            if (code in stood and count >= ENDS * len(frames))
            or (count >= FEWEST and count >= BEGINS * len(frames))
        )
