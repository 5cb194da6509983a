"""Long recordings as several rows of a manifest, one for each segment.

The model learns while it plays, so a segment begins with a warm-up: frames that the segment before counts.
Borders are frame numbers. All segments together count each frame of the recording once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from sags_lab.archive.manifest import Recording
from sags_node.config.schema import RecordedSource
from sags_node.errors import UsageError
from sags_node.sources.replay import Replay

FRAMES_BY = ("source.start", "source.frames", "source.warm_up", "source.stride", "source.rate")


@dataclass(frozen=True, slots=True)
class Cut:
    """How long a segment is at most, and what is played before it, both in seconds."""

    seconds: float
    warm_up: float


def borders(first: int, count: int, most: int) -> list[int]:
    """Return where parts of at most `most` frames begin, and where the last one ends.

    There are as few parts as possible, and their lengths differ by at most one frame.
    """
    parts = -(-count // most)
    return [first + part * count // parts for part in range(parts + 1)]


def segments(recording: Recording, config: RecordedSource, source: Replay, cut: Cut) -> list[Recording]:
    """Return a row for each segment of a recording; its own row where it is short enough.

    The last one has no `source.frames` where the recording is played to its end: files may hold more frames
    than they announce.

    Args:
        config: how the recording is played, without `loop`.
        source: the recording, opened.
    """
    announced = source.frame_count
    assert announced is not None  # it does not loop
    count = announced - config.warm_up
    most = max(1, round(cut.seconds * source.rate))
    if count <= most:
        return [recording]
    marks = borders(source.first + config.warm_up, count, most)
    digits = len(str(marks[-1] - 1))
    found = []
    for begin, end in pairwise(marks):
        start = source.seconds_of(max(source.first, begin - round(cut.warm_up * source.rate)))
        played = source.frame_at(start)  # the first of several frames with this stamp
        said = [f"source.start:={start:.9f}".rstrip("0").rstrip("."), f"source.warm_up:={begin - played}"]
        to_the_end = end == marks[-1] and config.frames is None
        if not to_the_end:
            said.append(f"source.frames:={end - played}")
        last = "end" if to_the_end else f"{end - 1:0{digits}d}"
        found.append(
            replace(
                recording,
                overrides=(*recording.overrides, *said),
                weight=float(f"{recording.weight * (end - played) / announced:.4g}"),
                segment=f"{begin:0{digits}d}-{last}",
            )
        )
    return found


def check_frames(recordings: Sequence[Recording], overrides: Sequence[str]) -> None:
    """Refuse overrides for all recordings that change which frames a segment has.

    Raises:
        UsageError: there is such an override, and a row that is a segment.
    """
    changed = [each for each in overrides if each.partition(":=")[0] in FRAMES_BY]
    if changed and any(recording.segment for recording in recordings):
        raise UsageError(
            f"{changed[0]}: the manifest lists segments, whose frames were counted without it; write it into "
            "a launch file of the recording and scan again"
        )
