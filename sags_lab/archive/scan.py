"""Finds recordings in a folder: all that the node can play, and why it cannot play the others."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sags_lab.archive.launching import arguments, counterpart, is_video, split
from sags_lab.archive.manifest import Recording
from sags_lab.archive.segments import Cut, segments
from sags_node.config.launch_file import BAG_SUFFIXES, is_sidecar, known_recording, load_launch
from sags_node.config.schema import LiveSource, PhantomSource, Source
from sags_node.config.yaml_reader import read_yaml
from sags_node.errors import SagsError, UsageError
from sags_node.media.video import Video
from sags_node.pipeline.session import open_session
from sags_node.sources.dvrk import read_sidecar
from sags_node.sources.replay import Replay
from sags_node.sources.source import open_source, recorded_rig

WIDE = 2.2  # width / height of two images side by side, at least; of one it is at most 1.9 (16:9, 17:9)
PHANTOM_RATE = 30.0  # frames per second, where the launch file names none


@dataclass(frozen=True, slots=True)
class Refused:
    """What looks like a recording and cannot be played."""

    path: str  # relative to the folder
    why: str


@dataclass(frozen=True, slots=True)
class Scan:
    recordings: list[Recording]
    refused: list[Refused]


def scan(
    folder: Path,
    rig: Path | None = None,
    progress: Callable[[int], None] = lambda done: None,
    cut: Cut | None = None,
) -> Scan:
    """Look for recordings below a folder, and open each.

    The weight of a recording is its frames times the megapixels of one eye.

    Args:
        rig: the calibration of those that bring none; None: the nearest folder `calib` beside or above.
        cut: how to cut recordings into segments, a row for each; None: they stay whole.
        progress: called with how many were looked at.

    Raises:
        UsageError: the folder is missing.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder} is no folder; name the one that holds the recordings")
    root = folder.resolve()
    given = None if rig is None else rig.resolve()
    found = Scan([], [])
    for done, path in enumerate(_candidates(root), 1):
        name = path.relative_to(root).as_posix()
        try:
            found.recordings.extend(_opened(root, name, given, cut))
        except (SagsError, OSError) as error:
            found.refused.append(Refused(name, str(error)))
        progress(done)
    return found


def _candidates(folder: Path) -> Iterator[Path]:
    """Paths that may be recordings, in order. Nothing inside a recording is another one."""
    if (folder / "launch.yaml").is_file() or _is_whole(folder):
        yield folder
        return
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            yield from _candidates(path)
        elif path.suffix in BAG_SUFFIXES or is_sidecar(path) or _is_launch(path):
            yield path
        elif is_video(path.name) and not _is_right_eye(path) and not _has_sidecar(path):
            yield path


def _is_whole(folder: Path) -> bool:
    """Whether a folder is itself one recording, and not a folder of recordings."""
    pictures = all((folder / eye).is_dir() for eye in ("left", "right"))
    known = known_recording(folder)
    if known is None:
        return pictures
    kind = known["source"]["kind"]
    return kind not in ("bag", "dvrk") or (folder / "metadata.yaml").is_file()


def _is_launch(file: Path) -> bool:
    if file.suffix not in (".yaml", ".yml"):
        return False
    try:
        tree = read_yaml(file, "launch file")
    except SagsError:
        return False  # a calibration of OpenCV is no YAML to others
    return isinstance(tree, dict) and isinstance(tree.get("source"), dict)


def _is_right_eye(file: Path) -> bool:
    return any(
        other != file and is_video(other.name) and counterpart(other.name) == file.name
        for other in file.parent.iterdir()
    )


def _has_sidecar(video: Path) -> bool:
    """Whether a sidecar file of dVRK's `record` beside this video names it."""
    return any(
        read_sidecar(file).video_file == video.name
        for file in video.parent.glob("*.json")
        if is_sidecar(file)
    )


def _opened(root: Path, name: str, rig: Path | None, cut: Cut | None) -> list[Recording]:
    """The row of a recording that can be played, or those of its segments.

    Raises:
        SagsError: it cannot be played.
    """
    path = root / name
    overrides = _says_how(path) if is_video(path.name) else []
    config = load_launch(*split(arguments(path, None, overrides)))
    if isinstance(config.source, LiveSource):
        raise UsageError("live cameras, no recording; record them first (sags bag record)")
    once = config.source.model_copy(update={"loop": False})  # as all jobs play it
    if isinstance(once, PhantomSource):
        frames = once.frames or round(once.seconds * (once.rate or PHANTOM_RATE))
        row = Recording(name, str(root), None, (), _weight(frames, once.width, once.height))
        return [row] if cut is None else _segments(row, once, cut)
    rig_name = None
    if config.rig is None and recorded_rig(once, judged=False) is None:
        found = rig or _nearest_calib(path, root)
        if found is None:
            raise UsageError("no calibration: name one with --rig, or put a folder calib beside it")
        rig_name = found.relative_to(root).as_posix() if found.is_relative_to(root) else str(found)
    said = arguments(path, None if rig_name is None else root / rig_name, overrides)
    launch, changed = split(said)
    session = open_session(launch, [*changed, "source.loop:=false"])
    with session.source as source:
        frames = source.frame_count or 1
        row = Recording(name, str(root), rig_name, tuple(overrides), _weight(frames, *session.working_size))
        if cut is None:
            return [row]
        return segments(row, once, source, cut) if isinstance(source, Replay) else _segments(row, once, cut)


def _weight(frames: int, width: int, height: int) -> float:
    return float(f"{frames * width * height * 1e-6:.4g}")


def _segments(row: Recording, config: Source, cut: Cut) -> list[Recording]:
    """`segments` of a recording that is not open yet: a phantom is rendered for it."""
    with open_source(config, references=False) as source:
        assert isinstance(source, Replay) and not isinstance(config, LiveSource)
        return segments(row, config, source, cut)


def _says_how(video: Path) -> list[str]:
    """How a video shows the eyes, from its name and shape."""
    right = counterpart(video.name)
    if right is not None and video.with_name(right).is_file():
        return ["source.kind:=videos"]
    opened = Video(video)
    opened.close()
    width, height = opened.size
    if width >= WIDE * height:
        return ["source.kind:=videos", "source.geometry.layout:=side_by_side"]
    raise UsageError(
        f"one video of {width}x{height} px, and no other one is named as its right eye. If it shows both "
        "eyes, write its row by hand with source.kind:=videos source.geometry.layout:=..., or a launch file "
        "(docs/recordings.md)"
    )


def _nearest_calib(path: Path, root: Path) -> Path | None:
    for folder in (path, *path.parents):
        if (folder / "calib").is_dir():
            return folder / "calib"
        if folder == root:
            break
    return None
