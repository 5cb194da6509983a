"""The files of a recording: how a change of them is seen, and how they get to the machine that works."""

import fcntl
import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fsspec.core import url_to_fs

from sags_lab.archive.launching import arguments, belongs, split
from sags_lab.archive.manifest import Recording, is_url
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LaunchConfig
from sags_node.errors import SagsError, UsageError

Stat = tuple[str, int, str]  # name, bytes, and the time of change or the server's checksum

_SCRATCH = "sags-archive-"
_CHANGED = ("ETag", "etag", "md5Hash", "LastModified", "mtime")  # keys of fsspec's info, the surest first


def settings_of(about: Mapping[str, Any]) -> str:
    """Return how all keys with these settings (job, options, overrides, version) begin: their hash."""
    return _hash({name: about[name] for name in ("job", "options", "overrides", "version")})[:8]


def key_of(recording: Recording, about: Mapping[str, Any]) -> str:
    """Return a hash of the settings, see `settings_of`, followed by one of the recording's own inputs.

    Of a file its name, size and time of change count (of a URL the server's ETag, where it has one); its
    content is not read. The files are those of the recording, of its calibration, and all that its launch
    file names. The overrides of its row count, too.

    Args:
        about: job, options, overrides and version.
    """
    stats = [_stats(place) for place in places(recording)]
    said = {"files": stats, "own": recording.overrides, "rig": recording.rig_name}
    return settings_of(about) + _hash(said)[:16]


def _hash(said: Any) -> str:
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def places(recording: Recording) -> list[str]:
    """Return all paths and URLs that a recording needs, as far as they can be found out."""
    found = belongs(recording.place, recording.overrides)
    if recording.rig is not None:
        found.append(recording.rig)
    if not any(is_url(place) for place in found):
        rig = None if recording.rig is None else Path(recording.rig)
        with suppress(SagsError, OSError):  # the job says what is wrong
            said = arguments(Path(recording.place), rig, recording.overrides)
            found += map(str, _named(load_launch(*split(said))))
    return list(dict.fromkeys(found))


def _named(config: LaunchConfig) -> Iterator[Path]:
    trees: list[Any] = [config.model_dump(include={"source", "rig", "robot", "vision"})]
    for tree in trees:  # the list grows meanwhile
        if isinstance(tree, Path):
            yield tree
        elif isinstance(tree, dict):
            trees += tree.values()
        elif isinstance(tree, tuple):
            trees += tree


def _stats(place: str) -> list[Stat]:
    if is_url(place):
        return _remote_stats(place)
    path = Path(place)
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    found = []
    for file in files:
        with suppress(OSError):
            stat = file.stat()
            if not file.is_dir():
                found.append((str(file.relative_to(path.parent)), stat.st_size, str(stat.st_mtime_ns)))
    return found


def _remote_stats(url: str) -> list[Stat]:
    try:
        fs, path = url_to_fs(url, use_listings_cache=False)
        infos = {path: fs.info(path)} if fs.isfile(path) else fs.find(path, detail=True)
    except (OSError, ValueError, ImportError):
        return []  # the job says what is wrong
    found = []
    for name, info in sorted(infos.items()):
        changed = next((info[key] for key in _CHANGED if key in info), "")
        found.append((name.removeprefix(path), int(info.get("size") or 0), str(changed)))
    return found


@contextmanager
def scratch() -> Iterator[Path]:
    """Make an empty temporary folder. Those that killed workers of this machine left behind are removed."""
    parent = Path(tempfile.gettempdir())
    for old in parent.glob(f"{_SCRATCH}*"):
        _remove_orphan(old)
    new = Path(tempfile.mkdtemp(dir=parent))
    with (new / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        folder = new.rename(parent / f"{_SCRATCH}{new.name}")  # locked before others look for it
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def _remove_orphan(folder: Path) -> None:
    with suppress(OSError), (folder / ".lock").open("r") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)


def fetched(recording: Recording, folder: Path, most_gb: float) -> tuple[Path, Path | None]:
    """Bring a recording and its calibration to this machine: URLs are copied to `folder`.

    Returns:
        Their paths here; None for no calibration.

    Raises:
        UsageError: what must be copied is larger than `most_gb` (10^9 bytes).
        OSError: it cannot be fetched.
    """
    names = belongs(recording.place, recording.overrides)
    places = [*names, *([] if recording.rig is None else [recording.rig])]
    remote = [place for place in places if is_url(place)]
    size = sum(stat[1] for place in remote for stat in _remote_stats(place)) * 1e-9
    if size > most_gb:
        raise UsageError(f"{recording.name} has {size:.2f} GB, {most_gb:g} may be fetched (--stage-limit)")
    here = {place: _fetch(place, folder / str(number)) for number, place in enumerate(remote)}
    if len(names) == 2 and names[0] in here:  # the eyes' videos: the right one is found beside the left
        (right := here[names[1]]).rename(here[names[0]].with_name(right.name))
    found = [here.get(place) or Path(place) for place in places]
    return found[0], None if recording.rig is None else found[-1]


def _fetch(url: str, folder: Path) -> Path:
    folder.mkdir()
    try:
        fs, path = url_to_fs(url, use_listings_cache=False)
    except (ValueError, ImportError) as error:
        raise UsageError(f"{url}: {error}") from None
    target = folder / Path(path).name
    fs.get(path, str(target), recursive=not fs.isfile(path))
    if not target.exists():
        raise FileNotFoundError(f"{url} does not exist")
    return target
