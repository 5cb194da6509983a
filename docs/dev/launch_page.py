"""Writes docs/launch.md from the descriptions of `sags_node.config.schema`: `make docs`."""

import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeGuard, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le
from pydantic.fields import FieldInfo

from sags_node.config.schema import (
    LIVE_PARAMETERS,
    BagRobot,
    Box,
    GeometryConfig,
    Guarded,
    LaunchConfig,
    LiveSource,
    Pose,
    PushRobot,
    RecordedSource,
    RobotPoses,
    RobotTool,
    Ros2Robot,
    RosGraph,
    Section,
    Segments,
    SentSource,
)

PAGE = Path(__file__).parents[1] / "launch.md"
HEAD = """# Launch files

<!-- Written by `make docs` from sags_node/config/schema.py. Change it there. -->

A launch file says what the node plays, with which calibration, and how. It is YAML:

```yaml
source:
  kind: videos
  left: left.mp4
  right: right.mp4
rig: ../calib/mine
mapping:
  budget_ms: 33
```

    sags run my_launch.yaml mapping.budget_ms:=25

- The first argument is the path of a launch file, of a folder with a `launch.yaml` in it, or of a
  [recording](recordings.md) that is recognised by its files. Without one the built-in phantom is played.
- `sags new RECORDING -o my_launch.yaml` writes one.
- `sags param set key:=value` changes keys of a running node. They say so below.
- `key:=value` on the command line wins over the file. Keys are written with dots, as in the tables below.
  Values are YAML: `source.right:=null`, `'publish.data:=[tcp://*:5556]'`; but without comments:
  `source.left:='/data/Case #3'` is that folder.
- An unknown key is an error that names the nearest known one. So is a wrong value. The exit code is 2.
- A missing key has its default.
- Paths in a file are relative to the file. Paths on the command line are relative to the folder that you are
  in. `~/` is your home in both.
- `$NAME` in a file is an environment variable, `$$` is a dollar. `$SAGS_DATA` need not be set. It is then
  `../shared/data`, seen from the folder above the launch file's.
- The topic `parameters` shows the configuration of a running node.
"""
WORDS: dict[Any, str] = {
    bool: "`true` or `false`",
    int: "whole number",
    float: "number",
    get_args(Pose)[0]: "4 rows of 4 numbers",
    str: "text",
    Path: "path",
    RobotTool: "map",
    Box: "`[x, y, width, height]`, px",
    Segments: "map",
}
MANY = {
    "whole number": "whole numbers",
    "number": "numbers",
    "path": "paths",
    "text": "texts",
    "map": "maps",
    "whole number or text": "whole numbers or texts",
}


def page() -> str:
    """The whole page: one table for each section."""
    return "\n".join([HEAD, *_tables(LaunchConfig, "", "Top level")])


def _tables(section: type[Section], prefix: str, title: str) -> Iterator[str]:
    yield from _table(section, prefix, title, list(section.model_fields))
    for name, field in section.model_fields.items():
        if field.discriminator is not None:
            yield from _kinds(f"{prefix}{name}.", get_args(field.annotation))
        elif _is_section(field.annotation):
            yield from _tables(field.annotation, f"{prefix}{name}.", f"`{prefix}{name}`")
        elif name == "robot":
            yield from _robot(f"{prefix}{name}.")


def _kinds(prefix: str, sections: tuple[type[Section], ...]) -> Iterator[str]:
    """What all recordings have in common, then what each kind of source has beyond it."""
    yield f"## `{prefix.removesuffix('.')}`: where the images come from\n"
    yield "`source.kind` says which kind of source it is, and so which other keys there are."
    yield "Without `source` it is the `phantom`.\n"
    yield from _tables(RecordedSource, prefix, "Every recording")
    yield from _table(LiveSource, prefix, "Every live kind", list(LiveSource.model_fields))
    geometry = f"{prefix}geometry"
    yield from _tables(GeometryConfig, f"{geometry}.", f"`{geometry}`: videos, bags and every live kind")
    yield from _table(SentSource, prefix, "`ros2` and `push`", list(SentSource.__annotations__))
    yield from _table(RosGraph, prefix, "`ros2`", list(RosGraph.model_fields))
    yield from _table(Guarded, prefix, "`push`", list(Guarded.model_fields))
    for section in sections:
        own = [name for name in section.__annotations__ if name != "kind"]  # what is inherited stands above
        yield from _table(section, prefix, f"`kind: {section.model_fields['kind'].default}`", own)


