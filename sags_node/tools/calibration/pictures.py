"""Stereo images to check a calibration with: files, folders, or some frames of a session."""

from collections.abc import Callable, Sequence
from pathlib import Path

from sags_node.config.launch_file import VIDEO_SUFFIXES
from sags_node.config.schema import LaunchConfig, PhantomSource, RecordedSource
from sags_node.errors import SagsError, UsageError
from sags_node.sources.pictures import pair_files, read_picture, size_text, some_of
from sags_node.sources.replay import Recording, Replay
from sags_node.sources.source import open_source
from sags_node.types import F32, U8

Pair = tuple[U8, U8]  # left, right: [H, W, 3] RGB, raw
PAIRS = 8  # spread over all files, or over the recording
REFERENCE_EVERY = 10  # frames: recordings often know the depth of every tenth one only
LIVE_STRIDE = 15  # frames from one pair of live cameras to the next


def pairs_of_files(named: Sequence[tuple[Path, Path]]) -> list[Pair]:
    """Read the images of pairs of files, or of pairs of folders.

    Raises:
        UsageError: there are none, left and right are not equally many, or one is a video.
        SagsError: an image is damaged, or of another size than the others.
    """
    files: list[tuple[Path, Path]] = []
    for left, right in named:
        for file in (left, right):
            if file.suffix.lower() in VIDEO_SUFFIXES:
                raise UsageError(f"{file} is a video: name the launch file that plays it with --session")
        if left.is_dir() or right.is_dir():
            files += [(pair[0], pair[1]) for pair in pair_files((left, right))]
        else:
            files.append((left, right))
    pairs = [(read_picture(left), read_picture(right)) for left, right in some_of(files, PAIRS)]
    sizes = {picture.shape[1::-1] for pair in pairs for picture in pair}
    if len(sizes) > 1:
        said = " and ".join(size_text(*size) for size in sorted(sizes))
        raise SagsError(f"images of {said} px: give those of one rig, all of one size")
    return pairs


def pairs_of_session(
    config: LaunchConfig, progress: Callable[[int, int], None] | None = None
) -> tuple[list[Pair], list[F32 | None]]:
    """Read some frames, spread over a recording, and the depth [H, W] m that it has of each, or None; from
    cameras, one frame every half second.

    Raises:
        UsageError: the session has no right eye, or a wrong path.
        SagsError: it cannot be read.
    """
    source, stride = config.source, LIVE_STRIDE
    if isinstance(source, RecordedSource):
        source, stride = spread(source, PAIRS, REFERENCE_EVERY, progress), 1
    pairs: list[Pair] = []
    depths: list[F32 | None] = []
    with open_source(source) as opened:
        for index, frame in enumerate(opened):
            if frame.right is None:
                raise UsageError("the session has no right eye: there are no rows to compare")
            if index % stride == 0:
                pairs.append((frame.left, frame.right))
                depths.append(None if frame.reference is None else frame.reference.depth)
            if len(pairs) == PAIRS:
                break
    return pairs, depths


def spread(
    source: Recording | PhantomSource,
    count: int,
    multiple: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Recording | PhantomSource:
    """Return a source that plays `count` frames or more, spread over those that `source` plays.

    Args:
        multiple: the stride is a multiple of this, where there are enough frames.
        progress: called while a phantom session is rendered.

    Raises:
        UsageError: the recording has a wrong path.
        SagsError: it cannot be read.
    """
    source = source.model_copy(update={"pace": "step", "loop": False})
    with open_source(source, references=False, progress=progress) as recording:
        assert isinstance(recording, Replay)
        there = recording.frame_count or 0
        stride = max(1, there // count)
        if stride > multiple:
            stride -= stride % multiple
        begin = -(-recording.first // stride) * stride  # a stride counts from the recording's first frame
        playing = {
            "stride": source.stride * stride,
            "start": recording.seconds_of(begin),
            "frames": -(-(recording.first + there - begin) // stride),
        }
    return source.model_copy(update=playing)
