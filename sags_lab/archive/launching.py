"""From a row of a manifest to the arguments that `sags eval`, `fit` and `export` take."""

import re
from collections.abc import Sequence
from pathlib import Path

from sags_node.config.launch_file import VIDEO_SUFFIXES, known_recording
from sags_node.errors import UsageError


def counterpart(left: str) -> str | None:
    """Return the name of the right eye's file or folder; None where `left` is not named as a left one.

    The last "left" of the name becomes "right"; else an "l" at its end, after _ or -, becomes "r".
    """
    stem, dot, suffix = left.rpartition(".") if "." in left else (left, "", "")
    for pattern in (r"^(.*)(left)(.*)$", r"^(.*[_-])(l)()$"):
        found = re.match(pattern, stem, re.IGNORECASE)
        if found:
            said = found[2]
            right = "right" if len(said) > 1 else "r"
            right = right.upper() if said.isupper() else right.title() if said[0].isupper() else right
            return f"{found[1]}{right}{found[3]}{dot}{suffix}"
    return None


def is_video(name: str) -> bool:
    return name.lower().endswith(VIDEO_SUFFIXES)


def belongs(name: str, overrides: Sequence[str]) -> list[str]:
    """Return the paths or URLs of a recording's files and folders: two where each eye has its video."""
    right = counterpart(name) if is_video(name) and _kind(overrides) == "videos" else None
    return [name] if right is None or _shows_both(overrides) else [name, right]


def arguments(place: Path, rig: Path | None, overrides: Sequence[str]) -> list[str]:
    """Return the arguments after `sags eval`: a launch file or session, and `key:=value`.

    Args:
        place: of the recording, on this machine.
        rig: a calibration for it.

    Raises:
        UsageError: a video whose overrides do not say how it shows the eyes.
    """
    said = [*([] if rig is None else [f"rig:={rig}"]), *overrides]
    if is_video(place.name):
        return [*_video(place, overrides), *said]
    pair = place / "left", place / "right"
    if place.is_dir() and not (place / "launch.yaml").exists() and all(eye.is_dir() for eye in pair):
        if known_recording(place) is None:
            return ["source.kind:=folders", f"source.left:={pair[0]}", f"source.right:={pair[1]}", *said]
    return [str(place), *said]


def _video(place: Path, overrides: Sequence[str]) -> list[str]:
    if _kind(overrides) != "videos":
        raise UsageError(
            f"{place} is a video: its overrides must say source.kind:=videos and how it shows the eyes, e.g. "
            "source.geometry.layout:=side_by_side (docs/archive.md)"
        )
    right = counterpart(place.name)
    if _shows_both(overrides) or right is None:
        return [f"source.left:={place}"]
    return [f"source.left:={place}", f"source.right:={place.with_name(right)}"]


def _kind(overrides: Sequence[str]) -> str | None:
    kinds = [each.partition(":=")[2] for each in overrides if each.startswith("source.kind:=")]
    return kinds[-1] if kinds else None


def _shows_both(overrides: Sequence[str]) -> bool:
    return any(each.startswith("source.geometry.layout:=") for each in overrides)


def split(said: Sequence[str]) -> tuple[str | None, list[str]]:
    """Split arguments for `load_launch` and `open_session`: what is launched, and the overrides."""
    launch = next((each for each in said if ":=" not in each), None)
    return launch, [each for each in said if ":=" in each]
