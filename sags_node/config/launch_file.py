"""Reads launch files. An unknown key is an error that names the nearest known one."""

import difflib
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any, TypeVar, get_args

from pydantic import ValidationError

from sags_node.config.schema import LaunchConfig, PhantomSource, Section, Source
from sags_node.config.yaml_reader import parse_word, read_yaml
from sags_node.errors import UsageError, brief
from sags_node.files import SHOWN, check_name, open_file

S = TypeVar("S", bound=Section)

MOST_MISTAKES = 10  # in one message
COMMAND_LINE = "command line"
DEFAULT_DATA = "../shared/data"
BAG_SUFFIXES = (".mcap", ".db3", ".bag")
UNFINISHED = ".bag.active"  # of ROS 1, while it is recorded
VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".3gp", ".avi", ".mkv", ".webm", ".wmv", ".asf", ".flv", ".ogv", ".mxf", ".dv"),
    *(".mpg", ".mpeg", ".vob", ".ts", ".mts", ".m2ts", ".h264", ".264", ".hevc", ".h265", ".265"),
)
SIDECAR_TYPE = "dvrk_data:video_sidecar@"
SIDECAR_LOOK = 65536  # bytes at either end; jsoncpp sorts the keys, so the type comes after the frames


_SOURCES: dict[str, type[Section]] = {
    source.model_fields["kind"].default: source for source in get_args(get_args(Source)[0])
}


def load_launch(path: Path | str | None = None, overrides: Sequence[str] = ()) -> LaunchConfig:
    """Read a launch file, or a folder that holds `launch.yaml` or a known recording, and apply `key:=value`
    overrides. Any other folder, or a video, is not read here: `overrides` must say how it is played.

    `$SAGS_DATA` and other variables are expanded; relative paths in the file are relative to the file.
    `path=None` gives the defaults: the built-in phantom session.

    Raises:
        UsageError: the file is missing, is not YAML, or holds an unknown key or a wrong value; a calibration
            is named for the phantom; or there is one camera only, and no network for its depth.
    """
    tree: dict[str, Any] = {"source": {"kind": "phantom"}}
    name = COMMAND_LINE
    if path is not None:
        file = Path(path)
        check_name(file)
        recording = known_recording(file)
        played = any(override.startswith("source.kind:=") for override in overrides)
        if recording is None and not is_launch(file) and played:
            recording = {}
        elif file.is_dir() and recording is None:
            file = file / "launch.yaml"
        name = str(file)
        if recording is not None:
            tree = recording
        else:
            tree = _resolved(_read_yaml(file), file.parent)
    for override in overrides:
        _apply_override(tree, override)
    tree = _with_texts(tree, lambda key, text, is_path: os.path.expanduser(text) if is_path else text)
    try:
        config = LaunchConfig.model_validate(tree)
    except ValidationError as error:
        given = [override.partition(":=")[0] for override in overrides]
        raise UsageError(explain(error, name, given)) from None
    if isinstance(config.source, PhantomSource) and config.rig is not None:
        raise UsageError(
            f"rig: the built-in phantom brings its own calibration; name the launch file or recording that "
            f"{config.rig} is of, or leave rig out"
        )
    if config.one_camera and config.vision.onnx.path is None:
        raise UsageError(
            f"{name}: source.right is missing: name the right eye's images. With one camera alone depth "
            "comes from a monocular network: set vision.onnx.path, and vision.onnx.declared_depth to the "
            "distance to the middle of the first image, m; docs/networks.md has an example under 'One eye'"
        )
    return config


def is_launch(path: Path) -> bool:
    """Tell whether a path is a folder that holds `launch.yaml`, or a file (it need not exist) that is no
    video."""
    if path.is_dir():
        return (path / "launch.yaml").exists()
    return path.suffix.lower() not in VIDEO_SUFFIXES


def tree_of(overrides: Sequence[str]) -> dict[str, Any]:
    """Return the nested sections and keys that these `key:=value` overrides set.

    Raises:
        UsageError: one is no override.
    """
    tree: dict[str, Any] = {}
    for override in overrides:
        _apply_override(tree, override)
    return tree


