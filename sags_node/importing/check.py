"""`sags import --check`: one folder looked over, from what it is to how it is played."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path

from sags_node.calibration.check import check_calibration, judge, rectified_before
from sags_node.calibration.pictures import Pair, pairs_of_files
from sags_node.calibration.rows import RECTIFIED
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import EndoNerfSource, LaunchConfig, RecordedSource, VideosSource
from sags_node.errors import SagsError, UsageError
from sags_node.importing import pictures, videos
from sags_node.importing.folder import Contents, both_eyes, calibration_of, override, recognise
from sags_node.importing.timing import LOOKED_AT, Timing, check_timing
from sags_node.rig import Finding, read_rig
from sags_node.sources.endonerf import is_published
from sags_node.sources.pictures import FolderPairs, size_text
from sags_node.sources.rectified import as_named
from sags_node.sources.replay import Replay
from sags_node.sources.source import open_source


def check_folder(folder: Path) -> list[Finding]:
    """What a folder is, what is missing or odd, each with a way to fix it; the last says how to play it.

    Raises:
        UsageError: it is no folder.
    """
    contents = recognise(folder)
    fix = "" if contents.level == "ok" else contents.instead
    found = [Finding(contents.level, f"{folder.name or folder} is {contents.what}", fix)]
    if contents.left is not None:
        found += _pictures(contents, contents.left)
    if contents.videos:
        looked, pairs = videos.look(contents.videos)
        found += looked + (_calibrated(folder, contents.videos, pairs) if pairs else [])
    if contents.config is not None:
        found += played(contents.config)
    if not any("clocks_differ_ms" in finding.figures for finding in found):  # else rows tell of the clocks
        found += _calibration(folder, contents)
    found = _once(found)
    if contents.level == "error":
        return found
    if any(finding.level == "error" for finding in found):
        return [*found, Finding("ok", f"to play it: when that is fixed: sags run {_quoted(folder)}")]
    if contents.instead:
        return [*found, Finding("ok", f"to play it: {contents.instead}")]
    launch = overrides_of(folder)
    stands_for = f", which stands for {' '.join(map(_quoted, launch))}" if launch else ""
    return [*found, Finding("ok", f"to play it: sags run {_quoted(folder)}{stands_for}")]


def _quoted(word: Path | str) -> str:
    """As a shell takes it; brackets stay, as no file is named like the lists in which they stand."""
    return shlex.quote(str(word)) if shlex.quote(re.sub(r"[\[\]]", "", str(word)))[0] == "'" else str(word)


def overrides_of(path: Path) -> list[str]:
    """`key:=value` that play what a folder holds, or a video; none where it is played as it is.

    Raises:
        UsageError: nothing can be made of it.
        SagsError: a video cannot be read.
    """
    contents = recognise(path)
    if contents.config is not None:
        return []
    launch = contents.launch or (videos.launch_of(contents.videos) if contents.videos else ())
    if not launch:
        raise UsageError(f"{path} is {contents.what}; {contents.instead}")
    form = calibration_of(path if path.is_dir() else path.parent)
    if form is None:
        return list(launch)
    with_rig = [*launch, override("rig", form)]
    return [*with_rig, RECTIFIED] if rectified_before(load_launch(path, with_rig)) else with_rig


def _once(found: list[Finding]) -> list[Finding]:
    """One file that cannot be read is met by several who look; the first says it."""
    said: set[str] = set()
    kept = []
    for finding in found:
        why = finding.what.partition(": ")[2]
        if finding.level != "error" or not why or why not in said:
            kept.append(finding)
        said.add(why)
    return kept


def _pictures(contents: Contents, left_folder: Path) -> list[Finding]:
    if contents.right is None and contents.config is None:
        return _tried("pictures", lambda: _in_one_folder(left_folder))
    named = {"left": left_folder, "right": contents.right, "masks": contents.masks}
    there = {what: each for what, each in named.items() if each is not None}
    source = None if contents.config is None else contents.config.source
    clip = source if isinstance(source, EndoNerfSource) else None
    if clip is not None and contents.depth is not None:
        there["depth"] = contents.depth
    found = _tried("pictures", lambda: pictures.check_counts(there))
    right_folder = contents.right
    if right_folder is not None and contents.config is None and found[0].level == "ok":
        found += _tried("pictures", lambda: check_timing(FolderPairs(left_folder, right_folder)))
    try:
        left = pictures.sample(left_folder)
        right = [] if contents.right is None else pictures.sample(contents.right)
    except SagsError as error:
        return [*found, pictures.refused("pictures", error)]
    found += pictures.check_eye("left", left)
    if right:
        found += pictures.check_eye("right", right) + pictures.check_eyes(left, right)
    size = left[0][1].shape[1], left[0][1].shape[0]
    masks, depth = contents.masks, contents.depth
    if masks is not None:
        polarity = "white" if clip is None else clip.instruments
        found += _tried("masks", lambda: pictures.check_masks(masks, size, polarity))
    if depth is not None:
        unit = None if clip is None else clip.depth_unit
        stated = clip is not None and clip.depth_unit == 1e-3 and is_published(clip)
        found += _tried("depth", lambda: pictures.check_depth(depth, size, unit, stated))
    return found


def _in_one_folder(folder: Path) -> list[Finding]:
    """Where the names tell the eyes both are looked at, else what there is."""
    apart = both_eyes(folder)
    if not apart:
        return pictures.check_eye("pictures", pictures.sample(folder))
    left, right = (pictures.read_some([pair[eye] for pair in apart]) for eye in (0, 1))
    eyes = pictures.check_eye("left", left) + pictures.check_eye("right", right)
    return eyes + pictures.check_eyes(left, right)


def _calibration(folder: Path, contents: Contents) -> list[Finding]:
    """The calibration beside the pictures, against them; sessions that are played as they are name theirs."""
    if contents.config is not None and (contents.right is not None or contents.left is None):
        return _tried("calibration", lambda: odd_or_last(check_calibration(folder)))
    if contents.right is None or contents.left is None:
        return []
    return _calibrated(folder, (contents.left, contents.right))


def _calibrated(folder: Path, eyes: tuple[Path, ...], pairs: Sequence[Pair] = ()) -> list[Finding]:
    """The calibration beside the pictures of both eyes, against some `pairs` of them; default: of the files
    in two folders."""
    form = calibration_of(folder)
    if form is None:
        return [without_calibration()]

    def compare() -> list[Finding]:
        looked_at = pairs or pairs_of_files([(eyes[0], eyes[1])])
        height, width = looked_at[0][0].shape[:2]
        return odd_or_last(judge(as_named(read_rig(form, (width, height)), *eyes), looked_at))

    return _tried("calibration", compare)


def without_calibration() -> Finding:
    fix = "without one depth has no unit: sags calib stereo makes one (docs/calibration.md), then set rig"
    return Finding("warning", "no calibration lies beside the pictures", fix)


def odd_or_last(found: list[Finding]) -> list[Finding]:
    """All is well in one line; else what is not."""
    odd = [finding for finding in found if finding.level != "ok"]
    return odd or [Finding("ok", f"calibration: {found[-1].what}", "", found[-1].figures)]


def played(config: LaunchConfig) -> list[Finding]:
    """Whether frames come as `sags run` would read them, all of both eyes, and both at one time."""
    source = config.source
    if not isinstance(source, RecordedSource):
        return [
            Finding("ok", f"source.kind {source.kind} is live: sags doctor and sags calib live look at it")
        ]
    source = source.model_copy(update={"pace": "step", "loop": False})

    def look() -> list[Finding]:
        timing, size, ends = Timing(), None, []
        with open_source(source, references=False) as opened:
            if isinstance(source, VideosSource) and source.right is not None:
                frames = round(source.start * opened.rate) + (opened.frame_count or 0)
                ends = videos.check_ends(source.left, source.right, frames * source.stride)
            for frame in islice(opened, 1 if ends else LOOKED_AT):
                size = size or frame.left.shape[1::-1]
                if frame.right is not None:
                    timing.add(frame.left, frame.right)
            if size is None:
                return [Finding("error", "not one frame can be read", "check the files")]
            said = f"{opened.frame_count} frames of {size_text(*size)} px at {opened.rate:g} Hz"
            stamped = list(opened.findings) if isinstance(opened, Replay) else []
        return [Finding("ok", said), *ends, *(stamped or timing.findings())]

    return _tried("frames", look)


def _tried(what: str, look: Callable[[], list[Finding]]) -> list[Finding]:
    try:
        return look()
    except SagsError as error:
        return [pictures.refused(what, error)]