def _robot(prefix: str) -> Iterator[str]:
    """What all robots have in common, then what each kind has beyond it."""
    yield "## `robot`: poses of the scope\n"
    yield "`robot.kind` says which way poses come. Without `robot` the recording has poses, or none come.\n"
    yield from _table(RobotPoses, prefix, "Every kind of robot", list(RobotPoses.model_fields))
    yield from _table(RobotTool, f"{prefix}tools[].", "Each of `robot.tools`", list(RobotTool.model_fields))
    for section in (Ros2Robot, PushRobot, BagRobot):
        own = [name for name in section.model_fields if name not in {"kind", *RobotPoses.model_fields}]
        yield from _table(section, prefix, f"`robot.kind: {section.model_fields['kind'].default}`", own)


def _table(section: type[Section], prefix: str, title: str, names: list[str]) -> Iterator[str]:
    level = "##" if prefix.count(".") <= 1 and not prefix.startswith(("source.", "robot.")) else "###"
    yield f"{level} {title}\n"
    if section.__doc__:
        yield f"{_linked(section.__doc__)}\n"
    fields = {name: section.model_fields[name] for name in names}
    fields = {n: f for n, f in fields.items() if f.discriminator is None and not _is_section(f.annotation)}
    if not fields:
        return
    yield "| key | value | default | what it does |"
    yield "|---|---|---|---|"
    for name, field in fields.items():
        said, default = _said(field)
        live = ". It can change while the node runs" if f"{prefix}{name}" in LIVE_PARAMETERS else ""
        yield f"| `{prefix}{name}` | {_value(field)} | {default} | {said}{live} |"
    yield ""


def _said(field: FieldInfo) -> tuple[str, str]:
    """What a key does, and its default: a default that depends stands in the description."""
    said, _, depends = (field.description or "").partition("default: ")
    if depends:
        return _linked(said.removesuffix("; ")), _linked(depends)
    if field.is_required():
        return _linked(said), "**must be set**"
    return _linked(said), "none" if field.default is None else f"`{_yaml(field.default)}`"


def _linked(text: str) -> str:
    """Names of other pages as links, in one line of a table."""
    text = re.sub(r"\bdocs/(\w+\.md)", r"[\1](\1)", " ".join(text.split()))
    return text.replace("|", "\\|")


def _yaml(value: Any) -> str:
    """A default as a launch file would say it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_yaml, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _value(field: FieldInfo) -> str:
    alternatives = [get_args(one)[1:] for one in get_args(field.annotation) if get_origin(one) is Annotated]
    return _type(field.annotation) + _limits([*field.metadata, *chain.from_iterable(alternatives)])


def _type(annotation: Any) -> str:
    """The type of a value in a reader's words."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if annotation in WORDS:
        return WORDS[annotation]
    if origin is Annotated:
        return _type(inner[0])
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(_type(one) for one in inner if one is not type(None)))
    if origin is Literal:
        *others, last = (f"`{_yaml(one)}`" for one in inner)
        return f"{', '.join(others)} or {last}" if others else last
    if origin is tuple and annotation != Box:
        one = _type(inner[0])
        many = MANY.get(one, one)
        return f"list of {many}" if inner[-1] is ... else f"list of {len(inner)} {many}"
    return WORDS.get(annotation, "name or map")


def _limits(metadata: list[Any]) -> str:
    """The range of a number."""
    above = next((one.gt for one in metadata if isinstance(one, Gt)), None)
    least = next((one.ge for one in metadata if isinstance(one, Ge)), None)
    most = next((one.le for one in metadata if isinstance(one, Le)), None)
    if least is not None:
        return f", {least} or more" if most is None else f", {least} to {most}"
    if above is not None:
        return f", above {above}" if most is None else f", above {above}, at most {most}"
    return ""


def _is_section(annotation: Any) -> TypeGuard[type[Section]]:
    return isinstance(annotation, type) and issubclass(annotation, Section)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
