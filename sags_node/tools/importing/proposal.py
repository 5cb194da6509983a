"""`sags new`: how a recording or a camera is best played, by what its images show."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sags_node.checks import Finding, is_wrong
from sags_node.config.launch_file import known_recording, leaves, load_launch
from sags_node.config.schema import EndoNerfSource, FoldersSource, GeometryConfig, LaunchConfig, LiveSource
from sags_node.errors import UsageError
from sags_node.pipeline.session import lacks_rig
from sags_node.rig import read_rig
from sags_node.sources.pictures import size_text
from sags_node.sources.source import recorded_rig
from sags_node.tools.calibration.eyes import look
from sags_node.tools.calibration.pictures import pairs_of_session
from sags_node.tools.importing import pictures, videos
from sags_node.tools.importing.check import Advance, calibrated, once, overrides_of, played, unseen
from sags_node.tools.importing.folder import is_video, override

DEVICES = Path("/dev")
EYES = ("left", "right")
EACH_EYE = (("source.left", "source.right"), ("source.geometry.crop", "source.geometry.crop_right"))
SECONDS = 2.0  # that a camera is watched
WHOLE = "source.geometry.layout:=over_under"  # takes any image apart so that it can be put together again


@dataclass(frozen=True, slots=True)
class Proposal:
    """What a launch file should say, and why."""

    launch: list[str]  # key:=value
    findings: list[Finding]


def propose(named: Sequence[Path], overrides: Sequence[str] = (), advance: Advance = unseen) -> Proposal:
    """Try a recording or cameras, and set what fixes their faults.

    Args:
        named: a folder, a video or a device; or two videos, folders or devices, the left eye first.
        overrides: `key:=value` that the user wants.

    Raises:
        UsageError: what is named is not there or cannot be played, or it has a launch file already.
        SagsError: it cannot be opened, or gives no images.
    """
    advance(0, 4, "looking at the files")
    launch = [*_launch_of(named, overrides), *overrides]
    config = load_launch(named[0], launch)
    advance(1, 4, "playing it")
    found = _opened(config)
    if is_wrong(found):
        return Proposal(launch, found)
    advance(2, 4, "looking at the images")
    looked = [] if isinstance(config.source, EndoNerfSource) else _looked_at(config)
    fixes = list(dict.fromkeys(fix for finding in looked for fix in finding.launch))
    if isinstance(config.source, FoldersSource):  # folders have no geometry
        fixes = [fix for fix in fixes if fix == pictures.RIGHT_FIRST]
    if fixes:
        launch, done = _with(launch, fixes)
        found += [
            replace(each, level="ok", fix=done[each.launch[0]])
            for each in looked
            if each.launch and each.launch[0] in done
        ]
        looked = _looked_at(load_launch(named[0], launch))
    advance(3, 4, "looking at the calibration")
    found += [*looked, *calibrated(load_launch(named[0], launch), named[0])]
    return Proposal(launch, once(found))


def _launch_of(named: Sequence[Path], overrides: Sequence[str]) -> list[str]:
    if len(named) > 2:
        raise UsageError("name one folder, video or device, or two of one kind: left and right")
    if all(path.is_relative_to(DEVICES) for path in named):
        return _of_cameras(named, overrides)
    if len(named) == 2:
        for kind, fits in (("videos", is_video), ("folders", Path.is_dir)):
            if all(fits(path) for path in named):
                left, right = (override(f"source.{eye}", path) for eye, path in zip(EYES, named, strict=True))
                return [f"source.kind:={kind}", left, right]
        raise UsageError(f"{named[0]} and {named[1]} are neither two videos nor two folders of images")
    known = known_recording(named[0])
    launch = overrides_of(named[0]) if known is None else [override(*each) for each in leaves(known)]
    if not launch:
        raise UsageError(f"{named[0]} has a launch file already: copy it, and change what should differ")
    return launch


def _of_cameras(devices: Sequence[Path], overrides: Sequence[str]) -> list[str]:
    launch = ["source.kind:=v4l2", override("source.left", devices[0])]
    if len(devices) == 2:
        return [*launch, override("source.right", devices[1])]
    launch.append("source.right:=null")
    if any(each.startswith(videos.LAYOUT) for each in overrides):
        return launch
    pairs, _ = pairs_of_session(load_launch(None, [*launch, *overrides, WHOLE]))
    whole = [np.vstack(pair) for pair in pairs]
    way = videos.way_of(whole)
    if way is None:
        raise UsageError(f"{devices[0]}: {videos.ONE_EYE}; name both devices, or set source.geometry.layout")
    return [*launch, *videos.layout_of(way, whole)]


def _opened(config: LaunchConfig) -> list[Finding]:
    if not isinstance(config.source, LiveSource):
        return played(config)
    _, found = look(config, SECONDS)
    size, rate = size_text(found["width"], found["height"]), found["frames_per_s"]
    what = f"{size} px at {rate} Hz; the eyes are {found['skew_ms']} ms apart, {found['age_ms']} ms old"
    return [Finding("ok", what)]


def _looked_at(config: LaunchConfig) -> list[Finding]:
    """Findings on some images, spread over the recording."""
    pairs, _ = pairs_of_session(config)
    left, right = zip(*pairs, strict=True)
    geometry: GeometryConfig | None = getattr(config.source, "geometry", None)
    found = pictures.check_both(left, right, geometry=geometry)
    why = _needs_borders(config, geometry, left[0].shape[1::-1])
    return [_with_borders(each, why) for each in found] if why else found


def _needs_borders(config: LaunchConfig, geometry: GeometryConfig | None, size: tuple[int, int]) -> str:
    """Why black borders of images of this size must stay; "": they need not."""
    if geometry is not None and geometry.crop_right is not None:
        return "each eye has a box of its own"
    if lacks_rig(config):
        return ""
    rig = recorded_rig(config.source, judged=False) if config.rig is None else read_rig(config.rig, size)
    fits = rig is not None and (rig.left.width, rig.left.height) == size
    return "the calibration is of whole images" if fits else ""


def _with_borders(finding: Finding, why: str) -> Finding:
    if not any(fix.startswith(pictures.CROP) for fix in finding.launch):
        return finding
    return replace(finding, level="ok", fix=f"the borders stay: {why}", launch=())


def _with(launch: list[str], fixes: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """The launch with its fixes, and in words what each of them did."""
    keys = dict(each.split(":=", 1) for each in launch)
    done = {fix: f"{fix} is set" for fix in fixes}
    each_eye = [
        (one, other) for one, other in EACH_EYE if keys.get(other) not in (None, "null") and one in keys
    ]
    apart = keys.get(videos.LAYOUT.removesuffix(":="), "separate") in ("separate", "panes")
    if pictures.RIGHT_FIRST in done and apart and each_eye:  # `first` does not apply to these
        for one, other in each_eye:
            keys[one], keys[other] = keys[other], keys[one]
        done[pictures.RIGHT_FIRST] = "left and right are exchanged"
        fixes = [fix for fix in fixes if fix != pictures.RIGHT_FIRST]
    return [*(f"{key}:={value}" for key, value in keys.items()), *fixes], done
