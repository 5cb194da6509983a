"""`sags import --check`: one folder looked over, from what it is to how it is played."""

import logging
import re
import shlex
from collections.abc import Callable, Sequence
from itertools import islice
from logging.handlers import BufferingHandler
from pathlib import Path

from sags_node.checks import Finding, as_warnings, is_wrong, parted, refused
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import EndoNerfSource, LaunchConfig, LiveSource, PhantomSource, RecordedSource
from sags_node.errors import SagsError, UsageError
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import lacks_rig, open_posed, rig_to_play
from sags_node.rig import read_rig
from sags_node.rig.check import RECALIBRATE
from sags_node.sources.endonerf import is_published
from sags_node.sources.pictures import list_pictures, say, size_text
from sags_node.sources.rectified import as_pictures_come
from sags_node.sources.replay import Recording, Replay
from sags_node.sources.source import open_source, recorded_rig
from sags_node.tools.calibration.check import judge, rectified_before
from sags_node.tools.calibration.guess import guess_rig
from sags_node.tools.calibration.pictures import pairs_of_session
from sags_node.tools.calibration.rows import PLAUSIBLE_DEPTH, RECTIFIED
from sags_node.tools.importing import pictures, videos
from sags_node.tools.importing.folder import (
    Contents,
    both_eyes,
    calibration_of,
    override,
    recognise,
    seem_calibrations,
)
from sags_node.tools.importing.timing import LOOKED_AT, Timing
from sags_node.types import U8
from sags_node.vision.watch.color_watch import EXCHANGED, is_blue

MAKE_ONE = "without one depth has no unit: sags calib stereo makes one (docs/calibration.md), then set rig"
MOST_NAMED = 4  # files in one sentence
MOST_SAID = 1 << 16  # lines in the log
Advance = Callable[[int, int, str], None]  # done, of, what comes


def unseen(done: int, of: int, what: str) -> None:
    """Show no progress."""


def check_folder(folder: Path, overrides: Sequence[str] = (), advance: Advance = unseen) -> list[Finding]:
    """Return what a folder is, what is missing or odd, each with a way to fix it; the last says how to play
    it.

    It is opened and played as `sags run` does it: what that refuses is an error here, with its words.

    Args:
        overrides: `key:=value` that it is to be played with.

    Raises:
        UsageError: it is no folder.
    """
    say.cache_clear()
    advance(0, 3, "looking at the files")
    contents = recognise(folder)
    fix = "" if contents.level == "ok" else contents.instead
    found = [Finding(contents.level, f"{folder.name or folder} is {contents.what}", fix)]
    if contents.left is not None:
        found += _pictures(contents, contents.left)
    if contents.videos:
        found += _tried("videos", lambda: videos.look(contents.videos))
    if contents.level == "error":
        return found
    launch: list[str] = []

    def look() -> list[Finding]:
        launch.extend([*overrides_of(folder), *overrides])
        config = load_launch(folder, launch)
        advance(1, 3, "playing it")
        plays = played(config)
        apart = any("clocks_differ_ms" in each.figures for each in plays)  # then rows differ by that
        advance(2, 3, "looking at the calibration")
        judged = [] if apart else calibrated(config, folder)
        return plays + (judged if is_wrong(plays) else as_warnings(judged))

    found = once(found + _tried("frames", look))
    if is_wrong(found):
        return [*found, Finding("ok", f"to play it: when that is fixed: sags run {_quoted(folder)}")]
    stands_for = f", which stands for {' '.join(map(_quoted, launch))}" if launch else ""
    return [*found, Finding("ok", f"to play it: sags run {_quoted(folder)}{stands_for}")]


def _quoted(word: Path | str) -> str:
    """Quote a word for a shell. Brackets alone need no quotes: no file is named like the lists in them."""
    return shlex.quote(str(word)) if shlex.quote(re.sub(r"[\[\]]", "", str(word)))[0] == "'" else str(word)


def overrides_of(path: Path) -> list[str]:
    """The overrides `key:=value` that play a folder or a video; none where it is played as it is.

    Raises:
        UsageError: it cannot be played.
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


def once(found: list[Finding]) -> list[Finding]:
    """Leave out findings that repeat an earlier one: several checks may meet the same fault."""
    said: list[str] = []
    kept = []
    for finding in found:
        why = finding.what.removeprefix(f"{finding.what.partition(': ')[0]}: ")
        if finding.level == "ok" or not any(each.endswith(why) for each in said):
            kept.append(finding)
        said.append(finding.what)
    return kept


def _pictures(contents: Contents, left_folder: Path) -> list[Finding]:
    """Findings on some of the images, before anything plays them."""
    if contents.right is None and contents.config is None:
        return _tried("images", lambda: _in_one_folder(left_folder))

    def look() -> list[Finding]:
        counts = {len(list_pictures(each)) for each in (left_folder, contents.right) if each is not None}
        found = [Finding("ok", f"{' and '.join(map(str, sorted(counts)))} images each")]
        left = _some(left_folder)
        right = [] if contents.right is None else _some(contents.right)
        found += pictures.check_both(left, right) if right else pictures.check_eye("left", left)
        if contents.depth is not None:
            source = None if contents.config is None else contents.config.source
            clip = source if isinstance(source, EndoNerfSource) else None
            unit = None if clip is None else clip.depth_unit
            stated = clip is not None and clip.depth_unit == 1e-3 and is_published(clip)
            size = left[0].shape[1], left[0].shape[0]
            found += as_warnings(pictures.check_depth(contents.depth, size, unit, stated))
        return found

    return _tried("images", look)


def _in_one_folder(folder: Path) -> list[Finding]:
    """Findings on one folder: on both eyes, if file names tell them apart, else on all images as one."""
    apart = both_eyes(folder)
    if not apart:
        return pictures.check_eye("images", _some(folder))
    left, right = (pictures.read_some([pair[eye] for pair in apart]).values() for eye in (0, 1))
    return pictures.check_both(left, right)


def _some(folder: Path) -> list[U8]:
    return list(pictures.read_some(list_pictures(folder)).values())


def played(config: LaunchConfig) -> list[Finding]:
    """Check, with the code of `sags run`, that all frames of both eyes come, both at one time and of the
    calibration's size. What that code logs is a finding, too."""
    source = config.source
    if not isinstance(source, RecordedSource):
        return [
            Finding("ok", f"source.kind {source.kind} is live: sags doctor and sags calib live look at it")
        ]
    source = source.model_copy(update={"pace": "step", "loop": False})
    found = _tried("frames", lambda: _frames(source))
    if is_wrong(found):
        return found
    what = "calibration" if config.robot is None else "calibration or robot"
    return once(found + _tried(what, lambda: _fits(config.model_copy(update={"source": source}))))