def leaves(tree: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each value of nested keys, with its full dotted key."""
    for key, value in tree.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, f"{within}{key}.")
        else:
            yield f"{within}{key}", value


def written_in(folder: Path, tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a launch file in this folder must say to be read as this tree: paths from there if they lie
    below it, else from the root, and $$ for each $."""
    here = folder.resolve()

    def written(key: str, text: str, is_path: bool) -> str:
        if is_path:
            path = Path(text).resolve()
            text = str(path.relative_to(here) if path.is_relative_to(here) else path)
        return text.replace("$", "$$")

    return _with_texts(tree, written)


def _with_texts(
    tree: Mapping[str, Any], change: Callable[[str, str, bool], str], section: Any = LaunchConfig
) -> dict[str, Any]:
    """A tree with every text in it changed: `change` gets its key, the text, and whether it is a path.

    Args:
        section: the section of the configuration that has these keys; None: they are unknown.
    """

    def changed(key: str, value: Any) -> Any:
        if isinstance(value, dict):
            sections = _sections_in(section, key)
            if len(sections) > 1:  # `kind` chooses one of them
                named = value.get("kind")
                sections = [each for each in sections if each.model_fields["kind"].default == named]
            return _with_texts(value, change, next(iter(sections), None))
        if isinstance(value, list):
            return [changed(key, item) for item in value]
        return change(key, value, Path in _kinds(section, key)) if isinstance(value, str) else value

    return {key: changed(key, value) for key, value in tree.items()}


def section_of(kind: type[S], overrides: Sequence[str]) -> S:
    """Return a section by itself, as `key:=value` overrides set it.

    Raises:
        UsageError: an unknown key or a wrong value.
    """
    tree = tree_of(overrides)
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        raise UsageError(explain(error, COMMAND_LINE, root=kind)) from None


def known_recording(folder: Path) -> dict[str, Any] | None:
    """Return how to play a ROS bag, a dVRK recording or a known data set; None: it is none of these."""
    if (folder / "launch.yaml").exists():
        return None
    is_folder = folder.is_dir()
    bag = _bag_of(folder)
    if bag is not None:
        return {"source": {"kind": "bag", "path": str(bag)}}
    if any(is_sidecar(file) for file in (folder.glob("*.json") if is_folder else [folder])):
        return {"source": {"kind": "dvrk", "path": str(folder)}}
    if (folder / "poses_bounds.npy").is_file() or all(
        (folder / name).is_dir() for name in ("images", "masks")
    ):
        return {"source": {"kind": "endonerf", "folder": str(folder)}}
    if (folder / "endoscope_calibration.yaml").is_file() or (folder / "data/rgb.mp4").is_file():
        # No instrument is in view; the search for them by colour would only take tissue away.
        return {"source": {"kind": "scared", "folder": str(folder)}, "vision": {"tissue": {"method": "none"}}}
    return None


def _bag_of(path: Path) -> Path | None:
    """The ROS recording that a file or folder is. Its metadata may be missing, as after a recorder was
    killed. A folder with a single bag of ROS 1 counts, too."""
    if path.suffix in BAG_SUFFIXES or path.name.endswith(UNFINISHED):
        return path
    if (path / "metadata.yaml").is_file() or any(path.glob("*.mcap")) or any(path.glob("*.db3")):
        return path
    bags = [*path.glob(f"{SHOWN}.bag"), *path.glob(f"{SHOWN}{UNFINISHED}")]
    return bags[0] if len(bags) == 1 else None


def is_sidecar(file: Path) -> bool:
    """Tell whether a file is the sidecar of a video of dVRK's `record`: its type is near either end of it."""
    if file.suffix != ".json" or not file.is_file():
        return False
    with open_file(file) as opened:
        start = opened.read(SIDECAR_LOOK)
        opened.seek(max(0, file.stat().st_size - SIDECAR_LOOK))
        return SIDECAR_TYPE.encode() in start + opened.read(SIDECAR_LOOK)


def with_parameters(config: LaunchConfig, parameters: Mapping[str, Any]) -> LaunchConfig:
    """Return the configuration with some `section.key` values replaced, validated again.

    Raises:
        UsageError: an unknown key or a wrong value.
    """
    tree = config.model_dump()
    for key, value in parameters.items():
        _set(tree, key, value, key)
    try:
        return LaunchConfig.model_validate(tree)
    except ValidationError as error:
        raise UsageError(explain(error, "parameters")) from None


def _read_yaml(file: Path) -> dict[str, Any]:
    tree = read_yaml(file, "launch file")
    if not tree:
        raise UsageError(f"{file} is empty; write source: into it, or leave it out to play the phantom")
    if not isinstance(tree, dict):
        raise UsageError(f"{file}: a launch file is a map of sections, this is a {type(tree).__name__}")
    return tree


def _resolved(tree: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The tree with variables in every text expanded, and paths relative to the launch file."""
    variables = {"SAGS_DATA": str((folder / ".." / DEFAULT_DATA).resolve()), **os.environ}

    def resolved(key: str, text: str, is_path: bool) -> str:
        template = Template(text)
        unset = [name for name in template.get_identifiers() if name not in variables]
        if unset and is_path:
            raise UsageError(
                f"{key}: {text} uses a variable that is not set; export {unset[0]} first, or write $$ where "
                "a name has a $"
            )
        expanded = template.safe_substitute(variables)
        return str(folder / os.path.expanduser(expanded)) if is_path else expanded

    return _with_texts(tree, resolved)


def _apply_override(tree: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition(":=")
    if not separator or not key:
        raise UsageError(f"'{override}' is not an override; write key:=value, e.g. mapping.budget_ms:=33")
    _set(tree, key, parse_word(text, f"the value of {key}:="), override)


def _set(tree: dict[str, Any], key: str, value: Any, said: str) -> None:
    node = tree
    *parents, leaf = key.split(".")
    for parent in parents:
        node = node.setdefault(parent, {})
        if not isinstance(node, dict):
            raise UsageError(f"'{said}': {parent} is a value, not a section")
    node[leaf] = value


def explain(
    error: ValidationError,
    name: object,
    given: Sequence[str] = (),
    root: type[Section] = LaunchConfig,
    page: str = "docs/launch.md",
) -> str:
    """Return one line per mistake: where, what, and for an unknown key the nearest known one.

    Args:
        name: of the file that was read.
        given: keys that were set on the command line instead.
        root: type of the section that was validated.
        page: that describes its keys; "": none does.
    """
    lines = []
    found = error.errors()
    around = {item["loc"][:depth] for item in found for depth in range(len(item["loc"]))}
    # pydantic calls a list too short whose only item is wrong.
    mistakes = [item for item in found if item["type"] != "too_short" or item["loc"] not in around]
    for item in mistakes[:MOST_MISTAKES]:
        path = [str(part) for part in item["loc"]]
        where = ".".join(part for part in path if part not in _SOURCES)
        said = COMMAND_LINE if any(f"{where}.".startswith(f"{key}.") for key in given) else name
        if item["type"] == "extra_forbidden":
            lines.append(f"{said}: unknown key '{where}'; {_nearest(path, root)}")
        elif item["type"] == "missing":
            lines.append(f"{said}: {where} is missing; set it")
        elif item["type"] in ("union_tag_invalid", "union_tag_not_found"):
            kinds = ", ".join(repr(one.model_fields["kind"].default) for one in _sections_in(root, path[-1]))
            got = item["input"].get("kind")
            said = COMMAND_LINE if f"{where}.kind" in given else name
            lines.append(f"{said}: {where}.kind: should be one of {kinds} (got {brief(got)})")
        else:
            what = _PLAIN.get(item["type"], item["msg"]).removeprefix("Value error, ")
            got = "" if isinstance(item["input"], dict) else f" (got {brief(item['input'])})"
            known = f"; {page}: {about}" if page and (about := _described(path, root)) else ""
            lines.append(f"{said}: {where + ': ' if where else ''}{what}{got}{known}")
    if len(mistakes) > MOST_MISTAKES:
        lines.append(f"{name}: and {len(mistakes) - MOST_MISTAKES} more")
    return "\n".join(lines)


_PLAIN = {  # where pydantic's message names types of Python
    "path_type": "Input should be a path",
    "tuple_type": "Input should be a list, e.g. [a, b]",
    "model_type": "Input should be a section of keys",
    "model_attributes_type": "Input should be a section of keys",
}


def _described(path: Sequence[str], root: type[Section]) -> str:
    """What is said of a key, and so its unit; "" where there is no such key."""
    key = path[-1] if path else ""
    fields = [one.model_fields[key] for one in _sections_at(path[:-1], root) if key in one.model_fields]
    said = next((field.description for field in fields if field.description), "")
    return re.split("[.] |; default: ", said)[0]


def _nearest(path: Sequence[str], root: type[Section]) -> str:
    """The known key that was probably meant: of this section, or one of that name in another."""
    known = _known_keys(path[:-1], root)
    near = difflib.get_close_matches(path[-1], known, n=1, cutoff=0.6)
    if not near:
        near = [f"{part}.{path[-1]}" for part in _SECTIONS if path[-1] in _known_keys([part], LaunchConfig)]
    return f"did you mean '{near[0]}'?" if near else f"known keys: {', '.join(sorted(known))}"


def _known_keys(path: Sequence[str], root: type[Section]) -> list[str]:
    return list(dict.fromkeys(name for one in _sections_at(path, root) for name in one.model_fields))


def _sections_at(path: Sequence[str], root: type[Section]) -> list[type[Section]]:
    """The types that the section at this path may have."""
    there = [root]
    for part in path:  # a key, a kind, or a number in a list
        kinds = [one for one in there if (kind := one.model_fields.get("kind")) and kind.default == part]
        inner = [section for one in there for section in _sections_in(one, part)]
        there = kinds or inner or there
    return there


def _sections_in(section: type[Section] | None, key: str) -> list[type[Section]]:
    """The types of the sections that a key may hold: one, one of several, or a list of them."""
    return [kind for kind in _kinds(section, key) if isinstance(kind, type) and issubclass(kind, Section)]


def _kinds(section: type[Section] | None, key: str) -> list[Any]:
    """The type of a key, and all type arguments in it."""
    field = None if section is None else section.model_fields.get(key)
    kinds: list[Any] = [] if field is None else [field.annotation]
    for kind in kinds:  # the list grows meanwhile
        kinds += get_args(kind)
    return kinds


_SECTIONS = ("vision", "engine", "mapping", "publish")