def _frames(source: Recording | PhantomSource) -> list[Finding]:
    """Check the first frame and those in the middle: do masks mark something, are the eyes of one time?"""
    with open_source(source, references=False) as opened:
        count, rate, first = opened.frame_count or 0, opened.rate, next(iter(opened), None)
        said, stamped, assumed = list[Finding](), False, ""
        if isinstance(opened, Replay):
            said, stamped, assumed = opened.pairs.findings, bool(opened.pairs.judged), opened.assumed
    if first is None:
        return [Finding("error", "not one frame can be read", "check the files")]
    size = size_text(*first.left.shape[1::-1])
    found = [Finding("ok", f"{count} frames of {size} px at {rate:g} Hz{assumed}"), *said]
    timing, shares, blue = Timing(), [], []
    middle = source.start + max(0, (count - LOOKED_AT) // 2) / rate
    with open_source(source.model_copy(update={"start": middle}), references=False) as opened:
        for frame in islice(opened, LOOKED_AT):
            blue.append(is_blue(frame.left))
            if frame.right is not None:
                timing.add(frame.left, frame.right)
            if frame.tissue is not None:
                shares.append(1 - float(frame.tissue.mean()))
    if sum(blue) > len(blue) / 2:
        found.append(parted("warning", EXCHANGED.text))
    return [*found, *pictures.check_shares(shares), *([] if stamped else timing.findings())]


def _fits(config: LaunchConfig) -> list[Finding]:
    """Make a pipeline and rectify one frame with its pose: no findings, or the error of what does not fit."""
    rig = rig_to_play(config, guess=guess_rig)
    with open_posed(config, rig, references=False) as opened:
        pipeline = Pipeline(config, rig, lambda stamp_ns: None, rate=opened.rate)
        for frame in islice(opened, 1):
            pipeline.rectifier(frame)
    return []


def calibrated(config: LaunchConfig, path: Path) -> list[Finding]:
    """Compare the calibration that is used with the recording's images, which lie in or at `path`."""

    def compare() -> list[Finding]:
        source = config.source
        one_eyed = isinstance(source, EndoNerfSource) and source.baseline is None
        if config.one_camera or one_eyed or isinstance(source, LiveSource | PhantomSource):
            return []
        if lacks_rig(config):
            return [_none_used(path if path.is_dir() else path.parent)]
        pairs, depths = pairs_of_session(config)
        size = pairs[0][0].shape[1], pairs[0][0].shape[0]
        rig = recorded_rig(source) if config.rig is None else read_rig(config.rig, size)
        assert rig is not None  # else it lacks one
        judged = _within_reach(judge(as_pictures_come(rig, config), pairs, depths), config)
        last = Finding("ok", f"calibration: {judged[-1].what}", "", judged[-1].figures)
        return [each for each in judged if each.level != "ok"] or [last]  # all is well in one line

    return _tried("calibration", compare)


def _none_used(folder: Path) -> Finding:
    if not (there := seem_calibrations(folder)):
        return Finding("warning", "no calibration lies beside the images", MAKE_ONE)
    named, first = ", ".join(str(file.relative_to(folder)) for file in there[:MOST_NAMED]), _quoted(there[0])
    fix = f"set {override('rig', first)} if sags calib check {first} takes it, else docs/calibration.md"
    return Finding("warning", f"no calibration is used, though {named} lies there", fix)


def _within_reach(judged: list[Finding], config: LaunchConfig) -> list[Finding]:
    """The findings with depth judged by `vision.stereo.max_depth`, unless the lengths' unit is wrong."""
    reach = config.vision.stereo.max_depth
    found = next((each for each in judged if "depth_median_m" in each.figures), None)
    if found is None or (found.level == "error" and found.fix != RECALIBRATE):  # another unit fits
        return judged
    depth, others = found.figures["depth_median_m"], [each for each in judged if each is not found]
    if depth <= reach:
        return others if depth > PLAUSIBLE_DEPTH[1] else judged
    what = f"points lie at {depth:.3g} m (median), and nothing is matched beyond {reach:g} m"
    fix = "if the calibration is right, set vision.stereo.max_depth to how far away tissue can be"
    return [*others, Finding("warning", what, fix, found.figures)]


def _tried(what: str, look: Callable[[], list[Finding]]) -> list[Finding]:
    """Run a check: return its findings, with logged warnings and an error as findings, too."""
    log, said = logging.getLogger("sags_node"), BufferingHandler(MOST_SAID)
    said.setLevel(logging.WARNING)
    log.addHandler(said)
    log.propagate = False
    try:
        found = look()
    except SagsError as error:
        found = [refused(what, error)]
    finally:
        log.propagate = True
        log.removeHandler(said)
    return [*(parted("warning", each.getMessage()) for each in said.buffer), *found]
